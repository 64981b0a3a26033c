"""Count what fits on a CAN bus."""

from dataclasses import dataclass
from math import ceil

from drives.errors import LimitsError

MAX_CYCLIC_LOAD = 0.9
"""Share of the bus that SYNC and PDOs may take in the worst case; the rest is for SDO, EMCY, NMT."""

PDO_BYTES = 8


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
