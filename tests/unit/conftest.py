"""A simulated machine on the bench, and a host made of nothing but frames."""

import struct
from collections.abc import Callable

import pytest

from drives.sim.machine import SimulatedDrive, SimulatedMachine
from drives.sim.plant import ChainParameters
from drives.sim.running import RunningMachine
from drives.sim.scheduler import nanoseconds

CHAIN = ChainParameters((0.01,), (), (), viscous_friction=0.01)
GAINS = {"position_p": 30.0, "velocity_p": 2.0, "velocity_i": 40.0, "velocity_filter": 1000.0}


class SdoAbortedError(Exception):
    """A node refused an SDO transfer."""

    def __init__(self, code: int) -> None:
        self.code = code
        super().__init__(f"0x{code:08X}")


class Rig:
    """A running machine, its frames, and the host's side of the services, frame by frame."""

    def __init__(self, machine: SimulatedMachine) -> None:
        self.machine = RunningMachine(machine)
        self.frames: list[tuple[int, int, bytes]] = []
        self.machine.listen(lambda t, cob, data: self.frames.append((t, cob, bytes(data))))

    def take(self, cob_id: int | None = None) -> list[bytes]:
        """Return and forget the frames received (of one identifier)."""
        taken = [data for _, cob, data in self.frames if cob_id in (None, cob)]
        self.frames = [f for f in self.frames if cob_id not in (None, f[1])]
        return taken

    def send(self, cob_id: int, data: bytes) -> None:
        self.machine.receive(cob_id, data)

    def run(self, seconds: float) -> None:
        self.machine.advance_to(self.machine.time + nanoseconds(seconds))

    def cycle(self, count: int = 1) -> None:
        """Send SYNC and let a communication cycle pass, so often."""
        for _ in range(count):
            self.machine.receive(0x80, b"")
            self.machine.advance_to(self.machine.time + self.machine.period)

    def nmt(self, command: int, node: int = 1) -> None:
        self.send(0, bytes((command, node)))

    def answer(self, data: bytes, node: int = 1) -> bytes:
        self.take(0x580 + node)
        self.send(0x600 + node, data)
        answers = self.take(0x580 + node)
        assert len(answers) == 1, f"expected one answer, got {answers}"
        if answers[0][0] == 0x80:
            raise SdoAbortedError(int.from_bytes(answers[0][4:], "little"))
        return answers[0]

    def write_raw(self, index: int, sub: int, data: bytes, node: int = 1) -> None:
        """Download up to 4 bytes, expedited."""
        head = struct.pack("<BHB", 0x23 | (4 - len(data)) << 2, index, sub)
        assert self.answer(head + data.ljust(4, b"\0"), node)[0] == 0x60

    def write(self, layout: str, index: int, sub: int, value: float, node: int = 1) -> None:
        self.write_raw(index, sub, struct.pack("<" + layout, value), node)

    def read_raw(self, index: int, sub: int = 0, node: int = 1) -> bytes:
        """Upload, expedited or segmented."""
        first = self.answer(struct.pack("<BHB4x", 0x40, index, sub), node)
        if first[0] & 0x02:
            return first[4 : 8 - (first[0] >> 2 & 3)]
        size, data, toggle = int.from_bytes(first[4:], "little"), b"", 0
        while True:
            segment = self.answer(bytes((0x60 | toggle,)) + bytes(7), node)
            assert segment[0] & 0x10 == toggle
            data += segment[1 : 8 - (segment[0] >> 1 & 7)]
            toggle ^= 0x10
            if segment[0] & 1:
                assert len(data) == size
                return data

    def read(self, layout: str, index: int, sub: int = 0, node: int = 1) -> int:
        return struct.unpack("<" + layout, self.read_raw(index, sub, node))[0]

    def map_pdo(
        self,
        communication: int,
        mapping: int,
        cob_id: int,
        words: tuple[int, ...],
        kind: int = 1,
        node: int = 1,
    ) -> None:
        """Map a PDO by CiA 301's procedure."""
        self.write("I", communication, 1, cob_id | 1 << 31, node)
        self.write("B", communication, 2, kind, node)
        self.write("B", mapping, 0, 0, node)
        for k, word in enumerate(words, start=1):
            self.write("I", mapping, k, word, node)
        self.write("B", mapping, 0, len(words), node)
        self.write("I", communication, 1, cob_id, node)

    def statusword(self, node: int = 1) -> int:
        return self.read("H", 0x6041, 0, node)

    def state(self, node: int = 1) -> int:
        """The power state's bits 0-3, 5, 6 as CiA 402 masks them."""
        word = self.statusword(node)
        return word & (0x4F if word & 0x4F in (0x00, 0x40, 0x0F, 0x08) else 0x6F)

    def control(self, word: int, node: int = 1) -> None:
        self.write("H", 0x6040, 0, word, node)

    def enable(self, node: int = 1, mode: int = 8) -> None:
        """Go to OPERATION ENABLED, with the target where the axis is."""
        self.write("b", 0x6060, 0, mode, node)
        self.write("i", 0x607A, 0, self.read("i", 0x6064, 0, node), node)
        for word in (0x06, 0x07, 0x0F):
            self.control(word, node)
        assert self.state(node) == 0x27

    def emergencies(self, node: int = 1) -> list[int]:
        return [int.from_bytes(data[:2], "little") for data in self.take(0x80 + node)]


def drive(name: str = "axis", node_id: int = 1, **changes: object) -> SimulatedDrive:
    settings: dict[str, object] = {
        "chain": CHAIN,
        "rated_torque": 10.0,
        "peak_torque": 20.0,
        "gains": GAINS,
        "serial": 4711,
    }
    return SimulatedDrive(name, node_id, **(settings | changes))  # type: ignore[arg-type]


@pytest.fixture
def rig() -> Rig:
    """One axis with a rigid load, node 1."""
    return Rig(SimulatedMachine((drive(),)))


@pytest.fixture
def rig_of() -> Callable[..., Rig]:
    """Make a rig of as many axes, with the drives' settings changed."""

    def make(count: int = 1, **changes: object) -> Rig:
        return Rig(
            SimulatedMachine(tuple(drive(f"axis{k}", k, **changes) for k in range(1, count + 1)))
        )

    return make


@pytest.fixture
def aborted() -> Callable[[int], object]:
    """Expect an SDO abort with this code."""

    def expect(code: int) -> object:
        return pytest.raises(SdoAbortedError, match=f"0x{code:08X}")

    return expect
