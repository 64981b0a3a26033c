"""Error frames in words.

SocketCAN encodes them in identifier and data (``linux/can/error.h``); other adapters' error frames
say no more than that there was one.
"""

from dataclasses import dataclass

import can

from drives.bus.kernel_link import kernel_links
from drives.errors import UserStopError

_TIMEOUT, _CONTROLLER, _PROTOCOL = 0x001, 0x004, 0x008
_TRANSCEIVER, _NO_ACK, _BUS_OFF, _BUS_ERROR, _RESTARTED = 0x010, 0x020, 0x040, 0x080, 0x100
_OVERFLOW = {0x01: "the adapter's receive buffer ran over", 0x02: "its transmit buffer ran over"}
_LEVELS = {
    0x04: "many receive errors",
    0x08: "many transmit errors",
    0x10: "error passive by receive errors",
    0x20: "error passive by transmit errors",
}


@dataclass(frozen=True)
class Trouble:
    """What an error frame says."""

    words: str
    bus_off: bool = False
    """The adapter has switched itself off the bus."""
    overrun: bool = False
    """Received frames were lost in the adapter."""
    matters: bool = True
    """False for the news that all is well again."""


def trouble_of(message: can.Message, socketcan: bool) -> Trouble:
    """Return what an error frame says.

    Parameters
    ----------
    message
        An error frame.
    socketcan
        Whether it is encoded as the Linux kernel does it.
    """
    if not socketcan:
        return Trouble("an error frame")
    kind, data = message.arbitration_id, bytes(message.data).ljust(8, b"\0")
    words = []
    if kind & _BUS_OFF:
        words.append("bus off: too many errors, the adapter has switched itself off")
    if kind & _NO_ACK:
        words.append("nobody acknowledges")
    if kind & (_PROTOCOL | _BUS_ERROR):
        words.append("bit or frame errors")
    if kind & _TRANSCEIVER:
        words.append("a fault of the transceiver or the cable")
    if kind & _TIMEOUT:
        words.append("a frame could not be sent")
    flags = data[1] if kind & _CONTROLLER else 0
    words += [text for bit, text in (_OVERFLOW | _LEVELS).items() if flags & bit]
    if kind & _RESTARTED:
        words.append("the adapter was restarted")
    return Trouble(
        ", ".join(words) or "an error frame",
        bus_off=bool(kind & _BUS_OFF),
        overrun=bool(flags & 0x01),
        matters=bool(words),
    )


def bus_state(bus: can.BusABC) -> str:
    """Return the adapter's state in words where it is not well, as far as it tells; else nothing."""
    channel = getattr(bus, "channel", None)
    if hasattr(bus, "overruns") and isinstance(channel, str):
        links = kernel_links(channel) or ()
        states = [link.state for link in links if link.state not in (None, "error active")]
        return states[0] or "" if states else ""
    try:
        state = bus.state
    except UserStopError:
        raise
    except Exception:  # many adapters do not tell, each in its own way
        return ""
    words = {can.BusState.PASSIVE: "error passive", can.BusState.ERROR: "off the bus or in error"}
    return words.get(state, "")
