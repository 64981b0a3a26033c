"""What only the kernel's own bus has: time stamps, filters, overruns, links that are down."""

import contextlib
import errno
import os
import pty
import shutil
import subprocess
import threading
import time
import tty
from pathlib import Path

import can
import numpy as np
import pytest
from can.interfaces.socketcan.socketcan import SocketcanBus

from drives.bus import open_bus
from drives.bus.kernel_bus import KernelBus
from drives.bus.kernel_link import kernel_links
from drives.bus.kernel_sync import LEASE, LeasedSync
from drives.canopen_drive import connect
from drives.canopen_drive.line import Line
from drives.errors import BusError
from drives.profile import BusProfile, load_machine
from tests.socketcan.conftest import CYCLE, MACHINE, TABLE, link


def opened(channel: str = "vcan1") -> KernelBus:
    bus = open_bus(BusProfile(interface="socketcan", channel=channel))
    assert isinstance(bus, KernelBus)
    return bus


def frame(identifier: int, data: bytes = b"") -> can.Message:
    return can.Message(arbitration_id=identifier, data=data, is_extended_id=False)


def test_the_kernel_tells_its_interfaces() -> None:
    names = {one.name: one for one in kernel_links() or ()}
    assert names["vcan1"].kind == "vcan"
    assert names["vcan1"].up
    assert names["vcan1"].bitrate is None
    assert kernel_links("vcan1") == (names["vcan1"],)


def test_time_stamps_are_those_of_the_arrival() -> None:
    sent = []
    with opened() as near, opened() as far:
        for k in range(3):
            before = time.time()
            far.send(frame(0x123, bytes([k])))
            sent.append((before, time.time()))
            time.sleep(0.05)
        time.sleep(0.3)
        read = time.time()
        stamps = [message.timestamp for _ in range(3) if (message := near.recv(1.0))]
    assert len(stamps) == 3
    assert read - stamps[-1] > 0.3, "not the time at which it was read"
    for (before, after), stamp in zip(sent, stamps, strict=True):
        assert before - 1e-6 <= stamp <= after + 0.04


def test_frames_that_nobody_wants_are_left_to_the_kernel() -> None:
    with opened() as near, opened() as far:
        with Line(near).only([0x18B, 0x70B]):
            far.send(frame(0x18B))
            far.send(frame(0x18C))
            far.send(can.Message(arbitration_id=0x18B, is_extended_id=True))
            far.send(frame(0x70B))
            got = []
            while not got or got[-1] != 0x70B:
                message = near.recv(2.0)
                assert message is not None
                got.append(message.arbitration_id)
        assert got == [0x18B, 0x70B]
        far.send(frame(0x18C))
        message = near.recv(2.0)
    assert message is not None
    assert message.arbitration_id == 0x18C


def test_the_receive_buffer_has_room_for_half_a_second_of_a_full_bus() -> None:
    with opened() as near, opened() as far:
        assert near.room >= 4000
        for k in range(3000):
            far.send(frame(0x100 + k % 7))
        taken = sum(1 for _ in range(3000) if near.recv(0.2))
        assert taken == 3000
        assert near.overruns == 0


def test_an_overrun_is_counted() -> None:
    with opened() as near, opened() as far:
        near.socket.setsockopt(1, 8, 4096)  # SO_RCVBUF: a few frames
        line = Line(near)
        for _ in range(500):
            far.send(frame(0x123))
        taken = 0
        while line.receive(0.05) is not None:
            taken += 1
        far.send(frame(0x123))  # the kernel tells with the next frame
        assert line.receive(1.0) is not None
        assert taken < 400
        assert line.overruns == 500 - taken


def test_a_cycle_that_lost_frames_is_spoiled_and_the_motion_goes_on(drives) -> None:
    """A flood that the filter lets through, while the host does not look."""
    machine = load_machine(MACHINE)
    bus = opened("vcan0")
    with bus, opened("vcan0") as other, connect(machine, bus) as group:
        with group.motion(CYCLE) as motion:
            hold = np.tile(motion.position, (20, 1))
            lost: list[int] = []

            def source(before):
                lost.append(bus.overruns)
                blocks = len(lost)
                if blocks == 2:
                    bus.socket.setsockopt(1, 8, 4096)
                    for _ in range(200):
                        other.send(frame(0x123))  # left out by the filter
                if blocks == 3:
                    for _ in range(200):
                        other.send(frame(0x700 + TABLE, b"\x05"))
                return hold if blocks < 6 else None

            capture = motion.stream(source)
        kept = group.punctuality
    assert capture.rows == 100
    assert lost[2] == 0, "what the filter leaves out does no harm"
    assert 40 in capture.missing, "the flood was seen"
    assert kept.overruns > 50
    assert "received frames were lost" in kept.sentence


def test_an_interface_that_is_down_or_missing_is_refused(up_again) -> None:
    link("vcan1", "down")
    with pytest.raises(BusError, match=r"vcan1 is down. Bring it up: `ip link set vcan1 up`"):
        opened()
    with pytest.raises(BusError, match=r"vcan7 does not exist; CAN interfaces .*: vcan0, vcan1"):
        opened("vcan7")


def test_a_transmit_queue_that_is_full_for_a_moment_is_waited_for(monkeypatch) -> None:
    """vcan has no queue, so what the kernel says of a full one is put in its place."""
    send, full = SocketcanBus.send, [3]

    def queued(self, msg, timeout=None):
        if full[0]:
            full[0] -= 1
            raise can.CanOperationError("Failed to transmit: no room", errno.ENOBUFS)
        send(self, msg, timeout)

    monkeypatch.setattr(SocketcanBus, "send", queued)
    with opened() as near, opened() as far:
        far.send(frame(0x123))
        assert near.recv(1.0) is not None
        full[0] = 10**9
        with pytest.raises(BusError, match=r"transmit queue of vcan1 is full.*txqueuelen 1000"):
            Line(far).send(frame(0x123))


