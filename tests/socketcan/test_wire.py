"""What is on the wire: seen by candump, and by a CANopen master of other hands."""

import json
import os
import re
import shutil
import signal
import subprocess
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from drives.canopen_drive import connect
from drives.profile import load_machine
from tests.socketcan.conftest import ARM, CYCLE, MACHINE, PATIENCE, TABLE, Listener

FOREIGN = Path(__file__).parent / "foreign"
FRAME = re.compile(r"\((\d+\.\d+)\) vcan0 ([0-9A-F]{3})#([0-9A-F]*)")
START, PRE_OPERATIONAL = ("000", "01{:02X}"), ("000", "80{:02X}")


class Candump:
    """``candump -L vcan0``, into a file."""

    LAST = "7FE"
    """Identifier of a frame that nobody else sends: what came before it is in the file."""

    def __init__(self, path: Path, listener: Listener) -> None:
        self._path, self._listener = path, listener
        self._file = path.open("wb")
        before = self._sockets()
        self._process = subprocess.Popen(["candump", "-L", "vcan0"], stdout=self._file)
        self._wait(lambda: self._sockets() > before)

    @staticmethod
    def _sockets() -> int:
        """Return how many sockets hear every frame of the interface."""
        table = Path("/proc/net/can/rcvlist_all").read_text()
        return sum(line.split()[:1] == ["vcan0"] for line in table.splitlines())

    @staticmethod
    def _wait(done: Callable[[], bool]) -> None:
        deadline = time.monotonic() + PATIENCE
        while not done():
            assert time.monotonic() < deadline, "candump hears nothing"
            time.sleep(0.01)

    def _frames(self) -> list[tuple[float, str, str]]:
        return [(float(t), i, d) for t, i, d in FRAME.findall(self._path.read_text())]

    def stop(self) -> list[tuple[float, str, str]]:
        """Return time, identifier and data of every frame."""
        if self._process.poll() is None:
            self._listener.send(int(self.LAST, 16))
            self._wait(lambda: any(i == self.LAST for _, i, _ in self._frames()))
            self._process.send_signal(signal.SIGINT)
            self._process.wait(10.0)
            self._file.close()
        return [frame for frame in self._frames() if frame[1] != self.LAST]


@pytest.fixture
def candump(tmp_path, listener):
    if shutil.which("candump") is None:
        pytest.skip("needs candump (can-utils)")
    started = Candump(tmp_path / "frames.log", listener)
    yield started
    started.stop()


def hold(group, rows: int) -> None:
    with group.motion(CYCLE) as motion:
        start, blocks = motion.position, [rows]
        motion.stream(lambda _: np.tile(start, (blocks.pop(), 1)) if blocks else None)


def test_candump_shows_nmt_sync_and_pdos_of_every_cycle_in_order(drives, candump) -> None:
    rows = 50
    with connect(load_machine(MACHINE)) as group:
        hold(group, rows)
    frames = candump.stop()
    told = [(i, d) for _, i, d in frames]
    for node in (TABLE, ARM):
        for command in (START, PRE_OPERATIONAL):
            assert told.count((command[0], command[1].format(node))) == 1
    assert ("77F", "05") in told, "the host's heartbeat"
    first = told.index((START[0], START[1].format(ARM)))
    last = told.index((PRE_OPERATIONAL[0], PRE_OPERATIONAL[1].format(TABLE)))
    outputs = [f"{0x200 + n:03X}" for n in (TABLE, ARM)]
    inputs = [f"{0x180 + n:03X}" for n in (TABLE, ARM)]
    cyclic = [i for i, _ in told[first:last] if i in (*outputs, "080", *inputs)]
    pattern = [*outputs, "080", *inputs]
    begin = len(cyclic) % len(pattern)
    assert begin == 0
    cycles = [cyclic[k : k + 5] for k in range(0, len(cyclic), 5)]
    assert len(cycles) >= rows
    assert all(cycle == pattern for cycle in cycles)
    enabled = [d for i, d in told[first:last] if i == outputs[0] and d.startswith("0F00")]
    assert len(enabled) >= rows
    assert {len(d) for d in enabled} == {16}
    shown = [d for i, d in told[first:last] if i == inputs[0] and int(d[:2], 16) & 0x6F == 0x27]
    assert len(shown) >= rows
    syncs = np.array([t for t, i, _ in frames if i == "080"])[-rows:]
    print("SYNC every", np.percentile(1000 * np.diff(syncs), [0, 50, 100]), "ms")
    assert np.median(np.diff(syncs)) == pytest.approx(CYCLE, rel=0.05)


def need_foreign_master() -> None:
    """Skip where there is no npm, or by order; fail where npm has not installed what it should have."""
    if os.environ.get("FIELDTOOL_OFFLINE"):
        pytest.skip("needs packages of npm, and FIELDTOOL_OFFLINE is set")
    if shutil.which("npm") is None:
        pytest.skip("needs npm, which is not on the path")
    loaded = subprocess.run(
        ["node", "-e", 'require("canopen"); require("socketcan")'],
        cwd=FOREIGN,
        capture_output=True,
        text=True,
        timeout=60.0,
        check=False,
    )
    if loaded.returncode:
        pytest.fail(
            "npm is here, but not what tests/socketcan/run installs in tests/socketcan/foreign with it. "
            "Let it reach npm's registry, or set FIELDTOOL_OFFLINE=1 to leave this test out.\n"
            f"{loaded.stderr}",
            pytrace=False,
        )


def test_a_master_of_other_hands_speaks_with_the_simulated_drive(drives, candump) -> None:
    need_foreign_master()
    asked = subprocess.run(
        ["node", "ask.js", "vcan0", str(TABLE)],
        cwd=FOREIGN,
        capture_output=True,
        text=True,
        timeout=60.0,
        check=False,
    )
    assert asked.returncode == 0, asked.stderr
    found = json.loads(asked.stdout)
    assert found["deviceType"] == 0x00020192
    assert found["name"] == "simulated CiA 402 servo drive"
    assert found["serial"] == 1000 + TABLE
    assert found["aborts"] == [0x06020000]
    assert found["enabled"] & 0x6F == 0x27
    assert found["disabled"] & 0x4F == 0x40
    assert found["state"] == 5
    assert set(found["heartbeats"]) == {TABLE}
    assert found["answers"] >= 20, "a PDO for every SYNC"
    assert {pdo[0] for pdo in found["pdos"]} == {0x180 + TABLE}
    assert any(pdo[1] & 0x6F == 0x27 for pdo in found["pdos"])
    told = [(i, d) for _, i, d in candump.stop()]
    assert ("000", f"01{TABLE:02X}") in told
    assert (f"{0x700 + TABLE:03X}", "05") in told
    assert told.count(("080", "")) >= 20
