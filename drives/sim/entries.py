"""The simulated drive's objects as data: what the dictionary and the EDS file are made from.

Communication objects after CiA 301, drive objects after CiA 402-2 (IEC 61800-7-201), manufacturer
objects 0x2010 to 0x2030 of this drive.  Positions are encoder counts, velocities counts/s,
accelerations counts/s2, torques per mille of the rated torque 0x6076 (mN m; mN on linear axes).
"""

from collections.abc import Iterator
from dataclasses import dataclass, field, replace

from durand.datatypes import DatatypeEnum as Type

VENDOR_ID = 0
"""No number of CiA's: this device does not exist."""
PRODUCT_CODE = 0x00402001
REVISION = 0x00010000
DEVICE_TYPE = 0x00020192
"""CiA 402 (0x192), servo drive (bit 17)."""

PDO_COUNT = 4
MAPPING_ENTRIES = 8
HISTORY_LENGTH = 8
HEARTBEAT_CONSUMERS = 2
NOT_VALID = 1 << 31
NO_REMOTE = 1 << 30


@dataclass(frozen=True)
class Entry:
    """One entry of the dictionary (index and sub-index)."""

    index: int
    subindex: int
    name: str
    type: Type
    access: str
    """``ro``, ``rw``, ``wo`` or ``const``."""
    default: int | float | bytes = 0
    low: float | None = None
    high: float | None = None
    """Limits; None where the type's own range is the limit."""
    mappable: bool = False
    """May be mapped: into a TPDO if it can be read, into an RPDO if it can be written."""
    plus_node_id: bool = False
    """The node id is added to the default."""
    stored: bool = True
    """Whether 0x1010 puts it into non-volatile memory (``rw`` entries only)."""
    choices: tuple[int, ...] = ()
    """The only values allowed, where they are no range."""

    @property
    def key(self) -> tuple[int, int]:
        """Index and sub-index."""
        return self.index, self.subindex

    @property
    def is_parameter(self) -> bool:
        """Whether a power cycle forgets it unless it was stored."""
        return self.stored and self.access == "rw"

    def default_for(self, node_id: int) -> int | float | bytes:
        """Return the default on a node of this id."""
        if self.plus_node_id:
            return int(self.default) + node_id
        return self.default


@dataclass(frozen=True)
class ObjectEntry:
    """One object: a variable, or a record or array with its sub-entries."""

    index: int
    name: str
    entries: tuple[Entry, ...]
    is_array: bool = False
    is_variable: bool = field(default=False)


def _var(index: int, name: str, type_: Type, access: str, **rest: object) -> ObjectEntry:
    entry = Entry(index, 0, name, type_, access, **rest)  # type: ignore[arg-type]
    return ObjectEntry(index, name, (entry,), is_variable=True)


def _sub(name: str, type_: Type, access: str, **rest: object) -> Entry:
    return Entry(0, 0, name, type_, access, **rest)  # type: ignore[arg-type]


def _record(
    index: int,
    name: str,
    subs: dict[int, Entry],
    *,
    array: bool = False,
    count: Entry | None = None,
) -> ObjectEntry:
    first = count or _sub("Highest sub-index supported", Type.UNSIGNED8, "const", default=max(subs))
    entries = [replace(first, index=index, subindex=0)]
    entries += [replace(sub, index=index, subindex=k) for k, sub in sorted(subs.items())]
    return ObjectEntry(index, name, tuple(entries), is_array=array)


