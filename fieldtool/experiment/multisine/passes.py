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

from fieldtool.experiment.multisine.excitation import IntArray
from fieldtool.records.model import FloatArray

BoolArray = NDArray[np.bool_]

AS_IT_CAME = ", as it came"
"""Ends the name of a record with all its rows in their order, beside the periods taken out of it."""
EDGE, EDGE_SHARE = 8, 0.25
"""Rows at each end of a disturbed stretch over which two passes are compared, at least; and their share
of its length."""


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
    """Passes in a row and a run-in before them, with the row of the record that stands for each."""

    own: IntArray
    """Their own rows, counted from the first pass' first, in a row; shape (n,)."""
    sources: IntArray
    """The same, but where they are disturbed rows of other passes."""
    sound: BoolArray
    """All rows of all passes, (passes * samples,)."""

    @property
    def lent(self) -> int:
        """How many rows are of other passes."""
        return int(np.count_nonzero(self.sources != self.own))

    def filled(self, values: FloatArray) -> FloatArray:
        """Return the rows' values, shape (n, M), with the disturbed ones replaced.

        Values of another pass are moved by the difference of the two at both ends of the stretch, in
        between by a straight line from one to the other, in whole steps: a drive tells no others.

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
                moved = self._between(values, int(self.own[a]), b - a, int(shift[a]))
                for k, told in enumerate(values.T):
                    filled[a:b, k] = _nearest(np.unique(told), filled[a:b, k] + moved[:, k])
        return filled

    def _between(self, values: FloatArray, begin: int, count: int, shift: int) -> FloatArray:
        """Return what a stretch of ``count`` rows is above its source, shape (count, M)."""
        rows = np.arange(max(0, -shift), min(self.sound.size, self.sound.size - shift))
        both = rows[self.sound[rows] & self.sound[rows + shift]]
        edge = max(EDGE, int(EDGE_SHARE * count))
        sides = both[both < begin][-edge:], both[both >= begin + count][:edge]
        known = [side for side in sides if side.size]
        if not known:
            return np.zeros((count, values.shape[1]))
        above = [(values[side] - values[side + shift]).mean(axis=0) for side in known]
        centres, place = [side.mean() for side in known], np.arange(begin, begin + count)
        share = np.interp(place, centres, np.arange(len(known)))
        moved: FloatArray = above[0] + share[:, None] * (above[-1] - above[0])
        return moved


def _nearest(levels: FloatArray, values: FloatArray) -> FloatArray:
    """Return values, shape (n,), in whole steps from the nearest of the rising levels."""
    if levels.size < 2:
        return values
    step = float(np.diff(levels).min())
    found = levels[np.searchsorted((levels[1:] + levels[:-1]) / 2, values)]
    whole: FloatArray = found + np.round((values - found) / step) * step
    return whole


def whole_periods(sound: BoolArray, periods: int, settle: int = 0) -> Whole:
    """Return ``periods`` passes in a row, as sound as can be, the later the better.

    Their disturbed rows are those of the nearest other passes that are sound there, no row twice.

    Parameters
    ----------
    sound
        Of each pass, shape (passes, samples); every row sound in ``periods`` passes at least.
    periods
        How many are wanted.
    settle
        Rows before them that stand for their run-in, as far as there are passes before them.
    """
    passes, samples = sound.shape
    windows = [int(sound[k : k + periods].sum()) for k in range(passes - periods + 1)]
    first = max(range(len(windows)), key=lambda k: (windows[k], k))
    inside = range(first, first + periods)
    nearest = sorted(range(passes), key=lambda k: (min(abs(k - i) for i in inside), -k))
    spare = [k for k in nearest if k not in inside]
    begin = max(0, first * samples - settle)
    own = np.arange(begin, (first + periods) * samples)
    sources = own.copy()
    for n in np.flatnonzero(~sound[inside].all(axis=0)).tolist():
        free = (k for k in spare if sound[k, n])
        for k in inside:
            if not sound[k, n]:
                sources[k * samples + n - begin] = next(free) * samples + n
    flat = sound.ravel()
    # of the run-in: there may be none that is not used yet
    for row in own[: first * samples - begin][~flat[begin : first * samples]].tolist():
        n = row % samples
        sources[row - begin] = next(k for k in (*spare, *inside) if sound[k, n]) * samples + n
    return Whole(own, sources, flat)
