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
    """N, a multiple of 4."""

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
        """Return the signal of phasors, shape (..., N / 2), as (..., N).

        One transform of N / 2 gives both halves: x(t) + j x(t + T) holds odd harmonics with twice their
        phasor at positive frequencies (T turns them by -j) or at negative ones, conjugated (by +j).
        """
        half, quarter = self.samples // 2, self.samples // 4
        folded = np.empty((*spectrum.shape[:-1], half), dtype=np.complex128)
        folded[..., :quarter] = spectrum[..., 1::2]
        np.conjugate(spectrum[..., ::2], out=folded[..., : quarter - 1 : -1])
        halves = np.fft.ifft(folded)
        halves *= self._turn
        return np.concatenate([halves.real, halves.imag], axis=-1)

    @cached_property
    def _twist(self) -> ComplexArray:
        return np.asarray(np.exp(1j * np.pi * np.arange(self.samples) / self.samples))

    @cached_property
    def _turn(self) -> ComplexArray:
        """Of the transform's lowest frequency, the third harmonic."""
        return self._twist[: self.samples // 2] ** 3

    def move(self, move: TestMove) -> FloatArray:
        """Return the reference of a move about its middle, from minus to plus half the distance."""
        return move.at(self.time)[0] - 0.5 * move.distance

    def step(self, height: float) -> FloatArray:
        """Return a step from minus to plus half its height, at time 0."""
        out = np.full(self.samples, 0.5 * height)
        out[0] = 0.0  # a jump's samples are its mean, so that it stays at time 0
        return out
