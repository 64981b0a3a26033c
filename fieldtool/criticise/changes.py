"""Which numbers of a machine changed since it was last accepted, in words."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import isfinite, sqrt

from fieldtool.records.model import Estimate, MachineModel

SURE = 3.0
"""Standard errors from which a number has changed."""
MATTERS = 0.02
"""Relative change from which it is worth a word."""
SAME_FACTOR = 0.02
"""Spread of the factors of all numbers of one axis, within which they changed together."""


@dataclass(frozen=True)
class Change:
    """One number, before and now."""

    axis: str
    what: str
    """``mass 1``, ``spring 2``, ``damper 1``, ``viscous friction``, or ``coupling`` (of two axes)."""
    before: float
    now: float
    std: float
    """Of what is known of the difference."""
    unit: str

    @property
    def factor(self) -> float:
        """Now over before."""
        return self.now / self.before if self.before else float("inf")


def changes(before: MachineModel, now: MachineModel) -> tuple[Change, ...]:
    """Return what changed beyond its uncertainty, masses first.

    Numbers whose standard errors are not known in either model are compared by their size alone.
    """
    out: list[Change] = []
    for old in before.axes:
        new = next((axis for axis in now.axes if axis.name == old.name), None)
        if new is None:
            continue
        units = _units(old.kind)
        for what, one, other in (
            ("mass", old.masses, new.masses),
            ("spring", old.springs, new.springs),
            ("damper", old.dampers, new.dampers),
        ):
            if len(one) == len(other):
                out += [
                    Change(old.name, f"{what} {k + 1}", a.value, b.value, _std(a, b), units[what])
                    for k, (a, b) in enumerate(zip(one, other, strict=True))
                    if _changed(a, b)
                ]
        a, b = old.viscous_friction, new.viscous_friction
        if _changed(a, b):
            out.append(
                Change(old.name, "viscous friction", a.value, b.value, _std(a, b), units["damper"])
            )
    held = {frozenset(c.axes): c for c in before.couplings}
    for c in now.couplings:
        was = held.get(frozenset(c.axes))
        a, b = Estimate(was.value if was else 0.0), Estimate(c.value, c.std)
        if _changed(a, b):
            kind = next(axis.kind for axis in now.axes if axis.name == c.axes[0])
            unit = _units(kind)["mass"]
            out.append(Change(" - ".join(c.axes), "coupling", a.value, b.value, _std(a, b), unit))
    return tuple(out)


def change_sentences(before: MachineModel, now: MachineModel) -> tuple[str, ...]:
    """Say what changed, and what did not, one sentence an axis."""
    found = changes(before, now)
    out = []
    for axis in before.axes:
        mine = [c for c in found if c.axis == axis.name]
        firm = [c for c in mine if c.what.startswith(("mass", "spring"))]
        count = len(axis.masses) + len(axis.springs)
        if not mine:
            out.append(f"{axis.name}: unchanged since it was last accepted.")
            continue
        words = ", ".join(f"{c.what} {c.before:.4g} -> {c.now:.4g} {c.unit}" for c in mine)
        sentence = f"{axis.name}: {words}"
        factor = _together(firm, count)
        if factor is not None:
            sentence += (
                f"; all its masses and springs changed by the same factor of {factor:.4g}: as of a "
                "wrong scale of the torque. The motor's data sheet (motor_inertia) tells both apart"
            )
        elif len(firm) < count:
            rest = [
                name
                for name in (
                    *(f"mass {k + 1}" for k in range(len(axis.masses))),
                    *(f"spring {k + 1}" for k in range(len(axis.springs))),
                )
                if name not in {c.what for c in firm}
            ]
            sentence += f"; {', '.join(rest)} unchanged"
        out.append(sentence + ".")
    out += [
        f"{c.axis}: coupling {c.before:.4g} -> {c.now:.4g} {c.unit}."
        for c in found
        if c.what == "coupling"
    ]
    return tuple(out)


def _together(found: Sequence[Change], count: int) -> float | None:
    """Return the factor by which all masses and springs of an axis changed; None if not one."""
    if len(found) < count or count < 2:
        return None
    factors = [c.factor for c in found]
    middle = sum(factors) / len(factors)
    spread = max(abs(f - middle) for f in factors)
    return middle if spread < SAME_FACTOR * middle else None


def _changed(a: Estimate, b: Estimate) -> bool:
    apart = abs(b.value - a.value)
    if apart <= MATTERS * max(abs(a.value), abs(b.value)):
        return False
    std = _std(a, b)
    return not isfinite(std) or apart > SURE * std


def _std(a: Estimate, b: Estimate) -> float:
    known = [e.std for e in (a, b) if isfinite(e.std)]
    return sqrt(sum(s * s for s in known)) if known else float("nan")


def _units(kind: str) -> dict[str, str]:
    if kind == "rotary":
        return {"mass": "kg m2", "spring": "N m/rad", "damper": "N m s/rad"}
    return {"mass": "kg", "spring": "N/m", "damper": "N s/m"}
