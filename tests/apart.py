"""A simulated machine in this process, the tool in others: what is killed there goes on living here.

The drives are served in real time to python-can's ``socketcand`` interface, over a socket on the
loopback.  A killed tool leaves them as they are; a test then looks into their memories directly.
"""

import multiprocessing
import os
import queue
import select
import signal
import socket
import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from math import inf
from pathlib import Path
from typing import Any

import can
import yaml

from drives.profile import load_machine
from drives.sim.entries import ENTRIES
from drives.sim.machine import simulated_machine
from drives.sim.node import DriveNode
from drives.sim.running import RunningMachine
from drives.sim.serve import serve

FIRST_NODE = 11
PARAMETERS = tuple(key for key, entry in ENTRIES.items() if entry.is_parameter)
WRITABLE = {
    "position_p": ((0x2010, 1), 0.001),
    "velocity_p": ((0x2010, 2), 0.001),
    "velocity_i": ((0x2010, 3), 0.001),
    "velocity_filter": ((0x2010, 6), 0.001),
    "filter1_frequency": ((0x2020, 2), 0.001),
    "filter1_zero_damping": ((0x2020, 3), 1.0),
    "filter2_frequency": ((0x2021, 2), 0.001),
    "filter2_pole_damping": ((0x2021, 4), 1.0),
}
"""Parameters that are written: object and scale of the reference drive."""
LIMITS = {
    "travel": ("-120 deg", "120 deg"),
    "velocity": "10 rad/s",
    "acceleration": "400 rad/s2",
    "torque": "6 N m",
    "following_error": "30 deg",
}
Values = Mapping[int, Mapping[tuple[int, int], Any]]
"""By node id and object."""


_FORKING = threading.Lock()


class SocketcandEnd(can.BusABC):
    """The server's side of ``socketcand`` for one client at a time."""

    def __init__(self) -> None:
        self._listening = socket.create_server(("127.0.0.1", 0))
        self._client: socket.socket | None = None
        self._buffer = b""
        self._greeted = inf
        """Time from which frames may be sent: the client takes each answer of the greeting for a whole
        packet, so nothing else may follow at once."""
        self.port = int(self._listening.getsockname()[1])
        self.on_frame: Callable[[can.Message], None] = lambda _: None
        """Sees each of the tool's frames before the drives do."""
        self.on_look: Callable[[], None] = lambda: None
        """Called about once a millisecond."""
        super().__init__("apart")

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        self.on_look()
        message = self._next()
        if message is None:
            sockets = [self._listening, *([self._client] if self._client else [])]
            for ready in select.select(sockets, [], [], timeout)[0]:
                if ready is self._listening:
                    self._accept()
                else:
                    self._read()
            message = self._next()
        if message is not None:
            self.on_frame(message)
        return message, True

    def _accept(self) -> None:
        client, _ = self._listening.accept()
        client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._hang_up()
        self._client, self._buffer, self._greeted = client, b"", inf
        client.sendall(b"< hi >")

    def _read(self) -> None:
        assert self._client is not None
        try:
            data = self._client.recv(4096)
        except OSError:
            data = b""
        if data:
            self._buffer += data
        else:
            self._hang_up()

    def _next(self) -> can.Message | None:
        while b">" in self._buffer:
            command, _, self._buffer = self._buffer.partition(b">")
            words = command.decode("ascii").strip("< ").split()
            if words[0] == "send":
                identifier, _, *data = words[1:]
                return can.Message(
                    arbitration_id=int(identifier, 16),
                    is_extended_id=False,
                    data=[int(byte, 16) for byte in data],
                )
            self._say("< ok >")
            if words[0] == "rawmode":
                self._greeted = time.monotonic() + 0.3
        return None

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        if time.monotonic() >= self._greeted:
            self._say(f"< frame {msg.arbitration_id:03X} 0.0 {bytes(msg.data).hex()} >")

    def _say(self, text: str) -> None:
        if self._client is not None:
            try:
                self._client.sendall(text.encode("ascii"))
            except OSError:
                self._hang_up()

    def _hang_up(self) -> None:
        if self._client is not None:
            self._client.close()
            self._client = None

    def shutdown(self) -> None:
        super().shutdown()
        self._hang_up()
        self._listening.close()


