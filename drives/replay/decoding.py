"""What the frames of a trace mean: services, objects by name, process data in physical units."""

import struct
from collections.abc import Iterable
from dataclasses import dataclass, field
from math import pi

import can
from canopen.objectdictionary import ObjectDictionary

from drives import objects
from drives.cia402 import MODE_WORDS, Controlword, PowerState, emergency_text
from drives.errors import ProfileError
from drives.objects import DataType, ObjectAddress, ObjectInfo, decode
from drives.profile import AxisProfile, DriveProfile
from drives.profile.eds import info_at, read_eds
from drives.replay.sdo import SdoChannel, SdoStep
from drives.scan.traffic import NMT_STATES, service_of

PDO_OFF = 1 << 31
NMT_COMMANDS = {
    0x01: "start",
    0x02: "stop",
    0x80: "enter pre-operational",
    0x81: "reset node",
    0x82: "reset communication",
}
"""First byte of an NMT command: meaning (CiA 301, clause 7.2.8.3.1)."""
POSITIONS = (objects.POSITION_ACTUAL.address, objects.TARGET_POSITION.address)
TORQUE_OFFSET = ObjectInfo(ObjectAddress(0x60B2), "INTEGER16", "torque offset")
TORQUES = (objects.TORQUE_ACTUAL.address, objects.TARGET_TORQUE.address, TORQUE_OFFSET.address)
_STANDARD = {
    info.address: info
    for info in (*vars(objects).values(), TORQUE_OFFSET)
    if isinstance(info, ObjectInfo)
}
_OF_SIZE: dict[int, DataType] = {1: "UNSIGNED8", 2: "UNSIGNED16", 4: "UNSIGNED32", 8: "UNSIGNED64"}


@dataclass(frozen=True)
class MappedValue:
    """One object in a PDO."""

    address: ObjectAddress
    name: str
    raw: int | float | str
    physical: float | None = None
    """SI; None where it has no scale."""
    unit: str = ""
    words: str = ""
    """What the number means, where it is a code."""

    def __str__(self) -> str:
        shown = self.words or str(self.raw)
        if self.physical is not None:
            shown = f"{self.physical:.6g} {self.unit}"
        return f"{self.name} {shown}"


@dataclass(frozen=True)
class Decoded:
    """One frame and what it means."""

    number: int
    """Of the frame in the trace, from 1."""
    time: float
    """Seconds, as in the trace."""
    sent: bool
    """Whether the host sent it."""
    identifier: int
    data: bytes
    kind: str
    """NMT, SYNC, SDO, PDO, EMCY, heartbeat, error or other."""
    node: int
    """0 for all nodes, or none."""
    text: str
    address: ObjectAddress | None = None
    """Object of an SDO transfer."""
    values: tuple[MappedValue, ...] = ()
    """Objects of a PDO."""


@dataclass
class NodeKnowledge:
    """What is known of a node: from profile and EDS, and from what its SDO transfers said."""

    axis: AxisProfile | None = None
    profile: DriveProfile | None = None
    dictionary: ObjectDictionary | None = None
    channel: SdoChannel = field(default_factory=SdoChannel)
    held: dict[ObjectAddress, bytes] = field(default_factory=dict)
    """What objects were read or written to be, last."""
    learned: int = 0
    """How often something was read or written."""

    def info(self, address: ObjectAddress) -> ObjectInfo | None:
        """Return name and type of an object; None where nobody knows it."""
        found = info_at(self.dictionary, address) if self.dictionary is not None else None
        return found or _STANDARD.get(address)

    def number(self, address: ObjectAddress) -> int | None:
        """Return the whole number that an object holds, as far as the trace tells."""
        data = self.held.get(address)
        return None if not data or len(data) > 8 else int.from_bytes(data, "little")

    @property
    def name(self) -> str:
        """Of the axis; empty if there is none."""
        return self.axis.name if self.axis is not None else ""

    @property
    def position_scale(self) -> float | None:
        """Rad or m of one position unit, from what the drive was heard to say of its encoder."""
        scale = self.profile.position if self.profile is not None else None
        if self.axis is None or scale is None or isinstance(scale, str):
            return None
        counts: int | float | None = self.axis.encoder_counts_per_rev
        turns: int | None = 1
        if isinstance(scale.counts, ObjectAddress) and self.number(scale.counts):
            counts = self.number(scale.counts)
            if scale.revolutions is not None:
                turns = self.number(scale.revolutions) or 1
        if not counts:
            return None
        a_turn = 2 * pi if self.axis.kind == "rotary" else self.axis.feed
        return None if a_turn is None else a_turn * (turns or 1) / counts

    @property
    def torque_scale(self) -> float | None:
        """N m or N of one per mille, from what the drive was heard to say of its rated torque."""
        scale = self.profile.torque if self.profile is not None else None
        if scale is None or isinstance(scale, str) or isinstance(scale.scale, str):
            return None
        rated = self.number(scale.per_mille_of)
        if not rated:
            return None
        value = rated * scale.scale
        if scale.unit == "A":
            if isinstance(scale.constant, ObjectAddress):
                constant: float | None = (
                    self.number(scale.constant) or 0
                ) * scale.constant_scale or None
            else:
                constant = self.axis.torque_constant if self.axis is not None else None
            if constant is None:
                return None
            value *= constant
        return value / 1000


