"""Who gives the beat: SYNC from the host itself, or from the kernel, and how late each was."""

import time
from collections.abc import Callable
from typing import Protocol

import can

from drives.bus import is_data
from drives.bus.kernel_sync import LeasedSync
from drives.canopen_drive.line import Line
from drives.canopen_drive.pace import LATE_SHARE
from drives.errors import BusError

SYNC_ID = 0x080
_BEFORE_NOW = 1e-7
"""Seconds by which a moment may be early: no clock is finer."""
PULL, MOST_PULL = 0.3, 0.2
"""Share of the kernel's lateness that its next period makes up for, and largest change of a period."""
OLDEST = 5.0
"""Seconds that a frame may have waited to be read; more, or less than none: the clock was set."""
AT_ONCE, READINGS = 2e-4, 10
"""Seconds within which two clocks are read, and times that it is tried."""
GONE = 1.5
"""Cycles without the kernel's SYNC after which its lease has ended."""
IN_VAIN = 10
"""Times that so many cycles are waited for it in one cycle, before it is given up."""

Early = Callable[[can.Message], None]
"""Takes a frame that came before the SYNC."""


class Sync(Protocol):
    """Gives a SYNC for every cycle, after the targets were sent."""

    cycles: int
    late: int
    """Cycles that began later than LATE_SHARE of a cycle."""
    worst: float
    """Largest lateness, s."""
    lateness: float
    """Of the present cycle, s; 0 where it is not late."""
    stretch: float
    """Seconds by which the present SYNC came later than a cycle after the one before."""
    behind: list[int]
    """Of each cycle, in a row until the present one, whose SYNC went out before all earlier frames were
    taken: the identifier of the last one taken.  What comes next may be old."""

    def restart(self) -> None:
        """Begin anew: the next cycle is one cycle time from now."""

    def give(self, early: Early) -> float:
        """Have the next SYNC sent; return the time at which it was, by the bus' clock."""

    def close(self) -> None:
        """Send none any more."""


class HostSync:
    """The host sends it; a late one shifts those that follow.

    However long the host is held up, no drive sees a SYNC without new targets.
    """

    def __init__(self, line: Line, cycle_time: float) -> None:
        self._line, self._cycle_time = line, cycle_time
        self._message = can.Message(arbitration_id=SYNC_ID, is_extended_id=False)
        self._start, self._count = line.clock.now() + cycle_time, 0
        self.cycles = self.late = 0
        self.worst = self.lateness = self.stretch = 0.0
        self._last: float | None = None
        self.behind: list[int] = []

    def restart(self) -> None:
        """Begin anew: the next cycle is one cycle time from now."""
        self._start, self._count = self._line.clock.now() + self._cycle_time, 0
        self._last = None

    def give(self, early: Early) -> float:
        """Wait for the next cycle's moment, take what came until then, and send a SYNC.

        Frames that come faster than they are taken keep it back for a cycle at most; once for as long
        as the host was held up besides, for many may have come meanwhile.
        """
        line, clock = self._line, self._line.clock
        moment = self._start + self._count * self._cycle_time
        clock.wait_until(moment - _BEFORE_NOW)
        late = clock.now() - moment
        self._count += 1
        self._note(late)
        if self.lateness:
            self._start += late
            moment += late
        held_up = 0.0 if self.behind else max(0.0, late)
        self._take_early(early, clock.now() + held_up + self._cycle_time)
        self._note_stretch(clock.now())
        line.send(self._message)
        return moment

    def _take_early(self, early: Early, end: float) -> None:
        line = self._line
        while (message := line.receive(0.0)) is not None:
            early(message)
            if line.clock.now() >= end:
                self.behind.append(message.arbitration_id)
                return
        self.behind.clear()

    def close(self) -> None:
        """Nothing is left to do."""

    def _note(self, late: float) -> None:
        self.cycles += 1
        self.worst = max(self.worst, late)
        self.lateness = late if late > LATE_SHARE * self._cycle_time else 0.0
        self.late += self.lateness > 0

    def _note_stretch(self, moment: float) -> None:
        self.stretch = 0.0 if self._last is None else moment - self._last - self._cycle_time
        self._last = moment


class KernelSync(HostSync):
    """The kernel's broadcast manager sends it, on a lease that every cycle renews.

    The kernel's timer begins each period when the one before has ended, late or not, so its period is
    a little long; time stamps show by how much, and the next period makes up for it.
    """

    def __init__(self, line: Line, cycle_time: float) -> None:
        super().__init__(line, cycle_time)
        self._lease = LeasedSync(str(getattr(line.can_bus, "channel", "")), SYNC_ID)
        self._origin: float | None = None
        """Moment of the first SYNC of the present count, by the bus' clock; None before it."""
        self._period = cycle_time

    def restart(self) -> None:
        """Begin anew with the next cycle."""
        if self._origin is not None:
            self._lease.stop()
        self._origin, self._count, self._period = None, 0, self._cycle_time
        self._last = None

    def give(self, early: Early) -> float:
        """Renew the lease, and wait for the SYNC that acts on the targets just sent.

        One that came before they were all sent is no SYNC of this cycle: the cycle is late.

        Raises
        ------
        BusError
            If it does not come, however often it is started, or not through all the others.
        """
        line, patience = self._line, GONE * self._cycle_time
        sent, overtaken = line.clock.now(), 0.0
        in_vain, until = 0, sent + patience
        if self._origin is None:
            self._lease.start(self._period)
        else:
            self._lease.renew(self._period)
        while in_vain < IN_VAIN:
            message = line.receive(patience)
            if message is None:  # the lease had ended: the host was very late
                self._origin, self._count = None, 0
                overtaken = max(overtaken, patience)
                self._lease.start(self._cycle_time)
            elif message.arbitration_id != SYNC_ID or not is_data(message):
                early(message)
            elif (moment := self._moment(message)) < sent:
                overtaken = max(overtaken, sent - moment)
                self._count += 1
            else:
                self._follow(moment, overtaken)
                return moment
            now = line.clock.now()
            if message is None or now >= until:  # once, however long the host was held up
                in_vain, until = in_vain + 1, now + patience
        raise BusError(
            f"the kernel's SYNC did not come back within {1000 * (line.clock.now() - sent):.0f} ms: "
            "what this computer sends does not get onto the bus, or others fill it. Check the cable to "
            "the drives, look for a device that sends without end, and start again."
        )

    def _moment(self, message: can.Message) -> float:
        """Return when a frame came, by the bus' clock, which nobody sets: the kernel stamps by its
        time of day.

        Both clocks are read at once, again where the host was held up in between: the frame would
        seem to have come as much later.
        """
        clock = self._line.clock
        for _ in range(READINGS):
            before, day, now = clock.now(), time.time(), clock.now()
            if now - before < AT_ONCE:
                break
        age = day - message.timestamp
        return now - (age if 0 <= age <= OLDEST else 0.0)

    def _follow(self, moment: float, overtaken: float) -> None:
        """Take note of how late a SYNC was, and choose the next period."""
        if self._origin is None:
            self._origin, self._count = moment, 0
        phase = moment - self._origin - self._count * self._cycle_time
        if abs(phase) > self._cycle_time / 2:  # the kernel was held up
            self._origin, self._count = moment, 0
        self._count += 1
        most = MOST_PULL * self._cycle_time
        self._period = self._cycle_time - min(most, max(-most, PULL * phase))
        self._note(max(overtaken, phase))
        self._note_stretch(moment)

    def close(self) -> None:
        """Send none any more."""
        self._lease.close()