@dataclass
class Ended:
    """How a process of the tool ended."""

    code: int
    """Exit code, or minus the signal's number."""
    text: str


class MachineApart:
    """Drives that outlive the tool; a context manager.

    Parameters
    ----------
    folder
        For profiles, sessions and output.
    axes
        Number of rigid axes, one drive each.
    quick
        Fork the tool from a process that has imported it already, instead of starting a new
        interpreter each time.
    """

    def __init__(self, folder: Path, axes: int, *, quick: bool = False) -> None:
        self.folder, self._quick = folder, quick
        self.names = [f"axis{k + 1}" for k in range(axes)]
        self.bus = SocketcandEnd()
        self.profile = folder / "machine.yaml"
        self.profile.write_text(yaml.safe_dump(self._described()), encoding="utf-8")
        self.machine = RunningMachine(simulated_machine(load_machine(self.profile)))
        self._asked: queue.SimpleQueue[tuple[Callable[[], Any], threading.Event, list[Any]]] = (
            queue.SimpleQueue()
        )
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self.bus.on_look = self._look
        self.looks: list[Callable[[], None]] = []
        """Called about once a millisecond by the thread that serves."""
        self._environment = {"FIELDTOOL_STATE_DIR": str(folder / "notes")}
        if quick:
            self._context = multiprocessing.get_context("forkserver")
            self._context.set_forkserver_preload(["__main__", "fieldtool.cli.main"])

    def _described(self) -> dict[str, Any]:
        return {
            "format": "fieldtool-machine/1",
            "name": "apart",
            "bus": {
                "interface": "socketcand",
                "channel": "can0",
                "options": {"host": "127.0.0.1", "port": self.bus.port, "tcp_tune": True},
                "shortest_cycle": "10 ms",  # in real time, on a computer that may be busy
            },
            "axes": [
                {
                    "name": name,
                    "kind": "rotary",
                    "node_id": FIRST_NODE + k,
                    "drive": "reference",
                    "limits": LIMITS | {"travel": list(LIMITS["travel"])},
                    "prior": {"masses": [0.04]},
                }
                for k, name in enumerate(self.names)
            ],
            "simulation": {
                "axes": [
                    {"masses": [0.04], "rated_torque": 4, "peak_torque": 12} for _ in self.names
                ]
            },
        }

    def __enter__(self) -> "MachineApart":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._thread.join()
        self.bus.shutdown()

    def _serve(self) -> None:
        serve(self.machine, self.bus, self._ended.is_set)

    def _look(self) -> None:
        while not self._asked.empty():
            work, done, result = self._asked.get()
            result.append(work())
            done.set()
        for look in tuple(self.looks):
            look()

    def ask(self, work: Callable[[], Any]) -> Any:
        """Do something with the drives in the thread that serves them; return what it returns."""
        done, result = threading.Event(), []
        self._asked.put((work, done, result))
        if not done.wait(30):
            raise RuntimeError("the machine is not served any more")
        return result[0]

    # --- the drives ------------------------------------------------------------------------------

    @property
    def nodes(self) -> tuple[DriveNode, ...]:
        return self.machine.nodes

    def working(self) -> Values:
        """Return all parameters in the drives' working memory."""
        return self.ask(
            lambda: {n.node_id: {k: n.dictionary.read(*k) for k in PARAMETERS} for n in self.nodes}
        )

    def stored(self) -> Values:
        """Return what a power cycle brings."""

        def read() -> Values:
            return {
                node.node_id: {
                    key: node.memory.stored.get(key, node.dictionary.factory_value(ENTRIES[key]))
                    for key in PARAMETERS
                }
                for node in self.nodes
            }

        return self.ask(read)

    def set_up(self, values: Mapping[str, float], *, store: bool) -> None:
        """Give all drives these values, physical, in working memory and perhaps stored."""

        def write() -> None:
            for node in self.nodes:
                node.power_cycle()
                for name, value in values.items():
                    (index, subindex), scale = WRITABLE[name]
                    raw = value if scale == 1.0 else round(value / scale)
                    node.dictionary.write(index, subindex, raw)
                if store:
                    node.memory.save(node.dictionary)

        self.ask(write)

    # --- the tool --------------------------------------------------------------------------------

    def session(self, name: str, values: Mapping[str, float]) -> Path:
        """Make a session folder with a tuning for all axes."""
        session = self.folder / name
        session.mkdir()
        (session / "machine.yaml").write_text(self.profile.read_text())
        tuning = {
            "format": "fieldtool-tuning/1",
            "axes": [
                {"axis": a, "parameters": dict(values), "sensitivity_peak": 1.4, "reason": "test"}
                for a in self.names
            ],
        }
        (session / "tuning.yaml").write_text(yaml.safe_dump(tuning))
        return session

    def start(self, *arguments: object, tool: str | None = None) -> "ToolProcess":
        """Start the tool in a process of its own; or a program that is told instead of it."""
        output = self.folder / "output.txt"
        words = [str(argument) for argument in arguments]
        environment = {**os.environ, **self._environment}
        if self._quick:
            process: Any = self._context.Process(
                target=_run_tool, args=(words, str(output), environment), daemon=True
            )
            with _FORKING:  # it looks at all others' ends
                process.start()
            return ToolProcess(process.pid, process, output)
        import subprocess

        with output.open("wb") as file:
            popen = subprocess.Popen(
                [sys.executable, "-c", tool or _TOOL, *words],
                cwd=self.folder,
                env=environment | {"PYTHONPATH": str(Path(__file__).parents[1])},
                stdin=subprocess.DEVNULL,
                stdout=file,
                stderr=subprocess.STDOUT,
            )
        return ToolProcess(popen.pid, popen, output)

    def run(self, *arguments: object) -> Ended:
        """Run the tool to its end."""
        return self.start(*arguments).wait()


