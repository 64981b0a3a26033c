"""Who else commands: frames on the bus that only the host may send.

Two masters must not command one machine.  Before a motion a foreign SYNC, heartbeat or target refuses
it; while axes move, any such frame stops them, and so do NMT commands and SDO downloads to the drives:
nobody knows what the other one does next.  Reading objects is harmless, and time stamps are.
"""

from collections.abc import Iterable, Sequence

import can

from drives.bus import is_data
from drives.canopen_drive.drive import CanopenDrive

SYNC_ID, NMT_ID, HEARTBEAT_ID, REQUEST_ID = 0x080, 0x000, 0x700, 0x600
TARGET_IDS = (0x200, 0x300, 0x400, 0x500)
_DOWNLOAD, _BLOCK_DOWNLOAD = 1, 6
_NMT_WORDS = {0x01: "start", 0x02: "stop", 0x80: "pre-operational", 0x81: "reset", 0x82: "reset"}
_NMT_BYTES, _REQUEST_BYTES = 2, 4


def commands(drives: Iterable[CanopenDrive], host: int) -> dict[int, str]:
    """Return the identifiers that only the host sends cyclically, and what they are, in words."""
    found = {SYNC_ID: "a SYNC", HEARTBEAT_ID + host: "the host's own heartbeat"}
    for drive in drives:
        for base in TARGET_IDS:
            found[base + drive.node_id] = f"targets (a PDO) for {drive.axis}"
    return found


class Strangers:
    """Tells frames of somebody else's that command the drives of a machine."""

    def __init__(self, drives: Sequence[CanopenDrive], host: int) -> None:
        self._cyclic = commands(drives, host)
        self._axes = {drive.node_id: drive.axis for drive in drives}

    @property
    def identifiers(self) -> tuple[int, ...]:
        """Identifiers of frames that could be a stranger's."""
        requests = (REQUEST_ID + node_id for node_id in self._axes)
        return (NMT_ID, *self._cyclic, *requests)

    def command(self, message: can.Message) -> str:
        """Return what a frame commands, in words; empty if it is harmless, or the host's own echo."""
        if not (message.is_rx and is_data(message)):
            return ""
        identifier, data = message.arbitration_id, bytes(message.data)
        if identifier == NMT_ID:
            return self._nmt(data)
        if identifier - REQUEST_ID in self._axes:
            return self._download(identifier - REQUEST_ID, data)
        return self._cyclic.get(identifier, "")

    def _nmt(self, data: bytes) -> str:
        if len(data) != _NMT_BYTES or data[1] not in (0, *self._axes) or data[0] not in _NMT_WORDS:
            return ""
        whom = self._axes.get(data[1], "all nodes")
        return f"the NMT command {_NMT_WORDS[data[0]]} (0x{data[0]:02X}) to {whom}"

    def _download(self, node_id: int, data: bytes) -> str:
        if len(data) < _REQUEST_BYTES or data[0] >> 5 not in (_DOWNLOAD, _BLOCK_DOWNLOAD):
            return ""
        index = int.from_bytes(data[1:3], "little")
        return f"a write to object 0x{index:04X}:{data[3]:02X} of {self._axes[node_id]}"
