"""Which rows of a periodic record are sound, and whole periods put together from what is sound.

A cycle that is late, or a sample that is missing, disturbs the axes: its row and those of a while after
it are left out.  The excitation goes on meanwhile, period after period, until every row of a period was
passed undisturbed as often as is wanted.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

IntArray = NDArray[np.int_]
BoolArray = NDArray[np.bool_]

AS_IT_CAME = ", as it came"
"""Ends the name of a record with all its rows in their order, beside the periods taken out of it."""


def sound_rows(
    missing: Sequence[int], tail: int, settle: int, samples: int, passes: int
) -> BoolArray:
    """Return which rows of each pass are undisturbed, shape (passes, samples).

    Parameters
    ----------
    missing
        Rows in which a sample is missing or a cycle was late, from the beginning of the run-in.
    tail
        Rows after such a one that it disturbs.
    settle, samples
        Rows of the run-in, and of a period.
    passes
        Periods that were passed since the run-in.
    """
    sound = np.ones(settle + passes * samples, dtype=np.bool_)
    for row in missing:
        sound[row : row + tail + 1] = False
    return sound[settle:].reshape(passes, samples)


def whole_periods(sound: BoolArray, periods: int) -> IntArray:
    """Return the passes that the rows of ``periods`` whole periods come from, (periods, samples).

    Every period is a pass of its own, and no row of a pass is in two periods.  As few rows as can be
    come from another pass than the rest of their period; the later passes are preferred.

    Parameters
    ----------
    sound
        Of each pass, shape (passes, samples); every row sound in ``periods`` passes at least.
    periods
        How many are wanted.
    """
    passes = sound.shape[0]
    by_worth = sorted(range(passes), key=lambda k: (-int(sound[k].sum()), -k))
    own, spare = sorted(by_worth[:periods]), by_worth[periods:]
    chosen = np.tile(np.array(own)[:, None], (1, sound.shape[1]))
    for row in np.flatnonzero(~sound[own].all(axis=0)).tolist():
        free = (k for k in spare if sound[k, row])
        for period in np.flatnonzero(~sound[own, row]).tolist():
            chosen[period, row] = next(free)
    return chosen
