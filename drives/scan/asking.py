"""Read objects of nodes that nobody has described yet: short time-outs, few frames, no writes."""

import struct
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import can
from canopen.objectdictionary import ObjectDictionary
from canopen.sdo import SdoAbortedError, SdoCommunicationError

from drives import objects
from drives.bus import frame_bits, is_data
from drives.canopen_drive.line import SHORTEST_WAIT, Line, Node
from drives.errors import ABORT_CODES
from drives.objects import ObjectAddress, ObjectInfo

PACE_SHARE = 0.25
"""Of the bus that asking all node ids takes at most."""
SHORTEST_PACE = 0.002
"""Seconds between two requests at least: adapters' buffers are short."""
FIRST_ANSWER = 0.25
"""Seconds that a node has for its first answer."""
ANSWER = 0.2
"""Seconds that a node has for each further answer."""
SILENCES = 2
"""Time-outs in a row after which a node is asked no more."""
NOT_THERE = (0x06020000, 0x06090011)
"""Abort codes of objects and sub-indexes that do not exist."""


@dataclass(frozen=True)
class Reading:
    """What a node answered when it was asked for one object."""

    info: ObjectInfo
    data: bytes | None = None
    """As it came; None if it was refused, or there was no answer."""
    why: str = ""
    """Why there is no value, in words."""
    absent: bool = False
    """The node says that it has no such object."""

    @property
    def number(self) -> int | None:
        """Value of a whole-number object, by the size that came; None if there is none."""
        if self.data is None or not 1 <= len(self.data) <= 8:
            return None
        return int.from_bytes(self.data, "little", signed=self.info.type.startswith("INTEGER"))

    @property
    def text(self) -> str:
        """Value of a text object; empty if there is none."""
        raw = self.data or b""
        return raw.split(b"\0")[0].decode("latin-1").strip()


def who_answers(
    line: Line,
    node_ids: Iterable[int],
    bitrate: int,
    progress: Callable[[float], None] = lambda _: None,
) -> frozenset[int]:
    """Return the nodes that answer a request for their device type 0x1000.

    All are asked one after the other, slowly enough for the slowest bus, and listened to meanwhile.

    Parameters
    ----------
    line
        An open bus.
    node_ids
        Whom to ask.
    bitrate
        Of the bus, bit/s.
    progress
        Is told the share that is done, 0 to 1.

    Raises
    ------
    BusError
        If the bus does not take or deliver frames.
    """
    pace = max(SHORTEST_PACE, 2 * frame_bits(8) / (PACE_SHARE * bitrate))
    asked = tuple(node_ids)
    answered: set[int] = set()

    def collect(seconds: float) -> None:
        deadline = line.clock.now() + seconds
        while (left := deadline - line.clock.now()) > 0:
            message = line.pump(max(SHORTEST_WAIT, left))
            if message is not None and _is_answer(message):
                answered.add(message.arbitration_id - 0x580)

    for k, node_id in enumerate(asked):
        line.send_message(0x600 + node_id, b"\x40\x00\x10\x00\x00\x00\x00\x00")
        collect(pace)
        progress((k + 1) / (len(asked) + FIRST_ANSWER / pace))
    collect(FIRST_ANSWER)
    return frozenset(answered & set(asked))


def _is_answer(message: can.Message) -> bool:
    return is_data(message) and 0x581 <= message.arbitration_id <= 0x5FF and len(message.data) == 8


def node_to_ask(line: Line, node_id: int, timeout: float = ANSWER) -> Node:
    """Return a node of which nothing is known, with a time-out for each answer in seconds."""
    node = Node(node_id, ObjectDictionary())
    line.add_node(node)
    node.sdo.RESPONSE_TIMEOUT = timeout
    return node


class Asked:
    """One node while it is asked; each object once."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self.answers: dict[ObjectAddress, Reading] = {}
        """What it said so far, by object."""
        self._silences = 0

    @property
    def silent(self) -> bool:
        """Whether it has stopped to answer, and is asked no more."""
        return self._silences >= SILENCES

    def read(self, info: ObjectInfo) -> Reading:
        """Return what the node says of an object; errors are part of the answer."""
        if info.address not in self.answers:
            self.answers[info.address] = self._read(info)
        return self.answers[info.address]

    def _read(self, info: ObjectInfo) -> Reading:
        if self.silent:
            return Reading(info, why="not asked: the node does not answer any more")
        address = info.address
        try:
            data = bytes(self._node.sdo.upload(address.index, address.subindex))
        except SdoAbortedError as error:
            self._silences = 0
            meaning = ABORT_CODES.get(error.code, f"refused with 0x{error.code:08X}")
            return Reading(info, why=meaning, absent=error.code in NOT_THERE)
        except SdoCommunicationError as error:
            if "No SDO response" in str(error):
                self._silences += 1
                return Reading(info, why="no answer")
            return Reading(info, why=f"a wrong answer: {error}")
        except struct.error as error:
            return Reading(info, why=f"a wrong answer: {error}")
        self._silences = 0
        return Reading(info, data)

    def read_all(self, infos: Iterable[ObjectInfo]) -> tuple[Reading, ...]:
        """Return what the node says of objects, in order."""
        return tuple(self.read(info) for info in infos)


IDENTITY = (
    objects.DEVICE_TYPE,
    objects.VENDOR_ID,
    objects.PRODUCT_CODE,
    objects.REVISION,
    objects.SERIAL_NUMBER,
    objects.DEVICE_NAME,
    objects.FIRMWARE_VERSION,
)
"""What a node is asked for first."""
