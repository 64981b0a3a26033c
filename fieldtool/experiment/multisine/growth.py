"""A watch for position loops that become unstable while they are excited.

What is watched, each as a share of its limit, is the part of position error (reference minus position)
and torque that does not repeat from period to period; before there are two periods, the position error
itself.  Noise, friction and decaying transients are in it too, but they do not grow.  An oscillation
that grows by itself does: over four stretches of one length, each a factor larger than the one before.
Stretches of many lengths see fast and slow growth: the time constant may be up to 4.5 stretches.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from fieldtool.records.model import FloatArray

SHORTEST, LONGEST = 0.015, 4.0
"""Seconds of a stretch; lengths double from one to the next."""
FEWEST_ROWS = 8
"""Of a stretch."""
RISES, RISE = 3, 1.25
"""So many times in a row, a stretch is larger than the one before by this factor."""
TURNS = 5
"""Times that it turns to the other side of its mean in these stretches, at least: no mere push."""
ONE_FREQUENCY = 0.8
"""Share of its power about one frequency, once its growth is taken out: no mere noise."""
AT_LEAST = 2
"""They are compared with all stretches before these, of which there have to be so many."""
OUT_OF_THE_USUAL, LARGER_THAN_MOST, MOST = 4.0, 2.0, 0.95
"""The last one is larger by these than the median, and than this share, of the stretches before."""
SHARE_OF_LIMIT = 0.25
"""And above this share of the limit."""
UNEXPECTED = 3.0
"""While nothing repeats yet: larger by this than the peak that was predicted, instead of usual."""
NEAR_LINES, NEAR_SHARE, MOSTLY = 4, 0.1, 0.7
"""Lines beside that of an oscillation, or share of its frequency, that belong to it as it grows; and the
share of the power above the band that they hold: of noise they do not."""
_PADDING = 4


@dataclass(frozen=True)
class Growth:
    """A growing oscillation."""

    axis: int
    quantity: Literal["following error", "torque"]
    frequency: float
    """Hz."""
    share: float
    """Amplitude of the last stretch, as a share of the limit."""


class GrowthWatch:
    """Watches one experiment, block by block; quick enough for between two cycles.

    Parameters
    ----------
    samples
        Rows of a period.
    steady
        First row at which the excitation has its full size: nothing before it counts as a period.
    error_limits, torque_limits
        Shape (M,), SI.
    expected_errors
        Largest following errors by the forecast, shape (M,), or None: then nothing is judged until
        something repeats.
    cycle_time
        Seconds.
    periods
        So many there may be at most, for which there is room from the beginning (of memory that is not
        used before it is written): to make room takes as long as several cycles.
    """

    def __init__(
        self,
        samples: int,
        steady: int,
        error_limits: FloatArray,
        torque_limits: FloatArray,
        expected_errors: FloatArray | None,
        cycle_time: float,
        periods: int = 4,
    ) -> None:
        self._samples, self._steady, self._step = samples, steady, cycle_time
        self._limits = np.concatenate([error_limits, torque_limits])
        M = error_limits.size
        self._first_threshold = np.full(2 * M, np.inf)
        if expected_errors is not None:
            predicted = UNEXPECTED * expected_errors / error_limits
            self._first_threshold[:M] = np.maximum(SHARE_OF_LIMIT, predicted)
        self._seen = _Trail(2 * M, steady + periods * samples)
        self._odd = _Trail(2 * M, periods * samples)
        shortest = max(FEWEST_ROWS, round(SHORTEST / cycle_time))
        doublings = max(1, 1 + int(np.log2(max(1.0, LONGEST / cycle_time / shortest))))
        self._lengths = [shortest << k for k in range(doublings)]

    def take(self, error: FloatArray, torque: FloatArray) -> Growth | None:
        """Take a block of position errors and torques, shape (n, M) each; return growth once sure."""
        values = np.hstack([error, torque]) / self._limits
        begin = self._seen.rows
        self._seen.extend(values)
        first = self._steady + self._samples  # from here on there is a period before
        skipped = max(0, first - begin)
        if skipped < values.shape[0]:
            before = self._seen.values(begin + skipped - self._samples, values.shape[0] - skipped)
            self._odd.extend(values[skipped:] - before)
        if self._odd.rows:
            return self._judge(self._odd, np.full(self._limits.size, SHARE_OF_LIMIT), compare=True)
        return self._judge(self._seen, self._first_threshold, compare=False)

    def _judge(self, trail: "_Trail", threshold: FloatArray, *, compare: bool) -> Growth | None:
        for length in self._lengths:
            if (RISES + 1) * length > trail.rows:
                break
            growing = trail.growing(length, threshold, compare=compare)
            if np.any(growing):
                level = np.where(growing, trail.levels(length, 0, 1)[0], 0.0)
                place = int(np.argmax(level))
                M = self._limits.size // 2
                return Growth(
                    place % M,
                    "following error" if place < M else "torque",
                    trail.frequency(place, length) / self._step,
                    float(level[place]),
                )
        return None


class _Trail:
    """Signals so far, with running sums that give the level of any stretch at once."""

    def __init__(self, signals: int, capacity: int) -> None:
        self.rows = 0
        self._values = np.zeros((capacity, signals))
        self._sums = np.zeros((2, capacity + 1, signals))

    def extend(self, values: FloatArray) -> None:
        """Add rows, shape (n, S)."""
        begin, end = self.rows, self.rows + values.shape[0]
        while end > self._values.shape[0]:
            self._values = np.concatenate([self._values, np.zeros_like(self._values)])
            self._sums = np.concatenate([self._sums, np.zeros_like(self._sums[:, 1:])], axis=1)
        self._values[begin:end] = values
        for sums, added in zip(self._sums, (values, values**2), strict=True):
            sums[begin + 1 : end + 1] = sums[begin] + np.cumsum(added, axis=0)
        self.rows = end

    def values(self, begin: int, count: int) -> FloatArray:
        """Return rows, shape (count, S)."""
        return self._values[begin : begin + count]

    def levels(self, length: int, skipped: int, count: int) -> FloatArray:
        """Return amplitudes of ``count`` stretches, the last one ``skipped`` before the end, (count, S).

        As of a sine: root of twice the variance.
        """
        edges = self.rows - length * np.arange(skipped + count, skipped - 1, -1)
        mean, square = np.diff(self._sums[:, edges], axis=1) / length
        level: FloatArray = np.sqrt(2 * np.maximum(square - mean**2, 0.0))
        return level

    def growing(self, length: int, threshold: FloatArray, *, compare: bool) -> NDArray[np.bool_]:
        """Return which signals grow over the last stretches of a length, shape (S,)."""
        level = self.levels(length, 0, RISES + 1)
        grown: NDArray[np.bool_] = np.all(level[1:] > RISE * level[:-1], axis=0)
        grown &= level[-1] > threshold
        if compare and np.any(grown):
            count = self.rows // length - RISES - 1
            if count < AT_LEAST:
                return np.zeros_like(grown)
            before = self.levels(length, RISES + 1, count)
            grown &= level[-1] > OUT_OF_THE_USUAL * np.median(before, axis=0)
            grown &= level[-1] > LARGER_THAN_MOST * np.quantile(before, MOST, axis=0)
        for signal in np.flatnonzero(grown):
            evened = self._evened(int(signal), length)
            grown[signal] = _turns(evened) >= TURNS and _main(evened)[1] >= ONE_FREQUENCY
        return grown

    def frequency(self, signal: int, length: int) -> float:
        """Return what stands out in the stretches of a growing signal, periods a row."""
        return _main(self._evened(signal, length))[0]

    def _evened(self, signal: int, length: int) -> FloatArray:
        """Return the last stretches with their growth taken out, about their mean."""
        count = (RISES + 1) * length
        last = self.values(self.rows - count, count)[:, signal]
        level = self.levels(length, 0, RISES + 1)[:, signal]
        rate = np.log(level[-1] / max(level[0], 1e-3 * level[-1])) / (RISES * length)
        evened = (last - last.mean()) * np.exp(-rate * np.arange(count))
        result: FloatArray = evened - evened.mean()
        return result


def _main(values: FloatArray) -> tuple[float, float]:
    """Return the frequency that stands out, periods a row, and the share of power about it."""
    n = values.size
    power = np.abs(np.fft.rfft(values * np.hanning(n), _PADDING * n)) ** 2
    peak = int(np.argmax(power))
    near = power[max(0, peak - 2 * _PADDING) : peak + 2 * _PADDING + 1]  # the window's main lobe
    return peak / (_PADDING * n), float(near.sum() / power.sum())


def _turns(values: FloatArray) -> int:
    """Count how often a signal goes from clearly above to clearly below 0 or back."""
    side = np.sign(values[np.abs(values) > 0.5 * values.std()])
    return int(np.count_nonzero(np.diff(side)))


def out_of_band(torque: FloatArray, highest: float) -> float | None:
    """Return the frequency of a torque, shape (n,), that oscillates mostly above the band; else None.

    Noise does not: no frequency holds most of what is above.

    Parameters
    ----------
    torque
        A block.
    highest
        Frequency up to which there is excitation, periods a row.

    Returns
    -------
    float or None
        Periods a row.  Drives run faster than the bus: what oscillates above half its rate shows at
        another frequency, perhaps inside the band.
    """
    n = torque.size
    power = np.abs(np.fft.rfft((torque - torque.mean()) * np.hanning(n))) ** 2
    above = np.arange(power.size) / n > 1.2 * highest + 2 / n
    power_above = np.where(above, power, 0.0)
    if not np.any(above) or power_above.sum() < 0.5 * power.sum():
        return None
    peak = int(np.argmax(power_above))
    near = max(NEAR_LINES, round(NEAR_SHARE * peak))
    if power_above[max(peak - near, 0) : peak + near + 1].sum() < MOSTLY * power_above.sum():
        return None
    return peak / n