def _communication() -> Iterator[ObjectEntry]:
    u8, u16, u32, text = Type.UNSIGNED8, Type.UNSIGNED16, Type.UNSIGNED32, Type.VISIBLE_STRING
    yield _var(0x1000, "Device type", u32, "const", default=DEVICE_TYPE)
    yield _var(0x1001, "Error register", u8, "ro", mappable=True)
    yield _record(
        0x1003,
        "Pre-defined error field",
        {k: _sub(f"Standard error field {k}", u32, "ro") for k in range(1, HISTORY_LENGTH + 1)},
        array=True,
        count=_sub("Number of errors", u8, "rw", stored=False),
    )
    yield _var(0x1005, "COB-ID SYNC message", u32, "rw", default=0x80)
    yield _var(0x1006, "Communication cycle period", u32, "rw", high=1_000_000)
    yield _var(
        0x1008, "Manufacturer device name", text, "const", default=b"simulated CiA 402 servo drive"
    )
    yield _var(0x1009, "Manufacturer hardware version", text, "const", default=b"none, simulated")
    yield _var(
        0x100A,
        "Manufacturer software version",
        text,
        "const",
        default=b"1.0.0, 8 kHz cascade with two torque filters",
    )
    store = _sub("Store all parameters", u32, "rw", default=1, stored=False)
    yield _record(0x1010, "Store parameters", {1: store}, array=True)
    restore = _sub("Restore all default parameters", u32, "rw", default=1, stored=False)
    yield _record(0x1011, "Restore default parameters", {1: restore}, array=True)
    yield _var(0x1014, "COB-ID EMCY message", u32, "rw", default=0x80, plus_node_id=True)
    consumers = range(1, HEARTBEAT_CONSUMERS + 1)
    yield _record(
        0x1016,
        "Consumer heartbeat time",
        {k: _sub(f"Consumer heartbeat time {k}", u32, "rw") for k in consumers},
        array=True,
    )
    yield _var(0x1017, "Producer heartbeat time", u16, "rw")
    yield _record(
        0x1018,
        "Identity object",
        {
            1: _sub("Vendor-ID", u32, "const", default=VENDOR_ID),
            2: _sub("Product code", u32, "const", default=PRODUCT_CODE),
            3: _sub("Revision number", u32, "const", default=REVISION),
            4: _sub("Serial number", u32, "ro"),
        },
    )
    yield _var(0x1021, "Store EDS", Type.DOMAIN, "ro", default=b"")
    yield _var(0x1022, "Store format", u8, "const")
    yield _record(
        0x1029, "Error behaviour", {1: _sub("Communication error", u8, "rw", high=2)}, array=True
    )
    yield _record(
        0x1200,
        "SDO server parameter",
        {
            1: _sub("COB-ID client to server (rx)", u32, "const", default=0x600, plus_node_id=True),
            2: _sub("COB-ID server to client (tx)", u32, "const", default=0x580, plus_node_id=True),
        },
    )


_RECEIVE_DEFAULTS = ((0x60400010,), (0x60400010, 0x60600008), (0x60400010, 0x607A0020),
                     (0x60400010, 0x60FF0020))  # fmt: skip
_TRANSMIT_DEFAULTS = ((0x60410010,), (0x60410010, 0x60610008), (0x60410010, 0x60640020),
                      (0x60410010, 0x606C0020))  # fmt: skip


def _mapping(index: int, name: str, mapped: tuple[int, ...]) -> ObjectEntry:
    slots = {
        k: _sub(
            f"Mapped object {k}",
            Type.UNSIGNED32,
            "rw",
            default=mapped[k - 1] if k <= len(mapped) else 0,
        )
        for k in range(1, MAPPING_ENTRIES + 1)
    }
    count = _sub(
        "Number of mapped objects",
        Type.UNSIGNED8,
        "rw",
        default=len(mapped),
        high=MAPPING_ENTRIES,
    )
    return _record(index, name, slots, count=count)


