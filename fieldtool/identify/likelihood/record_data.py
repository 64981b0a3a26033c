"""Whole records as the fit takes them: several stretches of time, each with its own free motion.

What is left of each stretch (:mod:`record_system`) is weighted with the covariance of its equation
error; something in the torques whose course is known is eliminated as the states are.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from fieldtool.identify.likelihood.parameters import Parameter
from fieldtool.identify.likelihood.record_spectrum import Spectrum
from fieldtool.identify.likelihood.record_system import ROUNDING, RecordSystem, compliance_of
from fieldtool.identify.likelihood.whitening import whitening
from fieldtool.records.model import MachineModel

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]


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
            compliance = compliance_of(model, self.omega)
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
