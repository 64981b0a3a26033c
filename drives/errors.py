"""What drives, buses and their profiles can do wrong, as a tree.

::

    DrivesError
    ├── ProfileError              a profile is wrong: file, line, key, value, what to do
    ├── BusError                  the bus can not be opened, or is gone
    ├── NothingMovedError         refused before any motion
    │   ├── NodeAbsentError       no answer from a node
    │   ├── WrongDeviceError      another device than the profile says
    │   ├── NotSupportedError     the drive has no such mode or object
    │   ├── DriveFaultError       the drive is in fault, or does not follow the controlword
    │   └── LimitsError           limits missing, or the cycle does not fit the bus
    ├── SdoError                  an object could not be read or written
    │   ├── SdoAbortError         the drive refused: abort code and its meaning
    │   └── SdoTimeoutError       the drive did not answer
    ├── StoppedError              the machine was stopped while it moved
    │   ├── SafetyStopError       by a limit or a fault
    │   │   └── OscillationError  by the watch for loops that swing or run by themselves
    │   └── UserStopError         by the user
    ├── NotVerifiedError          new parameters did not stand the test on the machine
    ├── WriteBackError            writing failed and everything was restored
    └── WriteBackMixedError       writing failed and could not be restored
"""

from collections.abc import Collection, Mapping
from pathlib import Path

STOPPED_AT_REST = "stopped by the user; no axis was moving, all are disabled."
MAY_BE_ENABLED = "MAY STILL BE ENABLED"
"""In every sentence of a drive that may not have taken the command to switch off."""
LONGEST = 1000
"""Characters of a message about a profile."""


def may_be_enabled(error: BaseException) -> bool:
    """Whether an error, or a note of it, says that a drive may not have switched off."""
    return any(MAY_BE_ENABLED in text for text in (str(error), *getattr(error, "__notes__", ())))


class DrivesError(Exception):
    """Root; the message is one sentence for a person."""


class ProfileError(DrivesError):
    """A profile is not what it should be."""

    def __init__(self, path: Path | str, message: str, line: int | None = None) -> None:
        self.path, self.line = Path(path), line
        shown = "".join(c if c.isprintable() else " " for c in message)  # the file's words, perhaps
        if len(shown) > LONGEST:
            shown = f"{shown[: LONGEST // 2]} ... {shown[-LONGEST // 2 :]}"
        super().__init__(f"{path}:{line}: {shown}" if line else f"{path}: {shown}")


class BusError(DrivesError):
    """The bus can not be opened, or does not carry frames any more."""


class NothingMovedError(DrivesError):
    """Refused before any motion."""


class NodeAbsentError(NothingMovedError):
    """No answer from a node."""


class WrongDeviceError(NothingMovedError):
    """The node is another device than the profile says."""


class NotSupportedError(NothingMovedError):
    """The drive has no such mode or object."""


class DriveFaultError(NothingMovedError):
    """The drive is in fault, or does not reach the state asked for."""


class LimitsError(NothingMovedError):
    """A limit is missing or would be left, or the cycle does not fit the bus."""


class SdoError(DrivesError):
    """An object could not be read or written."""

    def __init__(self, axis: str, index: int, subindex: int, message: str) -> None:
        self.axis, self.index, self.subindex = axis, index, subindex
        self.what = message
        """The message without its place."""
        super().__init__(f"{axis}, object 0x{index:04X}:{subindex:02X}: {message}")


class SdoAbortError(SdoError):
    """The drive refused, with an SDO abort code (CiA 301, table of abort codes)."""

    def __init__(self, axis: str, index: int, subindex: int, code: int, verb: str) -> None:
        self.code = code
        self.why = f"{ABORT_CODES.get(code, 'meaning unknown')} (0x{code:08X})"
        """The code and its meaning."""
        super().__init__(axis, index, subindex, f"the drive refused to {verb} it: {self.why}.")


class SdoTimeoutError(SdoError):
    """The drive did not answer within the time-out."""


class StoppedError(DrivesError):
    """The machine was stopped while it moved; what was recorded until then is kept."""

    capture: object = None
    """``drives.api.Capture`` of the stream that was cut short, if there was one."""


class SafetyStopError(StoppedError):
    """A limit was passed, or a drive failed, while the machine moved; all axes were stopped."""

    def __init__(
        self,
        message: str,
        *,
        axis: str | None = None,
        cycle: int | None = None,
        runaway: bool = False,
        power_off: Collection[str] = (),
        held_up: float = 0.0,
    ) -> None:
        self.axis, self.cycle = axis, cycle
        self.held_up = held_up
        """Seconds by which the host began a cycle of moving targets late, if that alone may have done
        it; else 0, also where drives miss a host that is so late."""
        self.runaway = runaway
        """The axis moves by itself: a quick stop may make it worse, its power is cut at once."""
        self.power_off = frozenset(power_off) | ({axis} if runaway and axis else frozenset())
        """All axes of which that is so."""
        super().__init__(message)


class OscillationError(SafetyStopError):
    """An axis swings, runs or pushes by itself, as with gains that do not fit; its power was cut."""


class UserStopError(StoppedError):
    """The user asked to stop; all axes were stopped."""


class NotVerifiedError(DrivesError):
    """New parameters did not stand the test on the machine; what is written is taken back."""


class WriteBackError(DrivesError):
    """Writing parameters failed; every drive holds its old values again."""


class WriteBackMixedError(DrivesError):
    """Writing parameters failed and not everything could be restored."""

    def __init__(self, message: str, holds: Mapping[str, str]) -> None:
        self.holds = dict(holds)
        super().__init__(message)


ABORT_CODES = {
    0x05030000: "toggle bit not alternated",
    0x05040000: "SDO protocol timed out",
    0x05040001: "command specifier not valid",
    0x05040002: "invalid block size",
    0x05040003: "invalid sequence number",
    0x05040004: "CRC error",
    0x05040005: "out of memory",
    0x06010000: "access not supported",
    0x06010001: "the object is write-only",
    0x06010002: "the object is read-only",
    0x06020000: "the object does not exist",
    0x06040041: "the object can not be mapped to the PDO",
    0x06040042: "the mapped objects exceed the PDO's length",
    0x06040043: "general parameter incompatibility",
    0x06040047: "general internal incompatibility",
    0x06060000: "hardware error",
    0x06070010: "length of the value does not match",
    0x06070012: "the value is too long",
    0x06070013: "the value is too short",
    0x06090011: "the sub-index does not exist",
    0x06090030: "the value is not allowed",
    0x06090031: "the value is too high",
    0x06090032: "the value is too low",
    0x06090036: "maximum is less than minimum",
    0x060A0023: "resource not available",
    0x08000000: "general error",
    0x08000020: "data can not be transferred or stored",
    0x08000021: "data can not be stored because of local control",
    0x08000022: "not in the present state of the drive",
    0x08000023: "no object dictionary",
    0x08000024: "no data available",
}
"""SDO abort code: meaning (CiA 301, clause 7.2.4.3.17)."""
