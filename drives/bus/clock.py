"""The time in which a bus lives."""

import os
import time
from typing import Protocol, cast

import can

SPIN = 0.0004 if (os.cpu_count() or 1) > 1 else 0.0
"""Seconds before a moment for which the host does not sleep, because sleeping may take longer; not
with one processor, where nothing else would run meanwhile, the kernel's work for the bus included."""


class Clock(Protocol):
    """Time of a bus, seconds."""

    def now(self) -> float:
        """Present time."""

    def wait_until(self, moment: float) -> None:
        """Return at that time, at once if it has passed."""


class WallClock:
    """Time of the host: monotonic."""

    def __init__(self) -> None:
        self.spin = SPIN
        """Seconds of the wait that are not slept; 0 where sleeping is exact (real-time priority)."""

    def now(self) -> float:
        """Seconds since an arbitrary start."""
        return time.perf_counter()

    def wait_until(self, moment: float) -> None:
        """Sleep, and spin for the last part, which sleeping would miss."""
        spin = self.spin
        while (left := moment - time.perf_counter()) > 0:
            if left > spin:
                time.sleep(left - spin)


def clock_of(bus: can.BusABC) -> Clock:
    """Return the bus' own clock if it brings one, else the host's."""
    own = getattr(bus, "clock", None)
    return cast(Clock, own) if own is not None else WallClock()


def drives_begin_anew(bus: can.BusABC) -> bool:
    """Return whether the drives begin with this bus: nothing of an earlier session is in them.

    So it is with a machine that is simulated in this process, and never with a real one.
    """
    return bool(getattr(bus, "drives_begin_anew", False))


def not_imitated(bus: can.BusABC) -> tuple[str, ...]:
    """Return what the bus says it does not imitate of a real one; empty for a real bus."""
    return tuple(getattr(bus, "not_imitated", ()))
