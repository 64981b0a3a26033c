"""What the host's end of the bus makes of error frames and silence."""

from collections.abc import Iterator

import can
import pytest
from can.interfaces.virtual import VirtualBus

from drives.canopen_drive import connect
from drives.canopen_drive.line import Line
from drives.errors import BusError, NodeAbsentError
from drives.profile import load_machine

BUS_OFF, OVERFLOW = (0x040, b""), (0x004, b"\0\x01")


class Coded(VirtualBus):
    """A bus whose error frames are encoded as the Linux kernel does it."""

    overruns = 0


def error(identifier: int = 0, data: bytes = b"") -> can.Message:
    return can.Message(
        arbitration_id=identifier, data=data.ljust(8, b"\0"), dlc=8, is_error_frame=True
    )


@pytest.fixture
def far() -> Iterator[can.BusABC]:
    bus = can.Bus(interface="virtual", channel="line")
    yield bus
    bus.shutdown()


@pytest.fixture
def line() -> Iterator[Line]:
    bus = Coded(channel="line")
    yield Line(bus)
    bus.shutdown()


def test_a_silent_bus_is_told_from_one_with_errors(line: Line, far: can.BusABC) -> None:
    assert line.diagnosis() == "Nothing at all was heard on this bus."
    for _ in range(3):
        far.send(error(0x008, b"\0\0\x04"))
    line.wait(0.05)
    assert line.diagnosis() == (
        "There were error frames: bit or frame errors (3 times). The bit rate is most likely another "
        "one."
    )


def test_a_bus_on_which_others_speak_is_not_called_silent(line: Line, far: can.BusABC) -> None:
    far.send(can.Message(arbitration_id=0x705, data=b"\x05", is_extended_id=False))
    line.wait(0.05)
    assert line.diagnosis() == ""


def test_bus_off_ends_it(line: Line, far: can.BusABC) -> None:
    far.send(error(*BUS_OFF))
    with pytest.raises(BusError, match="the adapter went off the bus: bus off"):
        line.wait(0.5)


def test_frames_that_the_adapter_lost_are_counted(line: Line, far: can.BusABC) -> None:
    far.send(error(*OVERFLOW))
    line.wait(0.05)
    assert line.overruns == 1
    line.can_bus.overruns = 7  # type: ignore[attr-defined]
    assert line.overruns == 8


def test_good_news_is_no_trouble(line: Line, far: can.BusABC) -> None:
    far.send(error(0x004, b"\0\x40"))  # error active again
    line.wait(0.05)
    assert line.troubles == {}


def test_error_frames_are_named_where_a_node_is_silent(far: can.BusABC) -> None:
    machine = load_machine("turntable-arm")
    bus = can.Bus(interface="virtual", channel="line")
    try:
        for _ in range(2):
            far.send(error())
        with (
            pytest.raises(
                NodeAbsentError,
                match=r"node 11 does not answer. There were error frames: an error frame \(2 times\). "
                "The bit rate is most likely another one. Check its supply",
            ),
            connect(machine, bus=bus),
        ):
            pytest.fail("there is nobody")
    finally:
        bus.shutdown()
