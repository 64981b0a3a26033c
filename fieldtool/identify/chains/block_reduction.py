"""From fitted modes to a machine, all chains at once, and a test of the assumed structure.

:mod:`fieldtool.identify.chains.block_lanczos` takes the chains apart; what it finds where a machine of
chains has zeros tells whether the machine is one (:mod:`fieldtool.identify.chains.structure`).

Errors are propagated from those of the modes to first order, by central differences, together with
what fitted modes neglect: squares of out-of-phase shapes and of friction.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from fieldtool.errors import NotAChainError, NotEnoughDataError
from fieldtool.identify.chains.block_lanczos import ChainRows, chain_rows
from fieldtool.identify.chains.structure import (
    StructureTest,
    structure_notes,
    structure_tests,
    structure_values,
    whitened_square,
)
from fieldtool.identify.likelihood.least_squares import propagate, standard_errors
from fieldtool.identify.modes.model import ModalModel
from fieldtool.records.model import AxisModel, Coupling, Estimate, Kind, MachineModel

FloatArray = NDArray[np.float64]
NO_MASS = (
    "the rigid body of the fitted modes has no positive mass in every direction; measure lower "
    "frequencies, and check the signs of torque and position on each axis"
)
STEP = 1e-5
"""Relative, of central differences."""


@dataclass(frozen=True, eq=False)
class BlockReduced:
    """A machine from modes, and whether the modes are those of such a machine."""

    model: MachineModel
    """With standard errors; dampers, where the modes tell them, without."""
    structure: tuple[StructureTest, ...]
    """In the order in which the reduction comes upon them: a violation spoils what follows it."""
    misfit: float
    """Sum of squares of all tests, whitened: like chi2 of `constraints` degrees of freedom in a
    machine of chains."""
    constraints: int
    """(M - 1) n: how many tests are independent."""
    notes: tuple[str, ...]
    """Sentences: the first significant violation, and how many others follow from it."""


def reduce_blocks(
    modal: ModalModel, masses: Mapping[str, int], kinds: Mapping[str, Kind] | None = None
) -> BlockReduced:
    """Masses, springs and couplings of all chains, with standard errors and tests of structure.

    Parameters
    ----------
    modal : ModalModel
        With all pairs of axes measured and n modes, n the sum of N - 1.
    masses : mapping of axis name to N
        Chains may differ in length.
    kinds : mapping of axis name to rotary or linear, optional
        Rotary where not given.

    Raises
    ------
    ValueError
        If an axis has no N, or the number of modes is not the sum of N - 1.
    NotEnoughDataError
        If a pair of axes was not measured.
    NotAChainError
        If a mass or spring comes out as no machine can have it.
    """
    lengths = _lengths(modal, masses)
    variants = _Variants.of(modal)
    rows = chain_rows(variants.resonances, variants.motors, lengths)
    values, tests = _values(rows), structure_values(rows, variants.resonances)
    covariance = variants.covariance(modal)
    test_covariance = propagate(variants.derivatives(tests), covariance)
    structure = structure_tests(modal.names, rows, tests[0], standard_errors(test_covariance))
    notes = structure_notes(structure)
    _check_physical(modal.names, rows, notes)
    std = standard_errors(propagate(variants.derivatives(values), covariance))
    model = _machine(modal, kinds or {}, rows, values[0], std)
    constraints = (len(lengths) - 1) * modal.omega.size
    misfit = whitened_square(tests[0], test_covariance, constraints)
    return BlockReduced(model, structure, misfit, constraints, notes)


def mismatch(modal: ModalModel, combinations_of_lengths: Sequence[tuple[int, ...]]) -> FloatArray:
    """How far modes are from those of chains of given lengths, at a glance, shape (K,).

    Sum of squared cosines between rows that must be across each other.  It needs no errors, and
    one reduction serves all combinations: a chain's rows do not depend on the other chains.

    Parameters
    ----------
    modal : ModalModel
        With all pairs of axes measured.
    combinations_of_lengths : sequence of tuples
        K times N of every axis.

    Raises
    ------
    NotAChainError
        If the rigid body of the modes has no positive mass in every direction.
    """
    variants = _Variants.of(modal)
    longest = max((max(each) for each in combinations_of_lengths), default=1)
    axes = len(modal.names)
    rows = chain_rows(variants.resonances[:1], variants.motors[:1], (longest,) * axes).rows[0]
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        unit = rows / np.linalg.norm(rows, axis=1, keepdims=True)
        squares = (unit @ unit.T) ** 2
    squares = np.where(np.isfinite(squares), squares, 1.0)
    result = np.zeros(len(combinations_of_lengths))
    for c, lengths in enumerate(combinations_of_lengths):
        used = np.concatenate([i * longest + np.arange(n) for i, n in enumerate(lengths)])
        ends = np.arange(axes) * longest + np.array(lengths) - 1
        own = sum(
            squares[i * longest :, i * longest :][:n, :n].sum() for i, n in enumerate(lengths)
        )
        between_ends = squares[np.ix_(ends, ends)].sum() - squares[ends, ends].sum()
        result[c] = squares[np.ix_(used, used)].sum() - own - between_ends
    return result


def _lengths(modal: ModalModel, masses: Mapping[str, int]) -> tuple[int, ...]:
    missing = [name for name in modal.names if name not in masses]
    if missing:
        raise ValueError(f"no number of masses is given for axis {', '.join(missing)}")
    lengths = tuple(masses[name] for name in modal.names)
    if min(lengths) < 1 or sum(lengths) - len(lengths) != modal.omega.size:
        raise ValueError(
            f"chains of {lengths} masses have {sum(lengths) - len(lengths)} modes, "
            f"{modal.omega.size} were fitted"
        )
    if not modal.parts.pairs.all():
        i, j = np.argwhere(~modal.parts.pairs)[0]
        raise NotEnoughDataError(
            f"axes {modal.names[i]} and {modal.names[j]}: no response between them was measured, "
            "so the chains can not be taken apart together; measure one"
        )
    return lengths


@dataclass(frozen=True, eq=False)
class _Variants:
    """The modes as fitted, then with every number moved up, then with every number moved down."""

    resonances: FloatArray
    """Shape (1 + 2 P, M + n)."""
    motors: FloatArray
    """Shape (1 + 2 P, M, M + n)."""
    steps: FloatArray
    """Shape (P,)."""
    columns: NDArray[np.intp]
    """Of the P numbers in the modal parameter vector, shape (P,)."""

    @classmethod
    def of(cls, modal: ModalModel) -> "_Variants":
        at, (axes, modes) = modal.parts.slices, modal.phi.shape
        columns = np.r_[at["omega"], at["phi"], at["rigid"]].astype(np.intp)
        i, j = modal.parts.upper
        size = np.sqrt(np.maximum(np.diag(modal.rigid), 0.0))
        if (
            not np.isfinite(modal.parameters).all()
            or not size.all()
            or not np.linalg.eigvalsh(modal.rigid / np.outer(size, size))[0] > 0.0
        ):
            raise NotAChainError(NO_MASS)
        scales = np.r_[
            modal.omega,
            np.repeat(np.hypot(np.abs(modal.phi).max(axis=1, initial=0.0), size), modes),
            size[i] * size[j],
        ]
        steps = STEP * scales
        moved = np.vstack([np.zeros(steps.size), np.diag(steps), -np.diag(steps)])
        x = modal.parameters[columns] + moved
        phi = x[:, modes : modes + axes * modes].reshape(x.shape[0], axes, modes)
        rigid = np.empty((x.shape[0], axes, axes))
        rigid[:, i, j] = rigid[:, j, i] = x[:, modes + axes * modes :]
        resonances = np.hstack([np.zeros((x.shape[0], axes)), x[:, :modes] ** 2])
        try:
            motors = np.concatenate([np.linalg.cholesky(rigid), phi], axis=2)
        except np.linalg.LinAlgError as error:  # all but singular: a step away it is
            raise NotAChainError(NO_MASS) from error
        return cls(resonances, motors, steps, columns)

    def derivatives(self, results: FloatArray) -> FloatArray:
        """Of results of all variants, shape (1 + 2 P, Q), by the numbers, shape (Q, P)."""
        count = self.steps.size
        difference = results[1 : count + 1] - results[count + 1 :]
        derivatives: FloatArray = (difference / (2.0 * self.steps[:, None])).T
        return derivatives

    def covariance(self, modal: ModalModel) -> FloatArray:
        """Of the numbers, shape (P, P), with the squares that modes neglect.

        Of a fit gone astray these are infinite or no numbers: nothing is known there, as
        :func:`~fieldtool.identify.likelihood.least_squares.propagate` takes it.
        """
        size = np.sqrt(np.diag(modal.rigid))
        i, j = modal.parts.upper
        with np.errstate(over="ignore", invalid="ignore"):
            phi, chi = np.linalg.norm(modal.phi, axis=0), np.linalg.norm(modal.chi, axis=0)
            drag = np.diag(modal.rigid) * np.abs(modal.friction)
            slow = (drag.max(initial=0.0) / modal.omega.min(initial=np.inf)) ** 2
            neglected = (chi / np.maximum(phi, 1e-300)) ** 2
            errors = np.r_[
                modal.omega * neglected,
                np.tile(phi * (neglected + slow), modal.phi.shape[0]),
                size[i] * size[j] * slow,
            ]
            variances = errors**2
        covariance: FloatArray = modal.covariance[np.ix_(self.columns, self.columns)]
        return np.asarray(covariance + np.diag(variances), dtype=np.float64)


def _values(rows: ChainRows) -> FloatArray:
    """Masses, springs, couplings (upper triangle), of all variants, shape (B, Q)."""
    i, j = np.triu_indices(len(rows.lengths), 1)
    return np.hstack([rows.masses, rows.springs, rows.ends[:, i, j]])


def _check_physical(names: Sequence[str], rows: ChainRows, notes: tuple[str, ...]) -> None:
    why = f"; {notes[0]}" if notes else ""
    starts = np.cumsum([0, *rows.lengths])
    for i, name in enumerate(names):
        chain = rows.masses[0, starts[i] : starts[i + 1]]
        springs = rows.springs[0, starts[i] - i : starts[i + 1] - i - 1]
        for what, values in (("mass", chain), ("spring", springs)):
            bad = np.flatnonzero(~(np.isfinite(values) & (values > 0.0)))
            if bad.size:
                raise NotAChainError(
                    f"axis {name}: {what} {bad[0] + 1} of {len(values)} comes out as "
                    f"{values[bad[0]]:.3g}, which no machine has; the number of masses of this or "
                    f"another axis is not right, or a mode is missed or invented{why}"
                )
    if not (np.isfinite(rows.ends[0]).all() and np.linalg.eigvalsh(rows.ends[0])[0] > 0.0):
        raise NotAChainError(
            "the couplings come out larger than the end masses allow; the number of masses of an "
            f"axis is not right, or a mode is missed or invented{why}"
        )


def _machine(
    modal: ModalModel,
    kinds: Mapping[str, Kind],
    rows: ChainRows,
    values: FloatArray,
    std: FloatArray,
) -> MachineModel:
    estimates = [Estimate(float(v), float(s)) for v, s in zip(values, std, strict=True)]
    count, axes = rows.masses.shape[1], len(rows.lengths)
    masses, springs = estimates[:count], estimates[count : 2 * count - axes]
    couplings = estimates[2 * count - axes :]
    dampers = _dampers(modal, rows)
    chains = []
    for i, (name, n) in enumerate(zip(modal.names, rows.lengths, strict=True)):
        a = sum(rows.lengths[:i])
        joints = slice(a - i, a - i + n - 1)
        chains.append(
            AxisModel(
                name,
                kinds.get(name, "rotary"),
                tuple(masses[a : a + n]),
                tuple(springs[joints]),
                tuple(Estimate(float(d)) for d in dampers[joints]) if dampers.any() else (),
                Estimate(max(float(modal.friction[i]), 0.0)),
            )
        )
    joined = tuple(
        Coupling(pair, e.value, e.std)
        for pair, e in zip(combinations(modal.names, 2), couplings, strict=True)
    )
    return MachineModel(tuple(chains), joined)


def _dampers(modal: ModalModel, rows: ChainRows) -> FloatArray:
    """Dampers beside all springs, not negative, shape (sum of N - 1,).

    Every mode's damping is what dampers and motor friction take from it:
    2 zeta_r w_r = sum d_k (phi_k+1 - phi_k)**2 + sum f_i phi_i**2.
    """
    joints = [a for a, (i, k) in enumerate(rows.places) if k < rows.lengths[i] - 1]
    if not joints:
        return np.zeros(0)
    shapes = rows.rows[0][:, len(rows.lengths) :]
    stretch = np.array([(shapes[a + 1] - shapes[a]) ** 2 for a in joints]).T
    lost = 2.0 * modal.zeta * modal.omega - np.maximum(modal.friction, 0.0) @ modal.phi**2
    size = np.linalg.norm(stretch, axis=0)
    found: FloatArray = nnls(stretch / size, np.maximum(lost, 0.0))[0] / size
    return found
