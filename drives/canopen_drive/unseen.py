"""Motion that an encoder should have shown: told from its own counts and the torque, cycle by cycle.

A stuck encoder shows nothing of itself while its axis stands; it shows when the motor must be moving.
Two things tell so, whatever the loop does:

- an axis that moved stands dead from one cycle to the next, though nothing has ever changed its speed so
  fast: it goes on unseen, or a brake or a stop has caught it;
- an axis stands exactly while its torque leaves what friction can hold: by Newton's second law
  the inertia of the prior model would have been pushed away.

Friction, and the mean torque of weight, are learned while the axis moves: what it stood under, and then
moved.  Cycles that are missing now and then, or late, are bridged: of what happened in them only what is
sure counts.  All in position units, torque units and cycles.
"""

import math
from collections import deque
from dataclasses import dataclass
from statistics import median

DEAD_UNITS, LEAST_UNITS = 16, 24
"""Position units that may be unseen in any case: of an axis that stands dead, and of one at rest."""
LEARN_UNITS = 12
"""Those from which friction must have held an axis that moves again: a reversal between two counts comes
to half of that without any."""
LEARN_TIME, HELD_TIME = 0.08, 0.04
"""Seconds after which friction must have held it, or all that it stood under is little; and those over
which a torque has to last that friction held: inertia holds against short ones."""
STEADY = 3.0
"""Factor between torques of a moment and lasting ones beyond which it was a blow that broke it loose."""
NEAR_UNITS, NEAR_SHARE = 8, 2048
"""An axis that has moved by these position units, and that part of the window, has broken loose: before,
friction gives way like a spring."""
WINDOW_SHARE = 128
"""That part of the following error window may be unseen of an axis at rest."""
LEARN = 40
"""Samples in motion until the changes of speed that are normal for an axis are known."""
LAST_STEP, STEP_BEFORE, DEAD_SHARE = 1.5, 2.5, 1.5
"""Normal changes of speed that may be in the last step, and in the one before it, of an axis that
friction stops; and that may be unseen."""
SWING = 2.0
"""Times that way by which a load may swing."""
HOLDS, SURE_HOLDS, KEPT = 9, 5, 0.75
"""Times that an axis broke loose whose median torque is its friction; the least whose median is
remembered, and the share of the largest such median that stays: an axis that trembles slips away
under less, again and again."""
FRICTION_SHARE, FLOOR = 1.8, 0.03
"""Friction may hold an axis against so many times what was learned, and this share of the torque
limit."""
SMOOTHED = 3
"""Samples whose mean torque counts: what a loop gives on single counts of its encoder alternates."""
PULL_TIME = 0.5
"""Seconds in motion over which the mean torque is taken."""
STOOD = 2
"""Steps without motion after which an axis stands."""
BRIDGED_TIME, BRIDGED_CYCLES = 0.02, 3.0
"""Seconds, or cycles, between two samples that are bridged: over longer ones it begins anew."""


@dataclass
class Learned:
    """What an axis has shown so far, from motion to motion, torque and position units."""

    holds: tuple[float, ...] = ()
    """Torques beside the mean that it stood under, and then broke loose, the last ones."""
    torque: float = 0.0
    """Mean torque in motion."""
    direction: float = 0.0
    """Mean direction of that motion, -1 to 1: its share of friction is in the mean torque."""
    cycle_time: float = 0.0
    """s, of the motion in which the next was seen."""
    most: float = 0.0
    """Largest friction so far."""
    change: float = 0.0
    """Largest change of a step from one cycle to the next."""
    samples: int = 0
    """Samples in motion so far."""

    @property
    def friction(self) -> float:
        """The torque that friction holds it against, usually."""
        return max(median(self.holds), KEPT * self.most) if self.holds else 0.0

    def note_hold(self, torque: float) -> None:
        """Learn that it stood under a torque, and then broke loose."""
        self.holds = (*self.holds[1 - HOLDS :], torque)
        if len(self.holds) >= SURE_HOLDS:
            self.most = max(self.most, median(self.holds))

    @property
    def pull(self) -> float:
        """The torque that friction does not explain: weight, mostly."""
        return self.torque - self.friction * self.direction


