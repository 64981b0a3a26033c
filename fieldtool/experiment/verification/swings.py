"""Turns of one signal: where it comes back by more than a level."""

from dataclasses import dataclass, field
from itertools import pairwise

MOST_KEPT = 64
"""Turns that are remembered."""


@dataclass
class Swings:
    """Follows one signal, sample by sample, and notes its turns (hysteresis of one level)."""

    level: float = float("inf")
    """Peak to peak: what comes back by less is no turn."""
    sizes: list[float] = field(default_factory=list)
    """From turn to turn, peak to peak, the last ones."""
    times: list[int] = field(default_factory=list)
    """Samples at which the turns were seen, one more than sizes where the first way was a swing too."""
    _rising: bool | None = None
    _extreme: float = 0.0
    _begin: float = 0.0
    _low: float = float("inf")
    _high: float = float("-inf")
    _now: int = 0

    @property
    def now(self) -> int:
        """Samples taken so far."""
        return self._now

    def restart(self, level: float) -> None:
        """Forget all turns, and look for those of another level from the next sample on."""
        self.level, self.sizes, self.times, self._rising = level, [], [], None
        self._low, self._high = float("inf"), float("-inf")

    def go_on(self, level: float) -> None:
        """Look for turns of another level from now on; those that were seen still count."""
        if self.level < float("inf") and level < float("inf"):
            self.level = level
        else:
            self.restart(level)

    def take(self, value: float) -> bool:
        """Take a sample; return whether it completes a swing."""
        self._now += 1
        if self._rising is None:
            self._low, self._high = min(self._low, value), max(self._high, value)
            if self._high - self._low < self.level:
                return False
            self._rising = value == self._high
            ends = self._low, self._high
            self._begin, self._extreme = ends if self._rising else ends[::-1]
            self.times.append(self._now)
            return False
        if value > self._extreme if self._rising else value < self._extreme:
            self._extreme = value
            return False
        if abs(value - self._extreme) < self.level:
            return False
        self.sizes.append(abs(self._extreme - self._begin))
        self.times.append(self._now)
        self._begin, self._extreme, self._rising = self._extreme, value, not self._rising
        del self.sizes[:-MOST_KEPT], self.times[: -MOST_KEPT - 1]
        return True

    def series(self, longest: int, since: int = 0) -> list[float]:
        """Return the sizes of the last swings, each of them at most so many samples after another.

        Only those that began after a sample count.
        """
        count = 0
        for a, b in pairwise(self.times[::-1]):
            if a - b > longest or b <= since:
                break
            count += 1
        return self.sizes[len(self.sizes) - min(count, len(self.sizes)) :]

    def frequency(self, count: int) -> float:
        """Return the mean frequency of the last swings, periods a sample."""
        times = self.times[-count:]  # turns; the first way began before it was seen
        return (len(times) - 1) / (2 * max(times[-1] - times[0], 1))
