"""Take coupled chains apart: masses, springs and couplings from modes and gains.

The paper's sections 3.1 to 3.4.  Each axis gives resonances, antiresonances and the gains A_L and
A_H; every pair of axes gives A_C.  Per axis, two masses are removed at a time, or one at a time
where the motor's mass is known from its data sheet::

    K_1 = B11 m_1        m_2 = m_1 B11**2 / B12**2       K_2 = B22 m_2 - K_1       (17) - (19)
    m_3 = K_2**2 / (m_2 B23**2), and so on;              m_N = 1 / A_L - sum        (22)

The step from one pair to the next continues the same Lanczos recursion (every vector orthogonal
to all earlier ones) instead of forming new transfer functions and their roots.

Special cases: one mass has no spring and is 1 / A_L; of two masses the second is the final one.

Each result carries a bound on what rounding of the given frequencies and gains, and of the
algorithm itself, can do to it; with standard errors given, also its standard error.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from math import nan

import numpy as np
from numpy.typing import NDArray

from fieldtool.errors import NotAChainError
from fieldtool.identify.chains.lanczos import LanczosStep, lanczos_step, next_vector
from fieldtool.identify.chains.reduction_error import ChainSensitivity, chain_sensitivity
from fieldtool.identify.chains.spectrum import Spectrum
from fieldtool.identify.likelihood.least_squares import propagate, standard_errors
from fieldtool.records.model import AxisModel, Coupling, Estimate, Kind, MachineModel

FloatArray = NDArray[np.float64]
WORTH_A_NOTE = 1e-6
"""Relative error bound above which a result says so."""


@dataclass(frozen=True, eq=False)
class AxisModes:
    """What is known of one axis before its chain is taken apart."""

    spectrum: Spectrum
    masses: int
    """N, the number of masses in the chain, motor included."""
    low_gain: Estimate
    """A_L, 1/kg or 1/(kg m2), the other axes held (equation 2)."""
    high_gain: Estimate | None = None
    """A_H, 1/kg or 1/(kg m2) (equation 3)."""
    motor_mass: Estimate | None = None
    """From the data sheet, kg or kg m2; then A_H is not used, one mass is removed at a time."""
    kind: Kind = "rotary"

    def __post_init__(self) -> None:
        name = self.spectrum.axis
        if self.masses < 1:
            raise ValueError(f"axis {name}: a chain has at least one mass, got {self.masses}")
        if self.masses > 1 and self.high_gain is None and self.motor_mass is None:
            raise ValueError(
                f"axis {name}: {self.masses} masses need the high-frequency gain A_H, "
                "or the motor's mass from its data sheet"
            )
        known = [self.low_gain, self.high_gain, self.motor_mass]
        if any(e is not None and not (np.isfinite(e.value) and e.value > 0) for e in known):
            raise ValueError(f"axis {name}: gains and the motor's mass must be positive numbers")

    @property
    def first_mass(self) -> Estimate:
        """m_1 with its standard error: data sheet, else 1 / A_H."""
        if self.motor_mass is not None:
            return self.motor_mass
        gain = self.low_gain if self.high_gain is None or self.masses == 1 else self.high_gain
        return _reciprocal(gain)


@dataclass(frozen=True)
class CrossGain:
    """A_C of two axes, all others held, with its sign (paper, section 3.2)."""

    axes: tuple[str, str]
    value: float
    """theta''_i / tau_j at low frequency, 1/kg or 1/(kg m2); positive where they are in phase."""
    std: float = nan


@dataclass(frozen=True, eq=False)
class ReducedChain:
    """One chain taken apart, motor side first."""

    modes: AxisModes
    masses: FloatArray
    """Shape (N,), kg or kg m2."""
    springs: FloatArray
    """Shape (N - 1,), N/m or N m/rad."""
    steps: tuple[LanczosStep, ...]
    """The steps that removed two masses each, or one each with a known motor mass; a last single
    spring needs B11 alone and has none."""
    sensitivity: ChainSensitivity
    """Derivatives of (masses, springs) by everything that was given, and rounding."""

    @property
    def relative_bounds(self) -> FloatArray:
        """Bound of the relative error by rounding, shape (2N - 1,), masses first then springs.

        Infinite where rounding can change the value by half or more.
        """
        return self.sensitivity.relative_bounds

    @property
    def values(self) -> FloatArray:
        """Masses, then springs, shape (2N - 1,)."""
        return np.concatenate([self.masses, self.springs])


@dataclass(frozen=True, eq=False)
class ReducedMachine:
    """All chains and couplings."""

    model: MachineModel
    """With standard errors where those of the input are known."""
    chains: tuple[ReducedChain, ...]
    coupling_bounds: FloatArray
    """Bounds of the couplings' relative errors by rounding, in the model's order."""
    covariance: FloatArray | None
    """Of all chains' (masses, springs), axis after axis, then couplings; None if not known."""
    notes: tuple[str, ...]
    """What the reader must know: left-out pairs, values that rounding spoils."""