class Unseen:
    """Watches one axis.

    Parameters
    ----------
    learned
        What is known of the axis; goes on to be learned.
    push
        Position units per cycle and cycle by which one torque unit accelerates the whole axis.
    window
        Following error window, position units.
    floor
        Torque units that are no push in any case.
    cycle_time
        s.
    wind_up
        Position units by which the torque limit winds up the axis' springs: so far its load may go
        while the motor stands.
    """

    def __init__(
        self,
        learned: Learned,
        push: float,
        window: int,
        floor: float,
        cycle_time: float,
        wind_up: float = 0.0,
    ) -> None:
        self._learned, self._push, self._floor = learned, push, floor
        self._fresh = min(1.0, cycle_time / PULL_TIME)
        self._torques = [0] * SMOOTHED
        self._bridged = max(BRIDGED_CYCLES, BRIDGED_TIME / cycle_time)
        self._count = max(STOOD, round(HELD_TIME / cycle_time))
        self._lasting: deque[int] = deque(maxlen=self._count)
        self._long = max(STOOD, round(LEARN_TIME / cycle_time))
        if learned.cycle_time != cycle_time:
            learned.cycle_time, learned.change, learned.samples = cycle_time, 0, 0
        self._near = max(NEAR_UNITS, window / NEAR_SHARE)
        self._hold_at(0)
        self.at_rest = max(LEAST_UNITS, window / WINDOW_SHARE) + SWING * wind_up
        """Position units that an axis at rest may go unseen, by its torque and inertia."""
        self._position: int | None = None
        self._step = self._step_before = 0.0
        self._stood = 0
        self._coasting = self._doubtful = False
        self._speed = self._pushed = self._disturbed = 0.0
        self.way = 0.0
        """How far it has gone unseen, position units; signed."""
        self.alarm = ""
        """Why it has to be stopped: "dead" or "pushed"; empty where it has not."""

    @property
    def knows(self) -> bool:
        """Whether the axis has stood and moved, so that its friction is known."""
        return bool(self._learned.holds)

    @property
    def dead(self) -> float:
        """Position units that an axis may go on unseen that stood dead."""
        return max(DEAD_UNITS, DEAD_SHARE * self._learned.change)

    def restart(self) -> None:
        """Begin anew: time has passed unseen, or nothing pushes the axis."""
        self._position = None

    def take(self, position: int, torque: int, cycles: float = 1.0, disturbed: float = 0.0) -> None:
        """Take the next sample, which comes so many cycles after the one before.

        ``disturbed`` is the torque that other axes may hold it by, through couplings: not for long, for
        they swing.
        """
        self._disturbed = disturbed if self._stood < self._count else 0.0
        if cycles > self._bridged:
            self.restart()
        before, self._position = self._position, position
        if before is None:
            self._torques = [torque] * SMOOTHED
            self._lasting.append(torque)
            if not self._learned.samples and not self.knows:
                self._learned.torque = torque
            self._step = self._step_before = 0.0
            self._begin()
            self._hold_at(position)
            return
        for _ in range(max(1, round(cycles))):
            self._torques = [*self._torques[1:], torque]
            self._lasting.append(torque)
        self._since += max(1, round(cycles))
        self._learn_friction(position)
        if position != before:
            self._moves(position - before, torque, cycles)
            self._begin()
            return
        self._stood += 1
        if self._stood == 1:
            self._speed = self._speed_left(cycles)
            self._coasting = self._speed != 0
        pushed = sum(self._torques) / SMOOTHED - self._learned.pull
        if cycles > 1:
            self._push_on(_surely(self._pushed, pushed), cycles - 1)
        self._push_on(pushed)
        self._pushed = pushed

    def _begin(self) -> None:
        self._stood = 0
        self._speed = self.way = self._pushed = 0.0
        self._coasting = False

    def _hold_at(self, position: int) -> None:
        self._anchor, self._since, self._must = position, 0, False
        self._held = self._shortly = 0.0

    def _learn_friction(self, position: int) -> None:
        """Note under which torque it stays near a place, and take it for friction once it leaves."""
        learned = self._learned
        if abs(position - self._anchor) <= self._near:
            now = abs(sum(self._torques) / SMOOTHED - learned.pull)
            self._shortly = max(self._shortly, now)
            if self._since >= self._count:
                lasting = abs(sum(self._lasting) / len(self._lasting) - learned.pull)
                self._held = max(self._held, lasting)
            self._must = self._must or abs(self.way) > LEARN_UNITS
            return
        steady = self._shortly <= STEADY * self._held + 2 * self._floor
        if steady and (self._since >= self._long or self._must):
            learned.note_hold(self._held)
        self._hold_at(position)

    def _moves(self, step: int, torque: int, cycles: float) -> None:
        learned = self._learned
        direction = 1.0 if step > 0 else -1.0
        learned.torque += self._fresh * (torque - learned.torque)
        learned.direction += self._fresh * (direction - learned.direction)
        if cycles > 1:
            self._bridge(step / cycles, cycles)
            return
        before = 0.0 if self._stood else self._step
        if not self._doubtful:
            entered = (
                abs(self._step) if self._stood else 0
            )  # that it stood so suddenly was no alarm
            learned.change = max(learned.change, abs(step - before), entered)
            learned.samples += 1
        self._step_before, self._step, self._doubtful = before, step, False

    def _bridge(self, mean: float, cycles: float) -> None:
        """Take the mean step of some cycles: its last one may be slower, as far as is normal."""
        slowest = max(0.0, abs(mean) - self._learned.change * (cycles - 1) / 2)
        self._step_before, self._step = 0.0, slowest if mean > 0 else -slowest
        self._doubtful = True

    def _speed_left(self, cycles: float) -> float:
        """Return how fast it must still be, position units a cycle, whatever friction did."""
        learned, last, before = self._learned, self._step, self._step_before
        if learned.samples < LEARN:
            return 0.0
        sign = 1.0 if last > 0 or (last == 0 and before > 0) else -1.0
        size = max(
            sign * last - LAST_STEP * learned.change, sign * before - STEP_BEFORE * learned.change
        )
        return sign * max(0.0, size - 1 - learned.change * (cycles - 1))

    def _push_on(self, pushed: float, cycles: float = 1.0) -> None:
        """Go on by so many cycles under a torque beside the mean."""
        friction, push = self._learned.friction, self._push * cycles
        if self._coasting:
            direction = 1.0 if self._speed > 0 else -1.0
            self._speed += push * (pushed - direction * friction)
            if direction * self._speed <= 0:
                self._speed, self._coasting = 0.0, False
            self.way += self._speed * cycles
            if self._stood >= STOOD and abs(self.way) > self.dead:
                self.alarm = "dead"
            return
        hold = FRICTION_SHARE * friction + self._floor + self._disturbed
        if not self._speed:
            self._speed = push * (pushed - math.copysign(min(abs(pushed), hold), pushed))
        else:  # it moves, and friction takes no more of its speed than it holds it by
            direction = math.copysign(1.0, self._speed)
            self._speed += push * (pushed - direction * hold)
            if direction * self._speed < 0:  # it is caught again
                self._speed = 0.0
        self.way += self._speed * cycles
        if self.knows and abs(self.way) > self.at_rest:
            self.alarm = "pushed"


def _surely(before: float, now: float) -> float:
    """Return the torque that acted between two samples at least: none where it changed its sign."""
    if before * now <= 0:
        return 0.0
    return before if abs(before) < abs(now) else now
