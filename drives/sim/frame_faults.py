"""Faults of single frames, and of who sends them: answers that are wrong, PDOs that are, strangers.

They act on the frames between nodes and host; the drives themselves are sound and know nothing.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from drives.sim.faults import Fault
from drives.sim.running import RunningMachine
from drives.sim.wire import Sent, unchanged

_UPLOAD_BEGUN, _SEGMENT, _DOWNLOAD_BEGUN, _ABORTED = 2, 0, 3, 4
"""Command specifiers of an SDO server (CiA 301, clause 7.2.4.3)."""
_TOGGLE = 0x10
_STATUSWORD_BYTES = 2
_FIRST = 5e-4
"""s after which a stranger sends first."""

Alteration = Literal[
    "other index",
    "other sub-index",
    "other value size",
    "toggle bit",
    "truncated",
    "empty",
    "other specifier",
    "no specifier",
    "twice",
]


@dataclass(frozen=True)
class FrameFault(Fault):
    """A defect that changes frames which a node sends; ``times`` of them, or all."""

    times: float = float("inf")
    """How many frames it befalls."""

    def set(self, machine: RunningMachine, *, present: bool) -> None:
        """Begin or end it."""
        if not present:
            machine.wire.from_nodes.pop(self, None)
            return
        node, left = machine.node(self.node_id), self.times

        def tamper(cob_id: int, data: bytes) -> tuple[Sent, ...]:
            nonlocal left
            if left <= 0 or not self.concerns(cob_id, data, node.node_id):
                return unchanged(cob_id, data)
            left -= 1
            return self.instead(machine, cob_id, data)

        machine.wire.from_nodes[self] = tamper

    def concerns(self, cob_id: int, data: bytes, node_id: int) -> bool:
        """Whether it befalls this frame."""
        raise NotImplementedError

    def instead(self, machine: RunningMachine, cob_id: int, data: bytes) -> tuple[Sent, ...]:
        """Return what goes out in its place."""
        raise NotImplementedError


@dataclass(frozen=True)
class HeartbeatLost(FrameFault):
    """The node's heartbeat stays away; all else works."""

    def concerns(self, cob_id: int, data: bytes, node_id: int) -> bool:  # noqa: ARG002
        """Heartbeats."""
        return cob_id == 0x700 + node_id

    def instead(self, machine: RunningMachine, cob_id: int, data: bytes) -> tuple[Sent, ...]:  # noqa: ARG002
        """Return nothing."""
        return ()


@dataclass(frozen=True)
class SdoAnswerWrong(FrameFault):
    """The node's SDO answers are not what they should be."""

    how: Alteration = "other index"
    index: int | None = None
    """Only answers about this object; None: all."""

    def concerns(self, cob_id: int, data: bytes, node_id: int) -> bool:
        """SDO answers; of segments alone the toggle bit can be wrong."""
        if cob_id != 0x580 + node_id or len(data) != 8 or data[0] >> 5 == _ABORTED:
            return False
        if self.how == "toggle bit":
            return data[0] >> 5 == _SEGMENT
        if self.how == "other value size" and data[0] >> 5 != _UPLOAD_BEGUN:
            return False
        return self.index is None or data[1:3] == self.index.to_bytes(2, "little")

    def instead(self, machine: RunningMachine, cob_id: int, data: bytes) -> tuple[Sent, ...]:  # noqa: ARG002
        """Return the altered answer."""
        altered = bytearray(data)
        match self.how:
            case "other index":
                altered[1] ^= 0x01
            case "other sub-index":
                altered[3] ^= 0x01
            case "other value size":
                altered[0] ^= 0x08
            case "toggle bit":
                altered[0] ^= _TOGGLE
            case "truncated":
                del altered[3:]
            case "empty":
                altered.clear()
            case "other specifier":
                other = _UPLOAD_BEGUN if data[0] >> 5 == _DOWNLOAD_BEGUN else _DOWNLOAD_BEGUN
                altered[0] = altered[0] & 0x1F | other << 5
            case "no specifier":
                altered[0] |= 0xE0
            case "twice":
                return ((0, cob_id, data), (0, cob_id, data))
        return ((0, cob_id, bytes(altered)),)


@dataclass(frozen=True)
class SdoAnswerLate(FrameFault):
    """The node's SDO answers come when the host has given up waiting for them."""

    delay: float = 0.7
    """s."""

    def concerns(self, cob_id: int, data: bytes, node_id: int) -> bool:  # noqa: ARG002
        """SDO answers."""
        return cob_id == 0x580 + node_id

    def instead(self, machine: RunningMachine, cob_id: int, data: bytes) -> tuple[Sent, ...]:  # noqa: ARG002
        """Return it for later."""
        return ((round(self.delay * 1e9), cob_id, data),)