def reduce_chain(modes: AxisModes) -> ReducedChain:
    """Masses and springs of one axis (equations 13 to 22).

    Raises
    ------
    NotAChainError
        If there are fewer modes than masses, or a mass or spring comes out negative.
    """
    name, count = modes.spectrum.axis, modes.masses
    if modes.spectrum.resonances.size < count:
        raise NotAChainError(
            f"axis {name}: {count} masses need at least {count - 1} flexible modes, "
            f"{modes.spectrum.resonances.size - 1} are given; look for the missing ones, or "
            "describe the axis with fewer masses"
        )
    diagonal, off, steps = _rows(modes)
    masses, springs = _read_chain(diagonal, off, modes)
    _check_positive(name, masses, springs)
    sensitivity = chain_sensitivity(
        modes.spectrum, diagonal, off, masses, springs, uses_motor_mass=modes.motor_mass is not None
    )
    return ReducedChain(modes, masses, springs, steps, sensitivity)


def _rows(modes: AxisModes) -> tuple[FloatArray, FloatArray, tuple[LanczosStep, ...]]:
    """Rows of B that hold only uncoupled masses: B_kk, k < N, B_k,k+1, k < N - 1, and the steps."""
    lam = modes.spectrum.resonances
    rows = modes.masses - 1
    at_a_time = 2 if modes.motor_mass is None else 1
    done, start = np.zeros((lam.size, 0)), np.sqrt(modes.spectrum.weights)
    diagonal: list[float] = []
    off: list[float] = []
    steps: list[LanczosStep] = []
    try:
        while rows - len(diagonal) > 1:
            step = lanczos_step(lam, start, done)
            steps.append(step)
            diagonal += [step.b11, step.b22][:at_a_time]
            off.append(step.b12)
            if at_a_time == 1:
                done, start = np.column_stack([done, step.u1]), step.d2
            elif len(diagonal) < rows:
                done = np.column_stack([done, step.u1, step.u2])
                start, _ = next_vector(lam, done, step.b22)
                off.append(float(np.linalg.norm(start)))
    except ZeroDivisionError as error:
        raise NotAChainError(
            f"axis {modes.spectrum.axis}: {error}, but the chain is to have {modes.masses}; the "
            "modes beyond are not seen by this motor: describe the axis with fewer masses"
        ) from error
    if len(diagonal) < rows:  # the last spring needs B_kk alone
        last = start / np.linalg.norm(start)
        diagonal.append(float(last @ (lam * last)))
    return np.array(diagonal), np.array(off), tuple(steps)


def _read_chain(
    diagonal: FloatArray, off: FloatArray, modes: AxisModes
) -> tuple[FloatArray, FloatArray]:
    """Equations (17) to (19) row by row, then (22)."""
    masses = [modes.first_mass.value] if modes.masses > 1 else []
    springs: list[float] = []
    for k, entry in enumerate(diagonal):
        springs.append(entry * masses[k] - (springs[k - 1] if k else 0.0))
        if k < off.size:
            masses.append(springs[k] ** 2 / (masses[k] * off[k] ** 2))
    masses.append(1.0 / modes.low_gain.value - sum(masses))
    return np.array(masses), np.array(springs)


def _check_positive(name: str, masses: FloatArray, springs: FloatArray) -> None:
    for what, values in (("spring", springs), ("mass", masses)):
        for k, value in enumerate(values, start=1):
            if not value > 0.0:
                raise NotAChainError(
                    f"axis {name}: {what} {k} comes out as {value:.4g}, it must be positive; the "
                    "frequencies and gains do not fit together: check A_L and A_H (friction and "
                    "noise distort them) and the number of masses"
                )


def coupling_from_gains(low_i: float, low_j: float, cross: float) -> float:
    """Coupling m_ij of two last masses from A_iL, A_jL and the signed A_C (equations 7 and 8).

    A physical mass matrix has m_ij**2 < 1 / (A_iL A_jL), so only the second case of equation (8)
    occurs: the coupling has the opposite sign of theta''_i / tau_j.  The root is written without
    its cancellation at small A_C.
    """
    squared = 1.0 / (low_i * low_j)
    return -2.0 * cross * squared / (1.0 + float(np.sqrt(1.0 + 4.0 * cross**2 * squared)))


