"""A motor that turns against its torque: told in motion from the energy of the whole machine.

Masses, springs, dampers and friction give back at most the energy that they were given, and couplings
pass it on: whatever a machine of these is like, the work of all its motors never falls below what it
held in the beginning (passivity; Willems 1972, Arch. Rational Mech. Anal. 45, 321).  A motor that turns
against its torque does the opposite of the work that its drive tells, so that the sum falls without
bound as it moves.  Nothing has to be known of masses, springs, or loops for that.

The work is told from positions and torques, one sample of each a cycle, and errs: every axis' balance
counts in the machine's favour what that may come to.  A drive whose SYNC comes late has its reference at
rest already and brakes, or drives on: what it tells then is not what moved the axis there, and samples
differ by as much from one another.  So it may be in every cycle in which targets go on, for the way that
they go: a motor that turns against its torque does not follow them.  A person or another machine that
moves an axis brings energy too; it is as good a reason to stop.
"""

from collections.abc import Sequence
from math import exp

STAYS = 1.0
"""Seconds after which a share of 1 / e is left of an energy that no motion of motors holds: of a load's
swing of 8 Hz with 1 % of damping."""
DELAY = 0.003
"""Seconds by which position and torque may be told apart (filters, delays): it turns work done into work
given back, where both change fast."""
SCALE = 0.1
"""Share by which a torque may be told wrong, against that of another axis."""
ROUNDING = 0.25
"""Position units that a position is beside the true one, when the torque changes."""
MOVES = 2.0
"""Times the energy of motion by the prior model which a moving axis may hold: that does not fade."""
WEIGHT = 2.0
"""Times the torque that holds an axis which its weight, or a balancing spring, may come to."""
FIRST, HOLDS = 20, 0.5
"""Samples, and seconds, over which the mean torque may be what holds an axis against its weight."""
RUN_UP = 0.01
"""Seconds in which the torque limit gives an axis from rest the energy that may be missing at the end,
and that may be there in the beginning, from blows and old swings."""
WOBBLES = 0.3
"""Seconds in which there is a SYNC in time among the late ones, and a late one among those in time."""
LATELY = 0.1
"""Seconds over which it is judged which axis gave back most, and how fast one is that swings."""


class Balance:
    """The energy that one axis' motor has brought in, and that may still be there, J.

    Parameters
    ----------
    position_unit, torque_unit
        rad or m, N m or N.
    torque
        Torque limit, N m or N.
    inertia
        Of the whole axis by its prior model, kg m2 or kg.
    cycle_time
        s.
    weight
        Torque that does not come from friction as far as is known, N m or N; None for an axis that
        stays where it is without torque.
    """

    def __init__(
        self,
        position_unit: float,
        torque_unit: float,
        torque: float,
        inertia: float,
        cycle_time: float,
        weight: float | None = None,
    ) -> None:
        self._position_unit, self._torque_unit = position_unit, torque_unit
        self._stays, self._lately = exp(-cycle_time / STAYS), exp(-cycle_time / LATELY)
        self._wobbles = exp(-cycle_time / WOBBLES)
        self._delay, self._cycle_time, self._inertia = DELAY / cycle_time, cycle_time, inertia
        self._speed = 0.0
        self._weighs, self._weight = weight is not None, abs(weight or 0.0)
        self._mean, self._samples, self._held = 0.0, 0, max(FIRST, round(HOLDS / cycle_time))
        self._before: tuple[int, float, int] | None = None
        self._asked = self._jump = self._most = self._least = 0.0
        """Of late: longest way of a target in a cycle, rad or m; largest jump of the torque from one
        sample to the next, largest and least torque, N m or N."""
        self._low = self._high = 0
        self.spare = 0.5 * (torque * RUN_UP) ** 2 / inertia
        """What may be missing before it is sure that something is wrong."""
        self.brought = self.spare
        """What it has brought in that may still be there."""
        self.lately = 0.0
        """What it has brought in lately, nothing in its favour."""

    def take(
        self, position: int, torque: int, target: int, cycles: float, *, enabled: bool
    ) -> None:
        """Take the next sample, and the target sent last, in units, so many cycles after the last."""
        now = torque * self._torque_unit if enabled else 0.0
        place, before, asked = self._before or (position, now, target)
        self._before = position, now, target
        way = abs(position - place) * self._position_unit
        work = (before + now) / 2 * (position - place) * self._position_unit
        jump = abs(now - before)
        self._note_brakes(now, jump, abs(target - asked) * self._position_unit if enabled else 0.0)
        doubt = SCALE * abs(work) + jump * ROUNDING * self._position_unit
        doubt += max(
            jump * self._delay * way,
            self._brakes((before + now) / 2, position > place) * min(way, self._asked),
        )
        if cycles != 1.0:
            doubt += (abs(before) + abs(now)) * way
        self._speed = max(way / (self._cycle_time * cycles), self._lately * self._speed)
        moves = min(max(self.brought, 0.0), MOVES * 0.5 * self._inertia * self._speed**2)
        self.brought = moves + self._stays * (self.brought - moves) + work + doubt
        self.lately = self._lately * self.lately + work
        if enabled and self._weighs:
            self._note_weight(now, position)

    def _note_brakes(self, now: float, jump: float, asked: float) -> None:
        fades = self._wobbles
        self._asked = max(asked, self._lately * self._asked)
        self._jump = max(jump, fades * self._jump)
        self._most = now + max(0.0, fades * (self._most - now))
        self._least = now - max(0.0, fades * (now - self._least))

    def _brakes(self, told: float, forward: bool) -> float:
        """Return by how much a cycle's torque may be above what its samples tell, the way it moves."""
        return min(self._jump, self._most - told if forward else told - self._least)

    def _note_weight(self, torque: float, position: int) -> None:
        if not self._samples:
            self._low = self._high = position
        self._low, self._high = min(self._low, position), max(self._high, position)
        self._samples += 1
        self._mean += (torque - self._mean) / min(self._samples, self._held)
        if self._samples >= FIRST:
            self._weight = max(self._weight, abs(self._mean))

    @property
    def stored(self) -> float:
        """What its weight may have stored before, and given back by now."""
        return WEIGHT * self._weight * (self._high - self._low) * self._position_unit


def reversed_axis(balances: Sequence[Balance]) -> int | None:
    """Return which axis' motor turns against its torque, by number; None if none does for sure."""
    worst = min(range(len(balances)), key=lambda k: balances[k].lately)
    missing = -sum(one.brought + one.stored for one in balances)
    return worst if missing > balances[worst].spare else None
