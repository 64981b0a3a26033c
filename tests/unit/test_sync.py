"""SYNC from host and kernel: clocks that are set, SYNCs that do not come, frames that do not end."""

from itertools import pairwise
from types import SimpleNamespace

import can
import pytest

from drives.bus import kernel_sync
from drives.canopen_drive import sync
from drives.canopen_drive.line import Line
from drives.canopen_drive.sync import GONE, IN_VAIN, SYNC_ID, HostSync, KernelSync
from drives.errors import BusError
from tests.unit.scripted_bus import ScriptedBus, frame

CYCLE = 0.01


class Kernel:
    """A line, a broadcast manager and both clocks in virtual time; a SYNC every cycle."""

    def __init__(self) -> None:
        self.monotonic, self.day, self.asked = 5.0, 1e9, 0
        self.clock, self.can_bus = self, self
        self.channel = "vcan0"

    def now(self) -> float:
        return self.monotonic

    def pass_by(self, seconds: float) -> None:
        self.monotonic += seconds
        self.day += seconds

    def receive(self, timeout: float) -> can.Message:
        self.asked += 1
        self.pass_by(CYCLE - self.monotonic % CYCLE)
        stamp = self.day
        self.pass_by(1e-4)
        return can.Message(arbitration_id=SYNC_ID, is_extended_id=False, timestamp=stamp)


class Lease:
    def __init__(self, *_: object) -> None:
        self.starts = 0

    def start(self, period: float) -> None:
        self.starts += 1

    def renew(self, period: float) -> None:
        pass

    stop = renew


@pytest.fixture
def kernel(monkeypatch):
    kernel = Kernel()
    monkeypatch.setattr(sync, "LeasedSync", Lease)
    monkeypatch.setattr(sync.time, "time", lambda: kernel.day)
    return kernel


def cycles(kernel: Kernel, beat: KernelSync, count: int) -> list[float]:
    """Give so many SYNCs, each after some work; return their moments."""
    moments = []
    for _ in range(count):
        kernel.pass_by(0.002)
        moments.append(beat.give(lambda _: None))
    return moments


@pytest.mark.parametrize("jump", [-3600.0, -0.3, 7.0, 3600.0])
def test_a_clock_that_is_set_is_neither_late_nor_waited_for(kernel, jump):
    beat = KernelSync(kernel, CYCLE)
    before = cycles(kernel, beat, 20)
    kernel.day += jump
    asked = kernel.asked
    after = cycles(kernel, beat, 20)
    assert kernel.asked == asked + 20, "one SYNC a cycle, whatever time it is"
    steps = [b - a for a, b in zip([*before, *after], [*before, *after][1:], strict=False)]
    assert steps == pytest.approx([CYCLE] * 39, abs=1e-3)
    assert (beat.late, beat.worst) == (0, pytest.approx(0.0, abs=1e-3))


def test_a_host_that_comes_late_is_late(kernel):
    beat = KernelSync(kernel, CYCLE)
    cycles(kernel, beat, 5)
    kernel.pass_by(0.05)
    cycles(kernel, beat, 1)
    assert beat.lateness == pytest.approx(0.05, abs=CYCLE)
    assert beat.late == 1


@pytest.mark.parametrize("before_the_day", [True, False])
def test_a_host_held_up_between_its_two_clocks_knows_when_the_sync_came(
    kernel, monkeypatch, before_the_day
):
    beat = KernelSync(kernel, CYCLE)
    cycles(kernel, beat, 5)
    pauses = [0.043]

    def day() -> float:
        said = kernel.day
        if pauses:
            kernel.pass_by(pauses.pop())
            said = kernel.day if before_the_day else said
        return said

    monkeypatch.setattr(sync.time, "time", day)
    (moment,) = cycles(kernel, beat, 1)
    assert not pauses
    assert moment == pytest.approx(5.0 + 6 * CYCLE)
    assert beat.late == 0, "the SYNC was in time"


@pytest.mark.parametrize("how", [{"is_error_frame": True}, {"is_remote_frame": True}])
def test_what_only_looks_like_a_sync_is_none(beat_on, how):
    class Likeness(Kernel):
        def receive(self, timeout: float) -> can.Message:
            if self.asked % 2:
                return super().receive(timeout)
            self.asked += 1
            return frame(SYNC_ID, timestamp=self.day, **how)

    line, early = Likeness(), []
    line.pass_by(0.002)
    assert beat_on(line).give(early.append) == pytest.approx(5.0 + CYCLE)
    assert len(early) == 1, "it was handed on"