def _coupling_gradient(low_i: float, low_j: float, cross: float) -> FloatArray:
    """Derivatives of the coupling by A_iL, A_jL and A_C."""
    squared = 1.0 / (low_i * low_j)
    root = float(np.sqrt(1.0 + 4.0 * cross**2 * squared))
    by_squared = -cross / root  # d m / d (M_i M_j)
    by_cross = -2.0 * squared / (root * (1.0 + root))
    return np.array([-by_squared * squared / low_i, -by_squared * squared / low_j, by_cross])


def reduce_machine(
    axes: Sequence[AxisModes],
    cross_gains: Sequence[CrossGain] = (),
    covariance: FloatArray | None = None,
) -> ReducedMachine:
    """Masses, springs and couplings of a machine.

    Parameters
    ----------
    axes : sequence of AxisModes
        One per axis; chains may differ in length.
    cross_gains : sequence of CrossGain
        One per pair of axes; a pair that is not given has no coupling.
    covariance : array, optional
        Of all inputs: per axis (resonances[1:], antiresonances, A_L, A_H), axis after axis, then
        the cross gains.  Where an axis has neither A_H nor a motor mass (one mass), or has its
        motor mass from the data sheet, the fourth entry is that mass or 1 / A_L; give its
        variance, or 0.  Without it the standard errors of the inputs are taken as independent.

    Raises
    ------
    NotAChainError
        As :func:`reduce_chain`, or if the couplings make the mass matrix indefinite.
    ValueError
        If a cross gain does not join two axes, or the covariance has another shape.
    """
    chains = tuple(reduce_chain(axis) for axis in axes)
    names = [axis.spectrum.axis for axis in axes]
    couplings, gradients = _couplings(axes, names, cross_gains)
    jacobian = _jacobian(chains, names, cross_gains, gradients)
    given = _given_covariance(axes, cross_gains) if covariance is None else covariance
    if given is not None and given.shape != (jacobian.shape[1],) * 2:
        raise ValueError(
            f"covariance must have shape {(jacobian.shape[1],) * 2}, got {given.shape}"
        )
    result = None if given is None else propagate(jacobian, given)
    std = np.full(jacobian.shape[0], nan) if result is None else standard_errors(result)
    model = _model(chains, cross_gains, couplings, std)
    _check_end_masses(model)
    bounds = _coupling_bounds(axes, names, cross_gains, couplings, gradients)
    return ReducedMachine(model, chains, bounds, result, _notes(chains))


def _couplings(
    axes: Sequence[AxisModes], names: list[str], cross_gains: Sequence[CrossGain]
) -> tuple[FloatArray, FloatArray]:
    known = {frozenset(pair) for pair in combinations(names, 2)}
    values, gradients = [], []
    for gain in cross_gains:
        if frozenset(gain.axes) not in known:
            raise ValueError(f"cross gain {gain.axes} does not join two axes of {names}")
        low_i, low_j = (axes[names.index(name)].low_gain.value for name in gain.axes)
        values.append(coupling_from_gains(low_i, low_j, gain.value))
        gradients.append(_coupling_gradient(low_i, low_j, gain.value))
    return np.array(values), np.array(gradients).reshape(-1, 3)


def _input_starts(chains: Sequence[ReducedChain]) -> NDArray[np.intp]:
    sizes = [chain.sensitivity.jacobian.shape[1] for chain in chains]
    return np.cumsum([0, *sizes]).astype(np.intp)


def _jacobian(
    chains: Sequence[ReducedChain],
    names: list[str],
    cross_gains: Sequence[CrossGain],
    gradients: FloatArray,
) -> FloatArray:
    """All results by all inputs, in the order of the covariance."""
    starts = _input_starts(chains)
    outputs = np.cumsum([0, *(chain.values.size for chain in chains)])
    jacobian = np.zeros((outputs[-1] + len(cross_gains), starts[-1] + len(cross_gains)))
    for c, chain in enumerate(chains):
        jacobian[outputs[c] : outputs[c + 1], starts[c] : starts[c + 1]] = (
            chain.sensitivity.jacobian
        )
    for g, gain in enumerate(cross_gains):
        i, j = (names.index(name) for name in gain.axes)
        columns = [starts[i + 1] - 2, starts[j + 1] - 2, starts[-1] + g]
        jacobian[outputs[-1] + g, columns] = gradients[g]
    return jacobian


