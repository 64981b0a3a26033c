"""By which factors do a drive's gains differ from those that were written?  Estimated cycle by cycle.

The torque that a controller should give is a sum of parts: what its position gain makes of the distance
from the reference, what its velocity gain makes of the velocity's error, and what is fed forward.  The
difference of told and expected torque is explained by shares of these parts, by torques and by
positions that are told late, and by the noise of the one torque from which slow ones are left out, which
fades as they do::

    told - expected = a position + b velocity + c fed forward
                      + t d(expected)/dt + u d(what positions make)/dt
                      + w d(what velocities make)/dt + s fading + noise

by least squares over the last cycles (forgotten exponentially), with prior knowledge of c, t, u, w and s
(Gaussian: Bishop 2006, equations 3.53 and 3.54).  A position that is told late has its own column: what
reference and position make nearly cancel in good tracking, so the whole hardly changes where what is
late does.  A velocity is a difference quotient, late by half a period of the loops: where nobody knows
that period it has a column too, for what it makes in good tracking is as large as all the feedback
(w is nothing where the period is known).  1 + a and 1 + b are the factors.  Both at once, a = b,
is a test of its own: gains that are wrong together may show before they can be told apart.

So a gain is told wrong, too high or too low, while its part is still hidden by a larger one: a good
feed-forward leaves little to the feedback.  Noise is what the fit leaves, but at least what a step of
the torque and some of the encoder's make: told and expected may see different steps.
"""

from math import exp

import numpy as np

from fieldtool.records.model import FloatArray

REMEMBERED, REMEMBERED_CYCLES = 0.03, 15.0
"""s, and cycles at least, with which cycles are forgotten (time constants)."""
FEWEST = 12.0
"""Cycles that have to be remembered before anything is said; fewer than REMEMBERED_CYCLES."""
FED_OFF, LATE_OFF, TOLD_OFF, ANY_OFF, BEGUN_OFF = 0.3, 0.05, 1.0, 100.0, 30.0
"""Standard deviations before anything is seen: of the share of what is fed forward; of being late, in
cycles, besides what is known; of positions that are told late, in cycles (many drives tell that of the
cycle before, and no profile says so); of the gains' shares; and of the first torque, times what is
noise at least."""
OFF, SURE = 0.35, 5.0
"""Share by which a gain may be off, and standard deviations by which it has to be farther off."""
STEPS, CLEAR = 0.7, (0.8, 2.5, 0.8)
"""Times what the encoder's steps make of a torque at their worst, RMS: what is noise in any case; and
what a part has to be that is judged, by names (of the position gain: times its own share, about eight
counts): told and expected torques see different steps, over and over again where an axis creeps."""
LEARNED, MOST_LEARNED = 2.0, 0.3
"""Times the share that was surely off with the old parameters that may be off with the new ones; and
that share beyond which nothing is said."""
SEEN = 8
"""Cycles after another that are enough.  Where a quick answer begins, what is only nearly known of
filters and lateness makes sound gains look off for some."""
NAMES = ("feedback", "position gain", "velocity gain")
"""What is tested: all gains of the feedback by one factor, and each of two by its own."""
COLUMNS = 7
NONE_OFF = 1e-4
"""Cycles: as good as no column at all."""
TINY = 1e-300


