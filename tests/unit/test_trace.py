"""Traces: every frame, both ways, in order; kept when the program dies; ended, in words, when full."""

import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import can
import pytest

from drives import trace as tracing
from drives.bus import clock_of, not_imitated
from drives.errors import BusError
from drives.sim.lockstep_bus import LockstepBus, register, unregister
from drives.sim.machine import SimulatedDrive, SimulatedMachine
from drives.sim.plant import ChainParameters
from drives.trace import FORMATS, Trace, TracedBus, trace_problem, traced

Frame = tuple[bool, int, bytes]
"""Received, identifier, data."""


@pytest.fixture
def channel() -> Iterator[str]:
    drive = SimulatedDrive("table", 5, ChainParameters((0.02,), (), ()), 4.0, 12.0)
    register("traced", SimulatedMachine((drive,)))
    yield "traced"
    unregister("traced")


def frames_of(path: Path) -> list[Frame]:
    return [(m.is_rx, m.arbitration_id, bytes(m.data)) for m in can.LogReader(path)]


def talk(bus: can.BusABC) -> None:
    """Ask for the device type, start the node, and send some SYNCs."""
    bus.send(can.Message(arbitration_id=0x605, data=b"\x40\0\x10\0\0\0\0\0", is_extended_id=False))
    bus.recv(0.01)
    bus.send(can.Message(arbitration_id=0, data=b"\x01\x05", is_extended_id=False))
    for _ in range(50):
        bus.send(can.Message(arbitration_id=0x80, is_extended_id=False))
        while bus.recv(0.0) is not None:
            pass


@pytest.mark.parametrize("suffix", FORMATS)
def test_what_is_traced_is_what_another_adapter_hears(
    tmp_path: Path, channel: str, suffix: str
) -> None:
    listener = LockstepBus(channel, receive_own_messages=False)
    path = tmp_path / f"trace{suffix}"
    with LockstepBus(channel) as bus, traced(bus, path) as used:
        talk(used)
    heard = []
    while (message := listener.recv(0.0)) is not None:
        heard.append((message.arbitration_id, bytes(message.data)))
    listener.shutdown()

    found = frames_of(path)
    assert [(cob, data) for _, cob, data in found] == heard
    assert sum(not received for received, *_ in found) == 52
    assert {cob for received, cob, _ in found if received} >= {0x585}


@pytest.mark.parametrize("suffix", FORMATS)
def test_time_stamps_are_the_buses_own(tmp_path: Path, channel: str, suffix: str) -> None:
    path = tmp_path / f"trace{suffix}"
    with LockstepBus(channel) as bus, traced(bus, path) as used:
        clock_of(used).wait_until(12.0)
        talk(used)
    syncs = [m.timestamp for m in can.LogReader(path) if m.arbitration_id == 0x80]
    assert [round(b - a, 5) for a, b in pairwise(syncs)] == [0.001] * 49


def test_without_a_path_the_bus_is_the_bus(channel: str) -> None:
    with LockstepBus(channel) as bus, traced(bus, None) as used:
        assert used is bus
        assert trace_problem(used) == ""


def test_everything_else_is_the_buses_own(tmp_path: Path, channel: str) -> None:
    with LockstepBus(channel) as bus, traced(bus, tmp_path / "t.asc") as used:
        assert clock_of(used) is bus.clock
        assert not_imitated(used) == not_imitated(bus)
        assert used.channel_info == bus.channel_info


def test_stamps_that_count_from_some_other_start_are_moved_to_this_computers_clock(
    tmp_path: Path,
) -> None:
    class Adapter:
        """Its stamps are seconds since it was plugged in."""

        channel = "1"
        stamps = iter([7.0, 7.25])

        def recv(self, _timeout: float | None) -> can.Message:
            return can.Message(arbitration_id=0x701, timestamp=next(self.stamps))

    with traced(Adapter(), tmp_path / "t.log") as used:  # type: ignore[arg-type]
        used.recv(1.0)
        used.recv(1.0)
    first, second = (m.timestamp for m in can.LogReader(tmp_path / "t.log"))
    assert second - first == pytest.approx(0.25, abs=2e-6)
    assert abs(first - os.stat(tmp_path / "t.log").st_mtime) < 30


