"""How well the host keeps its cycles, and what it takes to be in time."""

import gc
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass

from drives.bus import Clock, WallClock

LATE_SHARE = 0.25
"""Share of a cycle by which the host may be late; a block with a later cycle is measured again."""
REAL_TIME_PRIORITY = 40
"""Of SCHED_FIFO: above ordinary programs, below the kernel's own threads."""


@dataclass(frozen=True)
class Punctuality:
    """How well the host kept its cycles; motions add up."""

    cycles: int = 0
    late: int = 0
    """Cycles that began later than ``LATE_SHARE`` of the cycle."""
    worst: float = 0.0
    """Largest lateness, s."""
    cycle_time: float = 0.0
    """Of the last motion, s."""
    overruns: int = 0
    """Received frames that were lost because the host took them too late."""
    real_time: str = ""
    """Why the host has no real-time priority; empty where it has."""
    kernel_could: bool = False
    """Whether the kernel could give the SYNC, and the host does."""

    def plus(self, other: "Punctuality") -> "Punctuality":
        """Return the two together, on the bus of the first."""
        return Punctuality(
            self.cycles + other.cycles,
            self.late + other.late,
            max(self.worst, other.worst),
            other.cycle_time,
            self.overruns + other.overruns,
            other.real_time,
            self.kernel_could,
        )

    @property
    def sentence(self) -> str:
        """All of it for a person."""
        share = f"{100 * LATE_SHARE:g} % of the cycle"
        lost = f" {self.overruns} received frames were lost." if self.overruns else ""
        how = (
            f"without real-time priority ({self.real_time})"
            if self.real_time
            else "with real-time priority"
        )
        return (
            f"This computer began {self.late} of {self.cycles} cycles more than {share} late, the worst "
            f"{1000 * self.worst:.2g} ms in a cycle of {1000 * self.cycle_time:g} ms, {how}.{lost}"
        )

    @property
    def advice(self) -> str:
        """What to do about late cycles; empty where there were none."""
        if not (self.late or self.overruns):
            return ""
        allow = (
            "allow real-time priority (in /etc/security/limits.d: `@users - rtprio 50`, then log in "
            "anew), "
            if self.real_time and hasattr(os, "sched_setscheduler")
            else ""
        )
        kernel = (
            "let the kernel give the SYNC (`sync: kernel` under `bus` in the machine profile), "
            if self.kernel_could and self.late
            else ""
        )
        return (
            "The blocks with them were measured again. To have fewer: close other programs, "
            f"{allow}{kernel}or give the bus a longer `shortest_cycle` in the machine profile."
        )


@contextmanager
def undisturbed(clock: Clock) -> Iterator[str]:
    """Give this thread what it takes to be in time, for as long as axes move; yield why not.

    Real-time priority (SCHED_FIFO) is taken where it is allowed; there, the host sleeps until each
    cycle instead of waiting busily.  What Python holds already is not searched for garbage meanwhile:
    that takes longer than many a cycle.  In virtual time nothing is done.
    """
    if not isinstance(clock, WallClock):
        yield ""
        return
    gc.collect()
    gc.freeze()
    spin = clock.spin
    refused = _take_priority()
    try:
        if not refused:
            clock.spin = 0.0
        yield refused
    finally:
        clock.spin = spin
        if not refused:
            _give_back()
        gc.unfreeze()


def _take_priority() -> str:
    if not hasattr(os, "sched_setscheduler"):
        return "this system has no SCHED_FIFO"
    try:
        policy = os.SCHED_FIFO | os.SCHED_RESET_ON_FORK
        os.sched_setscheduler(0, policy, os.sched_param(REAL_TIME_PRIORITY))
    except OSError as error:
        return f"SCHED_FIFO: {(error.strerror or 'refused').lower()}"
    return ""


def _give_back() -> None:
    with suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
