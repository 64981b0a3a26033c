"""Whether one hypothesis is better than another on data that neither has seen, by more than chance.

The weighted errors of the unseen spans are taken back into time and squared, block by block; each
block gives one difference between both hypotheses.  Neighbouring blocks may be alike (errors of a
model are not white), and how much they are can not be told from a few dozen of them: an estimate of
their correlation is too small, and the test calls chance a gain.  So the variance of the mean comes from
the B slowest waves over the blocks, whose sizes are independent and alike whatever neighbours have in
common; the mean over its error then has Student's distribution with B degrees of freedom, which counts
that the error is estimated.  B is as large as it may be for blocks whose correlation r is one standard
error above what it seems: where the spectrum of such blocks has fallen by a tenth, on average over
the B waves, 0.17 n (1 - r) / r^(1/2).
Source: Lazarus, Lewis, Stock, Watson, HAR Inference: Recommendations for Practice, Journal of
Business and Economic Statistics 36, 2018, p. 541 (equal-weighted cosines).
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
FALLEN = 0.1
"""Of its value at zero: by how much the spectrum of the blocks may fall, on average over the waves."""
FEWEST_WAVES, MOST_WAVES = 4, 0.5
"""Waves at least; over the number of blocks at most."""
TINY = 1e-9
"""Of the spread of the blocks: the least standard error of their mean."""
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
    waves = min(n - 1, _waves(gains))
    number, place = np.arange(1, waves + 1)[:, None], np.arange(n) + 0.5
    sizes = np.sqrt(2.0 / n) * np.cos(np.pi * number * place / n) @ gains
    error = max(float(np.sqrt(np.mean(sizes**2) / n)), TINY * spread)
    t = float(gains.mean()) / error
    return t, float(student.sf(t, waves))


def _waves(gains: FloatArray) -> int:
    """Return how many slow waves have the size that the slowest of all would have.

    The spectrum of values with correlation r is that at zero over 1 + r w^2 / (1 - r)^2 for small w.
    """
    n = gains.size
    centred = gains - gains.mean()
    r = float(np.sum(centred[1:] * centred[:-1]) / np.sum(centred**2))
    # A correlation from few values comes out too small by about (1 + 3 r) / n.
    r = float(np.clip(r + (1.0 + 3.0 * max(r, 0.0)) / n + 1.0 / np.sqrt(n), 1e-3, 0.95))
    highest = np.sqrt(3.0 * FALLEN / r) * (1.0 - r)
    return int(np.clip(highest * n / np.pi, FEWEST_WAVES, MOST_WAVES * n))