class Deaf(Kernel):
    """Nothing comes back of what is sent."""

    def receive(self, timeout: float) -> None:
        self.asked += 1
        assert self.asked < 100, "it goes on for ever"
        self.pass_by(timeout)


class Flooded(Kernel):
    """Somebody fills the bus; a SYNC comes after so many of his frames, and after none if it is None."""

    def __init__(self, before_sync: int | None = None, each: float = 1e-4) -> None:
        super().__init__()
        self.before_sync, self.each = before_sync, each

    def receive(self, timeout: float) -> can.Message:
        self.asked += 1
        assert self.asked < 5000, "it goes on for ever"
        self.pass_by(self.each)
        identifier = SYNC_ID if self.asked - 1 == self.before_sync else 0x18C
        return can.Message(arbitration_id=identifier, is_extended_id=False, timestamp=self.day)


@pytest.fixture
def beat_on(monkeypatch):
    """Make the kernel's SYNC on a line."""

    def make(line: Kernel) -> KernelSync:
        monkeypatch.setattr(sync, "LeasedSync", Lease)
        monkeypatch.setattr(sync.time, "time", lambda: line.day)
        return KernelSync(line, CYCLE)

    return make


def test_a_sync_that_never_comes_back_is_given_up(beat_on):
    line = Deaf()
    beat = beat_on(line)
    for number in (1, 2):
        begun = line.now()
        with pytest.raises(BusError, match=r"did not come back within 150 ms.*Check the cable"):
            beat.give(lambda _: None)
        assert line.now() - begun == pytest.approx(IN_VAIN * GONE * CYCLE)
        assert beat._lease.starts == number * (IN_VAIN + 1), (
            "and each was tried with its own targets"
        )


def test_a_sync_that_does_not_come_through_a_flood_is_given_up(beat_on):
    line = Flooded()
    beat, taken = beat_on(line), []
    with pytest.raises(BusError, match=r"did not come back .* sends without end"):
        beat.give(taken.append)
    assert line.now() - 5.0 == pytest.approx(IN_VAIN * GONE * CYCLE, rel=0.02)
    assert len(taken) == line.asked, "all were handed on"
    assert beat._lease.starts == 1, "what waits behind other frames is not sent once more"


def test_a_host_that_was_held_up_still_takes_the_sync_that_waits(beat_on):
    """One pause, however long, is not waiting in vain again and again."""
    line = Flooded(before_sync=3, each=0.05)
    beat = beat_on(line)
    assert beat.give(lambda _: None) == pytest.approx(5.2)
    assert beat._lease.starts == 1


@pytest.mark.parametrize("call", ["start", "renew", "stop"])
def test_a_broadcast_manager_that_is_gone_is_a_bus_that_is_gone(monkeypatch, call):
    def refuse(_command: bytes) -> None:
        raise OSError(19, "No such device")

    opened = SimpleNamespace(connect=lambda _where: None, send=refuse)
    module = SimpleNamespace(AF_CAN=29, SOCK_DGRAM=2, socket=lambda *_: opened)
    monkeypatch.setattr(kernel_sync, "socket", module)
    lease = kernel_sync.LeasedSync("can0")
    with pytest.raises(BusError, match="no SYNC any more: No such device"):
        getattr(lease, call)(*([] if call == "stop" else [CYCLE]))


class Crowded(ScriptedBus):
    """A bus on which the next frame waits whenever one was taken, which takes so long."""

    each, left = 1e-5, 10**6

    def recv(self, timeout: float | None = None) -> can.Message | None:
        if not self.left:
            return super().recv(timeout)
        self.left -= 1
        self._time += self.each
        return frame(0x18C, bytes(8))


def test_the_host_s_sync_goes_out_whatever_floods_the_bus():
    bus = Crowded()
    beat = HostSync(Line(bus), CYCLE)
    moments = []
    for number in range(1, 6):
        beat.give(lambda _: None)
        moments.append(bus.now())
        assert [m.arbitration_id for m in bus.sent] == [SYNC_ID] * number
        assert beat.behind == [0x18C] * number
    steps = [b - a for a, b in pairwise(moments)]
    assert max(steps) < 1.1 * CYCLE
    bus.left = 5
    beat.give(lambda _: None)
    assert beat.behind == [], "all were taken"


def test_frames_that_came_while_the_host_was_held_up_are_all_taken():
    bus = Crowded()
    beat, taken = HostSync(Line(bus), CYCLE), []
    bus.wait_until(0.1)
    bus.left = 5000
    beat.give(taken.append)
    assert len(taken) == 5000
    assert beat.behind == []
    bus.left = 5000
    beat.give(taken.append)
    assert beat.behind, "in other cycles there can not be so many"
