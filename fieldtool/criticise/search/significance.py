"""Whether one hypothesis is better than another on data that neither has seen, by more than chance.

The weighted errors of the unseen spans are taken back into time and squared, block by block; each
block gives one difference between both hypotheses.  Neighbouring blocks may be alike (errors of a
model are not white), so the standard error of the mean difference counts their correlation: a t-test
whose number of blocks is the effective one, n (1 - r) / (1 + r), r the correlation of neighbours.
Blocks differ in size, and a few large ones make such a test blind; so the differences over the sums of
both are tested as well, and the smaller of both probabilities counts twice.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import t as student

from fieldtool.criticise.evidence.lines import Lines

FloatArray = NDArray[np.float64]
BLOCK = 0.2
"""s: shortest block."""
FEWEST, MOST = 12, 400
"""Blocks altogether."""
FEWEST_EFFECTIVE = 6
"""Effective number of blocks that is always granted."""
Parts = Sequence[tuple[Lines, FloatArray]]


@dataclass(frozen=True)
class Comparison:
    """Two hypotheses on unseen rows."""

    before: float
    """Sum of squares of the weighted errors of the first."""
    after: float
    t: float
    """Mean gain of a block over its standard error, the larger of both ways."""
    p: float
    """Probability of such a gain by chance."""
    blocks: int


def compared(before: Parts, after: Parts) -> Comparison:
    """Compare two hypotheses, given the weighted errors of the same spans."""
    total = sum(lines.in_time(values).shape[0] for lines, values in before)
    seconds = sum((lines.span.stop - lines.span.start) * lines.motion.step for lines, _ in before)
    blocks = int(np.clip(seconds / BLOCK, FEWEST, MOST))
    length = max(2, total // blocks)
    gains: list[float] = []
    sizes: list[float] = []
    sums = [0.0, 0.0]
    for (lines, first), (_, second) in zip(before, after, strict=True):
        squares = [np.sum(lines.in_time(v) ** 2, axis=1) for v in (first, second)]
        for k in range(2):
            sums[k] += float(squares[k].sum())
        difference = squares[0] - squares[1]
        count = max(1, round(difference.size / length))
        gains += [float(part.sum()) for part in np.array_split(difference, count)]
        both = squares[0] + squares[1]
        sizes += [float(part.sum()) for part in np.array_split(both, count)]
    t, p = chance(np.array(gains))
    t_relative, p_relative = chance(np.array(gains) / np.maximum(np.array(sizes), 1e-300))
    if sums[1] >= sums[0]:
        return Comparison(sums[0], sums[1], min(t, 0.0), 1.0, len(gains))
    return Comparison(
        sums[0], sums[1], max(t, t_relative), min(1.0, 2 * min(p, p_relative)), len(gains)
    )


def chance(gains: FloatArray) -> tuple[float, float]:
    """Return t and one-sided p of a mean above zero, for values that may be correlated in order."""
    n = gains.size
    spread = float(np.std(gains, ddof=1)) if n > 1 else 0.0
    if n < 3 or spread == 0.0:
        return 0.0, 1.0
    centred = gains - gains.mean()
    r = float(np.sum(centred[1:] * centred[:-1]) / np.sum(centred**2))
    # Few blocks show a correlation by chance: only what is more than its standard error counts.
    r = min(max(r - 1.0 / np.sqrt(n), 0.0), 0.9)
    effective = max(n * (1 - r) / (1 + r), min(n, FEWEST_EFFECTIVE))
    t = float(gains.mean()) / (spread / np.sqrt(effective))
    return t, float(student.sf(t, effective - 1))
