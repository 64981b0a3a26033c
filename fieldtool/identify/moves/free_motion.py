"""How a machine moves on its own from a state, as spectra of sampled records see it.

The spectrum X(k) = 1/N sum x_n z**-n (z = exp(j w Ts), N rows) of a record that does not repeat holds
more than G T: what moves freely at its start, less what would at its end::

    Theta(k) = G(w_k) T(k) + D(z_k) x_e        D = C z (z I - A)**-1 / N        x_e = x_0 - x_N

with A = exp(Ac Ts) the machine's free motion over one sample.  D is exact for a sampled record.  The
state is q and v Ts of all masses, so all of it has the unit of position.

At zero frequency springs drop out, and what is left is the balance of momentum of each chain: mean
torque times N Ts = change of momentum plus friction times travel.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm, expm_frechet

from fieldtool.identify.likelihood.parameters import Parameter
from fieldtool.records.model import MachineModel

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]


@dataclass(frozen=True, eq=False)
class FreeMotion:
    """Free motion of a machine of n masses and M axes in records of N rows."""

    model: MachineModel
    sample_period: float
    """s."""
    rows: int
    """N."""
    omega: FloatArray
    """(F,), rad/s, positive."""

    @cached_property
    def basis(self) -> ComplexArray:
        """D, shape (F, M, 2n): spectra of the motors' positions per initial less final state."""
        n = self._generator.shape[0] // 2
        pick = np.zeros((2 * n, len(self.model.axes)), complex)
        pick[self.model.first_masses, np.arange(len(self.model.axes))] = 1.0
        transposed = self._resolvent_inverse.transpose(0, 2, 1)
        solved = np.linalg.solve(transposed, np.broadcast_to(pick, (self.omega.size, *pick.shape)))
        scale = np.asarray(self._z / self.rows)[:, None, None]
        return np.asarray(scale * solved.transpose(0, 2, 1), dtype=np.complex128)

    def propagated(self, states: FloatArray) -> ComplexArray:
        """Return (z I - A)**-1 x_e of states (E, 2n), shape (F, 2n, E): for :meth:`derivative`."""
        right = np.broadcast_to(states.T, (self.omega.size, *states.T.shape))
        return np.asarray(np.linalg.solve(self._resolvent_inverse, right), dtype=np.complex128)

    def derivative(self, parameter: Parameter, propagated: ComplexArray) -> ComplexArray:
        """Derivative of D x_e with respect to a parameter (SI), shape (E, F, M); zero for a delay.

        Parameters
        ----------
        parameter
        propagated : array, shape (F, 2n, E)
            From :meth:`propagated`.
        """
        lines, size, count = propagated.shape
        if parameter.kind == "delay":
            return np.zeros((count, lines, len(self.model.axes)), complex)
        n = size // 2
        changed = np.zeros((size, size))
        mass, damping, stiffness = matrix_changes(parameter, n)
        step, inverse = self.sample_period, np.linalg.inv(self.model.mass_matrix)
        lost = mass @ inverse
        changed[n:, :n] = step**2 * inverse @ (lost @ self.model.stiffness_matrix - stiffness)
        changed[n:, n:] = step * inverse @ (lost @ self.model.damping_matrix - damping)
        turned = expm_frechet(self._generator, changed, compute_expm=False)
        result: ComplexArray = (self.basis @ (turned @ propagated)).transpose(2, 0, 1)
        return result

    @cached_property
    def balance(self) -> FloatArray:
        """R, shape (M, 2n): R x_e is the mean torque of each motor that the motion took, N m or N."""
        chains = self._members
        step = self.sample_period
        damping, mass = self.model.damping_matrix, self.model.mass_matrix
        return -np.hstack([chains @ damping, chains @ mass / step]) / (self.rows * step)

    def balance_derivative(self, parameter: Parameter) -> FloatArray:
        """Derivative of R with respect to a parameter (SI), shape (M, 2n)."""
        n, step = self.model.mass_matrix.shape[0], self.sample_period
        mass, damping, _ = matrix_changes(parameter, n)
        chains = self._members
        return -np.hstack([chains @ damping, chains @ mass / step]) / (self.rows * step)

    @property
    def _members(self) -> FloatArray:
        """Which masses belong to which chain, (M, n)."""
        lengths = [len(axis.masses) for axis in self.model.axes]
        return np.repeat(np.eye(len(lengths)), lengths, axis=1)

    @cached_property
    def _generator(self) -> FloatArray:
        """Ac Ts of the state (q, v Ts), (2n, 2n)."""
        mass, step = self.model.mass_matrix, self.sample_period
        n = mass.shape[0]
        result = np.zeros((2 * n, 2 * n))
        result[:n, n:] = np.eye(n)
        result[n:, :n] = -(step**2) * np.linalg.solve(mass, self.model.stiffness_matrix)
        result[n:, n:] = -step * np.linalg.solve(mass, self.model.damping_matrix)
        return result

    @cached_property
    def _resolvent_inverse(self) -> ComplexArray:
        """Matrix z I - A, (F, 2n, 2n)."""
        size = self._generator.shape[0]
        result: ComplexArray = self._z[:, None, None] * np.eye(size) - expm(self._generator)
        return result

    @cached_property
    def _z(self) -> ComplexArray:
        factors: ComplexArray = np.exp(1j * self.omega * self.sample_period)
        return factors


def matrix_changes(parameter: Parameter, n: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Derivatives of mass, damping and stiffness matrix, (n, n) each; all zero for a delay."""
    mass, damping, stiffness = np.zeros((3, n, n))
    place = _sandwich(n, parameter.dofs) if parameter.kind != "delay" else np.zeros((n, n))
    if parameter.kind == "mass":
        mass = place
    elif parameter.kind == "coupling":
        a, b = parameter.dofs
        mass[a, b] = mass[b, a] = 1.0
    elif parameter.kind == "spring":
        stiffness = place
    else:
        damping = place
    return mass, damping, stiffness


def _sandwich(n: int, dofs: Sequence[int]) -> FloatArray:
    """Build the matrix of an element from a mass to ground, or between two masses."""
    direction = np.zeros(n)
    direction[dofs[0]] = 1.0
    if len(dofs) == 2:
        direction[dofs[1]] = -1.0
    return np.outer(direction, direction)
