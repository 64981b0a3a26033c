"""Objects of CiA 301 and CiA 402 that the tool uses, and how their values look on the wire."""

import struct
from dataclasses import dataclass
from math import isfinite
from typing import Literal, get_args

DataType = Literal[
    "BOOLEAN",
    "INTEGER8",
    "INTEGER16",
    "INTEGER32",
    "INTEGER64",
    "UNSIGNED8",
    "UNSIGNED16",
    "UNSIGNED32",
    "UNSIGNED64",
    "REAL32",
    "REAL64",
    "VISIBLE_STRING",
]
DATA_TYPES: tuple[DataType, ...] = get_args(DataType)
_LAYOUT = {
    "BOOLEAN": "<?",
    "INTEGER8": "<b",
    "INTEGER16": "<h",
    "INTEGER32": "<i",
    "INTEGER64": "<q",
    "UNSIGNED8": "<B",
    "UNSIGNED16": "<H",
    "UNSIGNED32": "<I",
    "UNSIGNED64": "<Q",
    "REAL32": "<f",
    "REAL64": "<d",
}


@dataclass(frozen=True, order=True)
class ObjectAddress:
    """Index and sub-index of an object dictionary entry."""

    index: int
    subindex: int = 0

    def __str__(self) -> str:
        return f"0x{self.index:04X}:{self.subindex:02X}"

    @property
    def short(self) -> str:
        """As manuals write it: without a sub-index where that is 0."""
        return str(self) if self.subindex else f"0x{self.index:04X}"

    @classmethod
    def parse(cls, text: str) -> "ObjectAddress":
        """Read ``0x2010:01`` or ``0x6072``.

        Raises
        ------
        ValueError
            If the text is no such address.
        """
        index_text, colon, sub_text = text.partition(":")
        try:
            index, sub = int(index_text, 16), int(sub_text, 16) if colon else 0
        except ValueError:
            raise ValueError(
                f"{text!r} is no object address; write it as 0x2010:01 (hexadecimal)"
            ) from None
        if not (0x0001 <= index <= 0xFFFF and 0 <= sub <= 0xFF):
            raise ValueError(f"{text!r} is outside 0x0001:00 to 0xFFFF:FF")
        return cls(index, sub)


@dataclass(frozen=True)
class ObjectInfo:
    """One dictionary entry: where it is and how its value is coded."""

    address: ObjectAddress
    type: DataType
    name: str

    def encode(self, value: float | str) -> bytes:
        """Return the value's bytes.

        Raises
        ------
        ValueError
            If the value does not fit the type: out of range, not whole, or not finite.
        """
        return encode(self.type, value)

    def decode(self, data: bytes) -> int | float | str:
        """Return the value of these bytes; raise ValueError if their number is wrong."""
        return decode(self.type, data)


def encode(data_type: DataType, value: float | str) -> bytes:
    """Return a value's bytes in little endian (CiA 301, clause 7.1).

    Raises
    ------
    ValueError
        If the value does not fit the type: out of range, not whole, or not finite.
    """
    if data_type == "VISIBLE_STRING":
        try:
            return str(value).encode("ascii")
        except UnicodeEncodeError:
            raise ValueError(f"{data_type} needs plain ASCII, got {value!r}") from None
    if isinstance(value, str):
        raise ValueError(f"{data_type} needs a number, got {value!r}")  # noqa: TRY004
    number: int | float = value
    if isinstance(value, float) and not isfinite(value):
        raise ValueError(f"{data_type} needs a finite number, got {value!r}")
    if not data_type.startswith("REAL"):
        if value != int(value):
            raise ValueError(f"{data_type} needs a whole number, got {value!r}")
        number = int(value)
        low, high = type_range(data_type)
        if not low <= number <= high:
            raise ValueError(f"{number} is outside {data_type}'s range {low} to {high}")
    try:
        return struct.pack(_LAYOUT[data_type], number)
    except (struct.error, OverflowError):
        raise ValueError(f"{value!r} does not fit {data_type}") from None


def decode(data_type: DataType, data: bytes) -> int | float | str:
    """Return the value of these bytes.

    Raises
    ------
    ValueError
        If there are too few or too many bytes.
    """
    if data_type == "VISIBLE_STRING":
        return data.rstrip(b"\0").decode("ascii", errors="replace")
    layout = _LAYOUT[data_type]
    if len(data) != struct.calcsize(layout):
        raise ValueError(
            f"{data_type} has {struct.calcsize(layout)} bytes, the drive sent {len(data)}"
        )
    value: int | float = struct.unpack(layout, data)[0]
    return value


def type_range(data_type: DataType) -> tuple[int, int]:
    """Return the smallest and the largest value of a whole-number type.

    Raises
    ------
    ValueError
        If it is none.
    """
    if data_type == "BOOLEAN":
        return 0, 1
    if not data_type.startswith(("INTEGER", "UNSIGNED")):
        raise ValueError(f"{data_type} is no whole-number type")
    bits = type_bits(data_type)
    if data_type.startswith("UNSIGNED"):
        return 0, 2**bits - 1
    return -(2 ** (bits - 1)), 2 ** (bits - 1) - 1


def type_bits(data_type: DataType) -> int:
    """Return the number of bits that a fixed-length type takes in a PDO.

    Raises
    ------
    ValueError
        If the type has no fixed length, as texts have none.
    """
    if data_type not in _LAYOUT:
        raise ValueError(f"{data_type} has no fixed length")
    return 8 * struct.calcsize(_LAYOUT[data_type])


