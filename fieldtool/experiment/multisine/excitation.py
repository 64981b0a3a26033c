"""What a multisine experiment sends in any stretch of cycles, with a smooth beginning and end.

Displacements from the centre at cycle r, the periods that count beginning at cycle ``settle``::

    x(r) = Re sum_k U_k exp(2 pi j line_k (r - settle) / samples) * up(r) * (1 - up(r - end))

``up`` rises from 0 to 1 (value, slope and curvature are smooth at both ends), so that the axes start
and end at rest.  A bias velocity rises and ends likewise, and its way is added.
"""

from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from fieldtool.records.closed_loop import ComplexArray
from fieldtool.records.model import FloatArray

IntArray = NDArray[np.int_]


class Periodic(Protocol):
    """What an excitation needs to know of an experiment, such as a multisine."""

    @property
    def cycle_time(self) -> float:
        """Seconds."""

    @property
    def samples(self) -> int:
        """Cycles in a period."""

    @property
    def settle(self) -> int:
        """Cycles of excitation before the periods that count."""

    @property
    def fade(self) -> int:
        """Cycles in which the excitation rises."""

    @property
    def bias(self) -> FloatArray:
        """Constant velocity, (M,), rad/s or m/s."""

    @property
    def start(self) -> FloatArray:
        """Where it begins, from the centre, (M,), rad or m."""

    def one_period(self) -> FloatArray:
        """Return a period of displacements, shape (samples, M), rad or m, without the bias."""

    def one_period_of_torque(self) -> FloatArray:
        """Return a period of torque offsets, shape (samples, M), N m or N."""


@dataclass(frozen=True, eq=False)
class Excitation:
    """An experiment's excitation that may end at any cycle, in any stretch of cycles."""

    experiment: Periodic
    tables: tuple[FloatArray, FloatArray]
    """A period of displacements and of torque offsets, shape (samples, M) each."""
    end: int | None = None
    """Cycle from which it fades out; None: it goes on for ever."""
    fade_out: int = 0
    """Cycles of the fade-out; 0: as many as the fade-in has."""

    @classmethod
    def of(cls, experiment: Periodic, end: int | None = None) -> "Excitation":
        """Return an experiment's excitation."""
        tables = (experiment.one_period(), experiment.one_period_of_torque())
        return cls(experiment, tables, end)

    def ending_at(self, end: int, fade_out: int = 0) -> "Excitation":
        """Return it with an end."""
        return replace(self, end=end, fade_out=fade_out)

    @property
    def over(self) -> int | None:
        """First cycle in which it is at rest again; None where it has no end."""
        return None if self.end is None else self.end + self._out + 1

    @property
    def _out(self) -> int:
        return self.fade_out or self.experiment.fade

    def displacements(self, first: int, count: int) -> FloatArray:
        """Return displacements from the centre at ``count`` cycles, shape (count, M)."""
        one = self.experiment
        way = one.start + np.outer(self._bias_cycles(first, count), one.bias * one.cycle_time)
        moved: FloatArray = way + self._faded(self.tables[0], first, count)
        return moved

    def torques(self, first: int, count: int) -> FloatArray:
        """Return torque offsets at ``count`` cycles, shape (count, M)."""
        return self._faded(self.tables[1], first, count)

    def _faded(self, table: FloatArray, first: int, count: int) -> FloatArray:
        one = self.experiment
        r = np.arange(first, first + count)
        envelope = _rise(r / one.fade)
        if self.end is not None:
            envelope = envelope * (1 - _rise((r - self.end) / self._out))
        faded: FloatArray = table[(r - one.settle) % one.samples] * envelope[:, None]
        return faded

    def _bias_cycles(self, first: int, count: int) -> FloatArray:
        """Return the integral of the bias' rise and fall, in cycles at full bias."""
        r = np.arange(first, first + count, dtype=np.float64)
        cycles = _risen(r, self.experiment.fade)
        if self.end is not None:
            cycles = cycles - _risen(r - self.end, self._out)
        return cycles


def signals(phasors: ComplexArray, lines: IntArray, samples: int) -> FloatArray:
    """Return one period of Re sum_k U_k exp(2 pi j line_k n / samples), shape (samples, Q).

    Parameters
    ----------
    phasors
        U, peak values, shape (L, Q).
    lines
        Line numbers, shape (L,), below samples / 2.
    samples
        Samples in the period.
    """
    spectrum = np.zeros((samples // 2 + 1, phasors.shape[1]), dtype=np.complex128)
    spectrum[lines] = phasors * (samples / 2)
    values: FloatArray = np.fft.irfft(spectrum, samples, axis=0)
    return values


def _rise(u: FloatArray) -> FloatArray:
    """Return the smooth step from 0 at u = 0 to 1 at u = 1."""
    u = np.clip(u, 0.0, 1.0)
    risen: FloatArray = u**3 * (10 - 15 * u + 6 * u * u)
    return risen


def _risen(r: FloatArray, fade: int) -> FloatArray:
    """Return the integral of the smooth step over cycles, from 0."""
    u = np.clip(r / fade, 0.0, 1.0)
    area: FloatArray = fade * u**4 * (2.5 - 3 * u + u * u) + np.maximum(r - fade, 0.0)
    return area
