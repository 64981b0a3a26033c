"""Whether modes are those of chains that are coupled at their last masses only.

What the reduction finds where a machine of chains has zeros: row phi_a across row phi_b means that
no inertia couples masses a and b; a zero of K means that no spring does; and the force on a
chain's end that its last spring does not explain means that the chain goes on.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.stats import norm

from fieldtool.identify.chains.block_lanczos import ChainRows
from fieldtool.identify.likelihood.least_squares import standard_errors

FloatArray = NDArray[np.float64]
TestKind = Literal["inertia", "spring", "end"]
FALSE_ALARM = 1e-3
"""Chance that any of all tests of a sound machine is called significant."""
NEGLIGIBLE = 0.005
"""Couplings below this share of their neighbours are no doubt about the structure."""


@dataclass(frozen=True)
class StructureTest:
    """One number that is zero in a machine of chains coupled at their ends."""

    kind: TestKind
    """An inertia or a spring between two masses, or an end that is none."""
    places: tuple[tuple[str, int], tuple[str, int]]
    """Axis and mass, counted from 1 at the motor; the same twice for an end."""
    value: float
    """Inertia over the geometric mean of both masses; spring over that of the springs at both
    masses; force of an end that its spring does not explain, over the spring."""
    std: float
    significant: bool
    """Too large for noise, with the number of tests taken into account."""

    @property
    def sentence(self) -> str:
        """What it would mean, for a person."""
        (one, k), (other, m) = self.places
        size = f"{self.value:.3g} +- {self.std:.1g}"
        if self.kind == "end":
            return (
                f"the chain of {one} does not seem to end at mass {k} ({size} of its last spring is "
                "not explained): it goes on, or its end is held by something"
            )
        what, of = ("an inertia", "masses") if self.kind == "inertia" else ("a spring", "springs")
        return (
            f"{one} mass {k} and {other} mass {m} seem to be coupled by {what} ({size} of the "
            f"geometric mean of their {of}): a coupling in an unexpected place"
        )


@dataclass(frozen=True)
class _Place:
    """Two rows and what would be between them."""

    kind: TestKind
    one: int
    other: int


def _places(rows: ChainRows) -> list[_Place]:
    """All tests in the order in which the reduction comes upon them.

    An inertia between masses k and m of two chains first shows after k + m steps from motor to
    motor, a spring one step later; so do others as far along the path, of which those between
    masses of equal number come first.
    """
    ends = {int(e) for e in rows.end_rows}
    found: list[tuple[tuple[int, int, int], _Place]] = []
    for a, (i, k) in enumerate(rows.places):
        for b, (j, m) in enumerate(rows.places[:a]):
            if i == j:
                continue
            apart = abs(k - m)
            if not (a in ends and b in ends):
                found.append(((k + m, apart, 0), _Place("inertia", b, a)))
            found.append(((k + m + 1, apart, 1), _Place("spring", b, a)))
    last = 2 * max(rows.lengths)
    if len(rows.lengths) > 1:
        found += [((last, 0, 2), _Place("end", e, e)) for e in sorted(ends)]
    return [place for _, place in sorted(found, key=lambda pair: pair[0])]


def structure_values(rows: ChainRows, resonances: FloatArray) -> FloatArray:
    """Dimensionless values of all tests of all variants, shape (B, T)."""
    length = np.sqrt((rows.rows**2).sum(axis=2))
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        unit = rows.rows / length[:, :, None]
        cosines = unit @ unit.transpose(0, 2, 1)
        stiffness = rows.stiffness_matrix(resonances)
        held = _springs_at(rows, resonances)
        scale = np.sqrt(np.abs(held[:, :, None] * held[:, None, :]))
        unexplained = stiffness - _chain_stiffness(rows)
        relative = unexplained / scale
    values = [
        -cosines[:, p.one, p.other]
        if p.kind == "inertia"
        else (1.0 if p.kind == "end" else -1.0) * relative[:, p.one, p.other]
        for p in _places(rows)
    ]
    return np.reshape(values, (len(values), rows.rows.shape[0])).T


def _chain_stiffness(rows: ChainRows) -> FloatArray:
    """K of the springs that were found, shape (B, sum N, sum N)."""
    matrix = np.zeros((*rows.masses.shape, rows.masses.shape[1]))
    joints = [a for a, (i, k) in enumerate(rows.places) if k < rows.lengths[i] - 1]
    for spring, a in enumerate(joints):
        k = rows.springs[:, spring]
        matrix[:, a, a] += k
        matrix[:, a + 1, a + 1] += k
        matrix[:, a, a + 1] -= k
        matrix[:, a + 1, a] -= k
    return matrix


def _springs_at(rows: ChainRows, resonances: FloatArray) -> FloatArray:
    """Stiffness that masses are compared by: springs at each, shape (B, sum N)."""
    held: FloatArray = np.abs(np.diagonal(_chain_stiffness(rows), axis1=1, axis2=2)).copy()
    count = np.maximum((resonances > 0.0).sum(axis=1), 1)
    typical = resonances.sum(axis=1) / count
    free = held == 0.0  # the only mass of its chain
    held[free] = (np.abs(rows.masses) * typical[:, None])[free]
    return held


def structure_tests(
    names: Sequence[str], rows: ChainRows, values: FloatArray, std: FloatArray
) -> tuple[StructureTest, ...]:
    """All tests with their verdicts, in the order in which the reduction comes upon them.

    Parameters
    ----------
    names : sequence of str
        Axes.
    rows : ChainRows
    values, std : array, shape (T,)
        As :func:`structure_values` has them.
    """
    places = rows.places

    def named(row: int) -> tuple[str, int]:
        return names[places[row][0]], places[row][1] + 1

    tests = _places(rows)
    limit = float(norm.isf(FALSE_ALARM / (2.0 * max(len(tests), 1))))
    return tuple(
        StructureTest(
            p.kind,
            (named(p.one), named(p.other)),
            float(v),
            float(s),
            bool(abs(v) > max(limit * s, NEGLIGIBLE)),
        )
        for p, v, s in zip(tests, values, std, strict=True)
    )


def structure_notes(structure: Sequence[StructureTest]) -> tuple[str, ...]:
    """The first violation; the later ones may be its consequences."""
    found = [test for test in structure if test.significant]
    if not found:
        return ()
    more = len(found) - 1
    note = found[0].sentence
    if more:
        note += (
            f", or their neighbours are ({more} more numbers that should be zero are not, which may "
            "follow from it)"
        )
    return (note,)


def whitened_square(values: FloatArray, covariance: FloatArray, rank: int) -> float:
    """Sum of squares of values in their standard errors, along the `rank` best known directions."""
    if rank == 0:
        return 0.0
    if not (np.isfinite(values).all() and np.isfinite(covariance).all()):
        return np.inf
    std = np.maximum(standard_errors(covariance), 1e-300)
    known, vectors = np.linalg.eigh(covariance / np.outer(std, std))
    parts = vectors.T @ (values / std)
    best = slice(-min(rank, values.size), None)
    return float(np.sum(parts[best] ** 2 / np.maximum(known[best], 1e-12)))
