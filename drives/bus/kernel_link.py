"""What Linux says of its CAN interfaces, by netlink: name, kind, up or down, bit rate, state.

No program is started and nothing but the kernel is asked; other systems have no answer.
"""

import socket
import struct
from collections.abc import Iterator
from dataclasses import dataclass

_REQUEST, _DUMP = 0x1, 0x300
_NEW_LINK, _GET_LINK, _ERROR, _DONE = 16, 18, 2, 3
_ARP_CAN = 280
_UP = 0x1
_NAME, _QUEUE, _LINK_INFO, _KIND, _DATA = 3, 13, 18, 1, 2
_BIT_TIMING, _STATE, _MODE, _COUNTERS = 1, 4, 5, 8
_LISTEN_ONLY = 0x02
_STATES = (
    "error active",
    "error warning",
    "error passive",
    "bus off",
    "stopped",
    "sleeping",
)
_HEADER = struct.Struct("=IHHII")
_LINK = struct.Struct("=BxHiII")
_ATTRIBUTE = struct.Struct("=HH")
_ANSWER = 1 << 16
_PATIENCE = 1.0
"""Seconds that the kernel may take to answer."""


@dataclass(frozen=True)
class KernelLink:
    """A CAN interface of the Linux kernel (``ip -details link``)."""

    name: str
    kind: str
    """Driver kind: ``can`` for real controllers, ``vcan`` for virtual ones."""
    up: bool
    bitrate: int | None = None
    """bit/s; None where there is none, as on vcan."""
    state: str | None = None
    """Of the controller, in CAN's words; None where the driver shows none."""
    errors: tuple[int, int] | None = None
    """The controller's error counters: transmit, receive."""
    queue: int = 0
    """Frames that may wait to be sent."""
    listen_only: bool = False


def kernel_links(name: str | None = None) -> tuple[KernelLink, ...] | None:
    """Return the kernel's CAN interfaces (the one of this name); None if there is nobody to ask.

    Other kinds of network interfaces are left out.
    """
    family = getattr(socket, "AF_NETLINK", None)
    if family is None:
        return None
    wanted = b"" if name is None else _attribute(_NAME, name.encode() + b"\0")
    flags = _REQUEST | (_DUMP if name is None else 0)
    body = _LINK.pack(0, 0, 0, 0, 0) + wanted
    request = _HEADER.pack(_HEADER.size + len(body), _GET_LINK, flags, 1, 0) + body
    try:
        with socket.socket(family, socket.SOCK_RAW, 0) as asked:
            asked.settimeout(_PATIENCE)
            asked.send(request)
            return tuple(_answers(asked, one=name is not None))
    except (OSError, struct.error, ValueError):
        return None


def _answers(asked: socket.socket, one: bool) -> Iterator[KernelLink]:
    while True:
        for kind, payload in _messages(asked.recv(_ANSWER)):
            if kind in (_DONE, _ERROR):  # an error: no interface of this name
                return
            if kind == _NEW_LINK:
                link = read_link(payload)
                if link is not None:
                    yield link
                if one:
                    return


def _messages(data: bytes) -> Iterator[tuple[int, bytes]]:
    while len(data) >= _HEADER.size:
        length, kind, _, _, _ = _HEADER.unpack_from(data)
        if length < _HEADER.size:
            return
        yield kind, data[_HEADER.size : length]
        data = data[(length + 3) & ~3 :]


def read_link(payload: bytes) -> KernelLink | None:
    """Return the CAN interface that an RTM_NEWLINK message describes; None for other interfaces.

    Parameters
    ----------
    payload
        The message behind its netlink header (``struct ifinfomsg`` and attributes).
    """
    _, hardware, _, flags, _ = _LINK.unpack_from(payload)
    if hardware != _ARP_CAN:
        return None
    given = _attributes(payload[_LINK.size :])
    info = _attributes(given.get(_LINK_INFO, b""))
    data = _attributes(info.get(_DATA, b""))
    bitrate = _number(data.get(_BIT_TIMING))
    state = _number(data.get(_STATE))
    mode = struct.unpack_from("=II", data[_MODE])[1] if len(data.get(_MODE, b"")) >= 8 else 0
    counters = data.get(_COUNTERS, b"")
    return KernelLink(
        name=given.get(_NAME, b"").rstrip(b"\0").decode(errors="replace"),
        kind=info.get(_KIND, b"").rstrip(b"\0").decode(errors="replace") or "can",
        up=bool(flags & _UP),
        bitrate=bitrate or None,
        state=_STATES[state] if state is not None and state < len(_STATES) else None,
        errors=struct.unpack_from("=HH", counters) if len(counters) >= 4 else None,
        queue=_number(given.get(_QUEUE)) or 0,
        listen_only=bool(mode & _LISTEN_ONLY),
    )


def _attributes(data: bytes) -> dict[int, bytes]:
    found = {}
    while len(data) >= _ATTRIBUTE.size:
        length, kind = _ATTRIBUTE.unpack_from(data)
        if length < _ATTRIBUTE.size:
            break
        found[kind & 0x3FFF] = data[_ATTRIBUTE.size : length]
        data = data[(length + 3) & ~3 :]
    return found


def _attribute(kind: int, data: bytes) -> bytes:
    length = _ATTRIBUTE.size + len(data)
    return _ATTRIBUTE.pack(length, kind) + data + bytes(-length % 4)


def _number(data: bytes | None) -> int | None:
    return int(struct.unpack_from("=I", data)[0]) if data and len(data) >= 4 else None
