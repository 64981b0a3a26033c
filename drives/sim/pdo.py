"""Process data objects of the simulated drive: 4 RPDOs and 4 TPDOs, mapped at run time.

A mapping is compiled once, when its PDO becomes valid: into one ``struct`` layout and a list of
setters or getters, so that a SYNC costs a few microseconds.

At a SYNC the order is CiA 301's: inputs have been latched, synchronous TPDOs go out with them, then
the synchronous RPDOs received since the last SYNC act.  Event-driven TPDOs (254, 255) are looked at
every millisecond, the drive's communication task: inhibit time and event timer are kept to that
resolution.  Transmission types 241 to 253 (reserved, and remote requests) are refused; remote
frames are not answered, whatever bit 30 of the COB-ID says.
"""

import struct
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

from durand.datatypes import DatatypeEnum as Type
from durand.datatypes import is_numeric, struct_dict

from drives.sim.abort_codes import Abort
from drives.sim.dictionary import DriveDictionary, Key
from drives.sim.emergency import PDO_TOO_SHORT, ErrorRegister, refuse_cob_id
from drives.sim.entries import MAPPING_ENTRIES, NOT_VALID, PDO_COUNT, Entry

LAST_SYNCHRONOUS = 240
FIRST_EVENT = 254
LONGEST = 64
"""Bits in a PDO."""

_DUMMIES = {k: struct_dict[Type(k)].size * 8 for k in range(2, 8)}
"""Index of a data type that may fill a gap in an RPDO: its bits."""

Setter = Callable[[Any], object]
Getter = Callable[[], Any]


class ProcessImage(Protocol):
    """How the drive's values are reached from PDOs."""

    def setter(self, key: Key) -> Setter:
        """Return what puts a received value into the drive."""
        ...

    def getter(self, key: Key, *, latched: bool) -> Getter:
        """Return what gives the value to send: as it was at the last SYNC, or as it is."""
        ...


@dataclass(frozen=True)
class MappedObject:
    """One mapping entry, taken apart."""

    key: Key
    bits: int

    @classmethod
    def of(cls, word: int) -> "MappedObject":
        """Take ``index << 16 | subindex << 8 | bits`` apart."""
        return cls((word >> 16, word >> 8 & 0xFF), word & 0xFF)

    def can_be_received(self, dictionary: DriveDictionary) -> bool:
        """Whether an RPDO may carry it."""
        if self.key[1] == 0 and self.key[0] in _DUMMIES:
            return bool(self.bits == _DUMMIES[self.key[0]])
        entry = dictionary.shows(self.key)
        return self._fits(entry) and entry is not None and entry.access in ("rw", "wo")

    def can_be_sent(self, dictionary: DriveDictionary) -> bool:
        """Whether a TPDO may carry it."""
        entry = dictionary.shows(self.key)
        return self._fits(entry) and entry is not None and entry.access != "wo"

    def _fits(self, entry: Entry | None) -> bool:
        if entry is None or not entry.mappable or not is_numeric(entry.type):
            return False
        return bool(struct_dict[entry.type].size * 8 == self.bits)

    def layout(self, dictionary: DriveDictionary) -> str:
        """Its letter in a ``struct`` layout."""
        entry = dictionary.entries.get(self.key)
        type_ = entry.type if entry is not None else Type(self.key[0])
        return str(struct_dict[type_].format).lstrip("<")


