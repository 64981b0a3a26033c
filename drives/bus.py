"""Open a CAN bus, tell its time, and count what fits on it."""

import time
from dataclasses import dataclass
from math import ceil
from typing import Protocol, cast

import can

from drives.errors import BusError, LimitsError
from drives.profile import BusProfile

MAX_CYCLIC_LOAD = 0.9
"""Share of the bus that SYNC and PDOs may take in the worst case; the rest is for SDO, EMCY, NMT."""

PDO_BYTES = 8


class Clock(Protocol):
    """Time of a bus, seconds."""

    def now(self) -> float:
        """Present time."""

    def wait_until(self, moment: float) -> None:
        """Return at that time, at once if it has passed."""


class WallClock:
    """Time of the host: monotonic."""

    def now(self) -> float:
        """Seconds since an arbitrary start."""
        return time.perf_counter()

    def wait_until(self, moment: float) -> None:
        """Sleep, and spin for the last part, which sleeping would miss."""
        while (left := moment - time.perf_counter()) > 0:
            if left > 0.0005:
                time.sleep(left - 0.0004)


def clock_of(bus: can.BusABC) -> Clock:
    """Return the bus' own clock if it brings one, else the host's."""
    own = getattr(bus, "clock", None)
    return cast(Clock, own) if own is not None else WallClock()


def not_imitated(bus: can.BusABC) -> tuple[str, ...]:
    """Return what the bus says it does not imitate of a real one; empty for a real bus."""
    return tuple(getattr(bus, "not_imitated", ()))


def open_bus(profile: BusProfile) -> can.BusABC:
    """Open the machine's bus.

    Raises
    ------
    BusError
        If python-can knows no such interface, or the interface can not be opened.
    """
    try:
        return can.Bus(
            interface=profile.interface, channel=profile.channel, bitrate=profile.bitrate
        )
    except Exception as error:  # adapters' libraries raise whatever they like
        raise BusError(
            f"bus {profile.interface} {profile.channel}: can not be opened ({error}). Is the "
            "adapter plugged in, the interface up, and its bit rate "
            f"{profile.bitrate} bit/s?"
        ) from error


def frame_bits(data_bytes: int) -> int:
    """Return a standard frame's longest time on the bus in bits: with worst-case stuffing.

    ISO 11898-1: 34 + 8 n bits are subject to stuffing, at most one more bit in four after the
    first; 13 more bits with the interframe space are not.
    """
    stuffed = 34 + 8 * data_bytes
    return stuffed + 13 + (stuffed - 1) // 4


@dataclass(frozen=True)
class CyclicLoad:
    """What SYNC and PDOs take of the bus in the worst case."""

    axes: int
    cycle_time: float
    """Seconds."""
    bitrate: int
    """bit/s."""

    @property
    def bits(self) -> int:
        """Bits a cycle: one SYNC, and two full PDOs an axis."""
        return frame_bits(0) + 2 * self.axes * frame_bits(PDO_BYTES)

    @property
    def share(self) -> float:
        """Of the bus, 0 to 1 and beyond."""
        return self.bits / (self.bitrate * self.cycle_time)


def shortest_cycle(axes: int, bitrate: int) -> float:
    """Return the shortest cycle time that fits, in whole milliseconds, as seconds."""
    bits = CyclicLoad(axes, 1.0, bitrate).bits
    return ceil(bits / (bitrate * MAX_CYCLIC_LOAD) * 1000 - 1e-9) / 1000


def check_cycle(load: CyclicLoad) -> None:
    """Refuse a cycle that does not fit the bus.

    Raises
    ------
    LimitsError
        With the numbers: bits, load, and the shortest cycle that fits.
    """
    if load.share > MAX_CYCLIC_LOAD:
        raise LimitsError(
            f"{load.axes} axes at a cycle of {load.cycle_time * 1000:g} ms need {load.bits} bits a "
            f"cycle, {100 * load.share:.0f} % of {load.bitrate} bit/s in the worst case; at most "
            f"{100 * MAX_CYCLIC_LOAD:.0f} % are allowed. The shortest cycle that fits is "
            f"{shortest_cycle(load.axes, load.bitrate) * 1000:g} ms."
        )
