"""``model.yaml``: read and write a machine model, with file and line in every error."""

from pathlib import Path
from typing import Literal

from pydantic import Field

from fieldtool.errors import FileFormatError
from fieldtool.records.model import MachineModel
from fieldtool.records.yaml_file import Number, StrictModel, line_of, read_checked, write_yaml

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


def read_model(path: Path | str) -> MachineModel:
    """Return the model in the file ``path`` (format ``fieldtool-model/1``, motor side first).

    Raises
    ------
    FileFormatError
        If the file is missing, larger than 1 MiB, not YAML, or not a model: an unknown or missing
        key, a value that is no number, chains that do not fit together. File and line are named.
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
    try:
        return MachineModel.from_dict(checked.model_dump(exclude_unset=True))
    except KeyError as error:
        raise FileFormatError(path, f"is no machine model: {error} is missing.") from error
    except (ValueError, TypeError) as error:
        raise FileFormatError(path, f"is no machine model: {error}.") from error


def write_model(model: MachineModel, path: Path | str) -> None:
    """Write ``model`` to ``path``; every number survives exactly.

    Raises
    ------
    OutputError
        If the file can not be written.
    """
    write_yaml(path, model.as_dict())
