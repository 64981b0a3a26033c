"""One stretch of time at one machine: its own free motion is part of the model.

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

Valid for linear machines, and a sample rate well above the band (:mod:`record_spectrum`).

Source: Pintelon and Schoukens, System Identification: A Frequency Domain Approach, chapters 6 and 8
(free motion in spectra of arbitrary signals); Golub and Pereyra 1973 (variable projection).
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import qr, solve_triangular

from fieldtool.identify.likelihood.parameters import Parameter
from fieldtool.identify.likelihood.record_spectrum import Spectrum
from fieldtool.records.model import MachineModel

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
ROUNDING = 1e-10
"""Share of the largest diagonal element of R below which a direction of the states is nothing."""


def compliance_of(model: MachineModel, omega: FloatArray) -> ComplexArray:
    """Return the inverse of the dynamic stiffness, (F, n, n)."""
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
