"""Up to which frequency a measured position may be differentiated, to know when an axis turns.

Dry friction bends the velocity where it passes zero: an axis stops faster than it starts again.  A low
pass puts the turn too late by that bend, and the friction that is taken off then looks like inertia.
So the velocity keeps all frequencies at which the position's noise does not yet hide standstill.
"""

from math import comb

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
UNSURE = 3.0
"""Standard errors of the velocity below which an axis may be standing."""
STOPPED = 2e-3
"""Share of the fastest velocity below which an axis may be standing."""
NOISY = 1e-2
"""Share of the fastest velocity that its noise may hide, UNSURE standard errors of it."""
HIGHEST = 0.8
"""Of half the sampling rate."""


def white_noise(values: FloatArray) -> FloatArray:
    """Standard error of each column's white noise, (M,): eighth differences leave no motion."""
    left = np.median(np.abs(np.diff(values, 8, axis=0)), axis=0)
    return np.asarray(left / 0.6745 / np.sqrt(comb(16, 8)), dtype=np.float64)


def position_noise(position: FloatArray) -> FloatArray:
    """Standard error of each column's noise, (M,): white, an encoder's steps, or rounded numbers.

    An axis that stands shows none of its noise, or a count now and then, which no median sees.  One
    move may be less than a step of the encoder: where periods are joined.
    """
    moves = np.abs(np.diff(position, axis=0))
    steps = np.sort(np.where(moves > 0, moves, np.inf), axis=0)[1]
    counts = np.where(np.isfinite(steps), steps, 0.0) / 12**0.5
    least: FloatArray = np.spacing(np.max(np.abs(position), axis=0))
    return np.asarray(np.maximum.reduce([white_noise(position), counts, least]), dtype=np.float64)


def velocity_noise(noise: FloatArray, band: FloatArray, step: float) -> FloatArray:
    """Standard error of velocities up to `band`, Hz, of positions with white `noise`, (M,)."""
    return np.asarray(2 * np.pi * band * noise * np.sqrt(2 * band * step / 3), dtype=np.float64)


def velocity_band(position: FloatArray, step: float, least: float) -> FloatArray:
    """Return the highest frequency that each axis' velocity keeps, Hz, shape (M,).

    Parameters
    ----------
    position
        Shape (n, M), n at least 10.
    step
        s.
    least
        What it keeps in any case, Hz: the band of the excitation and some of its harmonics.

    Notes
    -----
    The velocity's noise is then ``NOISY / UNSURE`` of the fastest velocity.
    """
    noise = position_noise(position)
    fastest = np.quantile(np.abs(np.diff(position, axis=0)), 0.99, axis=0) / step
    allowed = NOISY / UNSURE * fastest
    unit = np.maximum(velocity_noise(noise, np.ones_like(noise), step), 1e-300)
    band = np.minimum((allowed / unit) ** (2 / 3), HIGHEST / (2 * step))
    return np.asarray(np.maximum(band, min(least, HIGHEST / (2 * step))), dtype=np.float64)
