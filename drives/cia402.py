"""CiA 402 power states, controlwords, statuswords and modes (IEC 61800-7-201)."""

from collections.abc import Iterable
from enum import Enum, IntEnum


class PowerState(Enum):
    """Name = (mask, value) of the statusword, object 0x6041."""

    NOT_READY_TO_SWITCH_ON = (0x4F, 0x00)
    SWITCH_ON_DISABLED = (0x4F, 0x40)
    READY_TO_SWITCH_ON = (0x6F, 0x21)
    SWITCHED_ON = (0x6F, 0x23)
    OPERATION_ENABLED = (0x6F, 0x27)
    QUICK_STOP_ACTIVE = (0x6F, 0x07)
    FAULT_REACTION_ACTIVE = (0x4F, 0x0F)
    FAULT = (0x4F, 0x08)

    @classmethod
    def of(cls, statusword: int) -> "PowerState":
        """Return the one state this statusword shows; raise ValueError if it shows none."""
        for state in cls:
            mask, value = state.value
            if statusword & mask == value:
                return state
        raise ValueError(f"statusword 0x{statusword:04X} is no CiA 402 state")

    @property
    def words(self) -> str:
        """The state in words, as on a drive's display."""
        return self.name.lower().replace("_", " ")


class Controlword(IntEnum):
    """Commands of object 0x6040."""

    DISABLE_VOLTAGE = 0x00
    QUICK_STOP = 0x02
    SHUTDOWN = 0x06
    SWITCH_ON = 0x07
    ENABLE_OPERATION = 0x0F
    FAULT_RESET = 0x80


class Mode(IntEnum):
    """Modes of operation, objects 0x6060 and 0x6061."""

    PROFILE_POSITION = 1
    CYCLIC_POSITION = 8
    CYCLIC_VELOCITY = 9
    CYCLIC_TORQUE = 10

    @property
    def supported_bit(self) -> int:
        """Bit of object 0x6502 that says the drive has this mode."""
        return 1 << (self.value - 1)

    @property
    def words(self) -> str:
        """The mode in words."""
        return self.name.lower().replace("_", " ")


MODE_WORDS = {
    1: "profile position",
    2: "velocity",
    3: "profile velocity",
    4: "profile torque",
    6: "homing",
    7: "interpolated position",
    8: "cyclic position",
    9: "cyclic velocity",
    10: "cyclic torque",
}
"""Modes of operation that CiA 402 defines, by number, in words."""


def modes_in(supported: int) -> frozenset[int]:
    """Return the numbers of CiA 402's modes that a value of 0x6502 offers."""
    return frozenset(mode for mode in MODE_WORDS if supported >> (mode - 1) & 1)


def in_words(modes: Iterable[int]) -> str:
    """Return modes in words, separated by commas."""
    return ", ".join(MODE_WORDS.get(m, f"mode {m}") for m in sorted(modes)) or "no mode of CiA 402"


STEP_TOWARDS_ENABLED = {  # state now: (controlword to send, state to wait for)
    PowerState.SWITCH_ON_DISABLED: (Controlword.SHUTDOWN, PowerState.READY_TO_SWITCH_ON),
    PowerState.READY_TO_SWITCH_ON: (Controlword.SWITCH_ON, PowerState.SWITCHED_ON),
    PowerState.SWITCHED_ON: (Controlword.ENABLE_OPERATION, PowerState.OPERATION_ENABLED),
}
"""State now: controlword to send, state to wait for."""

ENABLED_MASK, ENABLED_VALUE = PowerState.OPERATION_ENABLED.value

STATUS_FAULT = 1 << 3
STATUS_WARNING = 1 << 7
STATUS_INTERNAL_LIMIT = 1 << 11
STATUS_FOLLOWING_ERROR = 1 << 13

EMERGENCY_CLASSES = {
    0x00: "error reset or no error",
    0x10: "generic error",
    0x20: "current",
    0x21: "current, device input side",
    0x22: "current inside the device",
    0x23: "current, device output side",
    0x30: "voltage",
    0x31: "mains voltage",
    0x32: "voltage inside the device",
    0x33: "output voltage",
    0x40: "temperature",
    0x41: "ambient temperature",
    0x42: "device temperature",
    0x50: "device hardware",
    0x60: "device software",
    0x61: "internal software",
    0x62: "user software",
    0x63: "data set",
    0x70: "additional modules",
    0x73: "sensor",
    0x80: "monitoring",
    0x81: "communication",
    0x82: "protocol error",
    0x83: "torque control",
    0x84: "velocity control",
    0x85: "position control",
    0x86: "positioning controller",
    0x90: "external error",
    0xF0: "additional functions",
    0xFF: "device specific",
}
"""High byte of an emergency error code: meaning (CiA 301 table of codes, CiA 402 additions)."""

EMERGENCY_CODES = {
    0x8110: "CAN overrun",
    0x8120: "CAN in error passive mode",
    0x8130: "life guard or heartbeat error",
    0x8140: "recovered from bus off",
    0x8210: "PDO not processed because of its length",
    0x8220: "PDO length exceeded",
    0x8250: "RPDO time-out",
    0x8611: "following error",
    0x8612: "position reference limit",
}


def emergency_text(code: int) -> str:
    """Return an emergency error code in words."""
    meaning = EMERGENCY_CODES.get(code) or EMERGENCY_CLASSES.get(
        code >> 8, EMERGENCY_CLASSES.get((code >> 8) & 0xF0, "unknown class")
    )
    return f"0x{code:04X} ({meaning})"
