"""Which rows of a periodic record are sound, and whole periods in which what is not was measured again.

A cycle that is late, or a sample that is missing, disturbs the axes: its row and those of a while after
it are not sound.  The excitation goes on meanwhile, period after period (pass after pass), until enough
of them in a row are sound, or, where a host is late again and again, until every row of a period was
passed undisturbed as often.  Then passes in a row are taken, and their disturbed rows are those of
other passes, moved by what the two differ around them: so what decays or drifts slowly goes on.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from fieldtool.records.model import FloatArray

IntArray = NDArray[np.int_]
BoolArray = NDArray[np.bool_]

AS_IT_CAME = ", as it came"
"""Ends the name of a record with all its rows in their order, beside the periods taken out of it."""
EDGE = 8
"""Rows at each end of a disturbed stretch over which two passes are compared."""


def sound_rows(
    missing: Sequence[int], tail: int, settle: int, samples: int, passes: int
) -> BoolArray:
    """Return which rows of each pass are undisturbed, shape (passes, samples).

    Parameters
    ----------
    missing
        Rows in which a sample is missing or a cycle was late, from the beginning of the run-in; below 0
        in what came before.
    tail
        Rows after such a one that it disturbs.
    settle, samples
        Rows of the run-in, and of a period.
    passes
        Periods that were passed since the run-in.
    """
    sound = np.ones(settle + passes * samples, dtype=np.bool_)
    for row in missing:
        sound[max(row, 0) : max(row + tail + 1, 0)] = False
    return sound[settle:].reshape(passes, samples)


def sound_in_a_row(sound: BoolArray, periods: int) -> bool:
    """Return whether the last ``periods`` passes are sound, without a disturbed row."""
    return sound.shape[0] >= periods and bool(sound[-periods:].all())


@dataclass(frozen=True, eq=False)
class Whole:
    """Passes in a row, with the row of the record that stands for each of theirs."""

    first: int
    """Pass."""
    own: IntArray
    """Their own rows, counted from the first pass' first, shape (periods * samples,)."""
    sources: IntArray
    """The same, but where they are disturbed rows of other passes."""
    sound: BoolArray
    """All rows of all passes, (passes * samples,)."""

    @property
    def lent(self) -> int:
        """How many rows are of other passes."""
        return int(np.count_nonzero(self.sources != self.own))

    def filled(self, values: FloatArray) -> FloatArray:
        """Return the passes' values, shape (periods * samples, M), with the disturbed ones replaced.

        Values of another pass are moved by the difference of the two at both ends of the stretch, in
        between by a straight line from one to the other.

        Parameters
        ----------
        values
            Of all passes, shape (passes * samples, M).
        """
        filled: FloatArray = values[self.sources]
        shift = self.sources - self.own
        ends = np.flatnonzero(np.diff(shift)) + 1
        for a, b in pairwise([0, *ends.tolist(), shift.size]):
            if shift[a]:
                filled[a:b] += self._between(values, int(self.own[a]), b - a, int(shift[a]))
        return filled

    def _between(self, values: FloatArray, begin: int, count: int, shift: int) -> FloatArray:
        """Return what a stretch of ``count`` rows is above its source, shape (count, M)."""
        rows = np.arange(max(0, -shift), min(self.sound.size, self.sound.size - shift))
        both = rows[self.sound[rows] & self.sound[rows + shift]]
        sides = both[both < begin][-EDGE:], both[both >= begin + count][:EDGE]
        known = [side for side in sides if side.size]
        if not known:
            return np.zeros((count, values.shape[1]))
        above = [(values[side] - values[side + shift]).mean(axis=0) for side in known]
        share = np.interp(
            np.arange(begin, begin + count), [side.mean() for side in known], [0, 1][: len(known)]
        )
        moved: FloatArray = above[0] + share[:, None] * (above[-1] - above[0])
        return moved


def whole_periods(sound: BoolArray, periods: int) -> Whole:
    """Return ``periods`` passes in a row, as sound as can be, the later the better.

    Their disturbed rows are those of the nearest other passes that are sound there, no row twice.

    Parameters
    ----------
    sound
        Of each pass, shape (passes, samples); every row sound in ``periods`` passes at least.
    periods
        How many are wanted.
    """
    passes, samples = sound.shape
    windows = [int(sound[k : k + periods].sum()) for k in range(passes - periods + 1)]
    first = max(range(len(windows)), key=lambda k: (windows[k], k))
    own = np.arange(first * samples, (first + periods) * samples)
    inside = range(first, first + periods)
    spare = sorted(set(range(passes)) - set(inside), key=lambda k: min(abs(k - i) for i in inside))
    sources = own.copy()
    for n in np.flatnonzero(~sound[inside].all(axis=0)).tolist():
        free = (k for k in spare if sound[k, n])
        for k in inside:
            if not sound[k, n]:
                sources[(k - first) * samples + n] = next(free) * samples + n
    return Whole(first, own, sources, sound.ravel())
