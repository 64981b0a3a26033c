"""A machine with some effects, and what it says of every experiment."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fieldtool.criticise.effects.base import Effect
from fieldtool.criticise.evidence.lines import Lines, flat
from fieldtool.criticise.evidence.spans import Role
from fieldtool.criticise.search.machine import Machine
from fieldtool.criticise.simulate.inverse import Driven
from fieldtool.criticise.simulate.motion import Motion
from fieldtool.criticise.simulate.structure import Structure

FloatArray = NDArray[np.float64]
KEPT = 48
"""Simulations of the chains that are remembered."""
READY = 4
"""Structures that are remembered ready to be driven."""
SEVERAL = ("cogging", "encoder_error", "extra_mode", "periodic_disturbance")
"""Effects of which there may be more than one at a place."""
THINNED = 3
"""Every so many rows count where the first state of the hidden masses is found."""


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """Values of the machine, and effects with theirs."""

    machine: Machine
    base: FloatArray
    effects: tuple[Effect, ...] = ()
    values: tuple[Mapping[str, float], ...] = ()

    @cached_property
    def off(self) -> frozenset[str]:
        """Variables of the machine that stand still at zero: an effect contains them."""
        names = self.machine.model.names
        return frozenset(
            f"{names[e.axis]}.{what}" for e in self.effects for what in e.replaces
        ) & frozenset(self.machine.names)

    @cached_property
    def structure(self) -> Structure:
        """The machine with what effects change of it."""
        structure = Structure.of(self.machine.with_values(self.base))
        for effect, values in zip(self.effects, self.values, strict=True):
            structure = effect.structure(structure, values)
        return structure

    def place_of(self, effect: Effect) -> int:
        """Return where an effect stands among all."""
        keys = [e.key for e in self.effects]
        return len(keys) - 1 - keys[::-1].index(effect.key)

    def with_effect(self, effect: Effect) -> "Hypothesis":
        """Add one effect at its start values; what it contains goes."""
        alike = [e for e in self.effects if e.name == effect.name and e.key[:4] == effect.key[:4]]
        if alike and effect.name in SEVERAL:
            effect = replace(effect, number=1 + max(e.number for e in alike))
        kept = [
            (e, v)
            for e, v in zip(self.effects, self.values, strict=True)
            if not (e.axis == effect.axis and e.name in effect.replaces) and e.key != effect.key
        ]
        start = {p.name: p.start for p in effect.parameters}
        grown = replace(
            self,
            effects=(*(e for e, _ in kept), effect),
            values=(*(v for _, v in kept), start),
        )
        base = self.base.copy()
        for k, name in enumerate(self.machine.names):
            if name in grown.off:
                base[k] = 0.0
        return replace(grown, base=base)

    def without(self, place: int) -> "Hypothesis":
        """Leave one effect out."""
        less = replace(
            self,
            effects=self.effects[:place] + self.effects[place + 1 :],
            values=self.values[:place] + self.values[place + 1 :],
        )
        base = self.base.copy()
        for k, name in enumerate(self.machine.names):
            if name in self.off - less.off:
                base[k] = self.machine.variables[k].value
        return replace(less, base=base)


@dataclass(eq=False)
class Simulator:
    """Errors of hypotheses in the rows that are compared; remembers what it simulated."""

    motions: Mapping[str, Motion]
    lines: tuple[Lines, ...]

    def __post_init__(self) -> None:
        self._kept: dict[bytes, FloatArray] = {}
        self._ready: dict[bytes, Driven] = {}
        self._courses: dict[bytes, FloatArray] = {}
        self._bases: dict[tuple[Any, ...], FloatArray] = {}

    def errors(self, hypothesis: Hypothesis) -> dict[str, FloatArray]:
        """Return the torque measured less simulated, (n, M), by experiment."""
        return {name: m.torque - self.torque(hypothesis, m) for name, m in self.motions.items()}

    def torque(self, hypothesis: Hypothesis, motion: Motion) -> FloatArray:
        """Return the torque that the drives would report for the measured motion, (n, M)."""
        pairs = list(zip(hypothesis.effects, hypothesis.values, strict=True))
        moved, moves = motion, motion.experiment
        for effect, values in pairs:
            other = effect.motion(moved, values)
            if other is not moved:
                moves += repr((effect.key, sorted(values.items())))
                moved = other
        structure = hypothesis.structure.between(*motion.clock[[0, -1]])
        needed = self._remembered(moves.encode(), structure, moved).copy()
        for effect, values in pairs:
            besides = effect.torque(moved, values)
            if besides is not None:
                needed[:, effect.axis] += besides
        for effect, values in pairs:
            needed[:, effect.axis] = effect.reported(needed[:, effect.axis], motion, values)
        needed += hypothesis.machine.offsets(hypothesis.base)
        return needed

    def residual(self, hypothesis: Hypothesis, role: Role) -> FloatArray:
        """Return the weighted error of all spans of one role, end to end."""
        parts = self.parts(hypothesis, role)
        return np.concatenate([values for _, values in parts]) if parts else np.zeros(0)

    def degrees(self, role: Role) -> int:
        """Return how many rows of :meth:`residual` are free: those of weight, less what is not known."""
        lines = [one for one in self.lines if one.span.role == role]
        return sum(2 * np.count_nonzero(one.weight) - one.free.shape[1] for one in lines)

    def parts(self, hypothesis: Hypothesis, role: Role) -> list[tuple[Lines, FloatArray]]:
        """Return the weighted error of each span of one role."""
        errors: dict[str, FloatArray] = {}
        out = []
        for lines in self.lines:
            if lines.span.role != role:
                continue
            name = lines.span.experiment
            if name not in errors:
                motion = self.motions[name]
                errors[name] = motion.torque - self.torque(hypothesis, motion)
            values = lines.projected(lines.weighted(errors[name]))
            out.append((lines, values - self._unknown_part(hypothesis, lines, values)))
        return out

    def _unknown_part(
        self, hypothesis: Hypothesis, lines: Lines, values: FloatArray
    ) -> FloatArray | float:
        """Return what torques of a size of their own explain of weighted lines; their basis is kept."""
        names = [
            (e.key, tuple(sorted(v.items())))
            for e, v in zip(hypothesis.effects, hypothesis.values, strict=True)
            if e.name == "periodic_disturbance"
        ]
        if not names:
            return 0.0
        key = (self.lines.index(lines), *names)
        if key not in self._bases:
            _make_room(self._bases, KEPT)
            self._bases[key] = _unknown_basis(hypothesis, lines)
        basis = self._bases[key]
        return np.asarray(basis @ (basis.T @ values))

    def _remembered(self, moves: bytes, structure: Structure, motion: Motion) -> FloatArray:
        key = moves + b"|" + structure.key
        if key not in self._kept:
            _make_room(self._kept, KEPT)
            self._kept[key] = self._less_free_motion(structure, motion)
        return self._kept[key]

    def _driven(self, structure: Structure, step: float) -> Driven:
        """Return a structure ready to be driven."""
        if structure.key not in self._ready:
            _make_room(self._ready, READY)
            self._ready[structure.key] = Driven.of(structure, step)
        return self._ready[structure.key]

    def _less_free_motion(self, structure: Structure, motion: Motion) -> FloatArray:
        """Return the needed torque from the hidden masses' first state that suits the data best.

        The first state is not measured; a wrong one rings on at the structure's own frequencies.
        """
        driven = self._driven(structure, motion.step)
        needed = driven.needed(motion)
        if not structure.hidden.size or not np.all(np.isfinite(needed)):
            return needed  # what runs away is no better than anything
        courses = self._free_motions(driven)
        some = slice(0, courses.shape[1] * THINNED, THINNED)
        counted = motion.counted[some]
        columns = (courses[:, : counted.shape[0]] * counted).reshape(courses.shape[0], -1)
        side = ((motion.torque[some] - needed[some]) * counted).ravel()
        size = np.linalg.norm(columns, axis=1)
        if not np.all(np.isfinite(size)):  # what it rings on as grows beyond all bounds
            return np.full_like(needed, np.inf)
        size[size == 0.0] = 1.0
        columns /= size[:, None]
        start = np.zeros((1, driven.system.rates.shape[0]))
        solved = np.linalg.lstsq(columns @ columns.T, columns @ side, rcond=1e-12)[0] / size
        start[0, : solved.size] = solved
        rows = min(motion.rows, courses.shape[1] * THINNED)
        needed[:rows] += driven.system.free_from(start, motion.step, rows)[0]
        return needed

    def _free_motions(self, driven: Driven) -> FloatArray:
        """Return what each state of the hidden masses rings on as, every third row."""
        key = replace(driven.structure, elements=()).key
        if key not in self._courses:
            _make_room(self._courses, READY)
            thinned = -(-max(m.rows for m in self.motions.values()) // THINNED)
            self._courses[key] = driven.system.free_torques(driven.step * THINNED, thinned)
        return self._courses[key]


def _make_room(kept: dict[Any, Any], most: int) -> None:
    """Forget the oldest until one more may be kept."""
    while len(kept) >= most:
        kept.pop(next(iter(kept)))


def unknown_courses(hypothesis: Hypothesis, motion: Motion) -> list[FloatArray]:
    """Return torques, (n, M) each, of which each experiment has its own size, if it has any."""
    out = []
    for effect, values in zip(hypothesis.effects, hypothesis.values, strict=True):
        if effect.name != "periodic_disturbance":
            continue
        axes = range(motion.position.shape[1]) if effect.spreads else (effect.axis,)
        for course in effect.unknown(motion, values):
            for axis in axes:
                full = np.zeros_like(motion.position)
                full[:, axis] = course
                out.append(full)
    return out


def _unknown_basis(hypothesis: Hypothesis, lines: Lines) -> FloatArray:
    """Return orthonormal columns that span the weighted lines of torques of a size of their own."""
    columns = [
        lines.projected(flat(lines.raw(full) * lines.weight))
        for full in unknown_courses(hypothesis, lines.motion)
    ]
    stacked = np.column_stack(columns) if columns else np.zeros((2 * lines.weight.size, 0))
    size = np.linalg.norm(stacked, axis=0)
    q, _ = np.linalg.qr(stacked[:, size > 0] / size[size > 0])
    return np.asarray(q)