class _Parameters:
    """Communication and mapping objects of one PDO, with the rules for writing them."""

    def __init__(
        self, dictionary: DriveDictionary, communication: int, mapping: int, *, receive: bool
    ) -> None:
        self._dictionary, self._receive = dictionary, receive
        self._communication, self._mapping = communication, mapping
        guards = dictionary.guards
        guards[communication, 1] = self._refuse_cob_id
        guards[communication, 2] = _refuse_transmission_type
        if not receive:
            guards[communication, 3] = lambda _: Abort.WRONG_STATE if self.valid else None
        guards[mapping, 0] = self._refuse_count
        for k in range(1, MAPPING_ENTRIES + 1):
            guards[mapping, k] = self._refuse_mapping

    def on_change(self, changed: Callable[[], None]) -> None:
        """Call back after each write that changes what the PDO does."""
        subindices = (1, 2) if self._receive else (1, 2, 3, 5)
        for subindex in subindices:
            self._dictionary.effects[self._communication, subindex] = lambda _: changed()

    def read(self, subindex: int) -> int:
        """Return a communication parameter."""
        return int(self._dictionary.read(self._communication, subindex))

    @property
    def valid(self) -> bool:
        """Whether bit 31 of the COB-ID is clear."""
        return not self.read(1) & NOT_VALID

    @property
    def identifier(self) -> int:
        """CAN identifier."""
        return self.read(1) & 0x7FF

    @property
    def transmission_type(self) -> int:
        """Sub-index 2."""
        return self.read(2)

    @property
    def mapped(self) -> tuple[MappedObject, ...]:
        """What is mapped, in order."""
        count = int(self._dictionary.read(self._mapping, 0))
        words = (int(self._dictionary.read(self._mapping, k)) for k in range(1, count + 1))
        return tuple(MappedObject.of(word) for word in words)

    @property
    def layout(self) -> str:
        """The mapped values' ``struct`` layout."""
        return "<" + "".join(each.layout(self._dictionary) for each in self.mapped)

    def _refuse_cob_id(self, value: int) -> int | None:
        return refuse_cob_id(value, self.read(1))

    def _refuse_mapping(self, word: int) -> int | None:
        if self.valid:
            return Abort.WRONG_STATE
        if self._dictionary.read(self._mapping, 0):
            return Abort.UNSUPPORTED_ACCESS
        if word and not self._allowed(MappedObject.of(word)):
            return Abort.NOT_MAPPABLE
        return None

    def _refuse_count(self, count: int) -> int | None:
        if self.valid:
            return Abort.WRONG_STATE
        words = [int(self._dictionary.read(self._mapping, k)) for k in range(1, count + 1)]
        mapped = [MappedObject.of(word) for word in words]
        if not all(self._allowed(each) for each in mapped):
            return Abort.NOT_MAPPABLE
        if sum(each.bits for each in mapped) > LONGEST:
            return Abort.PDO_LENGTH
        return None

    def _allowed(self, mapped: MappedObject) -> bool:
        if self._receive:
            return mapped.can_be_received(self._dictionary)
        return mapped.can_be_sent(self._dictionary)


def _refuse_transmission_type(value: int) -> int | None:
    return Abort.INVALID_VALUE if LAST_SYNCHRONOUS < value < FIRST_EVENT else None


class ReceivePdo:
    """One RPDO, compiled."""

    __slots__ = (
        "_apply_now",
        "_on_short",
        "_setters",
        "_unpack",
        "length",
        "pending",
        "synchronous",
    )

    def __init__(
        self,
        parameters: _Parameters,
        image: ProcessImage,
        apply_now: Callable[[], None],
        on_short: Callable[[int], None],
    ) -> None:
        mapped = parameters.mapped
        layout = struct.Struct(parameters.layout)
        self._unpack, self.length = layout.unpack_from, layout.size
        self._setters = [
            _ignore if each.key[0] in _DUMMIES else image.setter(each.key) for each in mapped
        ]
        self.synchronous = parameters.transmission_type <= LAST_SYNCHRONOUS
        self.pending: tuple[Any, ...] | None = None
        """Values that wait for the next SYNC."""
        self._apply_now, self._on_short = apply_now, on_short

    def receive(self, _cob_id: int, data: bytes | bytearray) -> None:
        """Take a frame; of one that is too long the rest is passed over."""
        if len(data) < self.length:
            self._on_short(len(data))
        elif self.synchronous:
            self.pending = self._unpack(data)
        else:
            self.apply(self._unpack(data))
            self._apply_now()

    def apply(self, values: tuple[Any, ...]) -> None:
        """Put values into the drive."""
        for setter, value in zip(self._setters, values, strict=True):
            setter(value)


