"""CiA 402 power states of the simulated drive: states, commands and transitions as a table.

Written from IEC 61800-7-201 for the drive's side; it shares nothing with the host's tables.
Numbers of transitions are the standard's::

    1 NOT READY -> SWITCH ON DISABLED         9 OPERATION ENABLED -> SWITCH ON DISABLED
    2 SWITCH ON DISABLED -> READY            10 SWITCHED ON -> SWITCH ON DISABLED
    3 READY -> SWITCHED ON                   11 OPERATION ENABLED -> QUICK STOP ACTIVE
    4 SWITCHED ON -> OPERATION ENABLED       12 QUICK STOP ACTIVE -> SWITCH ON DISABLED
    5 OPERATION ENABLED -> SWITCHED ON       13 any -> FAULT REACTION ACTIVE
    6 SWITCHED ON -> READY                   14 FAULT REACTION ACTIVE -> FAULT
    7 READY -> SWITCH ON DISABLED            15 FAULT -> SWITCH ON DISABLED
    8 OPERATION ENABLED -> READY             16 QUICK STOP ACTIVE -> OPERATION ENABLED
"""

from enum import Enum, IntFlag


class State(Enum):
    """Power states; the value is the statusword's bits 0-3, 5 and 6."""

    NOT_READY_TO_SWITCH_ON = 0b000_0000
    SWITCH_ON_DISABLED = 0b100_0000
    READY_TO_SWITCH_ON = 0b010_0001
    SWITCHED_ON = 0b010_0011
    OPERATION_ENABLED = 0b010_0111
    QUICK_STOP_ACTIVE = 0b000_0111
    FAULT_REACTION_ACTIVE = 0b000_1111
    FAULT = 0b000_1000


class Status(IntFlag):
    """Bits of the statusword that do not belong to the power state."""

    VOLTAGE_ENABLED = 1 << 4
    WARNING = 1 << 7
    REMOTE = 1 << 9
    TARGET_REACHED = 1 << 10
    INTERNAL_LIMIT = 1 << 11
    MODE_12 = 1 << 12
    """Profile position: set-point acknowledged; cyclic modes: drive follows the command."""
    FOLLOWING_ERROR = 1 << 13


class Control(IntFlag):
    """Bits of the controlword."""

    SWITCH_ON = 1 << 0
    ENABLE_VOLTAGE = 1 << 1
    NO_QUICK_STOP = 1 << 2
    ENABLE_OPERATION = 1 << 3
    NEW_SET_POINT = 1 << 4
    CHANGE_IMMEDIATELY = 1 << 5
    RELATIVE = 1 << 6
    FAULT_RESET = 1 << 7
    HALT = 1 << 8


class Command(Enum):
    """What bits 0-3 and 7 of the controlword ask for."""

    DISABLE_VOLTAGE = "disable voltage"
    QUICK_STOP = "quick stop"
    SHUTDOWN = "shutdown"
    SWITCH_ON = "switch on"
    ENABLE_OPERATION = "enable operation"
    FAULT_RESET = "fault reset"


def command_of(controlword: int, before: int) -> Command:
    """Return the command in a controlword; ``before`` is the one written before it.

    A fault is reset by the rising edge of bit 7 only; bit 7 that stays set says nothing.
    """
    if controlword & ~before & Control.FAULT_RESET:
        return Command.FAULT_RESET
    if not controlword & Control.ENABLE_VOLTAGE:
        return Command.DISABLE_VOLTAGE
    if not controlword & Control.NO_QUICK_STOP:
        return Command.QUICK_STOP
    if not controlword & Control.SWITCH_ON:
        return Command.SHUTDOWN
    if not controlword & Control.ENABLE_OPERATION:
        return Command.SWITCH_ON
    return Command.ENABLE_OPERATION


_DISABLED, _READY, _ON = State.SWITCH_ON_DISABLED, State.READY_TO_SWITCH_ON, State.SWITCHED_ON
_ENABLED, _STOPPING = State.OPERATION_ENABLED, State.QUICK_STOP_ACTIVE

TRANSITIONS: dict[tuple[State, Command], State] = {
    (_DISABLED, Command.SHUTDOWN): _READY,  # 2
    (_READY, Command.SWITCH_ON): _ON,  # 3
    (_READY, Command.ENABLE_OPERATION): _ENABLED,  # 3 and 4 in one
    (_READY, Command.QUICK_STOP): _DISABLED,  # 7
    (_READY, Command.DISABLE_VOLTAGE): _DISABLED,  # 7
    (_ON, Command.ENABLE_OPERATION): _ENABLED,  # 4
    (_ON, Command.SHUTDOWN): _READY,  # 6
    (_ON, Command.QUICK_STOP): _DISABLED,  # 10
    (_ON, Command.DISABLE_VOLTAGE): _DISABLED,  # 10
    (_ENABLED, Command.SWITCH_ON): _ON,  # 5, disable operation
    (_ENABLED, Command.SHUTDOWN): _READY,  # 8
    (_ENABLED, Command.DISABLE_VOLTAGE): _DISABLED,  # 9
    (_ENABLED, Command.QUICK_STOP): _STOPPING,  # 11
    (_STOPPING, Command.DISABLE_VOLTAGE): _DISABLED,  # 12
    (_STOPPING, Command.ENABLE_OPERATION): _ENABLED,  # 16
    (State.FAULT, Command.FAULT_RESET): _DISABLED,  # 15
}
"""State and command: next state.  What is not listed changes nothing."""
