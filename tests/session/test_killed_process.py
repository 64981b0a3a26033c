"""SIGKILL of the host's process while axes move, on a bus that any POSIX system has.

Two processes on python-can's serial interface, over two pseudo-terminals that are joined here: no
CAN hardware, no kernel bus.  The same on the kernel's own bus: ``tests/socketcan``.
"""

import contextlib
import json
import os
import select
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
import yaml

from drives.canopen_drive.setup import HOST_LOST_AFTER

pytestmark = [
    pytest.mark.skipif(os.name != "posix", reason="needs pseudo-terminals"),
]
TABLE = 11
PATIENCE = 120.0
"""Seconds that a process may take to begin, on a busy computer."""
BEGINNINGS = 10
"""Of a motion: two processes keep real time here, and a busy computer lets one of them wait."""
TOO_LATE = "answers a SYNC later"
"""What the tool says then, before anything moves."""
MASTER = """
import sys
import numpy as np
from drives.canopen_drive import connect
from drives.profile import load_machine

STEP = 0.05
with connect(load_machine(sys.argv[1])) as group, group.motion(STEP) as motion:
    start, rows = motion.position, [0]
    def source(_):
        rows[0] += 10
        t = STEP * (rows[0] - 10 + np.arange(10))
        print("moving", rows[0], flush=True)
        return start + 0.3 * np.sin(2 * t)[:, None]
    motion.stream(source)
"""
DRIVES = """
import json, sys, time
from drives.bus import open_bus
from drives.profile import load_machine
from drives.sim.machine import simulated_machine
from drives.sim.running import RunningMachine
from drives.sim.serve import serve

profile = load_machine(sys.argv[1])
machine = RunningMachine(simulated_machine(profile))
node, seen = machine.nodes[0], []

def look():
    state = node.motion.state.name
    if not seen or seen[-1][1] != state:
        seen.append((time.monotonic(), state, list(node.emergency.active)))
        print(json.dumps(seen[-1]), flush=True)
    return False

with open_bus(profile.bus) as bus:
    serve(machine, bus, look, begun=lambda: print('"ready"', flush=True))
"""


class Cable:
    """Two pseudo-terminals, joined."""

    def __init__(self) -> None:
        import pty
        import tty

        self._near: list[int] = []
        self.ends: list[str] = []
        self._far: list[int] = []
        for _ in range(2):
            near, far = pty.openpty()
            tty.setraw(far)
            self._near.append(near)
            self._far.append(far)
            self.ends.append(os.ttyname(far))
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._carry, daemon=True)
        self._thread.start()

    def _carry(self) -> None:
        a, b = self._near
        while not self._ended.is_set():
            for ready in select.select([a, b], [], [], 0.1)[0]:
                with contextlib.suppress(OSError):
                    os.write(b if ready == a else a, os.read(ready, 4096))

    def close(self) -> None:
        self._ended.set()
        self._thread.join()
        for descriptor in (*self._near, *self._far):
            os.close(descriptor)


class Lines:
    """What a process prints, with the time at which each line came."""

    def __init__(self, process: "subprocess.Popen[str]") -> None:
        self.lines: list[tuple[float, str]] = []
        self._process = process
        self._thread = threading.Thread(target=self._read, daemon=True)
        self._thread.start()

    def _read(self) -> None:
        assert self._process.stdout is not None
        with self._process.stdout as lines:
            for line in lines:
                self.lines.append((time.monotonic(), line.strip()))

    def close(self) -> None:
        """End the process, and read what it has said."""
        if self._process.poll() is None:
            self._process.kill()
        self._process.wait(10.0)
        self._thread.join(10.0)

    def said(self, words: str) -> bool:
        return any(words in line for _, line in self.lines)

    def wait_for(self, words: str, seconds: float = PATIENCE, *, or_end: bool = False) -> None:
        deadline = time.monotonic() + seconds
        while not self.said(words):
            if self._process.poll() is not None:
                self._thread.join(10.0)
                assert or_end or self.said(words), self.lines
                return
            assert time.monotonic() < deadline, self.lines
            time.sleep(0.02)


@pytest.fixture
def cable():
    pytest.importorskip("serial")
    made = Cable()
    yield made
    made.close()


def test_sigkill_in_motion_stops_the_drive_by_its_own_heartbeat_consumer(
    cable, tmp_path, profile_of_one
):
    def begin(script: str, end: str) -> "subprocess.Popen[str]":
        profile_of_one["bus"] = {"interface": "serial", "channel": end}
        file = tmp_path / f"{Path(end).name}.yaml"
        file.write_text(yaml.safe_dump(profile_of_one), encoding="utf-8")
        return subprocess.Popen(
            [sys.executable, "-c", script, str(file)],
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )

    with contextlib.ExitStack() as stack:
        told = Lines(begin(DRIVES, cable.ends[0]))
        stack.callback(told.close)
        told.wait_for("ready")
        for _ in range(BEGINNINGS):
            master = begin(MASTER, cable.ends[1])
            moving = Lines(master)
            stack.callback(moving.close)
            moving.wait_for("moving 50", or_end=True)
            if not moving.said(TOO_LATE):
                break
        assert moving.said("moving 50"), moving.lines
        killed = time.monotonic()
        master.send_signal(signal.SIGKILL)
        assert master.wait(10.0) == -signal.SIGKILL
        told.wait_for("QUICK_STOP_ACTIVE", 10.0)
        deadline = time.monotonic() + 10.0
        while "SWITCH_ON_DISABLED" not in told.lines[-1][1] and time.monotonic() < deadline:
            time.sleep(0.05)
        states = [json.loads(line) for _, line in told.lines if line.startswith("[")]
        (stopped,) = (s for s in states if s[1] == "QUICK_STOP_ACTIVE")
        assert states[states.index(stopped) - 1][1] == "OPERATION_ENABLED"
        assert stopped[2] == [0x8130], "it missed the host's heartbeat"
        # monotonic clocks of two processes are one; the last heartbeat came before the kill
        assert stopped[0] - killed < HOST_LOST_AFTER + 0.5
        assert states[-1][1] == "SWITCH_ON_DISABLED"
