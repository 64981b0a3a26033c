"""SYNC from the kernel's broadcast manager, for as long as somebody renews it.

The broadcast manager sends by the kernel's own timer, whatever the host is doing.  That must never
keep a machine going whose host hangs, so it works on a lease: each renewal allows ``LEASE`` SYNCs, the
kernel counts them down, and then sends no more (``count`` and ``ival1`` of ``linux/can/bcm.h``, with
``ival2`` 0).  It ends with the process too, because its socket does.  The host's heartbeat is never
sent this way.
"""

import socket
import struct

import can

from drives.errors import BusError

_TX_SETUP, _TX_DELETE = 1, 2
_SET_TIMER, _START_TIMER = 0x0001, 0x0002
_HEAD = struct.Struct("@IIIllllII0q")
_FRAME = struct.Struct("=IBxxx8x")
_CAN_BCM = 2
LEASE = 2
"""SYNCs that a renewal allows: the one that the host waits for, and one more that keeps the timer
running.  So a host that is late or dead has sent one SYNC without new targets at most."""


class LeasedSync:
    """A SYNC that the kernel sends at a period, until its lease ends.

    Parameters
    ----------
    channel
        Name of the SocketCAN interface.
    identifier
        Of the SYNC, 11 bits.

    Raises
    ------
    can.CanInitializationError
        If this kernel has no broadcast manager, or the interface is not there.
    BusError
        By every call later on, if the kernel does not take it any more.
    """

    def __init__(self, channel: str, identifier: int = 0x080) -> None:
        self._identifier = identifier
        try:
            self._socket = socket.socket(socket.AF_CAN, socket.SOCK_DGRAM, _CAN_BCM)
            self._socket.connect((channel,))
        except (AttributeError, OSError) as error:
            raise can.CanInitializationError(
                f"no broadcast manager on {channel}: {error}"
            ) from error

    def start(self, period: float) -> None:
        """Send a SYNC at once, and the next ones every ``period`` seconds, while the lease lasts."""
        self._setup(_SET_TIMER | _START_TIMER, period)

    def renew(self, period: float) -> None:
        """Allow ``LEASE`` SYNCs from now; the one that is due comes when it was to come.

        Where the lease has ended nothing is sent any more: it has to be started anew.
        """
        self._setup(_SET_TIMER, period)

    def stop(self) -> None:
        """Send none any more."""
        self._tell(_HEAD.pack(_TX_DELETE, 0, 0, 0, 0, 0, 0, self._identifier, 0))

    def close(self) -> None:
        """End it for good."""
        self._socket.close()

    def _setup(self, flags: int, period: float) -> None:
        seconds, microseconds = divmod(round(period * 1e6), 1_000_000)
        head = _HEAD.pack(_TX_SETUP, flags, LEASE, seconds, microseconds, 0, 0, self._identifier, 1)
        self._tell(head + _FRAME.pack(self._identifier, 0))

    def _tell(self, command: bytes) -> None:
        try:
            self._socket.send(command)
        except OSError as error:
            raise BusError(
                f"the kernel gives no SYNC any more: {error.strerror}. Is the adapter still plugged in, "
                "and its interface up?"
            ) from error
