"""Whole records as the fit takes them: the machine's own free motion is part of the model.

Over a stretch of time of length L, whatever moved the machine before, after and meanwhile, the finite
Fourier integrals Q of all masses' motion and T of the motors' torques obey at every bin w = 2 pi k / L

    Z(w) Q = E T - (2 / L) (M (dv + j w dq) + C dq),    Z = K + j w C - w**2 M

with dq and dv what positions and velocities differ by between the two ends: 2 n real unknowns for n
masses, whatever the transients are.  They enter linearly and are eliminated (variable projection).
What is left is the equation error of positions and torques, as in :mod:`joint_data`, at all bins of the
band: those between the excited lines tell the states, and with the run-in something of the machine.

A delay d of an axis' torque delays the integral too: what acted in the first d of the stretch was
measured before it, so T becomes T exp(-j w d) - (2 / L) dT (1 - exp(-j w d)) / (j w), with dT what
the torque differs by between the ends.

Valid for linear machines, and a sample rate well above the band: the integrals are sums of samples
with end weights of third order.

Source: Pintelon and Schoukens, System Identification: A Frequency Domain Approach, chapters 6 and 8
(free motion in spectra of arbitrary signals); Golub and Pereyra 1973 (variable projection); Press et
al., Numerical Recipes, equation 4.1.14 (end weights).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import qr, solve_triangular

from fieldtool.identify.likelihood.parameters import Parameter
from fieldtool.identify.likelihood.whitening import whitening
from fieldtool.records.model import MachineModel

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
END_WEIGHTS = np.array([3 / 8, 7 / 6, 23 / 24])
"""Of the first and, backwards, of the last samples of an integral; 1 between them."""
ROUNDING = 1e-10
"""Share of the largest diagonal element of R below which a direction of the states is nothing."""


@dataclass(frozen=True, eq=False)
class Spectrum:
    """One stretch of time at F bins, as amplitudes: integrals times 2 / L."""

    duration: float
    """L, s."""
    omega: FloatArray
    """(F,), rad/s, positive multiples of 2 pi / L, rising."""
    position: ComplexArray
    """(F, M), rad or m."""
    torque: ComplexArray
    """(F, M), N m or N."""
    torque_change: FloatArray
    """(M,): last less first torque."""


def spectrum_of(
    position: FloatArray, torque: FloatArray, step: float, bins: NDArray[np.intp]
) -> Spectrum:
    """Return the spectrum of N + 1 samples (N + 1, M), both ends of the stretch among them."""
    duration = (position.shape[0] - 1) * step
    return Spectrum(
        duration,
        2 * np.pi * bins / duration,
        amplitudes(position, step, bins),
        amplitudes(torque, step, bins),
        torque[-1] - torque[0],
    )


def amplitudes(signals: FloatArray, step: float, bins: NDArray[np.intp]) -> ComplexArray:
    """Integrals of x(t) exp(-j w t) over the stretch times 2 / L, (F, S), of signals (N + 1, S).

    Of the straight line between the ends exactly.
    """
    count = signals.shape[0] - 1
    change = signals[-1] - signals[0]
    rest = signals - signals[0] - np.linspace(0.0, 1.0, count + 1)[:, None] * change
    rest[: END_WEIGHTS.size] *= END_WEIGHTS[:, None]
    rest[-END_WEIGHTS.size :] *= END_WEIGHTS[::-1, None]
    rest[0] += rest[-1]
    sums = np.fft.rfft(rest[:-1], axis=0)[bins] * step
    omega = 2 * np.pi * bins / (count * step)
    result: ComplexArray = (sums - change / (1j * omega[:, None])) * (2 / (count * step))
    return result


@dataclass(frozen=True, eq=False)
class TorquePart:
    """Something in an axis' measured torque whose course is known, and its size all but known."""

    axis: int
    std: float
    """Of what is not known of its size."""
    spectra: tuple[ComplexArray, ...]
    """(F,) of each stretch, N m or N a unit of size."""
    beside: float = 0.0
    """By how much the size that was taken off is beside what was expected before."""


