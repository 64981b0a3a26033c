"""Spectra of whole records, as fits take them."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]


@dataclass(frozen=True, eq=False)
class TorquePart:
    """A torque of known course and unknown size that takes from a motor's torque.

    Its course is known in the time of the positions, so the delay of the torque is not its own.
    """

    name: str
    """``x.coulomb_friction`` (its course is the sign of the velocity), ``x.torque_offset`` (1)."""
    axis: int
    spectrum: ComplexArray
    """(E, F): of its course, in the scale of :class:`Spectra`."""
    mean: FloatArray
    """(E,): of its course."""
    start: float = 0.0
    """N m or N."""


@dataclass(frozen=True, eq=False)
class Spectra:
    """Spectra of E records of equal length and M axes at F lines: 1/N sum x_n exp(-j w n Ts)."""

    names: tuple[str, ...]
    sample_period: float
    """s."""
    rows: int
    """N, samples in each record."""
    omega: FloatArray
    """(F,), rad/s: lines 2 pi k / (N Ts), k > 0, rising."""
    position: ComplexArray
    """(E, F, M), rad or m."""
    torque: ComplexArray
    """(E, F, M), N m, N or A."""
    position_variance: FloatArray
    """(E, F, M): E|error|**2 of the position."""
    torque_variance: FloatArray
    """(E, F, M): E|error|**2 of the torque, disturbances included."""
    mean_torque: FloatArray | None = None
    """(E, M): needed where an offset is to be told from the machine's own motion."""
    parts: tuple[TorquePart, ...] = ()

    def __post_init__(self) -> None:
        shape = (self.position.shape[0], self.omega.size, len(self.names))
        for what in ("position", "torque", "position_variance", "torque_variance"):
            if getattr(self, what).shape != shape:
                raise ValueError(
                    f"spectra: {what} must have shape {shape}, got {getattr(self, what).shape}"
                )
            if not np.all(np.isfinite(getattr(self, what))):
                raise ValueError(f"spectra: {what} must be finite")
        if np.any(~(self.omega > 0.0)) or np.any(np.diff(self.omega) <= 0.0):
            raise ValueError("spectra: frequencies must be positive and rise")
        if np.any(self.position_variance < 0.0) or np.any(self.torque_variance < 0.0):
            raise ValueError("spectra: variances can not be negative")
        if not np.all((self.position_variance > 0.0) | (self.torque_variance > 0.0)):
            raise ValueError("spectra: either the position or the torque of an axis must be noisy")
        if self.mean_torque is not None and self.mean_torque.shape != (shape[0], shape[2]):
            raise ValueError(f"spectra: mean_torque must have shape {(shape[0], shape[2])}")
        for part in self.parts:
            if part.spectrum.shape != shape[:2] or part.mean.shape != shape[:1]:
                raise ValueError(f"spectra: {part.name} must have shape {shape[:2]}")

    @property
    def count(self) -> int:
        """Number of real numbers measured."""
        means = 0 if self.mean_torque is None else self.mean_torque.size
        return 2 * self.position.size + means

    def net_torque(self, sizes: Mapping[str, float], delays: FloatArray) -> ComplexArray:
        """Torque less its parts of these sizes, as early as the torque, (E, F, M)."""
        torque = self.torque.copy()
        for part in self.parts:
            early = np.exp(1j * self.omega * delays[part.axis])
            torque[:, :, part.axis] -= sizes[part.name] * part.spectrum * early
        return torque
