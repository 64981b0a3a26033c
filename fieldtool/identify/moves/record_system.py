"""Residuals of spectra of whole records at one set of parameters, and their derivatives.

See ``spectra`` for the equation.  The states of each experiment are eliminated:
residuals and derivatives are what they can not explain.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fieldtool.identify.likelihood.parameters import Parameter
from fieldtool.identify.likelihood.refine import machine_response, response_derivatives
from fieldtool.identify.moves.free_motion import FreeMotion
from fieldtool.identify.moves.record_spectra import Spectra
from fieldtool.records.model import MachineModel

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
ROUNDING = 1e-10
"""Singular values of the states' basis below this share count as nothing."""


class RecordSystem:
    """One set of spectra at one set of parameters."""

    def __init__(
        self, block: Spectra, model: MachineModel, delays: FloatArray, sizes: Mapping[str, float]
    ) -> None:
        self.block, self.model, self.delays = block, model, delays
        self.response = machine_response(model, block.omega, delays)
        self.free = FreeMotion(model, block.sample_period, block.rows, block.omega)
        self.net = block.net_torque(sizes, delays)
        driven = block.position - np.einsum("fij,efj->efi", self.response, self.net)
        self.whiten = self._whitening()
        basis = np.einsum("efij,fjs->efis", self.whiten, self.free.basis)
        rows = [flat_parts(basis)]
        right = [flat_parts(np.einsum("efij,efj->efi", self.whiten, driven))]
        if block.mean_torque is not None:
            self.mean_std = np.sqrt(self._mean_variance())
            mean = block.mean_torque.copy()
            for part in block.parts:
                mean[:, part.axis] -= sizes[part.name] * part.mean
            rows.append(-self.free.balance / self.mean_std[:, :, None])
            right.append(-mean / self.mean_std)
        self._project(np.concatenate(rows, axis=1), np.concatenate(right, axis=1))
        self.errors = driven - np.einsum("fis,es->efi", self.free.basis, self.states)

    def _whitening(self) -> ComplexArray:
        """Inverse Cholesky factors of half the covariance, (E, F, M, M)."""
        block, G = self.block, self.response
        spread: Any = (G * block.torque_variance[:, :, None, :]) @ G.conj().transpose(0, 2, 1)
        index = np.arange(len(block.names))
        spread[:, :, index, index] += block.position_variance
        lower = np.linalg.cholesky(np.asarray(spread, dtype=np.complex128) / 2.0)
        return np.asarray(np.linalg.inv(lower), dtype=np.complex128)

    def _mean_variance(self) -> FloatArray:
        """Of the mean torques, (E, M): as at the lowest line."""
        lowest = self.block.torque_variance[:, 0, :]
        noise = self.block.position_variance[:, 0, :]
        result: FloatArray = np.where(lowest > 0.0, lowest, 1e-12 * noise)
        return result

    def _project(self, basis: FloatArray, right: FloatArray) -> None:
        """Eliminate the states of each experiment: basis (E, rows, 2n), right (E, rows)."""
        scale = np.linalg.norm(basis, axis=1, keepdims=True)
        scale[scale == 0.0] = 1.0
        left, singular, rows = np.linalg.svd(basis / scale, full_matrices=False)
        known = singular > ROUNDING * singular[:, :1]
        self.span = left * known[:, None, :]
        inner = np.einsum("eak,ea->ek", self.span, right)
        inverse = np.where(known, 1.0 / np.where(known, singular, 1.0), 0.0)
        self.states = np.einsum("eks,ek->es", rows, inverse * inner) / scale[:, 0, :]
        self.left_over = right - np.einsum("eak,ek->ea", self.span, inner)

    def residuals(self) -> FloatArray:
        """Return residuals in standard errors, states eliminated, (E * rows,)."""
        flat: FloatArray = self.left_over.ravel()
        return flat

    def without_states(self, rows: FloatArray) -> FloatArray:
        """Take from (E, rows) what the states can explain."""
        inner = np.einsum("eak,ea->ek", self.span, rows)
        left: FloatArray = rows - np.einsum("eak,ek->ea", self.span, inner)
        return left

    def machine_columns(self, parameters: Sequence[Parameter]) -> list[FloatArray]:
        """Derivatives of the residuals, states eliminated, (E * rows,) each."""
        changes = response_derivatives(self.model, self.block.omega, self.delays, parameters)
        white = np.einsum("efij,efj->efi", self.whiten, self.errors)
        propagated = self.free.propagated(self.states)
        return [
            self._machine_column(p, np.ascontiguousarray(changes[..., k]), white, propagated)
            for k, p in enumerate(parameters)
        ]

    def _machine_column(
        self,
        parameter: Parameter,
        change: ComplexArray,
        white: ComplexArray,
        propagated: ComplexArray,
    ) -> FloatArray:
        acting = self.block.torque if parameter.kind == "delay" else self.net
        moved = -np.einsum("fij,efj->efi", change, acting)
        moved -= self.free.derivative(parameter, propagated)
        weighted = change * self.block.torque_variance[:, :, None, :]
        spread = weighted @ self.response.conj().transpose(0, 2, 1)
        spread = (spread + spread.conj().transpose(0, 1, 3, 2)) / 2.0
        turned = self.whiten @ spread @ self.whiten.conj().transpose(0, 1, 3, 2)
        lower = np.tril(turned)
        index = np.arange(lower.shape[-1])
        lower[:, :, index, index] /= 2.0
        column = np.einsum("efij,efj->efi", self.whiten, moved)
        column -= np.einsum("efij,efj->efi", lower, white)
        rows = [flat_parts(column)]
        if self.block.mean_torque is not None:
            change_of_balance = self.free.balance_derivative(parameter)
            rows.append((self.states @ change_of_balance.T) / self.mean_std)
        return self.without_states(np.concatenate(rows, axis=1)).ravel()

    def part_column(self, name: str) -> FloatArray:
        """Derivative by the size of the torque parts of this name, (E * rows,)."""
        moved = np.zeros_like(self.errors)
        means = np.zeros((moved.shape[0], moved.shape[2]))
        for part in self.block.parts:
            if part.name == name:
                early = np.exp(1j * self.block.omega * self.delays[part.axis])
                acting = part.spectrum * early
                moved += self.response[None, :, :, part.axis] * acting[:, :, None]
                means[:, part.axis] += part.mean
        rows = [flat_parts(np.einsum("efij,efj->efi", self.whiten, moved))]
        if self.block.mean_torque is not None:
            rows.append(means / self.mean_std)
        return self.without_states(np.concatenate(rows, axis=1)).ravel()


def flat_parts(values: ComplexArray) -> FloatArray:
    """Flatten lines and axes of (E, F, M) or (E, F, M, S), real parts, then imaginary parts."""
    flat = values.reshape(values.shape[0], -1, *values.shape[3:])
    return np.concatenate([flat.real, flat.imag], axis=1)