@dataclass(frozen=True, eq=False)
class RecordData:
    """Spectra of several stretches of time and the covariances of their equation errors."""

    names: tuple[str, ...]
    """Axes, in order."""
    spectra: tuple[Spectrum, ...]
    covariance: tuple[ComplexArray, ...]
    """Of each: (F, M, M), E[e e^H] of the equation error, rad2 or m2."""
    parts: tuple[TorquePart, ...] = ()
    """What is in the torques besides, its most likely size taken off already."""
    spread: tuple[FloatArray | None, ...] | None = None
    """Of each stretch: (2 n,), standard deviations of what positions, then velocities, of all masses
    differ by between the ends; 0 where they do not.  None: nothing is known of that."""

    @cached_property
    def omega(self) -> FloatArray:
        """All frequencies, each once, rising, rad/s."""
        return np.unique(np.concatenate([one.omega for one in self.spectra]))

    @property
    def count(self) -> int:
        """Number of real numbers measured."""
        return sum(2 * int(one.position.size) for one in self.spectra)

    def eliminated(self, model: MachineModel) -> int:
        """Return how many of the numbers the states at the ends and sizes of torque parts use up."""
        states = 2 * int(model.mass_matrix.shape[0])
        free = [states if one is None else np.count_nonzero(one) for one in self._spread]
        return int(sum(free)) + len(self.parts)

    def residuals(self, model: MachineModel, delays: FloatArray, _floor: float = 0.0) -> FloatArray:
        """Equation errors in standard errors, states and sizes of torque parts eliminated.

        After those of each stretch come its states in standard deviations, where something is known of
        them; after those of all stretches comes one of each part: its size in standard errors.
        """
        wide = self._with_parts(model, delays)
        span = self._span(model, delays)
        left: FloatArray = wide - span @ (span.T @ wide)
        return left

    def part_sizes(self, model: MachineModel, delays: FloatArray) -> FloatArray:
        """Return by how much the size of each torque part is larger than what was taken off, (P,)."""
        if not self.parts:
            return np.zeros(0)
        columns, wide = self._columns(model, delays), self._with_parts(model, delays)
        return -np.asarray(np.linalg.lstsq(columns, wide, rcond=None)[0], dtype=np.float64)

    def _with_parts(self, model: MachineModel, delays: FloatArray) -> FloatArray:
        """Residuals with the torque parts' sizes as they were taken off."""
        rows = [one.residuals for one in self.systems(model, delays)]
        return np.concatenate([*rows, [part.beside / part.std for part in self.parts]])

    def jacobian(
        self,
        model: MachineModel,
        delays: FloatArray,
        parameters: Sequence[Parameter],
        _floor: float = 0.0,
    ) -> FloatArray:
        """Derivatives of :meth:`residuals` by the parameters, SI."""
        rows = [one.jacobian(parameters) for one in self.systems(model, delays)]
        wide = np.concatenate([*rows, np.zeros((len(self.parts), len(parameters)))])
        span = self._span(model, delays)
        left: FloatArray = wide - span @ (span.T @ wide)
        return left

    def gain_of_mode(
        self,
        model: MachineModel,
        delays: FloatArray,
        parameters: Sequence[Parameter],
        omega: float,
        zeta: float,
    ) -> float:
        """By how much chi2 would fall with one more small mode, states and parameters following.

        A score test: residuals projected on the answers of a mode with this pole, whose residues are
        any symmetric matrix; chi2-distributed with M (M + 1) / 2 degrees of freedom without a mode.
        Its own free motion is not reckoned with.
        """
        told = [one.mode(omega, zeta) for one in self.systems(model, delays)]
        return self._gain(np.concatenate(told), model, delays, parameters)

    def gain_of_parameter(
        self,
        model: MachineModel,
        delays: FloatArray,
        parameters: Sequence[Parameter],
        added: Parameter,
    ) -> float:
        """By how much chi2 would fall with one more parameter, likewise; with 1 degree of freedom."""
        told = [one.jacobian([added]) for one in self.systems(model, delays)]
        return self._gain(np.concatenate(told), model, delays, parameters)

    def _gain(
        self,
        told: FloatArray,
        model: MachineModel,
        delays: FloatArray,
        parameters: Sequence[Parameter],
    ) -> float:
        answers = np.vstack([told, np.zeros((len(self.parts), told.shape[1]))])
        followed = np.linalg.qr(self.jacobian(model, delays, parameters))[0]
        for span in (self._span(model, delays), followed):
            answers = answers - span @ (span.T @ answers)
        scale = np.linalg.norm(answers, axis=0)
        basis, size, _ = np.linalg.svd(
            answers / np.where(scale > 0, scale, 1.0), full_matrices=False
        )
        known = basis[:, size > ROUNDING * size[0]]
        return float(np.sum((known.T @ self.residuals(model, delays)) ** 2))

    def _columns(self, model: MachineModel, delays: FloatArray) -> FloatArray:
        """Derivatives of all residuals by the sizes of the torque parts, (R + P, P)."""
        systems = self.systems(model, delays)
        columns = [
            np.concatenate([one.part(p.axis, p.spectra[k]) for k, one in enumerate(systems)])
            for p in self.parts
        ]
        known = np.diag([1.0 / p.std for p in self.parts])
        return np.asarray(np.vstack([np.stack(columns, axis=1), known]), dtype=np.float64)

    def _span(self, model: MachineModel, delays: FloatArray) -> FloatArray:
        """What sizes of torque parts can explain, an orthonormal basis, (R + P, P)."""
        if not self.parts:
            rows = sum(one.residuals.size for one in self.systems(model, delays))
            return np.zeros((rows, 0))
        return np.asarray(np.linalg.qr(self._columns(model, delays))[0], dtype=np.float64)

    def systems(self, model: MachineModel, delays: FloatArray) -> "list[RecordSystem]":
        """Return each stretch at one machine; the last machine's are kept."""
        matrices = (model.mass_matrix, model.damping_matrix, model.stiffness_matrix, delays)
        asked = tuple(one.tobytes() for one in matrices)
        if asked not in self._kept:
            compliance = _compliance(model, self.omega)
            self._kept.clear()
            self._kept[asked] = [
                RecordSystem(
                    one,
                    model,
                    compliance[np.searchsorted(self.omega, one.omega)],
                    delays,
                    white,
                    spread,
                )
                for one, white, spread in zip(
                    self.spectra, self._whitening, self._spread, strict=True
                )
            ]
        return self._kept[asked]

    @property
    def _spread(self) -> tuple[FloatArray | None, ...]:
        return self.spread or (None,) * len(self.spectra)

    @cached_property
    def _kept(self) -> "dict[tuple[bytes, ...], list[RecordSystem]]":
        return {}

    @cached_property
    def _whitening(self) -> list[ComplexArray]:
        """Matrices W with W C W^H = 2, (F, M, M) of each stretch."""
        return [whitening(covariance) for covariance in self.covariance]