@dataclass(frozen=True)
class PdoFault(FrameFault):
    """A defect of the node's first TPDO."""

    def concerns(self, cob_id: int, data: bytes, node_id: int) -> bool:  # noqa: ARG002
        """TPDO 1."""
        return cob_id == 0x180 + node_id


@dataclass(frozen=True)
class PdoMissing(PdoFault):
    """It does not come."""

    def instead(self, machine: RunningMachine, cob_id: int, data: bytes) -> tuple[Sent, ...]:  # noqa: ARG002
        """Return nothing."""
        return ()


@dataclass(frozen=True)
class PdoLate(PdoFault):
    """It comes so many cycles late."""

    cycles: float = 1.3

    def instead(self, machine: RunningMachine, cob_id: int, data: bytes) -> tuple[Sent, ...]:
        """Return it for later."""
        return ((round(self.cycles * machine.period), cob_id, data),)


@dataclass(frozen=True)
class PdoTwice(PdoFault):
    """It comes a second time."""

    def instead(self, machine: RunningMachine, cob_id: int, data: bytes) -> tuple[Sent, ...]:  # noqa: ARG002
        """Return it twice."""
        return ((0, cob_id, data), (0, cob_id, data))


@dataclass(frozen=True)
class PdoShort(PdoFault):
    """It has so many bytes."""

    length: int = 6

    def instead(self, machine: RunningMachine, cob_id: int, data: bytes) -> tuple[Sent, ...]:  # noqa: ARG002
        """Return its first bytes."""
        return ((0, cob_id, data[: self.length]),)


@dataclass(frozen=True)
class StatuswordFrozen(PdoFault):
    """The statusword in the PDO stays what it is when the fault begins."""

    def set(self, machine: RunningMachine, *, present: bool) -> None:
        """Freeze or thaw it."""
        if not present:
            machine.wire.from_nodes.pop(self, None)
            return
        node = machine.node(self.node_id)
        frozen = node.motion.statusword.to_bytes(2, "little")

        def tamper(cob_id: int, data: bytes) -> tuple[Sent, ...]:
            if cob_id == 0x180 + node.node_id:
                data = frozen + data[_STATUSWORD_BYTES:]
            return unchanged(cob_id, data)

        machine.wire.from_nodes[self] = tamper


@dataclass(frozen=True)
class SyncMissed(Fault):
    """The node does not hear so many of the next SYNCs."""

    times: float = 1

    def set(self, machine: RunningMachine, *, present: bool) -> None:
        """Deafen it or not."""
        machine.syncs_missed[self.node_id] = self.times if present else 0


@dataclass(frozen=True)
class NodeDuplicated(FrameFault):
    """A second drive on the bus has the same node id; it is disabled and stands at another place."""

    def concerns(self, cob_id: int, data: bytes, node_id: int) -> bool:  # noqa: ARG002
        """Everything that a node sends but emergencies."""
        return cob_id - node_id in (0x180, 0x580, 0x700)

    def instead(self, machine: RunningMachine, cob_id: int, data: bytes) -> tuple[Sent, ...]:  # noqa: ARG002
        """Return what both send."""
        other = bytearray(data)
        if cob_id < 0x580 and len(data) == 8:
            other[:6] = (0x0240).to_bytes(2, "little") + (123_456).to_bytes(4, "little")
        elif cob_id < 0x700 and len(data) == 8 and data[0] >> 5 == _UPLOAD_BEGUN:
            other[4] ^= 0x01
        return ((0, cob_id, data), (0, cob_id, bytes(other)))


@dataclass(frozen=True)
class Stranger(Fault):
    """Somebody else sends a frame on the bus, which nodes and host hear, again and again."""

    cob_id: int = 0x80
    data: bytes = b""
    period: float = 0.01
    """s; from the moment of the fault on."""
    times: float = float("inf")

    def set(self, machine: RunningMachine, *, present: bool) -> None:
        """Let him in, or send him away."""
        if not present:
            machine.wire.to_nodes.pop(self, None)
            return
        left = self.times

        def send() -> None:
            nonlocal left
            if left <= 0 or self not in machine.wire.to_nodes:
                return
            left -= 1
            machine.announce(self.cob_id, self.data)
            machine.receive(self.cob_id, self.data)
            machine.scheduler.add(self.period, send)

        machine.wire.to_nodes[self] = unchanged
        machine.scheduler.add(min(_FIRST, self.period), send)


def nmt_command(command: int, node_id: int) -> Callable[[int], Stranger]:
    """Return what makes a fault of a stranger's NMT command; the argument is the node's id."""
    return lambda node: Stranger(node, 0x000, bytes((command, node_id)), times=1)
