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
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.stats import t as student

from fieldtool.criticise.evidence.lines import Lines

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BLOCK = 0.2
"""s: shortest block."""
FEWEST, MOST = 12, 400
"""Blocks altogether."""
FALLEN = 0.1
"""Of its value at zero: by how much the spectrum of the blocks may fall, on average over the waves."""
FEWEST_WAVES, FEWEST_OF_MANY, MOST_WAVES = 4, 2, 0.5
"""Waves at least, in one stretch and in each of many; over the number of blocks at most."""
SHORTEST = 6
"""Blocks of a stretch that stands for itself."""
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

    def best_of(self, tried: int) -> "Comparison":
        """Return this of the best of some hypotheses that the same rows chose among.

        Each might have had such a gain by chance (Bonferroni).
        """
        return replace(self, p=min(1.0, tried * self.p))


def compared(before: Parts, after: Parts) -> Comparison:
    """Compare two hypotheses, given the weighted errors of the same spans."""
    total = sum(lines.in_time(values).shape[0] for lines, values in before)
    seconds = sum((lines.span.stop - lines.span.start) * lines.motion.step for lines, _ in before)
    blocks = int(np.clip(seconds / BLOCK, FEWEST, MOST))
    length = max(2, total // blocks)
    gains: list[FloatArray] = []
    shares: list[FloatArray] = []
    sums = [0.0, 0.0]
    for (lines, first), (_, second) in zip(before, after, strict=True):
        squares = [np.sum(lines.in_time(v) ** 2, axis=1) for v in (first, second)]
        for k in range(2):
            sums[k] += float(squares[k].sum())
        difference = squares[0] - squares[1]
        count = max(1, round(difference.size / length))
        both = squares[0] + squares[1]
        size = np.array([part.sum() for part in np.array_split(both, count)])
        gains.append(np.array([part.sum() for part in np.array_split(difference, count)]))
        shares.append(gains[-1] / np.maximum(size, 1e-300))
    count = sum(g.size for g in gains)
    if not np.isfinite(sums[1]):  # it runs away
        return Comparison(sums[0], float("inf"), float("-inf"), 1.0, count)
    if not np.isfinite(sums[0]):
        return Comparison(float("inf"), sums[1], float("inf"), 0.0, count)
    t, p = chance(*gains)
    t_relative, p_relative = chance(*shares)
    if sums[1] >= sums[0]:
        return Comparison(sums[0], sums[1], min(t, 0.0), 1.0, count)
    chances = min(1.0, 2 * min(p, p_relative))
    return Comparison(sums[0], sums[1], max(t, t_relative), chances, count)


def chance(*gains: FloatArray) -> tuple[float, float]:
    """Return t and one-sided p of a mean above zero, for values that may be correlated in order.

    Each argument holds the values of one stretch.  Their means may differ (an effect may show in one
    experiment and not in another), so only what varies within a stretch counts as chance.
    """
    parts = _long_enough(gains)
    n = sum(part.size for part in parts)
    whole = np.concatenate(parts) if parts else np.zeros(0)
    spread = float(np.std(whole, ddof=1)) if n > 1 else 0.0
    if n < 3 or spread == 0.0:
        return 0.0, 1.0
    waves = _waves(parts)
    powers = np.array([_slow_power(g, w) for g, w in zip(parts, waves, strict=True)])
    variances = np.array([g.size for g in parts]) * powers / n**2
    variance = max(float(variances.sum()), (TINY * spread) ** 2)
    freedom = max(float(variances.sum() ** 2 / max(np.sum(variances**2 / waves), 1e-300)), 1.0)
    t = float(whole.mean()) / float(np.sqrt(variance))
    return t, float(student.sf(t, freedom))


def _long_enough(gains: Sequence[FloatArray]) -> list[FloatArray]:
    """Join short stretches with those before them."""
    parts: list[FloatArray] = []
    for one in gains:
        if parts and min(one.size, parts[-1].size) < SHORTEST:
            parts[-1] = np.concatenate([parts[-1], one])
        else:
            parts.append(one)
    return parts


def _slow_power(gains: FloatArray, waves: int) -> float:
    """Mean power of the slowest waves over some values."""
    number, place = np.arange(1, waves + 1)[:, None], np.arange(gains.size) + 0.5
    shape = np.sqrt(2.0 / gains.size) * np.cos(np.pi * number * place / gains.size)
    return float(np.mean((shape @ gains) ** 2))


def _waves(parts: Sequence[FloatArray]) -> IntArray:
    """Return for each stretch how many slow waves have the size that the slowest of all would have.

    The spectrum of values with correlation r is that at zero over 1 + r w^2 / (1 - r)^2 for small w.
    """
    centred = [g - g.mean() for g in parts]
    n = sum(g.size for g in parts)
    both = sum(float(np.sum(c[1:] * c[:-1])) for c in centred)
    r = both / max(sum(float(np.sum(c**2)) for c in centred), 1e-300)
    # A correlation from few values comes out too small by about (1 + 3 r) / n.
    r += (1.0 + 3.0 * max(r, 0.0)) * len(parts) / n + 1.0 / np.sqrt(n)
    r = float(np.clip(r, 1e-3, 0.95))
    highest = np.sqrt(3.0 * FALLEN / r) * (1.0 - r)
    fewest = FEWEST_WAVES if len(parts) == 1 else FEWEST_OF_MANY
    sizes = np.array([g.size for g in parts])
    most = np.maximum(np.minimum(MOST_WAVES * sizes, sizes - 1), 1)
    wanted = np.maximum(highest * sizes / np.pi, fewest)
    return np.asarray(np.minimum(wanted, most), dtype=np.int64)
