"""A watch for loops that swing, run away or push by themselves: from position and torque alone.

It knows no model, no target and no controller.  It sees the positions and torques that are measured in
each cycle, and what is *allowed* for the time being.  Each of these ends the motion:

corridor
    A position leaves its corridor, or a torque goes farther from its value at rest than it may.  A loop
    of the wrong sign does so in some cycles.
swings
    Torque or position turn back again and again by more than a level.  A turn counts as soon as the
    signal has come back by the level.
growth
    Where swings are to be expected (what rings after a move dies out) they count if they grow, or are
    far above the level without dying clearly, or do not die out once all references stand.

An oscillation of frequency f is found some ``(turns + 1) / (2 f)`` after its swing is larger than the
level, if its turns follow within ``half_period``.  While a reference moves that is shorter than the
move's own turns, and a slower oscillation is stopped by corridor and torque bound, or in the rest after
the move: there turns may follow within LONGEST_HALF.  Valid while the level is above noise: the levels
are shares of limits, and grow with the encoder's counts.  What is no number is an alarm.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from math import isfinite

import numpy as np

from drives.api import Alarm, AxisLimits, FloatArray
from fieldtool.experiment.axes import torque_limits
from fieldtool.experiment.verification.hiss import hiss
from fieldtool.experiment.verification.swings import Swings

HOLD_LEVEL, HOLD_TURNS = 0.08, 2
"""At rest: share of the torque limit, peak to peak, by which the torque may swing, and turns."""
MOVE_LEVEL, MOVE_TURNS = 0.15, 3
"""While something is moved: the same."""
SWING_OF_ERROR, SWING_COUNTS = 0.02, 8.0
"""Share of the following error limit, and counts of the encoder besides, by which a position may swing,
peak to peak; at rest half of it."""
GROWS = 1.2
"""A swing grows that is larger by this than one before it, in the same direction, of the same series."""
LEAPS, FAST = 1.3, 3
"""A swing that is larger by this than the one just before it, in the other direction, leaps, where both
are so many times faster than they have to be."""
FAR_ABOVE = 5.0
"""Times the level: swings of this size count whether they grow or not, unless they die clearly."""
HALVES = 0.5
"""Swings die clearly that are each less than so many times the one before: after a push those of a loop
do whose sensitivity peaks at 2."""
LASTS, DIES = 7, 0.9
"""At rest a swing has to be smaller than DIES times the one three periods before it."""
MOST_STEPS = 0.6
"""Share of the torque limit by which steps of the targets, or a move as it is foreseen, may make a
torque swing, at most."""
LONGEST_HALF = 0.25
"""Seconds from one turn to the next, at most."""
SAGS = 4.0
"""Times the usual way that axes may sag, as they take over their weights, under loops that are known to
be good."""
HEARD = 0.1
"""s of the first standing still in which torques of loops that are known to be good are listened to."""
ENABLING = 1.5
"""Times what steps of targets usually make that they may make while drives are enabled."""
HISS, LOUDEST = 9.0, 4.0
"""Times its deviation by which noise may swing a torque, peak to peak; and times the usual level
that is allowed for it, at most."""
TORQUE_UNITS = {"rad": "N m", "m": "N"}
REST_TIME = 0.05
"""Time constant with which the torque at rest is found, s."""


@dataclass(frozen=True, eq=False)
class Allowed:
    """What all axes may do for the time being; shapes (M,), SI."""

    low: FloatArray
    high: FloatArray
    """Ends of the corridors of positions."""
    torque: FloatArray
    """Largest distance of the torques from those at rest."""
    torque_swing: FloatArray
    """Peak to peak."""
    position_swing: FloatArray
    """Peak to peak."""
    turns: int
    growing: bool
    """Whether swings count only if they grow, or are far above the level."""
    resting: bool
    """Whether the torque of the time being is that at rest."""
    half_period: float = LONGEST_HALF
    """Seconds from one turn to the next, at most, to count as one oscillation."""
    settled: bool = False
    """Whether all references stand: what began since then may turn as slowly as LONGEST_HALF."""
    moving: int | None = None
    """The axis whose reference moves, where only one does."""
    foreseen: int | None = None
    """The axis whose levels hold all that its model foresees: there every swing counts."""


class OscillationWatch:
    """Watches all axes of one motion; a ``drives.api.MotionWatch``.

    Until it is told otherwise, axes have to stand still where they are first seen.

    Parameters
    ----------
    names, limits
        Of the axes.
    counts
        One count of each encoder, shape (M,), rad or m.
    still
        How far an axis may go that is to stand still, shape (M,), rad or m.
    step
        Cycle time, s.
    trusts_loops
        Whether the drives' loops are known to be good: then a stop may leave a quick stop to them.
    louder
        Times the usual level by which torques may swing at rest, shape (M,): 1 but for axes that were
        heard to be louder with loops that are known to be good.
    steps
        By how much torques may swing because targets that move are whole counts, peak to peak, (M,).
    units
        Of positions, one an axis, for messages.
    sags
        How much farther axes may go as they are enabled, shape (M,), rad or m; None: none.
    """

    def __init__(
        self,
        names: Sequence[str],
        limits: Sequence[AxisLimits],
        counts: FloatArray,
        still: FloatArray,
        step: float,
        *,
        trusts_loops: bool,
        louder: FloatArray | None = None,
        steps: FloatArray | None = None,
        units: Sequence[str] = (),
        sags: FloatArray | None = None,
    ) -> None:
        self._names, self._step, self._still = tuple(names), step, still
        self._units = [(unit, TORQUE_UNITS.get(unit, "")) for unit in units or [""] * len(names)]
        self._torque_limits = torque_limits(limits)
        errors = np.array([one.following_error for one in limits])
        self._position_swing = SWING_OF_ERROR * errors + SWING_COUNTS * counts
        self._given = [one.sag for one in limits]
        self._sags = np.zeros(len(self._names)) if sags is None else sags
        self._first: FloatArray | None = None
        self._louder = np.ones(len(self._names)) if louder is None else louder
        self._steps = np.zeros(len(self._names)) if steps is None else steps
        self._trusts_loops = trusts_loops
        self._torques = [Swings() for _ in self._names]
        self._positions = [Swings() for _ in self._names]
        self._heard: list[Sequence[float]] | None = [] if trusts_loops else None
        self._rest: list[float] = []
        self._allowed: Allowed | None = None
        self._since = 0
        self.strays = False
        """Whether an axis is not where it may be, by the last alarm."""
        self.alarm: Alarm | None = None
        """What ended the motion."""

    @property
    def trusts_loops(self) -> bool:
        """Whether a quick stop may be left to the drives' loops."""
        return self._trusts_loops

    def begin(self) -> None:
        """Another motion begins: its axes stand still where they are first seen."""
        self._allowed, self._rest, self._first = None, [], None
        for swings in (*self._torques, *self._positions):
            swings.restart(float("inf"))

    @property
    def _resting_louder(self) -> FloatArray:
        return self._louder if self._heard is None else np.full(len(self._names), LOUDEST)

    def _listen(self, torque: Sequence[float]) -> None:
        """Hear how much torques hiss while all axes stand first; then the levels are what they need."""
        if self._heard is None or self._allowed is None or not self._allowed.resting:
            return
        self._heard.append(torque)
        if len(self._heard) < HEARD / self._step:
            return
        noise = np.array([hiss(own) for own in zip(*self._heard, strict=True)])
        needed = HISS * noise / (HOLD_LEVEL * self._torque_limits)
        self._louder = np.maximum(self._louder, np.minimum(needed, LOUDEST))
        self._heard = None
        level = self._louder * HOLD_LEVEL * self._torque_limits
        self._allow(replace(self._allowed, torque_swing=level))

    def hold(
        self,
        at: FloatArray,
        stands: FloatArray | None = None,
        *,
        enabling: bool = False,
        sinking: bool = False,
    ) -> None:
        """Allow no more than standing still at positions, shape (M,), or from there to where axes stand.

        While drives are being enabled their targets follow their positions: by steps.  Until that is
        over, and while they are ``sinking``, axes may sag from where they were first seen.
        """
        level = self._resting_louder * HOLD_LEVEL * self._torque_limits
        if enabling:
            steps = np.minimum(ENABLING * self._steps, MOST_STEPS * self._torque_limits)
            level = np.maximum(level, steps)
        still = (SAGS if self._trusts_loops else 1.0) * self._still
        ends = [at, at if stands is None else stands]
        if enabling or sinking:
            first = at if self._first is None else self._first
            ends += [np.where(self._sags > 0, first + way, at) for way in (-self._sags, self._sags)]
        self._allow(
            Allowed(
                np.min(ends, axis=0) - still,
                np.max(ends, axis=0) + still,
                self._torque_limits,
                level,
                self._position_swing / 2,
                HOLD_TURNS,
                growing=False,
                resting=True,
            )
        )

    def move(
        self,
        low: FloatArray,
        high: FloatArray,
        torque: FloatArray,
        half_period: float = LONGEST_HALF,
        *,
        axis: int | None = None,
        gentle: bool = False,
        shakes: float = 0.0,
    ) -> None:
        """Allow motion inside corridors (M,), with torques up to (M,) about those at rest.

        ``axis`` is the one that moves; on the others a torque that swings far above the level counts
        however slowly it turns.  A gentle one makes no swings of its own worth the name: they count as
        at rest.  ``shakes`` is how far the torque of the axis swings quickly, peak to peak, by what is
        foreseen of its move: less is no swing.
        """
        share = HOLD_LEVEL if gentle else MOVE_LEVEL
        level = np.maximum(self._louder * HOLD_LEVEL, share) * self._torque_limits
        level = np.maximum(level, np.minimum(self._steps, MOST_STEPS * self._torque_limits))
        if axis is not None:
            most = MOST_STEPS * float(self._torque_limits[axis])
            level[axis] = max(float(level[axis]), min(shakes, most))
        self._allow(
            Allowed(
                low,
                high,
                torque,
                level,
                self._position_swing,
                HOLD_TURNS if gentle else MOVE_TURNS,
                growing=not gentle,
                resting=False,
                half_period=min(half_period, LONGEST_HALF),
                moving=axis,
            )
        )

    def settle(
        self,
        low: FloatArray,
        high: FloatArray,
        torque: FloatArray,
        half_period: float,
        axis: int,
        foreseen: tuple[float, float] | None,
    ) -> None:
        """Allow what is left of a move once its reference stands.

        Parameters
        ----------
        low, high, torque, half_period
            As for :meth:`move`; the half period is for swings that began before.
        axis
            That moved.
        foreseen
            Peak to peak of its torque and of its position while it comes to rest, at most; larger ones
            count as at rest.  None: not known; then swings count that do not die out.
        """
        self.move(low, high, torque, half_period)
        allowed = self._allowed
        if allowed is None:
            raise AssertionError("a move was allowed")
        torque_swing, position_swing = allowed.torque_swing.copy(), allowed.position_swing.copy()
        if foreseen is not None:
            at_rest = float(self._louder[axis]) * HOLD_LEVEL * float(self._torque_limits[axis])
            torque_swing[axis] = max(at_rest, float(self._steps[axis]), foreseen[0])
            position_swing[axis] = max(float(self._position_swing[axis]), foreseen[1])
        self._since = self._torques[axis].now
        self._allow(
            replace(
                allowed,
                torque_swing=torque_swing,
                position_swing=position_swing,
                settled=True,
                moving=None,
                foreseen=None if foreseen is None else axis,
            )
        )

    def excite(self, low: FloatArray, high: FloatArray, torque: FloatArray) -> None:
        """Allow motion that swings by itself inside corridors (M,), with torques up to (M,).

        Corridor and bound are what ends it: swings of the torque say nothing here.
        """
        self._allow(
            Allowed(
                low,
                high,
                torque,
                np.full(torque.size, np.inf),
                np.full(torque.size, np.inf),
                MOVE_TURNS,
                growing=True,
                resting=False,
            )
        )

    def _allow(self, allowed: Allowed) -> None:
        self._allowed = allowed
        for torque, level in zip(self._torques, allowed.torque_swing.tolist(), strict=True):
            torque.go_on(level)
        for position, level in zip(self._positions, allowed.position_swing.tolist(), strict=True):
            position.go_on(level)

    def take(
        self,
        position: Sequence[float],
        torque: Sequence[float],
        smooth: Sequence[float] | None = None,
    ) -> Alarm | None:
        """Take one cycle; see ``drives.api.MotionWatch``.

        ``smooth`` are the torques whose swings count, where those that were measured show more.
        """
        if self._allowed is None:
            self._first = np.array(position)
            self.hold(self._first, enabling=True)
        allowed = self._allowed
        if allowed is None:
            raise AssertionError("something is always allowed")
        swinging = torque if smooth is None else smooth
        found = [
            (k, text)
            for k in range(len(self._names))
            if (text := self._judge(k, position[k], torque[k], swinging[k], allowed))
        ]
        self._follow_rest(torque, allowed)
        self._listen(torque)
        if not found:
            return None
        ways = zip(allowed.low, position, allowed.high, strict=True)
        self.strays = not all(low <= at <= high for low, at, high in ways)
        k, text = found[0]
        self.alarm = Alarm(
            f"{self._names[k]}: {text}; its power was cut and all axes were stopped.",
            self._names[k],
            frozenset(self._names[j] for j, _ in found),
        )
        return self.alarm

    def _follow_rest(self, torque: Sequence[float], allowed: Allowed) -> None:
        if not self._rest:
            self._rest = list(torque)
        elif allowed.resting:
            share = min(1.0, self._step / REST_TIME)
            self._rest = [r + share * (t - r) for r, t in zip(self._rest, torque, strict=True)]

    def _sag_words(self, k: int) -> str:
        sag = self._given[k]
        if sag is None:
            return "its limits in the machine profile have no `sag`"
        return f"its limit `sag` is {sag:.3g} {self._units[k][0]} while drives are being enabled"

    def _judge(
        self, k: int, position: float, torque: float, swinging: float, allowed: Allowed
    ) -> str:
        """Return what is wrong with an axis, in words; empty where nothing is."""
        if not (isfinite(position) and isfinite(torque)):
            return f"its position is told as {position:g} and its torque as {torque:g}: no numbers"
        turned = self._torques[k].take(swinging)
        swung = self._positions[k].take(position)
        unit, torque_unit = self._units[k]
        if not allowed.low[k] <= position <= allowed.high[k]:
            others = allowed.moving not in (None, k)
            sags = f", or it sags under its load ({self._sag_words(k)})" if allowed.resting else ""
            sags += ", or the axis that moves pushes it away" if others else ""
            return (
                f"is at {position:.5g} {unit}, outside of {allowed.low[k]:.5g} to "
                f"{allowed.high[k]:.5g} {unit} where it has to stay: its loop runs away or "
                f"swings{sags}"
            )
        push = torque - (self._rest[k] if self._rest else torque)
        if abs(push) > allowed.torque[k]:
            return (
                f"its torque went {abs(push):.3g} {torque_unit} from that at rest, above the "
                f"{allowed.torque[k]:.3g} {torque_unit} allowed here: its loop swings or pushes, or "
                "the axis is heavier than its model"
            )
        for swings, seen, what, of in (
            (self._torques[k], turned, "torque", torque_unit),
            (self._positions[k], swung, "position", unit),
        ):
            if seen and self._oscillates(k, swings, allowed):
                frequency = swings.frequency(self._turns(k, allowed)) / self._step
                return (
                    f"oscillates at about {frequency:.3g} Hz: its {what} swings by "
                    f"{swings.sizes[-1]:.3g} {of}, peak to peak, above the level of "
                    f"{swings.level:.3g} {of}"
                )
        return ""

    @staticmethod
    def _turns(k: int, allowed: Allowed) -> int:
        return HOLD_TURNS if allowed.foreseen == k else allowed.turns

    def _oscillates(self, k: int, swings: Swings, allowed: Allowed) -> bool:
        """Whether the swings, of which one was completed just now, are an oscillation."""
        longest = int(allowed.half_period / self._step) + 1
        if allowed.growing and self._leaps(swings.series(longest // FAST + 1)):
            return True
        if self._counts(k, swings.series(longest), swings.level, allowed):
            return True
        slow = int(LONGEST_HALF / self._step) + 1
        if allowed.moving not in (None, k) and swings is self._torques[k]:
            last = swings.series(slow)[-allowed.turns :]
            return len(last) == allowed.turns and self._stays_far_above(last, swings.level)
        if not allowed.settled:
            return False
        series = swings.series(slow, self._since)
        if self._counts(k, series, swings.level, allowed):
            return True
        return len(series) >= LASTS and series[-1] > DIES * series[-LASTS]

    def _counts(self, k: int, series: list[float], level: float, allowed: Allowed) -> bool:
        """Whether swings that follow each other are enough for an alarm."""
        turns = self._turns(k, allowed)
        if len(series) < turns:
            return False
        if not allowed.growing or allowed.foreseen == k:
            return True
        far = self._stays_far_above(series[-turns:], level)
        return far or series[-1] > GROWS * min(series[-3::-2])

    @staticmethod
    def _stays_far_above(last: list[float], level: float) -> bool:
        """Whether swings are far above the level, and not dying clearly."""
        dying = all(b < HALVES * a for a, b in pairwise(last))
        return min(last) > FAR_ABOVE * level and not dying

    @staticmethod
    def _leaps(series: list[float]) -> bool:
        """Whether fast swings grow so quickly that two of them are enough to tell."""
        return len(series) > 1 and series[-1] > LEAPS * series[-2]
