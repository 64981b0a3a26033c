"""SDO frames put together to transfers (CiA 301, clause 7.2.4.3), as somebody who listens sees them."""

from dataclasses import dataclass
from typing import Literal

from drives.errors import ABORT_CODES
from drives.objects import ObjectAddress

LARGEST = 1_000_000
"""Bytes of a transfer that are put together; what is longer is followed without them."""


@dataclass(frozen=True)
class SdoStep:
    """What one SDO frame says."""

    what: Literal["read", "write", "value", "written", "segment", "abort", "other"]
    """``value``: what was read has come whole; ``written``: a write was confirmed whole."""
    address: ObjectAddress | None = None
    data: bytes | None = None
    """Of ``write`` where it is known already, of ``value`` and ``written``."""
    abort: int | None = None
    """SDO abort code."""

    @property
    def abort_text(self) -> str:
        """The abort code in words."""
        code = self.abort or 0
        return f"{ABORT_CODES.get(code, 'meaning unknown')} (0x{code:08X})"


class SdoChannel:
    """The transfers of one node."""

    def __init__(self) -> None:
        self._address: ObjectAddress | None = None
        self._writing = False
        self._data: bytearray | None = None
        """Collected so far; None while there is nothing to collect."""
        self._last = False
        """Whether the segment under way is the last one."""

    def request(self, data: bytes) -> SdoStep:
        """Take a frame from the client."""
        if len(data) != 8:
            return SdoStep("other")
        command, specifier = data[0], data[0] >> 5
        if specifier == 2:
            self._begin(data, writing=False)
            return SdoStep("read", self._address)
        if specifier == 1:
            self._begin(data, writing=True)
            if command & 0x02:
                self._data = bytearray(_expedited(data))
                return SdoStep("write", self._address, bytes(self._data))
            return SdoStep("write", self._address)
        if specifier == 0 and self._writing:
            self._collect(data)
            return SdoStep("segment", self._address)
        if specifier == 3:
            return SdoStep("segment", self._address)
        if specifier == 4:
            return self._aborted(data)
        return SdoStep("other", self._address)

    def answer(self, data: bytes) -> SdoStep:
        """Take a frame from the server."""
        if len(data) != 8:
            return SdoStep("other")
        command, specifier = data[0], data[0] >> 5
        if specifier == 4:
            return self._aborted(data)
        if specifier == 2:
            address = _address(data)
            if command & 0x02:
                return self._ended("value", address, bytes(_expedited(data)))
            self._address, self._data, self._writing = address, bytearray(), False
            return SdoStep("segment", address)
        if specifier == 0 and not self._writing:
            self._collect(data)
            if self._last:
                return self._ended("value", self._address, bytes(self._data or b""))
            return SdoStep("segment", self._address)
        if specifier == 3:
            address = _address(data)
            if self._data:
                return self._ended("written", address, bytes(self._data))
            return SdoStep("segment", address)
        if specifier == 1:
            if self._last:
                return self._ended("written", self._address, bytes(self._data or b""))
            return SdoStep("segment", self._address)
        return SdoStep("other", self._address)

    def _begin(self, data: bytes, *, writing: bool) -> None:
        self._address, self._writing = _address(data), writing
        self._data, self._last = bytearray(), False

    def _collect(self, data: bytes) -> None:
        self._last = bool(data[0] & 0x01)
        if self._data is not None and len(self._data) < LARGEST:
            self._data += data[1 : 8 - (data[0] >> 1 & 0x07)]

    def _ended(
        self, what: Literal["value", "written"], address: ObjectAddress | None, data: bytes
    ) -> SdoStep:
        self._data, self._last = None, False
        return SdoStep(what, address, data)

    def _aborted(self, data: bytes) -> SdoStep:
        self._data, self._last = None, False
        return SdoStep("abort", _address(data), abort=int.from_bytes(data[4:8], "little"))


def _address(data: bytes) -> ObjectAddress:
    return ObjectAddress(int.from_bytes(data[1:3], "little"), data[3])


def _expedited(data: bytes) -> bytes:
    """Return the bytes of an expedited transfer; all four where their number is not given."""
    unused = data[0] >> 2 & 0x03 if data[0] & 0x01 else 0
    return data[4 : 8 - unused]