class GainEstimate:
    """Factors of the gains of several drives.

    Parameters
    ----------
    noise
        Standard deviation of a torque's difference from what is expected, at least, shape (M,).
    encoder
        RMS of what the encoder's steps make of the torque, shape (M,).
    position
        Position gain over the rate of cycles, shape (M,): its share of what an encoder's step makes.
    late
        s, by which torques may be late, standard deviation, shape (M,).
    late_velocity
        s, by which velocities may be late besides, shape (M,); 0 where their time is known.
    step
        Cycle time, s.
    fades
        Share of a torque that stands still, that is left of it after a cycle.
    off
        Shares that were surely off with the old parameters, shape (3, M); None: those are tried now.
    """

    def __init__(
        self,
        noise: FloatArray,
        encoder: FloatArray,
        position: FloatArray,
        late: FloatArray,
        late_velocity: FloatArray,
        step: float,
        fades: float,
        off: FloatArray | None = None,
    ) -> None:
        m = noise.size
        self._square = np.maximum(noise**2 + (STEPS * encoder) ** 2, TINY)
        shares = np.stack([np.ones(m), position, np.ones(m)])
        self._unclear = (np.array(CLEAR)[:, None] * shares * encoder) ** 2
        self._kept = exp(-min(step / REMEMBERED, 1.0 / REMEMBERED_CYCLES))
        self._tests = off is not None
        self.off: FloatArray = np.zeros((len(NAMES), m))
        """Largest shares that were surely off so far, shape (3, M)."""
        learned = np.zeros((len(NAMES), m)) if off is None else off
        self._allowed = np.where(learned > MOST_LEARNED, np.inf, np.maximum(OFF, LEARNED * learned))
        prior = np.tile([ANY_OFF, ANY_OFF, FED_OFF, 1.0, TOLD_OFF, 1.0, 1.0], (m, 1))
        prior[:, 3] = LATE_OFF + late / step
        prior[:, 5] = np.maximum(late_velocity / step, NONE_OFF)
        self._fitted = COLUMNS - 1 + (late_velocity > 0)
        prior[:, 6] = BEGUN_OFF * np.sqrt(self._square)
        self._prior = np.zeros((m, COLUMNS, COLUMNS))
        self._prior[:, range(COLUMNS), range(COLUMNS)] = prior**-2
        # position and velocity gain by one factor
        self._together = np.concatenate([np.eye(COLUMNS - 1)[:1], np.eye(COLUMNS - 1)])
        self._fades = fades
        self.begin()

    def begin(self) -> None:
        """Forget what was seen."""
        m = self._square.size
        self._normal, self._base = np.zeros((m, COLUMNS, COLUMNS)), np.zeros((m, COLUMNS))
        self._begun = 1.0
        self._cycles, self._squares = 0.0, np.zeros(m)
        self._since = np.zeros((len(NAMES), m), dtype=np.int64)

    def take(self, parts: FloatArray, difference: FloatArray) -> list[tuple[int, str, float]]:
        """Take one cycle; return axes, names and factors of gains that are surely not as written.

        Parameters
        ----------
        parts
            Of the expected torque, shape (6, M): by position gain, by velocity gain, fed forward, and
            what the whole, what the part by positions, and of it what velocities make, changed since
            the cycle before.
        difference
            Told less expected torque, shape (M,).
        """
        columns = np.column_stack([parts.T, np.full(difference.size, self._begun)])
        self._begun *= self._fades
        self._normal *= self._kept
        self._base *= self._kept
        self._normal += columns[:, :, None] * columns[:, None, :]
        self._base += columns * difference[:, None]
        self._cycles = self._kept * self._cycles + 1.0
        self._squares = self._kept * self._squares + difference**2
        if self._cycles < FEWEST:
            return []
        if np.all(self._squares < SURE**2 * self._square):  # nothing can be sure of so little
            self._since[:] = 0
            return []
        share, sure = self._estimated()
        away = np.maximum(np.abs(share) - SURE * sure, 0.0)
        if not self._tests:
            self.off = np.maximum(self.off, away)
            return []
        self._since = np.where(away > self._allowed, self._since + 1, 0)
        return [
            (k, NAMES[which], 1.0 + float(share[which, k]))
            for which, k in np.argwhere(self._since >= SEEN).tolist()
        ]

    def _estimated(self) -> tuple[FloatArray, FloatArray]:
        """Return shares and their standard deviations, (3, M) each; infinite where nothing is seen."""
        scale = self._square[:, None, None]
        known, base = self._normal / scale + self._prior, self._base / self._square[:, None]
        one = self._together
        joined, apart = np.linalg.inv(one.T @ known @ one), np.linalg.inv(known)
        together = (joined @ (base @ one)[:, :, None])[:, :, 0]
        each = (apart @ base[:, :, None])[:, :, 0]
        share = np.stack([together[:, 0], each[:, 0], each[:, 1]])
        variance = np.stack([joined[:, 0, 0], apart[:, 0, 0], apart[:, 1, 1]])
        left = np.stack([self._left(together @ one.T), *[self._left(each)] * 2])
        # what no other part explains of one, mean square
        alone = self._square / (np.maximum(variance, TINY) * self._cycles)
        hidden = alone < self._unclear
        return share, np.where(hidden, np.inf, np.sqrt(variance * (1 + left / self._square)))

    def _left(self, shares: FloatArray) -> FloatArray:
        """Return the mean square of what shares, (M, COLUMNS), leave of the difference, shape (M,)."""
        squares = self._squares - 2 * (shares * self._base).sum(axis=1)
        squares += np.einsum("mi,mij,mj->m", shares, self._normal, shares)
        left: FloatArray = np.maximum(squares, 0.0) / (self._cycles - self._fitted)
        return left
