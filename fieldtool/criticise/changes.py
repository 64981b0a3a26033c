"""Which numbers of a machine changed since it was last accepted, in words."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import isfinite, nan, sqrt

from fieldtool.records.model import AxisModel, Estimate, MachineModel

SURE = 3.0
"""Standard errors from which a number has changed."""
MATTERS = 0.02
"""Relative change from which it is worth a word."""
SAME_FACTOR = 0.02
"""Spread of the factors of all numbers of one axis, within which they changed together."""

MASSES = "masses"
"""What changed where a chain has another length."""


@dataclass(frozen=True)
class Change:
    """One number, before and now."""

    axis: str
    what: str
    """``mass 1``, ``spring 2``, ``damper 1``, ``viscous friction``, ``load friction``, ``coupling``
    of two axes; of chains of other lengths ``masses`` (how many), ``total inertia``, ``total mass``."""
    before: float
    now: float
    std: float
    """Of what is known of the difference."""
    unit: str

    @property
    def factor(self) -> float:
        """Now over before."""
        return self.now / self.before if self.before else float("inf")

    @property
    def words(self) -> str:
        """``mass 2 4.1 -> 5.6 kg m2``, ``2 masses -> 3``."""
        if self.what == MASSES:
            return f"{self.before:.0f} {'mass' if self.before == 1 else 'masses'} -> {self.now:.0f}"
        return f"{self.what} {self.before:.4g} -> {self.now:.4g} {self.unit}"


def changes(before: MachineModel, now: MachineModel) -> tuple[Change, ...]:
    """Return what changed beyond its uncertainty, masses first.

    Numbers whose standard errors are not known in either model are compared by their size alone.  Of
    chains of other lengths the numbers of masses and their sums are compared.
    """
    out: list[Change] = []
    for old in before.axes:
        new = next((axis for axis in now.axes if axis.name == old.name), None)
        if new is not None:
            out += _of_chain(old, new)
    kinds = {axis.name: axis.kind for axis in (*before.axes, *now.axes)}
    held, found = _by_axes(before), _by_axes(now)
    for axes in held | found:
        a, b = (m.get(axes, Estimate(0.0)) for m in (held, found))
        if _changed(a, b):
            pair = next(c.axes for c in (*now.couplings, *before.couplings) if axes == {*c.axes})
            ends = {kinds[name] for name in pair}
            unit = _units(kinds[pair[0]])["mass"] if len(ends) == 1 else "kg m"
            out.append(Change(" - ".join(pair), "coupling", a.value, b.value, _std(a, b), unit))
    return tuple(out)


def _of_chain(old: AxisModel, new: AxisModel) -> list[Change]:
    units = _units(old.kind)
    pairs = [
        (f"{what} {k + 1}", a, b, units[what])
        for what, one, other in (
            ("mass", old.masses, new.masses),
            ("spring", old.springs, new.springs),
            ("damper", old.dampers, new.dampers),
        )
        if len(one) == len(other)
        for k, (a, b) in enumerate(zip(one, other, strict=True))
    ]
    counts = len(old.masses), len(new.masses)
    out = []
    if counts[0] != counts[1]:
        out.append(Change(old.name, MASSES, *counts, nan, ""))
        total = "total inertia" if old.kind == "rotary" else "total mass"
        pairs = [(total, _total(old), _total(new), units["mass"])]
    pairs += [
        ("viscous friction", old.viscous_friction, new.viscous_friction, units["damper"]),
        ("load friction", old.load_friction, new.load_friction, units["damper"]),
    ]
    out += [
        Change(old.name, what, a.value, b.value, _std(a, b), unit)
        for what, a, b, unit in pairs
        if _changed(a, b)
    ]
    return out


def _total(axis: AxisModel) -> Estimate:
    """Sum of an axis' masses, whose errors are taken for independent."""
    return Estimate(axis.total_mass, sqrt(sum(m.std**2 for m in axis.masses)))


def _by_axes(model: MachineModel) -> dict[frozenset[str], Estimate]:
    return {frozenset(c.axes): Estimate(c.value, c.std) for c in model.couplings}


def change_sentences(before: MachineModel, now: MachineModel) -> tuple[str, ...]:
    """Say what changed, and what did not, one sentence an axis."""
    found = changes(before, now)
    out = [
        f"{axis.name}: {_chain_words(axis, [c for c in found if c.axis == axis.name])}."
        for axis in before.axes
        if axis.name in now.names
    ]
    out += [f"{c.axis}: {c.words}." for c in found if c.what == "coupling"]
    return tuple(out)


def _chain_words(axis: AxisModel, mine: Sequence[Change]) -> str:
    if not mine:
        return "unchanged since it was last accepted"
    words = ", ".join(c.words for c in mine)
    if mine[0].what == MASSES:
        return words.replace(", ", "; ", 1)
    firm = [c for c in mine if c.what.startswith(("mass", "spring"))]
    count = len(axis.masses) + len(axis.springs)
    factor = _together(firm, count)
    if factor is not None:
        return (
            f"{words}; all its masses and springs changed by the same factor of {factor:.4g}: as of a "
            "wrong scale of the torque. The motor's data sheet (motor_inertia) tells both apart"
        )
    if len(firm) == count:
        return words
    names = (
        *(f"mass {k + 1}" for k in range(len(axis.masses))),
        *(f"spring {k + 1}" for k in range(len(axis.springs))),
    )
    rest = [name for name in names if name not in {c.what for c in firm}]
    return f"{words}; {', '.join(rest)} unchanged"


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