class TransmitPdo:
    """One TPDO, compiled."""

    def __init__(
        self,
        parameters: _Parameters,
        image: ProcessImage,
        send: Callable[[int, bytes], None],
    ) -> None:
        mapped = parameters.mapped
        self._pack = struct.Struct(parameters.layout).pack
        self.kind = parameters.transmission_type
        latched = self.kind <= LAST_SYNCHRONOUS
        self._getters = [image.getter(each.key, latched=latched) for each in mapped]
        self._send, self._identifier = send, parameters.identifier
        self._left = max(self.kind, 1)
        self._inhibit = parameters.read(3) * 100_000
        self._event_timer = parameters.read(5) * 1_000_000
        self._sent: bytes | None = None
        self._sent_at = 0

    def at_sync(self) -> None:
        """Send, if this SYNC is the one to send at."""
        if self.kind == 0:
            data = self._pack(*[get() for get in self._getters])
            if data != self._sent:
                self._sent = data
                self._send(self._identifier, data)
            return
        self._left -= 1
        if self._left == 0:
            self._left = self.kind
            self._send(self._identifier, self._pack(*[get() for get in self._getters]))

    def at_task(self, now: int) -> None:
        """Send, if something changed or the event timer ran out; ``now`` in ns."""
        passed = now - self._sent_at
        if self._sent is not None and passed < self._inhibit:
            return
        data = self._pack(*[get() for get in self._getters])
        late = self._event_timer and passed >= self._event_timer
        if data != self._sent or late:
            self._sent, self._sent_at = data, now
            self._send(self._identifier, data)


class PdoService:
    """All PDOs of one node.

    Parameters
    ----------
    dictionary
        Whose PDO parameters are used.
    image
        Where mapped values live.
    network
        Frames come from and go to (durand's ``NetworkABC``).
    apply
        Called after received values were put into the drive.
    report
        Called with an emergency code, bits of the error register and data.
    """

    def __init__(
        self,
        dictionary: DriveDictionary,
        image: ProcessImage,
        network: Any,
        apply: Callable[[], None],
        report: Callable[[int, int, bytes], None],
    ) -> None:
        self._image, self._network, self._apply, self._report = image, network, apply, report
        self._receive = [
            _Parameters(dictionary, 0x1400 + k, 0x1600 + k, receive=True) for k in range(PDO_COUNT)
        ]
        self._transmit = [
            _Parameters(dictionary, 0x1800 + k, 0x1A00 + k, receive=False) for k in range(PDO_COUNT)
        ]
        for parameters in (*self._receive, *self._transmit):
            parameters.on_change(self._recompile)
        self._running = False
        self._subscribed: list[int] = []
        self._synchronous_in: list[ReceivePdo] = []
        self._synchronous_out: list[TransmitPdo] = []
        self.event_driven: list[TransmitPdo] = []
        """TPDOs that the communication task has to look at."""
        self.muted = False
        """Fault injection: no TPDO is sent."""

    def start(self) -> None:
        """Begin (the node became operational); event-driven TPDOs go out with the next task."""
        self._running = True
        self._recompile()

    def stop(self) -> None:
        """End (the node is not operational any more); what waited for a SYNC is forgotten."""
        self._running = False
        self._recompile()

    def at_sync(self) -> None:
        """Send latched inputs, then let received outputs act."""
        if not self.muted:
            for outgoing in self._synchronous_out:
                outgoing.at_sync()
        for incoming in self._synchronous_in:
            values = incoming.pending
            if values is not None:
                incoming.pending = None
                incoming.apply(values)
        self._apply()

    def at_task(self, now: int) -> None:
        """Do what event-driven TPDOs ask for; ``now`` in ns."""
        if not self.muted:
            for outgoing in self.event_driven:
                outgoing.at_task(now)

    def _recompile(self) -> None:
        for identifier in self._subscribed:
            self._network.remove_subscription(identifier)
        self._subscribed, self._synchronous_in = [], []
        self._synchronous_out, self.event_driven = [], []
        if not self._running:
            return
        for parameters in self._receive:
            if parameters.valid and parameters.mapped:
                self._listen(parameters)
        for parameters in self._transmit:
            if parameters.valid and parameters.mapped:
                pdo = TransmitPdo(parameters, self._image, self._network.send)
                synchronous = pdo.kind <= LAST_SYNCHRONOUS
                (self._synchronous_out if synchronous else self.event_driven).append(pdo)

    def _listen(self, parameters: _Parameters) -> None:
        identifier = parameters.identifier
        pdo = ReceivePdo(
            parameters,
            self._image,
            self._apply,
            lambda length: self._too_short(identifier, length),
        )
        self._network.add_subscription(identifier, pdo.receive)
        self._subscribed.append(identifier)
        if pdo.synchronous:
            self._synchronous_in.append(pdo)

    def _too_short(self, identifier: int, length: int) -> None:
        data = struct.pack("<HB", identifier, length)
        self._report(PDO_TOO_SHORT, ErrorRegister.COMMUNICATION, data)


def _ignore(_: Any) -> None:
    """Pass a gap in an RPDO over."""