def _given_covariance(
    axes: Sequence[AxisModes], cross_gains: Sequence[CrossGain]
) -> FloatArray | None:
    """Covariance of independent inputs; None unless every standard error is known."""
    blocks = []
    for axis in axes:
        modes = 2 * axis.spectrum.antiresonances.size
        if axis.spectrum.covariance is None and modes:
            return None
        first = axis.motor_mass or axis.high_gain or axis.low_gain
        block = np.zeros((modes + 2, modes + 2))
        if axis.spectrum.covariance is not None:
            block[:modes, :modes] = axis.spectrum.covariance
        block[modes:, modes:] = np.diag([axis.low_gain.std**2, first.std**2])
        blocks.append(block)
    stds = np.concatenate([np.diag(block) for block in blocks])
    stds = np.append(stds, [gain.std**2 for gain in cross_gains])
    if not np.all(np.isfinite(stds)):
        return None
    covariance = np.diag(stds)
    start = 0
    for block in blocks:
        covariance[start : start + len(block), start : start + len(block)] = block
        start += len(block)
    return covariance


def _model(
    chains: Sequence[ReducedChain],
    cross_gains: Sequence[CrossGain],
    couplings: FloatArray,
    std: FloatArray,
) -> MachineModel:
    remaining = iter(
        zip(np.concatenate([*(c.values for c in chains), couplings]), std, strict=True)
    )

    def take(count: int) -> tuple[Estimate, ...]:
        return tuple(
            Estimate(float(v), float(s)) for v, s in (next(remaining) for _ in range(count))
        )

    axes = tuple(
        AxisModel(c.modes.spectrum.axis, c.modes.kind, take(c.masses.size), take(c.springs.size))
        for c in chains
    )
    joined = []
    for gain in cross_gains:
        (estimate,) = take(1)
        joined.append(Coupling(gain.axes, estimate.value, estimate.std))
    return MachineModel(axes, tuple(joined))


def _check_end_masses(model: MachineModel) -> None:
    ends = model.mass_matrix[np.ix_(model.last_masses, model.last_masses)]
    if np.linalg.eigvalsh(ends)[0] <= 0.0:
        couplings = ", ".join(f"{'-'.join(c.axes)} {c.value:.4g}" for c in model.couplings)
        raise NotAChainError(
            f"couplings {couplings} are larger than the last masses "
            f"{[float(f'{m:.4g}') for m in np.diag(ends)]} allow; check the cross gains' size "
            "and sign, and the low-frequency gains (friction distorts both)"
        )


def _coupling_bounds(
    axes: Sequence[AxisModes],
    names: list[str],
    cross_gains: Sequence[CrossGain],
    couplings: FloatArray,
    gradients: FloatArray,
) -> FloatArray:
    bounds = []
    for gain, value, gradient in zip(cross_gains, couplings, gradients, strict=True):
        low = [axes[names.index(name)].low_gain.value for name in gain.axes]
        moved = np.abs(gradient) @ np.abs([*low, gain.value]) + 4.0 * abs(value)
        bounds.append(4.0 * np.finfo(float).eps * moved / abs(value) if value else 0.0)
    return np.array(bounds)


def _notes(chains: Sequence[ReducedChain]) -> tuple[str, ...]:
    notes = []
    for chain in chains:
        name = chain.modes.spectrum.axis
        for resonance, antiresonance in np.sqrt(chain.modes.spectrum.left_out) / (2.0 * np.pi):
            notes.append(
                f"axis {name}: resonance {resonance:.4g} Hz and antiresonance {antiresonance:.4g} "
                "Hz nearly cancel and were left out"
            )
        labels = [f"mass {k + 1}" for k in range(chain.masses.size)]
        labels += [f"spring {k + 1}" for k in range(chain.springs.size)]
        for label, bound in zip(labels, chain.relative_bounds, strict=True):
            if bound > WORTH_A_NOTE:
                notes.append(
                    f"axis {name}: {label} may be off by {bound:.1g} of its value through "
                    "rounding alone"
                    if np.isfinite(bound)
                    else f"axis {name}: {label} is lost in rounding; use a shorter chain"
                )
    return tuple(notes)


def _reciprocal(estimate: Estimate) -> Estimate:
    value = 1.0 / estimate.value
    return Estimate(value, estimate.std * value**2)
