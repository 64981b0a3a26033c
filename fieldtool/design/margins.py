"""Margins of one loop from its sensitivity: how far it is from swinging by itself."""

from dataclasses import asdict, dataclass
from math import inf
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fieldtool.records.model import FloatArray

ComplexArray = NDArray[np.complexfloating[Any, Any]]
BANDWIDTH_LEVEL = 1 / np.sqrt(2)


@dataclass(frozen=True)
class Margins:
    """Of one axis' loop with all others closed."""

    sensitivity_peak: float
    """Largest abs(1 / (1 + L)): reciprocal of the distance from -1."""
    peak_frequency: float
    """Hz, where it is."""
    gain_margin: float
    """Factor by which the loop's gain may grow; infinite where no growth makes it unstable."""
    gain_reduction: float
    """Factor to which it may fall; 0 where none makes it unstable."""
    phase_margin: float
    """Smallest of all crossings, degrees."""
    delay_margin: float
    """s, of further delay."""
    bandwidth: float
    """Hz: up to it disturbances are held down to 0.7 or less."""

    def as_dict(self) -> dict[str, float]:
        """Plain values."""
        return asdict(self)


def margins_of(omega: FloatArray, sensitivity: ComplexArray) -> Margins:
    """Return the margins of a stable loop.

    Parameters
    ----------
    omega
        Frequencies, shape (F,), rad/s, rising, close enough for all peaks.
    sensitivity
        1 / (1 + L), shape (F,).
    """
    loop = 1 / sensitivity - 1
    size = np.abs(sensitivity)
    peak = int(np.argmax(size))
    up, down = _gain_margins(loop)
    phase, delay = _phase_margins(omega, loop)
    above = np.flatnonzero(size >= BANDWIDTH_LEVEL)
    first = int(above[0]) if above.size else omega.size - 1
    bandwidth = float(omega[first])
    if first > 0 and size[first] > size[first - 1]:
        share = (BANDWIDTH_LEVEL - size[first - 1]) / (size[first] - size[first - 1])
        bandwidth = float(omega[first - 1] + share * (omega[first] - omega[first - 1]))
    return Margins(
        float(size[peak]),
        float(omega[peak]) / (2 * np.pi),
        up,
        down,
        phase,
        delay,
        bandwidth / (2 * np.pi),
    )


def _gain_margins(loop: ComplexArray) -> tuple[float, float]:
    """Return factors up and down at which L passes through -1."""
    sign = np.sign(loop.imag)
    at = np.flatnonzero(sign[:-1] * sign[1:] < 0)
    share = loop.imag[at] / (loop.imag[at] - loop.imag[at + 1])
    crossing = loop.real[at] + share * (loop.real[at + 1] - loop.real[at])
    crossing = -crossing[crossing < 0]
    up = crossing[crossing < 1]
    down = crossing[crossing >= 1]
    return (
        float(1 / up.max()) if up.size and up.max() > 0 else inf,
        float(1 / down.min()) if down.size else 0.0,
    )


def _phase_margins(omega: FloatArray, loop: ComplexArray) -> tuple[float, float]:
    size = np.log(np.abs(loop))
    at = np.flatnonzero(size[:-1] * size[1:] < 0)
    if at.size == 0:
        return inf, inf
    share = size[at] / (size[at] - size[at + 1])
    phase = np.unwrap(np.angle(loop))
    angle = phase[at] + share * (phase[at + 1] - phase[at])
    w = omega[at] + share * (omega[at + 1] - omega[at])
    beyond = np.mod(angle + np.pi, 2 * np.pi)
    nearest = np.minimum(beyond, 2 * np.pi - beyond)
    return float(np.degrees(nearest.min())), float((beyond / w).min())