def test_a_sync_that_the_kernel_sent_for_the_host_is_the_hosts(tmp_path: Path) -> None:
    class Kernel:
        """Frames of local processes look sent, those of drives served here as well."""

        channel = "vcan0"
        frames = iter([0x80, 0x18B])

        def recv(self, _timeout: float | None) -> can.Message:
            return can.Message(arbitration_id=next(self.frames), timestamp=1.0, is_rx=False)

    with traced(Kernel(), tmp_path / "t.asc") as used:  # type: ignore[arg-type]
        used.recv(1.0)
        used.recv(1.0)
    assert [(received, cob) for received, cob, _ in frames_of(tmp_path / "t.asc")] == [
        (False, 0x80),
        (True, 0x18B),
    ]


KILLED = """
import os, signal, sys
import can
from pathlib import Path
from drives.trace import Trace
trace = Trace(Path(sys.argv[1]))
for k in range(5000):
    trace.note(can.Message(arbitration_id=0x181, data=k.to_bytes(8, "little"), timestamp=k * 1e-3))
os.kill(os.getpid(), signal.SIGKILL)
"""


@pytest.mark.parametrize(("suffix", "lost"), [(".asc", 0), (".log", 0), (".blf", 200)])
def test_a_trace_survives_the_programs_death(tmp_path: Path, suffix: str, lost: int) -> None:
    path = tmp_path / f"trace{suffix}"
    ended = subprocess.run([sys.executable, "-c", KILLED, str(path)], check=False, timeout=60)
    assert ended.returncode == -signal.SIGKILL
    numbers = [int.from_bytes(data, "little") for _, _, data in frames_of(path)]
    assert numbers == list(range(len(numbers)))
    assert len(numbers) >= 5000 - lost


def test_a_disk_that_fails_ends_the_trace_and_nothing_else(
    tmp_path: Path, channel: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "trace.asc"
    with LockstepBus(channel) as bus, traced(bus, path) as used:
        talk(used)
        trace: Trace = used.trace  # type: ignore[attr-defined]
        kept = trace.frames

        def full(_text: str) -> int:
            raise OSError(28, "No space left on device")

        monkeypatch.setattr(trace._writer.file, "write", full, raising=False)
        talk(used)
        assert trace.frames == kept
        assert f"after {kept} frames: No space left on device" in trace_problem(used)
    assert len(frames_of(path)) == kept


def test_a_full_disk_is_left_to_recordings(
    tmp_path: Path, channel: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    usage = shutil._ntuple_diskusage(10**12, 10**12, 10**6)
    monkeypatch.setattr(tracing, "LOOKED_AT_EVERY", 20)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage)
    with LockstepBus(channel) as bus, traced(bus, tmp_path / "trace.asc") as used:
        talk(used)
        assert "after 20 frames: the disk has less than 256 MB left" in trace_problem(used)


def test_a_trace_has_a_largest_size(
    tmp_path: Path, channel: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tracing, "LOOKED_AT_EVERY", 10)
    monkeypatch.setattr(tracing, "LARGEST_TRACE", 1500)
    path = tmp_path / "trace.asc"
    with LockstepBus(channel) as bus, traced(bus, path) as used:
        talk(used)
        assert "as long as a trace may be" in trace_problem(used)
    assert path.stat().st_size < 2500


def test_a_trace_that_can_not_be_written_is_refused_before_anything_moves(tmp_path: Path) -> None:
    with pytest.raises(BusError, match="can not be written"):
        Trace(tmp_path / "nowhere" / "trace.asc")
    with pytest.raises(BusError, match=r"\.asc, \.blf, \.log"):
        Trace(tmp_path / "trace.txt")


def test_a_traced_bus_is_no_bus_class_but_has_its_methods(channel: str, tmp_path: Path) -> None:
    with LockstepBus(channel) as bus:
        used = TracedBus(bus, Trace(tmp_path / "t.log"))
        used.set_filters([{"can_id": 0x585, "can_mask": 0x7FF}])
        assert bus.filters == [{"can_id": 0x585, "can_mask": 0x7FF}]
        used.trace.close()
