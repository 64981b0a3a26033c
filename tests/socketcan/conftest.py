"""Master and simulated drives as processes of their own on the kernel's own CAN bus.

These tests need SocketCAN with ``vcan0`` and ``vcan1`` (``tests/socketcan/run`` finds or makes them)
and are skipped without.  Processes are forked from this one, which has imported everything: a new
Python process takes seconds in a small guest.
"""

import contextlib
import os
import re
import signal
import struct
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import can
import pytest

from drives.bus import open_bus
from drives.bus.kernel_bus import KernelBus
from drives.profile import BusProfile
from tests.socketcan.stalls import StallMeter, run_again_if_stalled

if sys.platform != "linux":
    collect_ignore_glob = ["test_*.py"]
ASKED = os.environ.get("FIELDTOOL_SOCKETCAN", "")
"""Set by ``tests/socketcan/run`` where the interfaces are there for these tests alone."""
MACHINE = Path(__file__).parent / "machine.yaml"
TABLE, ARM = 11, 12
CYCLE = 0.01
RADIANS = 6.283185307179586 / 2**20
"""Of one count of the simulated drives."""
PATIENCE = 60.0
"""Seconds that a process in a slow guest may take for anything."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        if Path(__file__).parent in item.path.parents:
            item.add_marker(pytest.mark.socketcan)
            if not ASKED:
                item.add_marker(
                    pytest.mark.skip(reason="needs vcan0 for itself: run tests/socketcan/run")
                )


METER = pytest.StashKey[StallMeter]()


def pytest_runtest_protocol(item: pytest.Item, nextitem: pytest.Item | None) -> bool | None:
    """See that a computer that stands still is not taken for a tool that fails."""
    if not ASKED:
        return None
    stash = item.config.stash
    if METER not in stash:
        stash[METER] = meter = StallMeter()
        item.config.add_cleanup(meter.close)
    terminal = item.config.pluginmanager.get_plugin("terminalreporter")
    say = terminal.write_line if terminal else print
    run_again_if_stalled(item, nextitem, stash[METER], say)
    return True


class Process:
    """A forked copy of this process that does one thing; what it prints goes to a file."""

    def __init__(self, work: Callable[[], object], output: Path) -> None:
        self._output = output
        self.code: int | None = None
        self.pid = os.fork()
        if self.pid == 0:
            self._child(work)

    def _child(self, work: Callable[[], object]) -> None:
        code = 1
        try:
            for number in (signal.SIGINT, signal.SIGTERM):
                signal.signal(number, signal.SIG_DFL)
            signal.signal(signal.SIGINT, signal.default_int_handler)
            with self._output.open("w", buffering=1, encoding="utf-8") as file:
                os.dup2(file.fileno(), 1)
                os.dup2(file.fileno(), 2)
                sys.stdout = sys.stderr = file
                try:
                    work()
                    code = 0
                except SystemExit as end:
                    code = end.code if isinstance(end.code, int) else 0
                except Exception as error:
                    print(f"{type(error).__name__}: {error}")
        finally:
            os._exit(code)

    @property
    def text(self) -> str:
        return self._output.read_text(encoding="utf-8") if self._output.exists() else ""

    def wait_for(self, words: str, seconds: float = PATIENCE) -> None:
        deadline = time.monotonic() + seconds
        while words not in self.text:
            assert not self.ended(), f"it ended with {self.code}:\n{self.text}"
            assert time.monotonic() < deadline, f"no {words!r} in {self.text!r}"
            time.sleep(0.05)

    def ended(self) -> bool:
        if self.code is None:
            pid, status = os.waitpid(self.pid, os.WNOHANG)
            if pid:
                self.code = os.waitstatus_to_exitcode(status)
        return self.code is not None

    def kill(self, number: int = signal.SIGKILL) -> None:
        if not self.ended():
            os.kill(self.pid, number)

    def join(self, seconds: float = PATIENCE) -> int:
        deadline = time.monotonic() + seconds
        while not self.ended():
            assert time.monotonic() < deadline, f"it does not end:\n{self.text}"
            time.sleep(0.02)
        assert self.code is not None
        return self.code


class Listener:
    """A bus of this process that hears and asks."""

    def __init__(self, channel: str = "vcan0") -> None:
        bus = open_bus(BusProfile(interface="socketcan", channel=channel))
        assert isinstance(bus, KernelBus)
        self.bus = bus

    def heard(
        self, seconds: float, until: Callable[[can.Message], bool] = lambda _: False
    ) -> list[can.Message]:
        """Return the frames of so many seconds, or up to one that is awaited."""
        frames, deadline = [], time.monotonic() + seconds
        while (left := deadline - time.monotonic()) > 0:
            message = self.bus.recv(left)
            if message is not None:
                frames.append(message)
                if until(message):
                    break
        return frames

    def forget(self) -> None:
        while self.bus.recv(0) is not None:
            pass

    def send(self, identifier: int, data: bytes = b"") -> None:
        self.bus.send(can.Message(arbitration_id=identifier, data=data, is_extended_id=False))

    def read(self, node: int, index: int, subindex: int = 0, layout: str = "I") -> int:
        """Upload up to four bytes, frame by frame."""
        self.forget()  # answers to other masters
        self.send(0x600 + node, struct.pack("<BHB4x", 0x40, index, subindex))
        frames = self.heard(2.0, lambda m: m.arbitration_id == 0x580 + node)
        assert frames, f"node {node} does not answer"
        answer = bytes(frames[-1].data)
        assert answer[0] & 0xE3 == 0x43, answer.hex()
        return int(struct.unpack("<" + layout, answer[4 : 4 + struct.calcsize(layout)])[0])

    def wait_for_motion(self, master: Process, node: int, rows: int, way: float) -> None:
        """Return when a drive has been enabled for so many SYNCs, and moved so far meanwhile, rad."""
        self.forget()
        places: list[float] = []
        deadline = time.monotonic() + PATIENCE
        while len(places) < rows or max(places) - min(places) < way:
            assert not master.ended(), f"it ended with {master.code}:\n{master.text}"
            assert time.monotonic() < deadline, f"node {node} does not move:\n{master.text}"
            message = self.bus.recv(0.5)
            if message is not None and message.arbitration_id == 0x180 + node:
                statusword, position = struct.unpack_from("<Hi", message.data)
                if statusword & 0x6F == 0x27:
                    places.append(position * RADIANS)
                else:
                    places.clear()

    def statusword(self, node: int) -> int:
        return self.read(node, 0x6041, layout="H")

    def enabled(self, node: int) -> bool:
        return self.statusword(node) & 0x6F == 0x27

    def position(self, node: int) -> float:
        return self.read(node, 0x6064, layout="i") * RADIANS


@pytest.fixture
def listener() -> Iterator[Listener]:
    opened = Listener()
    yield opened
    opened.bus.shutdown()


def link(*words: str) -> None:
    subprocess.run(["ip", "link", "set", *words], check=True)


@pytest.fixture
def up_again() -> Iterator[None]:
    """Whatever a test does to the interfaces, they are up afterwards."""
    yield
    for name in ("vcan0", "vcan1"):
        link(name, "up")


@pytest.fixture
def simulator(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Process]:
    """``fieldtool simulate`` on vcan0, for each test anew: an axis whose power was cut coasts away."""
    from fieldtool.cli.main import main

    process = Process(
        lambda: main(["simulate", str(MACHINE), "--interface", "socketcan", "--channel", "vcan0"]),
        tmp_path_factory.mktemp("simulator") / "out",
    )
    try:
        process.wait_for("Serving")
        yield process
        process.kill(signal.SIGINT)
        assert process.join() == 0, process.text
        assert re.search(r"Served \d+ frames", process.text), process.text
        print(process.text)
    finally:
        process.kill()


@pytest.fixture
def drives(simulator: Process, listener: Listener) -> Iterator[Process]:
    """Both simulated drives, fresh from a reset."""
    listener.send(0, b"\x81\x00")
    boots = {0x700 + node for node in (TABLE, ARM)}

    def both(message: can.Message) -> bool:
        boots.discard(message.arbitration_id)
        return not boots

    listener.heard(5.0, both)
    assert not boots, "no boot-up message"
    yield simulator
    assert not simulator.ended(), simulator.text


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Callable[..., Process]]:
    """Start a process; what still runs when the test ends is killed."""
    begun: list[Process] = []

    def starting(work: Callable[[], object]) -> Process:
        begun.append(Process(work, tmp_path / f"process-{len(begun)}"))
        return begun[-1]

    yield starting
    for process in begun:
        process.kill()
        with contextlib.suppress(AssertionError):
            process.join(5.0)
