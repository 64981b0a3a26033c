"""SocketCAN as python-can has it, with what the kernel knows besides: lost frames, filters, room.

Receive time stamps are the kernel's, taken when the frame came in, however late the host looks.
"""

import contextlib
import errno
import select
import socket
import struct
import time
from collections.abc import Iterable
from typing import Any

import can
from can.interfaces.socketcan.socketcan import SocketcanBus

_SO_RCVBUFFORCE, _SO_RXQ_OVFL, _SO_TIMESTAMPNS = 33, 40, 35
_FRAME = struct.Struct("=IBxxx8s")
_STAMP, _COUNT = struct.Struct("@ll"), struct.Struct("=I")
_EXTENDED, _REMOTE, _ERROR = 0x80000000, 0x40000000, 0x20000000
_STANDARD_MASK, _EXTENDED_MASK = 0x7FF, 0x1FFFFFFF
BYTES_A_FRAME = 768
"""Of the receive buffer that a frame takes up in the kernel, about (measured: 278 in 212992)."""
QUEUE_PATIENCE, QUEUE_STEP = 0.01, 0.0001
"""Seconds for which a full transmit queue is waited for, and between two tries: a frame takes 0.1 ms
at 1 Mbit/s, and the queue of a CAN interface holds 10 frames if nobody makes it longer."""
WANTED_FRAMES = 4096
"""Frames that are to fit into the receive buffer: a full bus at 1 Mbit/s for half a second."""


class KernelBus(SocketcanBus):
    """A SocketCAN bus that counts the frames that its receive buffer had no room for.

    Parameters
    ----------
    channel
        Name of the interface.
    options
        As of python-can's class.
    """

    def __init__(self, channel: str = "", **options: Any) -> None:
        self.overruns = 0
        """Received frames that were lost since the bus was opened, as far as is known."""
        super().__init__(str(channel), **options)
        self._space = socket.CMSG_SPACE(_STAMP.size) + socket.CMSG_SPACE(_COUNT.size)
        self.socket.setsockopt(socket.SOL_SOCKET, _SO_RXQ_OVFL, 1)
        self._make_room()

    def _make_room(self) -> None:
        """Have the receive buffer hold ``WANTED_FRAMES``, or as many as this user may have."""
        wanted = WANTED_FRAMES * BYTES_A_FRAME // 2  # the kernel doubles it
        try:
            self.socket.setsockopt(socket.SOL_SOCKET, _SO_RCVBUFFORCE, wanted)
        except OSError:
            with contextlib.suppress(OSError):
                self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, wanted)

    @property
    def room(self) -> int:
        """Frames that fit into the receive buffer, about."""
        size = self.socket.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF)
        return int(size) // BYTES_A_FRAME

    def focus(self, identifiers: Iterable[int] | None) -> None:
        """Receive frames of these 11-bit identifiers only, and error frames; None: every frame."""
        if identifiers is None:
            self.set_filters(None)
            return
        self.set_filters(
            [
                {"can_id": identifier, "can_mask": _STANDARD_MASK, "extended": False}
                for identifier in sorted(identifiers)
            ]
        )

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Send a frame; a queue that is full for a moment is waited for.

        Raises
        ------
        can.CanOperationError
            If the interface is down, or its queue stays full.
        """
        patience = time.monotonic() + max(QUEUE_PATIENCE, timeout or 0.0)
        while True:
            try:
                super().send(msg, timeout)
            except can.CanOperationError as error:
                if error.error_code == errno.ENETDOWN:
                    raise can.CanOperationError(f"interface {self.channel} is down") from error
                if error.error_code != errno.ENOBUFS:
                    raise
                if time.monotonic() >= patience:
                    raise can.CanOperationError(
                        f"the transmit queue of {self.channel} is full. Does anybody acknowledge its "
                        "frames? If so, make it longer: "
                        f"`ip link set {self.channel} txqueuelen 1000`"
                    ) from error
                time.sleep(QUEUE_STEP)
            else:
                return

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        try:
            if not select.select([self.socket], [], [], timeout)[0]:
                return None, self._is_filtered
            raw, ancillary, flags, _ = self.socket.recvmsg(_FRAME.size, self._space)
        except OSError as error:
            where = f"interface {self.channel}"
            words = {errno.ENETDOWN: f"{where} is down", errno.ENODEV: f"{where} is gone"}
            said = words.get(error.errno or 0, f"{where}: {error.strerror}")
            raise can.CanOperationError(said, error.errno) from error
        if len(raw) < _FRAME.size:
            return None, self._is_filtered
        identifier, length, data = _FRAME.unpack(raw)
        is_extended = bool(identifier & _EXTENDED)
        message = can.Message(
            timestamp=self._read_ancillary(ancillary),
            arbitration_id=identifier & (_EXTENDED_MASK if is_extended else _STANDARD_MASK),
            is_extended_id=is_extended,
            is_remote_frame=bool(identifier & _REMOTE),
            is_error_frame=bool(identifier & _ERROR),
            is_rx=not flags & socket.MSG_DONTROUTE,
            dlc=length,
            data=b"" if identifier & _REMOTE else data[: min(length, 8)],
            channel=self.channel,
        )
        return message, self._is_filtered

    def _read_ancillary(self, ancillary: list[tuple[int, int, bytes]]) -> float:
        """Return the kernel's time stamp, s since 1970, and take note of lost frames."""
        stamp = 0.0
        for level, kind, data in ancillary:
            if level != socket.SOL_SOCKET:
                continue
            if kind == _SO_TIMESTAMPNS and len(data) >= _STAMP.size:
                seconds, nanoseconds = _STAMP.unpack_from(data)
                stamp = seconds + nanoseconds * 1e-9
            elif kind == _SO_RXQ_OVFL:
                self.overruns = int(_COUNT.unpack_from(data)[0])
        return stamp