def _compliance(model: MachineModel, omega: FloatArray) -> ComplexArray:
    """Inverse of the dynamic stiffness, (F, n, n)."""
    s = 1j * omega[:, None, None]
    dynamic = model.stiffness_matrix + s * model.damping_matrix + s * s * model.mass_matrix
    return np.asarray(np.linalg.inv(dynamic), dtype=np.complex128)


class RecordSystem:
    """One stretch of time at one machine."""

    def __init__(
        self,
        one: Spectrum,
        model: MachineModel,
        compliance: ComplexArray,
        delays: FloatArray,
        whiten: ComplexArray,
        spread: FloatArray | None = None,
    ) -> None:
        self.one, self.delays, self.whiten = one, delays, whiten
        self._motors = model.first_masses
        self.s = 1j * one.omega
        self.moved = compliance[:, :, model.first_masses]
        mass, damping = model.mass_matrix, model.damping_matrix
        at_motors = self.moved.transpose(0, 2, 1)
        scale = -2 / one.duration
        jumped = at_motors @ (scale * mass)
        free = self.s[:, None, None] * jumped + at_motors @ (scale * damping)
        driven = _times(self.moved, self._acting())
        n = mass.shape[0]
        self._driven = driven
        self._error = _flat(_times(whiten, driven[:, self._motors] - one.position))
        self._basis = _flat(whiten @ np.concatenate([free, jumped], axis=2))
        size = np.ones(2 * n) if spread is None else spread
        self._known = 0 if spread is None else int(np.count_nonzero(spread))
        basis = self._basis * size
        if spread is not None:
            basis = np.vstack([basis, np.eye(2 * n)[spread > 0]])
        self._span, states = _eliminated(basis, self._with_known(self._error))
        states = states * size
        self.residuals = self._left(self._error)
        # What the masses' motion, velocity and acceleration are by the model, integrals as above.
        change, jump = (2 / one.duration) * states[:n], (2 / one.duration) * states[n:]
        force = (self.s[:, None] * change + jump) @ mass + change @ damping
        self.displacement = driven - _times(compliance, force)
        self.velocity = self.s[:, None] * self.displacement + change
        self.acceleration = self.s[:, None] * self.velocity + jump

    @property
    def freedom(self) -> FloatArray:
        """Share of each bin that the states did not use up, (F,)."""
        used = np.sum(self._told(self._span) ** 2, axis=1).reshape(2, self.s.size, -1)
        result: FloatArray = 1.0 - used.mean(axis=(0, 2))
        return result

    @property
    def white(self) -> ComplexArray:
        """Residuals as complex numbers, (F, M): both parts of variance 1."""
        parts = self._told(self.residuals).reshape(2, self.s.size, -1)
        result: ComplexArray = parts[0] + 1j * parts[1]
        return result

    def unrest(self) -> tuple[FloatArray, FloatArray]:
        """What the stretch tells of its states, as independent numbers, (K,) each.

        Returns
        -------
        found, told
            Found are numbers of variance 1 + (told s)**2 where the states are independent, each with a
            standard deviation of s times the motion of its mass, or the velocity.
        """
        turn, told, _ = np.linalg.svd(self._basis * self.motion, full_matrices=False)
        return turn.T @ self._error, told

    @property
    def motion(self) -> FloatArray:
        """Root mean squares of the motion of all masses, then of their velocities, (2 n,)."""
        both = np.concatenate([self._driven, self.s[:, None] * self._driven], axis=1)
        result: FloatArray = np.sqrt(np.sum(np.abs(both) ** 2, axis=0) / 2)
        return result

    def jacobian(self, parameters: Sequence[Parameter]) -> FloatArray:
        """Derivatives of the residuals by the parameters, SI."""
        columns = np.stack([self._column(p) for p in parameters], axis=2)
        return self._left(_flat(self.whiten @ columns))

    def part(self, axis: int, spectrum: ComplexArray) -> FloatArray:
        """Derivative of the residuals by the size of what is in an axis' torque but does not act."""
        turned = spectrum * np.exp(-self.s * self.delays[axis])
        answer = self.moved[:, self._motors, axis] * turned[:, None]
        return -self._left(_flat(_times(self.whiten, answer)))

    def mode(self, omega: float, zeta: float) -> FloatArray:
        """What a mode with this pole would add, for each residue between two motors, (R, pairs)."""
        curve = 1.0 / (self.s**2 + 2 * zeta * omega * self.s + omega**2)
        moved, M = curve[:, None] * self._acting(), self.delays.size
        answers = np.zeros((self.s.size, M, M * (M + 1) // 2), dtype=np.complex128)
        for k, (a, b) in enumerate(zip(*np.triu_indices(M), strict=True)):
            answers[:, a, k] = moved[:, b]
            answers[:, b, k] = moved[:, a]
        return self._left(_flat(self.whiten @ answers))

    def _column(self, p: Parameter) -> ComplexArray:
        """Derivative of the motors' motion, (F, M): minus what is felt, through the compliance."""
        moved = self.moved
        if p.kind == "delay":
            axis = p.dofs[0]
            turn = np.exp(-self.s * self.delays[axis])
            change = self.one.torque_change[axis] * (2 / self.one.duration)
            rate = -turn * (self.s * self.one.torque[:, axis] + change)
            answer: ComplexArray = self.moved[:, self._motors, axis] * rate[:, None]
            return answer
        a, b = p.dofs[0], p.dofs[-1]
        felt = {
            "spring": self.displacement,
            "mass": self.acceleration,
            "coupling": self.acceleration,
        }
        at = felt.get(p.kind, self.velocity)
        if p.kind == "coupling":
            return -(moved[:, a] * at[:, b, None] + moved[:, b] * at[:, a, None])
        if p.kind in ("spring", "damper"):
            return -(moved[:, a] - moved[:, b]) * (at[:, a] - at[:, b])[:, None]
        return -moved[:, a] * at[:, a, None]

    def _acting(self) -> ComplexArray:
        """Integrals of the torques that acted, delays included, (F, M)."""
        turn = np.exp(-np.outer(self.s, self.delays))
        late = self.one.torque_change * (2 / self.one.duration) * (1 - turn) / self.s[:, None]
        result: ComplexArray = self.one.torque * turn - late
        return result

    def _left(self, rows: FloatArray) -> FloatArray:
        """Take from rows (R,) or (R, P) what the states can explain; add those of known states."""
        rows = self._with_known(rows)
        left: FloatArray = rows - self._span @ (self._span.T @ rows)
        return left

    def _with_known(self, rows: FloatArray) -> FloatArray:
        """Rows and below them a zero for each state of which something is known."""
        return np.concatenate([rows, np.zeros((self._known, *rows.shape[1:]))])

    def _told(self, rows: FloatArray) -> FloatArray:
        """Without the rows of known states."""
        return rows[: rows.shape[0] - self._known]


def _eliminated(basis: FloatArray, right: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return an orthonormal basis of the states' columns (R, S), and the most likely states (S,)."""
    scale = np.linalg.norm(basis, axis=0)
    if not np.any(scale):
        return np.zeros((basis.shape[0], 0)), np.zeros(scale.size)
    scale[scale == 0.0] = 1.0
    span, triangle, order = qr(basis / scale, mode="economic", pivoting=True, check_finite=False)
    size = np.abs(np.diag(triangle))
    known = int(np.count_nonzero(size > ROUNDING * size[0]))
    span = np.ascontiguousarray(span[:, :known])
    states = np.zeros(scale.size)
    states[order[:known]] = -solve_triangular(triangle[:known, :known], span.T @ right)
    return span, states / scale


def _times(matrices: ComplexArray, vectors: ComplexArray) -> ComplexArray:
    result: ComplexArray = np.einsum("fij,fj->fi", matrices, vectors)
    return result


def _flat(values: ComplexArray) -> FloatArray:
    """Real parts of (F, M) or (F, M, S) one below the other, then imaginary parts."""
    flat = values.reshape(-1, *values.shape[2:])
    return np.concatenate([flat.real, flat.imag])
