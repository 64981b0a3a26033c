"""The numbers of a model one by one, with their units, as tables show them."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import isfinite

from fieldtool.records.model import Estimate, Kind, MachineModel

UNITS = {
    "rotary": {
        "mass": "kg m2",
        "spring": "N m/rad",
        "damper": "N m s/rad",
        "position": "rad",
        "torque": "N m",
    },
    "linear": {"mass": "kg", "spring": "N/m", "damper": "N s/m", "position": "m", "torque": "N"},
}
CONFIDENCE = 1.96
"""Standard errors to either side of a 95 % interval."""


@dataclass(frozen=True)
class ModelNumber:
    """One number of a model."""

    axis: str
    """Or both, of what joins two."""
    what: str
    """``mass 1``, ``spring 2``, ``viscous friction, motor``, ``backlash, gap`` ..."""
    value: Estimate
    unit: str

    @property
    def interval(self) -> str:
        """Half the width of the 95 % interval, in words where it is not known."""
        std = self.value.std
        return f"{CONFIDENCE * std:.2g}" if isfinite(std) else "not known"


def units_of(kind: Kind, torque_unit: str) -> dict[str, str]:
    """Return the units of masses, springs and dampers for a torque in N m, N, or A (motor current)."""
    if torque_unit != "A":
        return UNITS[kind]
    position = UNITS[kind]["position"]
    return {
        "mass": f"A s2/{position}",
        "spring": f"A/{position}",
        "damper": f"A s/{position}",
        "position": position,
        "torque": "A",
    }


def model_numbers(model: MachineModel, torque_units: Sequence[str] = ()) -> tuple[ModelNumber, ...]:
    """Return all numbers of a model: chains, couplings, effects.

    Parameters
    ----------
    model : MachineModel
    torque_units : sequence of str
        One an axis; N m or N where left out.
    """
    out: list[ModelNumber] = []
    units = [
        units_of(axis.kind, torque_units[k] if torque_units else "")
        for k, axis in enumerate(model.axes)
    ]
    for axis, unit in zip(model.axes, units, strict=True):
        for what, values in (
            ("mass", axis.masses),
            ("spring", axis.springs),
            ("damper", axis.dampers),
        ):
            out += [
                ModelNumber(axis.name, f"{what} {k + 1}", value, unit[what])
                for k, value in enumerate(values)
            ]
        out += [
            ModelNumber(axis.name, f"viscous friction, {where}", value, unit["damper"])
            for where, value in (("motor", axis.viscous_friction), ("load", axis.load_friction))
            if value.value != 0.0
        ]
    out += [
        ModelNumber(" - ".join(c.axes), "coupling", Estimate(c.value, c.std), _coupled(*masses))
        for c in model.couplings
        for masses in [[units[model.names.index(name)]["mass"] for name in c.axes]]
    ]
    for effect in model.effects:
        axis_name = effect.get("axis")
        words = axis_name if isinstance(axis_name, str) else " - ".join(axis_name or ())
        place = f" ({effect['location']})" if effect.get("location") else ""
        for name, found in effect["parameters"].items():
            held = found if isinstance(found, dict) else {"value": found}
            std = held.get("std")
            out.append(
                ModelNumber(
                    words,
                    f"{str(effect['effect']).replace('_', ' ')}{place}, {name.replace('_', ' ')}",
                    Estimate(float(held["value"]), float("nan") if std is None else float(std)),
                    str(held.get("unit") or ""),
                )
            )
    return tuple(out)


def _coupled(one: str, other: str) -> str:
    """Return the unit of a coupling of axes with these units of mass; empty where it has none."""
    if one == other:
        return one
    return "kg m" if {one, other} == {"kg", "kg m2"} else ""