def _process_data() -> Iterator[ObjectEntry]:
    u8, u16, u32 = Type.UNSIGNED8, Type.UNSIGNED16, Type.UNSIGNED32
    for k in range(PDO_COUNT):
        unused = 0 if k == 0 else NOT_VALID
        cob_id = _sub(
            "COB-ID used by RPDO", u32, "rw", default=0x200 + 0x100 * k + unused, plus_node_id=True
        )
        kind = _sub("Transmission type", u8, "rw", default=255)
        yield _record(0x1400 + k, f"RPDO {k + 1} communication parameter", {1: cob_id, 2: kind})
    for k, mapped in enumerate(_RECEIVE_DEFAULTS):
        yield _mapping(0x1600 + k, f"RPDO {k + 1} mapping parameter", mapped)
    for k in range(PDO_COUNT):
        unused = 0 if k == 0 else NOT_VALID
        cob_id = _sub(
            "COB-ID used by TPDO",
            u32,
            "rw",
            default=0x180 + 0x100 * k + NO_REMOTE + unused,
            plus_node_id=True,
        )
        yield _record(
            0x1800 + k,
            f"TPDO {k + 1} communication parameter",
            {
                1: cob_id,
                2: _sub("Transmission type", u8, "rw", default=255),
                3: _sub("Inhibit time", u16, "rw"),
                5: _sub("Event timer", u16, "rw"),
            },
        )
    for k, mapped in enumerate(_TRANSMIT_DEFAULTS):
        yield _mapping(0x1A00 + k, f"TPDO {k + 1} mapping parameter", mapped)


def _torque_filter(index: int, number: int) -> ObjectEntry:
    return _record(
        index,
        f"Torque filter {number}",
        {
            1: _sub("Type (0 off, 1 notch, 2 low-pass)", Type.UNSIGNED8, "rw", high=2),
            2: _sub(
                "Frequency, 0.001 Hz",
                Type.UNSIGNED32,
                "rw",
                default=100_000,
                low=100,
                high=3_000_000,
            ),
            3: _sub("Zero damping", Type.REAL32, "rw", default=0.1, low=0.0, high=10.0),
            4: _sub("Pole damping", Type.REAL32, "rw", default=0.7, low=0.001, high=10.0),
        },
    )


def _manufacturer() -> Iterator[ObjectEntry]:
    u16, u32 = Type.UNSIGNED16, Type.UNSIGNED32
    yield _record(
        0x2010,
        "Control loops",
        {
            1: _sub("Position P, 0.001 1/s", u32, "rw", default=10_000, high=10_000_000),
            2: _sub("Velocity P, 0.001 N m s/rad", u32, "rw", default=1_000, high=4_000_000_000),
            3: _sub("Velocity I, 0.001 N m/rad", u32, "rw", default=10_000, high=4_000_000_000),
            4: _sub("Velocity feed-forward, 0.001", u16, "rw", default=1_000, high=1_000),
            5: _sub("Inertia feed-forward, 1e-6 kg m2", u32, "rw", high=4_000_000_000),
            6: _sub(
                "Velocity filter cut-off, 0.001 Hz",
                u32,
                "rw",
                default=500_000,
                low=1_000,
                high=3_000_000,
            ),
        },
    )
    yield _torque_filter(0x2020, 1)
    yield _torque_filter(0x2021, 2)
    yield _var(0x2030, "Current loop bandwidth, Hz", u16, "ro", default=1_000)


def _offset(index: int, name: str, type_: Type) -> ObjectEntry:
    return _var(index, name, type_, "rw", mappable=True, stored=False)