def knowledge(axes: Iterable[tuple[AxisProfile, DriveProfile]]) -> dict[int, NodeKnowledge]:
    """Return what profiles tell of nodes, by node id; an EDS that can not be read tells nothing."""
    known = {}
    for axis, profile in axes:
        dictionary = None
        if profile.eds_path is not None:
            try:
                dictionary = read_eds(profile.eds_path)
            except ProfileError:
                dictionary = None
        known[axis.node_id] = NodeKnowledge(axis, profile, dictionary)
    return known


@dataclass(frozen=True)
class _Entry:
    """One object in a PDO, and how its values are shown."""

    address: ObjectAddress
    size: int
    info: ObjectInfo | None
    scale: float | None
    unit: str

    def value(self, data: bytes) -> MappedValue:
        raw, info = _value(self.info, data), self.info
        name = info.name if info is not None else str(self.address)
        if not isinstance(raw, int):
            return MappedValue(self.address, name, raw)
        if self.scale is not None:
            return MappedValue(self.address, name, raw, raw * self.scale, self.unit)
        return MappedValue(self.address, name, raw, words=_words(self.address, raw))


@dataclass
class _Pdo:
    node: int
    word: str
    objects: tuple[tuple[ObjectAddress, int], ...]
    """Object and bytes."""
    size: int
    entries: tuple[_Entry, ...] = ()
    known: int = -1
    """How much was known of the node when the entries were made."""


