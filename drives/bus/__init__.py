"""The CAN bus under everything: open one, tell its time, count what fits on it.

``opening`` opens whatever python-can opens, ``adapters`` knows python-can's interfaces and what they
take, ``kernel_link`` and ``kernel_bus`` what only SocketCAN has, ``frames`` tells CANopen's frames from
others, ``trouble`` reads error frames.
"""

from can import BusABC as Bus

from drives.bus.clock import Clock, WallClock, clock_of, drives_begin_anew, not_imitated
from drives.bus.frames import is_data
from drives.bus.load import (
    MAX_CYCLIC_LOAD,
    CyclicLoad,
    check_cycle,
    frame_bits,
    shortest_cycle,
)
from drives.bus.opening import close_bus, open_bus
from drives.bus.trouble import bus_state, trouble_of

__all__ = [
    "MAX_CYCLIC_LOAD",
    "Bus",
    "Clock",
    "CyclicLoad",
    "WallClock",
    "bus_state",
    "check_cycle",
    "clock_of",
    "close_bus",
    "drives_begin_anew",
    "frame_bits",
    "is_data",
    "not_imitated",
    "open_bus",
    "shortest_cycle",
    "trouble_of",
]
