"""Emergency messages, error register 0x1001, error history 0x1003 and error code 0x603F."""

import struct
from collections import deque
from collections.abc import Callable
from enum import IntFlag

from drives.sim.abort_codes import Abort
from drives.sim.dictionary import DriveDictionary
from drives.sim.entries import HISTORY_LENGTH, NOT_VALID


class ErrorRegister(IntFlag):
    """Bits of object 0x1001."""

    GENERIC = 1 << 0
    CURRENT = 1 << 1
    VOLTAGE = 1 << 2
    TEMPERATURE = 1 << 3
    COMMUNICATION = 1 << 4
    DEVICE_PROFILE = 1 << 5
    MANUFACTURER = 1 << 7


HEARTBEAT_LOST = 0x8130
PDO_TOO_SHORT = 0x8210
FOLLOWING_ERROR = 0x8611
NO_ERROR = 0x0000


class EmergencyProducer:
    """Tells the bus of errors, once each, and of their end."""

    def __init__(self, dictionary: DriveDictionary, send: Callable[[int, bytes], None]) -> None:
        self._dictionary, self._send = dictionary, send
        self._active: dict[int, int] = {}
        self._history: deque[int] = deque(maxlen=HISTORY_LENGTH)
        dictionary.set_read_callback(0x1001, 0, lambda: self.register)
        dictionary.set_read_callback(0x1003, 0, lambda: len(self._history))
        for k in range(1, HISTORY_LENGTH + 1):
            dictionary.set_read_callback(0x1003, k, lambda k=k: self._past(k))
        dictionary.guards[0x1003, 0] = lambda value: Abort.INVALID_VALUE if value else None
        dictionary.effects[0x1003, 0] = lambda _: self._history.clear()
        dictionary.guards[0x1014, 0] = self._refuse_cob_id

    @property
    def register(self) -> int:
        """Error register: bits of all errors that are active."""
        bits = 0
        for each in self._active.values():
            bits |= each
        return bits | ErrorRegister.GENERIC if bits else 0

    @property
    def active(self) -> tuple[int, ...]:
        """Codes of the errors that are active, oldest first."""
        return tuple(self._active)

    def report(self, code: int, bits: int, data: bytes = b"") -> None:
        """Send an emergency and keep it: bits of the error register, five bytes of the maker's.

        An error that is active already is not sent again.
        """
        if code in self._active:
            return
        self._active[code] = int(bits)
        self._history.appendleft(code | int.from_bytes(data[:2], "little") << 16)
        self._dictionary.force(0x603F, 0, code)
        self._transmit(code, data)

    def clear(self, code: int | None = None) -> None:
        """End one error, or all; tell the bus (code 0x0000 and what is left of the register)."""
        if code is None:
            ended = bool(self._active)
            self._active.clear()
        else:
            ended = self._active.pop(code, None) is not None
        if not ended:
            return
        newest = next(reversed(self._active), NO_ERROR)
        self._dictionary.force(0x603F, 0, newest)
        self._transmit(NO_ERROR, b"")

    def power_up(self) -> None:
        """Forget all errors and their history without a word, as a drive does that is switched on."""
        self._active.clear()
        self._history.clear()

    def _past(self, k: int) -> int:
        return self._history[k - 1] if k <= len(self._history) else 0

    def _transmit(self, code: int, data: bytes) -> None:
        cob_id = int(self._dictionary.read(0x1014, 0))
        if not cob_id & NOT_VALID:
            frame = struct.pack("<HB5s", code, self.register, data)
            self._send(cob_id & 0x7FF, frame)

    def _refuse_cob_id(self, value: int) -> int | None:
        before = int(self._dictionary.read(0x1014, 0))
        return refuse_cob_id(value, before)


def refuse_cob_id(value: int, before: int) -> int | None:
    """Return why a COB-ID must not be written over another, as an abort code; None if it may.

    Bit 31 set means not valid; while it is clear, before and after, the identifier must not change
    (CiA 301, clause 7.5.2.17).  Identifiers of 29 bits are not supported, and those that CiA 301
    keeps for other services are refused.
    """
    identifier = value & 0x1FFFFFFF
    if value & (1 << 29) or identifier > 0x7FF:
        return Abort.INVALID_VALUE
    if value & NOT_VALID:
        return None
    if _is_restricted(identifier):
        return Abort.INVALID_VALUE
    if not before & NOT_VALID and identifier != before & 0x7FF:
        return Abort.WRONG_STATE
    return None


def _is_restricted(identifier: int) -> bool:
    ranges = (
        (0x000, 0x07F),
        (0x101, 0x180),
        (0x581, 0x5FF),
        (0x601, 0x67F),
        (0x6E0, 0x6FF),
        (0x701, 0x7FF),
    )
    return any(low <= identifier <= high for low, high in ranges)
