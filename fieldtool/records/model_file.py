"""``model.yaml``: read and write a machine model, with file and line in every error."""

from collections.abc import Mapping
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import Field

from fieldtool.errors import FileFormatError
from fieldtool.records.model import MachineModel
from fieldtool.records.yaml_file import (
    Number,
    Path_,
    StrictModel,
    line_of,
    read_checked,
    write_yaml,
)

EffectName = Literal[
    "viscous_friction",
    "coulomb_friction",
    "stribeck_friction",
    "asymmetric_friction",
    "backlash",
    "hardening_spring",
    "softening_spring",
    "structural_damping",
    "gravity",
    "cogging",
    "torque_scale",
    "torque_lag",
    "measurement_delay",
    "encoder_error",
    "extra_mode",
    "coupling_spring",
    "coupling_inertia",
    "periodic_disturbance",
    "stiffness_change",
    "torque_saturation",
]


class _Estimate(StrictModel):
    value: Number
    std: Number | None = Field(default=None, ge=0)


class _Parameter(_Estimate):
    unit: str | None = None


class _Axis(StrictModel):
    name: str = Field(min_length=1)
    kind: Literal["rotary", "linear"]
    masses: list[_Estimate | Number] = Field(min_length=1)
    springs: list[_Estimate | Number] | None = None
    dampers: list[_Estimate | Number] | None = None


class _Coupling(_Estimate):
    axes: tuple[str, str]


class _Effect(StrictModel):
    effect: EffectName
    axis: str | tuple[str, ...] | None = None
    location: str | None = None
    parameters: dict[str, _Parameter | Number]


class _Correlation(StrictModel):
    names: list[str]
    rows: list[list[Number]]


class _ModelFile(StrictModel):
    format: Literal["fieldtool-model/1"]
    axes: list[_Axis] = Field(min_length=1)
    couplings: list[_Coupling] | None = None
    effects: list[_Effect] | None = None
    correlation: _Correlation | None = None


_PARTS = {
    "masses": ("mass", {"rotary": "kg m2", "linear": "kg"}),
    "springs": ("spring", {"rotary": "N m/rad", "linear": "N/m"}),
}
"""Words, and units by kind.  Dampers may be below 0 within their errors: fits find them so."""
_COUPLED = ("kg", "kg m", "kg m2")
"""Units of a coupling by how many of its axes are rotary."""


def read_model(path: Path | str) -> MachineModel:
    """Return the model in the file ``path`` (format ``fieldtool-model/1``, motor side first).

    Raises
    ------
    FileFormatError
        If the file is missing, larger than 1 MiB, not YAML, or not a model: an unknown or missing
        key, a value that is no number, chains that do not fit together, a mass or spring that is
        not above 0, couplings larger than their masses allow. File and line are named.
    """
    checked, lines = read_checked(path, _ModelFile)
    names = [axis.name for axis in checked.axes]
    for index, effect in enumerate(checked.effects or ()):
        axes = (effect.axis,) if isinstance(effect.axis, str) else effect.axis or ()
        for axis in axes:
            if axis not in names:
                raise FileFormatError(
                    path,
                    f"effect {effect.effect} is on axis '{axis}', the axes are {', '.join(names)}.",
                    line_of(lines, ("effects", index, "axis")),
                )
    _refuse_impossible(path, checked, lines)
    try:
        model = MachineModel.from_dict(checked.model_dump(exclude_unset=True))
    except KeyError as error:
        raise FileFormatError(path, f"is no machine model: {error} is missing.") from error
    except (ValueError, TypeError) as error:
        raise FileFormatError(path, f"is no machine model: {error}.") from error
    _refuse_couplings(path, model, lines)
    return model


def _refuse_impossible(path: Path | str, checked: _ModelFile, lines: Mapping[Path_, int]) -> None:
    for index, axis in enumerate(checked.axes):
        for key, chain in (("masses", axis.masses), ("springs", axis.springs or ())):
            what, units = _PARTS[key]
            for k, one in enumerate(chain):
                value = one.value if isinstance(one, _Estimate) else one
                if value > 0:
                    continue
                raise FileFormatError(
                    path,
                    f"axis '{axis.name}': {what} {k + 1} (motor side first) is {value:g} "
                    f"{units[axis.kind]}, it has to be above 0: correct it, or identify the axis again.",
                    line_of(lines, ("axes", index, key, k, "value")),
                )


def _refuse_couplings(path: Path | str, model: MachineModel, lines: Mapping[Path_, int]) -> None:
    """Scaled by its masses, as axes of kg and kg m2 stand in one matrix."""
    matrix = model.mass_matrix
    scale = np.sqrt(np.diag(matrix))
    smallest = float(np.linalg.eigvalsh(matrix / np.outer(scale, scale))[0])
    if smallest > 0:
        return
    last = dict(zip(model.names, model.last_masses, strict=True))
    shares = []
    for one in model.couplings:
        a, b = (last[name] for name in one.axes)
        shares.append(abs(one.value) / float(scale[a] * scale[b]))
    worst = int(np.argmax(shares))
    coupling = model.couplings[worst]
    kinds = {axis.name: axis.kind for axis in model.axes}
    unit = _COUPLED[sum(kinds[name] == "rotary" for name in coupling.axes)]
    raise FileFormatError(
        path,
        f"the couplings are larger than the last masses of their axes allow (the mass matrix is not "
        f"positive definite); the largest is that of axes {' and '.join(coupling.axes)}, "
        f"{coupling.value:g} {unit}, {shares[worst]:.3g} times what their masses allow of one alone: "
        "correct couplings or masses, or identify the machine again.",
        line_of(lines, ("couplings", worst, "value")),
    )


def write_model(model: MachineModel, path: Path | str) -> None:
    """Write ``model`` to ``path``; every number survives exactly.

    Raises
    ------
    OutputError
        If the file can not be written.
    """
    write_yaml(path, model.as_dict())
