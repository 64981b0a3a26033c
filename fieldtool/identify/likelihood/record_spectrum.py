"""Finite Fourier integrals of a stretch of time, with end weights of third order.

Source: Press et al., Numerical Recipes, equation 4.1.14 (end weights).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
END_WEIGHTS = np.array([3 / 8, 7 / 6, 23 / 24])
"""Of the first and, backwards, of the last samples of an integral; 1 between them."""


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