@dataclass
class ToolProcess:
    """A process of the tool."""

    pid: int
    process: Any
    output: Path
    killed: bool = field(default=False)

    def kill(self) -> None:
        """End it with SIGKILL: nothing of it runs on."""
        os.kill(self.pid, signal.SIGKILL)
        self.killed = True

    def wait(self, seconds: float = 120.0) -> Ended:
        """Wait for its end."""
        if hasattr(self.process, "join"):
            code, deadline = None, time.monotonic() + seconds
            while code is None and time.monotonic() < deadline:
                with _FORKING:  # a status can be read once
                    code = self.process.exitcode
                time.sleep(0.005)
        else:
            code = self.process.wait(seconds)
        if code is None:
            self.kill()
            raise TimeoutError(f"the tool did not end: {self.output.read_text()}")
        return Ended(code, self.output.read_text(errors="replace"))


def _run_tool(arguments: Sequence[str], output: str, environment: Mapping[str, str]) -> None:
    os.environ |= dict(environment)
    file = os.open(output, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    for descriptor in (1, 2):
        os.dup2(file, descriptor)
    from fieldtool.cli.main import main
    from tests.untried import untried

    untried()
    main(arguments)


_TOOL = "import tests.untried as u; u.untried(); from fieldtool.cli.main import main; main()"
"""The tool as a process, its writes untried: these tests are about the write, and in real time."""


def is_download(message: can.Message) -> bool:
    """Whether a frame begins to write an object of a drive."""
    return 0x601 <= message.arbitration_id <= 0x67F and message.data[0] >> 5 == 1


def object_of(message: can.Message) -> int:
    """Index of the object that a frame begins to read or write."""
    return int.from_bytes(message.data[1:3], "little")