def test_an_interface_that_goes_down_is_noticed(up_again) -> None:
    with opened() as near, opened() as other:
        line = Line(near)
        link("vcan1", "down")
        with pytest.raises(BusError, match="frames any more: interface vcan1 is down"):
            line.receive(1.0)
        with pytest.raises(BusError, match="interface vcan1 is down"):
            Line(other).send(frame(0x123))


def drained(terminal: int) -> None:
    """Take what the kernel sends to the adapter that is not there."""
    with contextlib.suppress(OSError):
        while os.read(terminal, 4096):
            pass


def syncs(bus: KernelBus, seconds: float) -> list[float]:
    """Return the time stamps of the SYNCs of so many seconds."""
    stamps, deadline = [], time.monotonic() + seconds
    while (left := deadline - time.monotonic()) > 0:
        message = bus.recv(left)
        if message is not None and message.arbitration_id == 0x080:
            stamps.append(message.timestamp)
    return stamps


def test_the_broadcast_manager_s_sync_ends_with_its_lease() -> None:
    with opened() as near:
        sync = LeasedSync("vcan1")
        try:
            sync.start(CYCLE)
            assert len(syncs(near, 0.3)) == LEASE, "nobody renewed it"
            sync.renew(CYCLE)
            assert syncs(near, 0.2) == [], "what has ended is not renewed"
            sync.start(CYCLE)
            stamps = []
            for _ in range(20):
                stamps += syncs(near, CYCLE / 2)
                begin = time.time()
                sync.renew(CYCLE)
            renewed = time.time()
            stamps += syncs(near, 0.3)
            assert len(stamps) > 2 * LEASE, "it goes on while it is renewed"
            assert sum(stamp > renewed for stamp in stamps) <= LEASE
            assert sum(stamp > begin for stamp in stamps) >= LEASE
            sync.start(CYCLE)
            sync.stop()
            stopped = time.time()
            stamps = syncs(near, 0.2)
            assert len(stamps) >= 1, "the first one comes at once"
            assert all(stamp <= stopped for stamp in stamps)
        finally:
            sync.close()


def test_the_kernel_s_sync_keeps_its_pace_and_answers_come(drives) -> None:
    machine = load_machine(MACHINE)
    kernel = machine.model_copy(update={"bus": machine.bus.model_copy(update={"sync": "kernel"})})
    rows = 300
    with opened("vcan0") as other, connect(kernel) as group:
        with group.motion(CYCLE) as motion:
            hold = np.tile(motion.position, (rows // 3, 1))
            blocks = [hold] * 3
            other.focus([0x080])
            while other.recv(0) is not None:
                pass
            capture = motion.stream(lambda _: blocks.pop() if blocks else None)
            stamps = [m.timestamp for _ in range(2 * rows) if (m := other.recv(0)) is not None]
        kept = group.punctuality
    assert capture.rows == rows
    print(kept.sentence, len(capture.missing), "rows spoiled")
    assert len(capture.missing) < rows / 4
    assert len(stamps) >= rows
    steps = np.diff(stamps[:rows])
    print("SYNC every", np.percentile(1000 * steps, [0, 5, 50, 95, 100]), "ms")
    assert np.median(steps) == pytest.approx(CYCLE, rel=0.1)
    assert stamps[rows - 1] - stamps[0] == pytest.approx((rows - 1) * CYCLE, rel=0.02)


def test_the_kernel_gives_the_sync_on_its_own_bus_only() -> None:
    bus = BusProfile(interface="virtual", channel="x", sync="kernel")
    with pytest.raises(BusError, match="on SocketCAN only, not on virtual"):
        open_bus(bus)


@pytest.fixture
def slcan():
    """A CAN interface with a bit rate: the kernel's serial-line CAN on a pseudo-terminal."""
    if shutil.which("slcand") is None:
        pytest.skip("needs slcand (can-utils)")
    if not Path("/sys/module/slcan").exists():
        modules = list(Path("/usr/lib/uml/modules").glob("*/kernel/drivers/net/can/slcan/slcan.ko"))
        if modules:
            subprocess.run(["busybox", "insmod", str(modules[-1])], check=False)
    near, far = pty.openpty()
    tty.setraw(near)
    tty.setraw(far)
    threading.Thread(target=drained, args=(near,), daemon=True).start()
    daemon = subprocess.Popen(["slcand", "-F", os.ttyname(far), "slcan0"])
    try:
        deadline = time.monotonic() + 10.0
        while not kernel_links("slcan0"):
            if daemon.poll() is not None or time.monotonic() > deadline:
                pytest.skip("this kernel has no slcan")
            time.sleep(0.1)
        yield "slcan0"
    finally:
        daemon.terminate()
        daemon.wait(10.0)
        os.close(far)
        os.close(near)


def test_another_bit_rate_than_the_profile_s_is_refused(slcan: str) -> None:
    link(slcan, "type", "can", "bitrate", "500000")
    link(slcan, "up")
    (found,) = kernel_links(slcan) or ()
    assert (found.bitrate, found.up) == (500_000, True)
    wrong = BusProfile(interface="socketcan", channel=slcan, bitrate=250_000)
    with pytest.raises(BusError, match="is set to 500000 bit/s, the machine profile says 250000"):
        open_bus(wrong)
    open_bus(BusProfile(interface="socketcan", channel=slcan, bitrate=500_000)).shutdown()