def _standard(index: int, subindex: int, data_type: DataType, name: str) -> ObjectInfo:
    return ObjectInfo(ObjectAddress(index, subindex), data_type, name)


DEVICE_TYPE = _standard(0x1000, 0, "UNSIGNED32", "device type")
ERROR_REGISTER = _standard(0x1001, 0, "UNSIGNED8", "error register")
ERROR_COUNT = _standard(0x1003, 0, "UNSIGNED8", "number of errors")
DEVICE_NAME = _standard(0x1008, 0, "VISIBLE_STRING", "manufacturer device name")
FIRMWARE_VERSION = _standard(0x100A, 0, "VISIBLE_STRING", "manufacturer software version")
STORE_ALL = _standard(0x1010, 1, "UNSIGNED32", "store all parameters")
CONSUMER_HEARTBEAT = _standard(0x1016, 1, "UNSIGNED32", "consumer heartbeat time")
PRODUCER_HEARTBEAT = _standard(0x1017, 0, "UNSIGNED16", "producer heartbeat time")
VENDOR_ID = _standard(0x1018, 1, "UNSIGNED32", "vendor-ID")
PRODUCT_CODE = _standard(0x1018, 2, "UNSIGNED32", "product code")
REVISION = _standard(0x1018, 3, "UNSIGNED32", "revision number")
SERIAL_NUMBER = _standard(0x1018, 4, "UNSIGNED32", "serial number")
ERROR_BEHAVIOUR = _standard(0x1029, 1, "UNSIGNED8", "communication error behaviour")
ABORT_CONNECTION = _standard(0x6007, 0, "INTEGER16", "abort connection option code")
CONTROLWORD = _standard(0x6040, 0, "UNSIGNED16", "controlword")
STATUSWORD = _standard(0x6041, 0, "UNSIGNED16", "statusword")
QUICK_STOP_OPTION = _standard(0x605A, 0, "INTEGER16", "quick stop option code")
MODE = _standard(0x6060, 0, "INTEGER8", "modes of operation")
MODE_DISPLAY = _standard(0x6061, 0, "INTEGER8", "modes of operation display")
POSITION_ACTUAL = _standard(0x6064, 0, "INTEGER32", "position actual value")
TARGET_TORQUE = _standard(0x6071, 0, "INTEGER16", "target torque")
RATED_TORQUE = _standard(0x6076, 0, "UNSIGNED32", "motor rated torque")
TORQUE_ACTUAL = _standard(0x6077, 0, "INTEGER16", "torque actual value")
TARGET_POSITION = _standard(0x607A, 0, "INTEGER32", "target position")
ENCODER_COUNTS = _standard(0x608F, 1, "UNSIGNED32", "encoder increments")
ENCODER_REVOLUTIONS = _standard(0x608F, 2, "UNSIGNED32", "motor revolutions")
GEAR_MOTOR = _standard(0x6091, 1, "UNSIGNED32", "gear: motor revolutions")
GEAR_SHAFT = _standard(0x6091, 2, "UNSIGNED32", "gear: shaft revolutions")
FEED_CONSTANT = _standard(0x6092, 1, "UNSIGNED32", "feed constant: feed")
FEED_REVOLUTIONS = _standard(0x6092, 2, "UNSIGNED32", "feed constant: shaft revolutions")
VELOCITY_UNIT = _standard(0x60A9, 0, "UNSIGNED32", "SI unit velocity")
INTERPOLATION_VALUE = _standard(0x60C2, 1, "UNSIGNED8", "interpolation time period value")
INTERPOLATION_INDEX = _standard(0x60C2, 2, "INTEGER8", "interpolation time index")
FOLLOWING_ERROR_WINDOW = _standard(0x6065, 0, "UNSIGNED32", "following error window")
MAX_TORQUE = _standard(0x6072, 0, "UNSIGNED16", "max torque")
SOFTWARE_LIMIT_LOW = _standard(0x607D, 1, "INTEGER32", "min software position limit")
SOFTWARE_LIMIT_HIGH = _standard(0x607D, 2, "INTEGER32", "max software position limit")
MAX_PROFILE_VELOCITY = _standard(0x607F, 0, "UNSIGNED32", "max profile velocity")
MAX_MOTOR_SPEED = _standard(0x6080, 0, "UNSIGNED32", "max motor speed")
VELOCITY_UNIT = _standard(0x60A9, 0, "UNSIGNED32", "SI unit velocity")
MAX_ACCELERATION = _standard(0x60C5, 0, "UNSIGNED32", "max acceleration")
SUPPORTED_MODES = _standard(0x6502, 0, "UNSIGNED32", "supported drive modes")
SYNC_PERIOD = _standard(0x1006, 0, "UNSIGNED32", "communication cycle period")

COMMANDS = frozenset(
    {
        0x1003,
        0x1010,
        0x1011,
        0x6040,
        0x6060,
        0x6071,
        0x607A,
        0x60B0,
        0x60B1,
        0x60B2,
        0x60C1,
        0x60FE,
        0x60FF,
    }
)
"""Indexes of writable objects that command something (motion, outputs, storing) on every drive:
they are never backed up nor restored, whatever a profile says."""
