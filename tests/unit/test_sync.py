"""The kernel's SYNC and the host's clocks: what a time of day that is set may not do."""

import can
import pytest

from drives.canopen_drive import sync
from drives.canopen_drive.sync import SYNC_ID, KernelSync

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
        pass

    def start(self, period: float) -> None:
        pass

    renew, stop = start, start


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
