"""Buses that can not be opened, and what the kernel says of its interfaces."""

import struct

import can
import pytest

from drives.bus import close_bus, opening
from drives.bus.adapters import known_options
from drives.bus.kernel_link import KernelLink, kernel_links, read_link
from drives.bus.trouble import trouble_of
from drives.errors import BusError
from drives.profile import BusProfile

REAL = KernelLink("can0", "can", True, 500_000, "error active", (0, 0), 10)


def _attribute(kind: int, data: bytes) -> bytes:
    return struct.pack("=HH", 4 + len(data), kind) + data + bytes(-len(data) % 4)


def _message(
    *, hardware: int = 280, flags: int = 1, bitrate: int = 500_000, state: int = 0, mode: int = 0
) -> bytes:
    """An RTM_NEWLINK as ``linux/rtnetlink.h`` and ``linux/can/netlink.h`` lay it out."""
    timing = struct.pack("=8I", bitrate, 875, 125, 6, 7, 2, 1, 1)
    data = (
        _attribute(1, timing)
        + _attribute(4, struct.pack("=I", state))
        + _attribute(5, struct.pack("=II", 0, mode))
        + _attribute(8, struct.pack("=HH", 3, 128))
    )
    info = _attribute(1, b"can\0") + _attribute(2, data)
    return (
        struct.pack("=BxHiII", 0, hardware, 3, flags, 0)
        + _attribute(3, b"can0\0")
        + _attribute(13, struct.pack("=I", 10))
        + _attribute(18 | 0x8000, info)
    )


def test_the_kernel_s_words_about_an_interface_are_read() -> None:
    link = read_link(_message(state=2))
    assert link == KernelLink("can0", "can", True, 500_000, "error passive", (3, 128), 10)
    assert read_link(_message(hardware=1)) is None, "an Ethernet card"
    down = read_link(_message(flags=0, mode=2))
    assert down is not None
    assert not down.up
    assert down.listen_only


@pytest.mark.parametrize("cut", range(0, 100, 7))
def test_a_message_that_is_cut_short_raises_no_more_than_struct_errors(cut: int) -> None:
    whole = _message()
    try:
        read_link(whole[: len(whole) - cut])
    except struct.error:
        assert len(whole) - cut < 16


def test_this_computer_s_interfaces() -> None:
    links = kernel_links()
    if links is None:
        pytest.skip("only Linux can be asked for its interfaces")
    assert all(link.name for link in links)
    assert kernel_links("lo") == ()
    assert kernel_links("no_such_can0") == ()


@pytest.mark.parametrize(
    ("links", "words"),
    [
        ((), r"vcan7 does not exist; CAN interfaces of this computer: none"),
        ((REAL,), r"vcan7 does not exist; CAN interfaces of this computer: can0"),
        (
            (KernelLink("vcan7", "can", True, 500_000),),
            r"is set to 500000 bit/s, the machine profile says 250000 bit/s.*"
            r"ip link set vcan7 up type can bitrate 250000",
        ),
        ((KernelLink("vcan7", "vcan", False),), r"vcan7 is down.*`ip link set vcan7 up`"),
        (
            (KernelLink("vcan7", "can", False),),
            r"down.*ip link set vcan7 up type can bitrate 250000",
        ),
        (
            (KernelLink("vcan7", "can", True, 250_000, "bus off"),),
            r"off the bus .*ip link set vcan7 type can restart",
        ),
        (
            (KernelLink("vcan7", "can", True, 250_000, listen_only=True),),
            r"only listens",
        ),
    ],
)
def test_an_interface_that_does_not_fit_is_refused_in_words(
    monkeypatch: pytest.MonkeyPatch, links: tuple[KernelLink, ...], words: str
) -> None:
    monkeypatch.setattr(opening, "kernel_links", lambda: links)
    with pytest.raises(BusError, match=words):
        opening.open_bus(BusProfile(interface="socketcan", channel="vcan7", bitrate=250_000))


def test_where_nobody_can_be_asked_python_can_has_the_word(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(opening, "kernel_links", lambda: None)
    with pytest.raises(BusError, match="bus socketcan no_such_can0: can not be opened"):
        opening.open_bus(BusProfile(interface="socketcan", channel="no_such_can0"))


@pytest.mark.parametrize(
    ("interface", "channel", "words"),
    [
        ("canalystii", 0, r"can not be used .*pip install python-can\[canalystii\]"),
        ("pcan", "PCAN_USBBUS1", "can not be opened .*driver"),
        ("vector", 0, "can not be opened .*driver for this system"),
    ],
)
def test_a_driver_or_package_that_is_missing_is_named(
    interface: str, channel: str | int, words: str
) -> None:
    with pytest.raises(BusError, match=words):
        opening.open_bus(BusProfile(interface=interface, channel=channel))


def test_options_are_what_the_interface_declares() -> None:
    assert known_options("slcan")["tty_baudrate"] == (int,)
    assert "channel" not in known_options("slcan")
    assert known_options("virtual")["preserve_timestamps"] == (bool,)
    assert known_options("kvaser")["accept_virtual"] == (bool,)


def test_the_environment_and_python_can_s_own_files_change_nothing(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("CAN_CONFIG", '{"receive_own_messages": true}')
    bus = opening.open_bus(BusProfile(interface="virtual", channel="own"))
    try:
        bus.send(can.Message(arbitration_id=1, is_extended_id=False))
        assert bus.recv(0.01) is None
    finally:
        bus.shutdown()


@pytest.mark.parametrize(
    ("identifier", "data", "words", "bus_off", "overrun"),
    [
        (0x040, b"", "bus off", True, False),
        (0x020, b"", "nobody acknowledges", False, False),
        (0x004, b"\0\x01", "receive buffer ran over", False, True),
        (0x004, b"\0\x20", "error passive by transmit errors", False, False),
        (0x008, b"\0\0\x04", "bit or frame errors", False, False),
    ],
)
def test_error_frames_in_words(
    identifier: int, data: bytes, words: str, bus_off: bool, overrun: bool
) -> None:
    frame = can.Message(arbitration_id=identifier, is_error_frame=True, data=data, dlc=8)
    trouble = trouble_of(frame, socketcan=True)
    assert words in trouble.words
    assert (trouble.bus_off, trouble.overrun) == (bus_off, overrun)
    assert not trouble_of(frame, socketcan=False).bus_off, "another adapter's numbers mean others"


def test_a_bus_on_other_hardware_has_other_channels_and_options() -> None:
    before = BusProfile(interface="pcan", channel="PCAN_USBBUS1", options={"device_id": 3})
    after = before.elsewhere("socketcan", "can0", 250_000)
    assert (after.interface, after.channel, after.bitrate) == ("socketcan", "can0", 250_000)
    assert after.options == {}
    kept = before.elsewhere(bitrate=125_000)
    assert (kept.channel, kept.options) == ("PCAN_USBBUS1", {"device_id": 3})
    assert kept.as_dict() == {
        "interface": "pcan",
        "channel": "PCAN_USBBUS1",
        "bitrate": 125_000,
        "options": {"device_id": 3},
    }


class Unplugged:
    """An adapter that was pulled out: its library complains where it is closed."""

    closed = False

    def shutdown(self) -> None:
        self.closed = True
        raise can.CanOperationError("Could not write to serial device")


def test_a_bus_that_can_not_be_closed_hides_no_error() -> None:
    bus = Unplugged()
    with pytest.raises(BusError, match="what matters"):
        try:
            raise BusError("what matters")
        finally:
            close_bus(bus)
    assert bus.closed