class Decoder:
    """Says what frames mean, one after the other; what SDO transfers set up is learned on the way.

    Parameters
    ----------
    nodes
        What is known of nodes before; grows.
    """

    def __init__(self, nodes: dict[int, NodeKnowledge] | None = None) -> None:
        self.nodes = nodes if nodes is not None else {}
        self._pdos: dict[int, _Pdo] = {}
        self._number = 0

    def node(self, node_id: int) -> NodeKnowledge:
        """Return what is known of a node."""
        return self.nodes.setdefault(node_id, NodeKnowledge())

    def decode(self, message: can.Message) -> Decoded:
        """Say what the next frame means."""
        self._number += 1
        data, identifier = bytes(message.data), message.arbitration_id
        address: ObjectAddress | None = None
        values: tuple[MappedValue, ...] = ()
        if message.is_error_frame:
            kind, node, text = "error", 0, "error frame"
        elif message.is_extended_id or message.is_remote_frame:
            how = "29-bit identifier" if message.is_extended_id else "remote request"
            kind, node, text = "other", 0, f"{how}, {len(data)} bytes"
        else:
            kind, node, text, address, values = self._standard(identifier, data)
        return Decoded(
            self._number,
            message.timestamp,
            not message.is_rx,
            identifier,
            data,
            kind,
            node,
            text,
            address,
            values,
        )

    def _standard(
        self, identifier: int, data: bytes
    ) -> tuple[str, int, str, ObjectAddress | None, tuple[MappedValue, ...]]:
        pdo = self._pdos.get(identifier)
        if pdo is not None:
            values = self._mapped(pdo, data)
            if values is None:
                text = f"{pdo.word}: {len(data)} bytes, not what is mapped: {data.hex(' ')}"
                return "PDO", pdo.node, text, None, ()
            return "PDO", pdo.node, f"{pdo.word}: {', '.join(map(str, values))}", None, values
        service, node = service_of(identifier)
        match service:
            case "SYNC":
                return "SYNC", 0, "SYNC" + (f" {data[0]}" if data else ""), None, ()
            case "NMT":
                return "NMT", data[1] if len(data) > 1 else 0, _nmt(data), None, ()
            case "EMCY":
                return "EMCY", node, _emergency(data), None, ()
            case "heartbeat":
                state = data[0] & 0x7F if data else -1
                word = NMT_STATES.get(state, f"state 0x{state:02X}" if data else "no data")
                return "heartbeat", node, word, None, ()
            case "SDO request" | "SDO answer":
                step = self._transfer(node, data, answer=service == "SDO answer")
                return "SDO", node, self._sdo_text(node, step), step.address, ()
        if "PDO" in service:
            return "PDO", node, f"{service}, mapping not known: {data.hex(' ')}", None, ()
        return "other", node, f"{service}: {data.hex(' ')}", None, ()

    # --- SDO ---------------------------------------------------------------------------------------

    def _transfer(self, node_id: int, data: bytes, *, answer: bool) -> SdoStep:
        node = self.node(node_id)
        step = node.channel.answer(data) if answer else node.channel.request(data)
        if step.what in ("value", "written") and step.address is not None:
            node.held[step.address] = step.data or b""
            node.learned += 1
            if 0x1400 <= step.address.index < 0x1C00:
                self._learn_pdos(node_id)
        return step

    def _sdo_text(self, node_id: int, step: SdoStep) -> str:
        if step.address is None:
            return step.what
        info = self.node(node_id).info(step.address)
        name = f"{step.address}{f' {info.name}' if info is not None else ''}"
        value = "" if step.data is None else f" = {_value_text(info, step.data)}"
        match step.what:
            case "read":
                return f"read {name}"
            case "write":
                return f"write {name}{value}"
            case "value":
                return f"{name}{value}"
            case "written":
                return f"written {name}{value}"
            case "abort":
                return f"abort {name}: {step.abort_text}"
        return f"{step.what} of {name}"

    # --- PDO ---------------------------------------------------------------------------------------

    def _learn_pdos(self, node_id: int) -> None:
        node = self.node(node_id)
        self._pdos = {cob: pdo for cob, pdo in self._pdos.items() if pdo.node != node_id}
        for first, mapping, word in ((0x1400, 0x1600, "RPDO"), (0x1800, 0x1A00, "TPDO")):
            for k in range(512):
                cob = node.number(ObjectAddress(first + k, 1))
                if cob is None:
                    if k > 8:
                        break
                    continue
                count = node.number(ObjectAddress(mapping + k, 0)) or 0
                entries = [node.number(ObjectAddress(mapping + k, j + 1)) for j in range(count)]
                if cob & PDO_OFF or not entries or None in entries:
                    continue
                mapped = tuple(
                    (ObjectAddress(e >> 16 or 1, e >> 8 & 0xFF), (e & 0xFF) // 8)
                    for e in entries
                    if e is not None
                )
                size = sum(bytes_ for _, bytes_ in mapped)
                self._pdos[cob & 0x7FF] = _Pdo(node_id, f"{word} {k + 1}", mapped, size)

    def _mapped(self, pdo: _Pdo, data: bytes) -> tuple[MappedValue, ...] | None:
        if len(data) != pdo.size:
            return None
        node = self.node(pdo.node)
        if pdo.known != node.learned:
            pdo.entries = tuple(_entry(node, address, size) for address, size in pdo.objects)
            pdo.known = node.learned
        at, values = 0, []
        for entry in pdo.entries:
            values.append(entry.value(data[at : at + entry.size]))
            at += entry.size
        return tuple(values)


def _entry(node: NodeKnowledge, address: ObjectAddress, size: int) -> _Entry:
    linear = node.axis is not None and node.axis.kind == "linear"
    scale, unit = None, ""
    if address in POSITIONS:
        scale, unit = node.position_scale, "m" if linear else "rad"
    elif address in TORQUES:
        scale, unit = node.torque_scale, "N" if linear else "N m"
    return _Entry(address, size, node.info(address), scale, unit)


def _words(address: ObjectAddress, raw: int) -> str:
    if address == objects.STATUSWORD.address:
        try:
            return f"0x{raw:04X} ({PowerState.of(raw).words})"
        except ValueError:
            return f"0x{raw:04X}"
    if address == objects.CONTROLWORD.address:
        known = {word.value: word.name.lower().replace("_", " ") for word in Controlword}
        return f"0x{raw:04X} ({known[raw]})" if raw in known else f"0x{raw:04X}"
    if address in (objects.MODE.address, objects.MODE_DISPLAY.address):
        return MODE_WORDS.get(raw, f"mode {raw}")
    return ""


def _value(info: ObjectInfo | None, data: bytes) -> int | float | str:
    """Return a value by its type; by its size where the type is not known, or another one."""
    if info is not None:
        try:
            return decode(info.type, data)
        except (ValueError, struct.error):
            pass
    kind = _OF_SIZE.get(len(data))
    return data.hex(" ") if kind is None else decode(kind, data)


def _value_text(info: ObjectInfo | None, data: bytes) -> str:
    value = _value(info, data)
    if isinstance(value, str):
        return f'"{"".join(c if c.isprintable() else "?" for c in value)}"'
    if isinstance(value, int) and info is not None:
        words = _words(info.address, value)
        if words:
            return words
        if value > 0xFFFF:
            return f"{value} (0x{value:X})"
    return f"{value:.9g}" if isinstance(value, float) else str(value)


def _nmt(data: bytes) -> str:
    if len(data) < 2:
        return f"NMT, {len(data)} bytes"
    what = NMT_COMMANDS.get(data[0], f"command 0x{data[0]:02X}")
    return f"{what} {f'node {data[1]}' if data[1] else 'all nodes'}"


def _emergency(data: bytes) -> str:
    if len(data) < 2:
        return f"emergency, {len(data)} bytes"
    code = int.from_bytes(data[:2], "little")
    register = f", error register 0x{data[2]:02X}" if len(data) > 2 else ""
    more = f", {data[3:].hex(' ')}" if any(data[3:]) else ""
    return f"emergency {emergency_text(code)}{register}{more}"
