"""Responses in time from responses in frequency, for signals that go there and back for ever.

A signal x(t) that repeats itself with the opposite sign after T has odd harmonics of 1 / 2T alone.  So
one response of a linear system from rest to rest is exact, delays and all, where it has come to rest
within T; what has not is folded back, which :attr:`HalfWave.duration` has to be long enough for.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fieldtool.design.moves import TestMove
from fieldtool.records.model import FloatArray

ComplexArray = NDArray[np.complexfloating[Any, Any]]


@dataclass(frozen=True)
class HalfWave:
    """N samples over half a period; frequencies are its odd harmonics below half the sample rate."""

    duration: float
    """s, half a period."""
    samples: int
    """N, even."""

    @cached_property
    def time(self) -> FloatArray:
        """Shape (N,), s, from 0."""
        return np.arange(self.samples, dtype=np.float64) * (self.duration / self.samples)

    @cached_property
    def omega(self) -> FloatArray:
        """Shape (N / 2,), rad/s."""
        return (2 * np.arange(self.samples // 2, dtype=np.float64) + 1) * (np.pi / self.duration)

    def spectrum(self, signal: FloatArray) -> ComplexArray:
        """Return the phasors of a signal, shape (N,), as shape (N / 2,)."""
        return np.fft.fft(signal * np.conj(self._twist))[: self.samples // 2]

    def signal(self, spectrum: ComplexArray) -> FloatArray:
        """Return the signal of phasors, shape (..., N / 2) or fewer (the others are 0), as (..., N)."""
        twisted = np.fft.ifft(spectrum, self.samples)
        twisted *= self._twist
        return np.asarray(2 * twisted.real)

    @cached_property
    def _twist(self) -> ComplexArray:
        return np.asarray(np.exp(1j * np.pi * np.arange(self.samples) / self.samples))

    def move(self, move: TestMove) -> FloatArray:
        """Return the reference of a move about its middle, from minus to plus half the distance."""
        return move.at(self.time)[0] - 0.5 * move.distance

    def step(self, height: float) -> FloatArray:
        """Return a step from minus to plus half its height, at time 0."""
        out = np.full(self.samples, 0.5 * height)
        out[0] = 0.0  # a jump's samples are its mean, so that it stays at time 0
        return out