def _drive() -> Iterator[ObjectEntry]:
    i8, i16, i32 = Type.INTEGER8, Type.INTEGER16, Type.INTEGER32
    u8, u16, u32 = Type.UNSIGNED8, Type.UNSIGNED16, Type.UNSIGNED32
    yield _var(0x6007, "Abort connection option code", i16, "rw", default=1, low=0, high=3)
    yield _var(0x603F, "Error code", u16, "ro", mappable=True)
    yield _var(0x6040, "Controlword", u16, "rw", mappable=True, stored=False)
    yield _var(0x6041, "Statusword", u16, "ro", mappable=True)
    yield _var(0x605A, "Quick stop option code", i16, "rw", default=2, choices=(0, 1, 2, 5, 6))
    yield _var(0x605B, "Shutdown option code", i16, "rw", default=0, low=0, high=1)
    yield _var(0x605C, "Disable operation option code", i16, "rw", default=1, low=0, high=1)
    yield _var(0x605D, "Halt option code", i16, "rw", default=1, low=1, high=2)
    yield _var(0x605E, "Fault reaction option code", i16, "rw", default=2, low=0, high=2)
    yield _var(
        0x6060,
        "Modes of operation",
        i8,
        "rw",
        default=1,
        mappable=True,
        stored=False,
        choices=(0, 1, 8, 9, 10),
    )
    yield _var(0x6061, "Modes of operation display", i8, "ro", default=1, mappable=True)
    yield _var(0x6064, "Position actual value", i32, "ro", mappable=True)
    yield _var(0x6065, "Following error window", u32, "rw", default=104_858)
    yield _var(0x6066, "Following error time out", u16, "rw", default=100)
    yield _var(0x6067, "Position window", u32, "rw", default=1_000)
    yield _var(0x606C, "Velocity actual value", i32, "ro", mappable=True)
    yield _var(0x6071, "Target torque", i16, "rw", mappable=True, stored=False)
    yield _var(0x6072, "Max torque", u16, "rw", default=2_000, mappable=True)
    yield _var(0x6074, "Torque demand", i16, "ro", mappable=True)
    yield _var(0x6076, "Motor rated torque", u32, "ro", default=10_000)
    yield _var(0x6077, "Torque actual value", i16, "ro", mappable=True)
    yield _var(0x607A, "Target position", i32, "rw", mappable=True, stored=False)
    yield _record(
        0x607D,
        "Software position limit",
        {
            1: _sub("Min position limit", i32, "rw", default=-(2**31)),
            2: _sub("Max position limit", i32, "rw", default=2**31 - 1),
        },
    )
    yield _var(0x607F, "Max profile velocity", u32, "rw", default=10_485_760, low=1)
    yield _var(0x6080, "Max motor speed", u32, "rw", default=52_428_800, low=1)
    yield _var(0x6081, "Profile velocity", u32, "rw", default=1_048_576, low=1, mappable=True)
    yield _var(0x6083, "Profile acceleration", u32, "rw", default=10_485_760, low=1, mappable=True)
    yield _var(0x6084, "Profile deceleration", u32, "rw", default=10_485_760, low=1, mappable=True)
    yield _var(0x6085, "Quick stop deceleration", u32, "rw", default=52_428_800, low=1)
    yield _record(
        0x608F,
        "Position encoder resolution",
        {
            1: _sub("Encoder increments", u32, "ro", default=2**20),
            2: _sub("Motor revolutions", u32, "ro", default=1),
        },
    )
    yield _record(
        0x6091,
        "Gear ratio",
        {
            1: _sub("Motor revolutions", u32, "ro", default=1),
            2: _sub("Shaft revolutions", u32, "ro", default=1),
        },
    )
    yield _offset(0x60B0, "Position offset", i32)
    yield _offset(0x60B1, "Velocity offset", i32)
    yield _offset(0x60B2, "Torque offset", i16)
    yield _record(
        0x60C2,
        "Interpolation time period",
        {
            1: _sub("Interpolation time period value", u8, "rw", default=1, low=1),
            2: _sub("Interpolation time index", i8, "rw", default=-3, low=-6, high=-1),
        },
    )
    yield _var(0x60F4, "Following error actual value", i32, "ro", mappable=True)
    yield _var(0x60FF, "Target velocity", i32, "rw", mappable=True, stored=False)
    yield _var(0x6502, "Supported drive modes", u32, "const", default=0x381)


OBJECTS: tuple[ObjectEntry, ...] = tuple(
    sorted(
        (*_communication(), *_process_data(), *_manufacturer(), *_drive()), key=lambda o: o.index
    )
)
"""Every object of the drive, by index."""

ENTRIES: dict[tuple[int, int], Entry] = {e.key: e for o in OBJECTS for e in o.entries}
"""Every entry, by index and sub-index."""
