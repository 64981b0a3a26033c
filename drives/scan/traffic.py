"""What frames on a CANopen bus say, sorted; nothing is sent here."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from statistics import median

import can

from drives.cia402 import emergency_text

NMT_STATES = {0x00: "boot-up", 0x04: "stopped", 0x05: "operational", 0x7F: "pre-operational"}
"""Data byte of a heartbeat: meaning (CiA 301, clause 7.2.8.3.2)."""
_PDOS = {
    0x180: "TPDO 1",
    0x200: "RPDO 1",
    0x280: "TPDO 2",
    0x300: "RPDO 2",
    0x380: "TPDO 3",
    0x400: "RPDO 3",
    0x480: "TPDO 4",
    0x500: "RPDO 4",
}
"""First identifier of each kind in the predefined connection set, less one."""


def service_of(identifier: int) -> tuple[str, int]:
    """Return the service of an 11-bit identifier and its node id, 0 for all nodes.

    By the predefined connection set (CiA 301, clause 7.3.5); identifiers of PDOs may be others on a
    machine that was set up so.
    """
    match identifier:
        case 0x000:
            return "NMT", 0
        case 0x080:
            return "SYNC", 0
        case 0x100:
            return "TIME", 0
        case 0x7E4 | 0x7E5:
            return "LSS", 0
    base, node = identifier & 0x780, identifier & 0x7F
    if not node:
        return "other", 0
    if base == 0x080:
        return "EMCY", node
    if base in _PDOS:
        return _PDOS[base], node
    services = {0x580: "SDO answer", 0x600: "SDO request", 0x700: "heartbeat"}
    return (services[base], node) if base in services else ("other", 0)


@dataclass(frozen=True)
class NodeTraffic:
    """What one node was heard to send."""

    node_id: int
    state: str = ""
    """NMT state of its last heartbeat in words; empty if none was heard."""
    heartbeat: float | None = None
    """Seconds between its heartbeats, median; None with less than two."""
    booted: bool = False
    """Whether its boot-up message was heard."""
    pdos: tuple[str, ...] = ()
    """Kinds of its PDOs."""
    emergencies: tuple[str, ...] = ()
    """In words, each once."""


@dataclass(frozen=True)
class Traffic:
    """What was heard on a bus for a while."""

    seconds: float
    frames: int
    """Good frames of standard identifiers."""
    errors: int = 0
    """Error frames."""
    extended: int = 0
    """Frames with 29-bit identifiers: CANopen has none."""
    nodes: tuple[NodeTraffic, ...] = ()
    """Nodes that sent something, by node id."""
    commands: tuple[str, ...] = ()
    """What only a master sends, in words: SYNC, NMT commands, SDO requests, targets ..."""
    sync_period: float | None = None
    """Seconds from SYNC to SYNC, median."""

    @property
    def commanded(self) -> bool:
        """Whether another master is at work."""
        return bool(self.commands)

    @property
    def wrong_bit_rate(self) -> bool:
        """Whether it looks as if the bus had another bit rate: errors, and no good frame."""
        return self.errors > 0 and self.frames == 0

    def node(self, node_id: int) -> NodeTraffic:
        """Return what a node was heard to send."""
        return next((n for n in self.nodes if n.node_id == node_id), NodeTraffic(node_id))


def sorted_traffic(
    frames: Sequence[can.Message], seconds: float, own: Callable[[can.Message], bool] | None = None
) -> Traffic:
    """Sort what was heard.

    Parameters
    ----------
    frames
        In the order in which they came, with time stamps in seconds.
    seconds
        How long was listened.
    own
        Says which frames are the host's own, which are left out.
    """
    standard: list[can.Message] = []
    errors = extended = 0
    for frame in frames:
        if frame.is_error_frame:
            errors += 1
        elif frame.is_extended_id:
            extended += 1
        elif own is None or not own(frame):
            standard.append(frame)
    by_node: dict[int, list[tuple[str, can.Message]]] = {}
    commands: dict[str, list[float]] = {}
    for frame in standard:
        service, node = service_of(frame.arbitration_id)
        word = _command(service, node, frame)
        if word:
            commands.setdefault(word, []).append(frame.timestamp)
        elif node:
            by_node.setdefault(node, []).append((service, frame))
    syncs = commands.get("SYNC", [])
    return Traffic(
        seconds,
        len(standard),
        errors,
        extended,
        tuple(_node(node, sent) for node, sent in sorted(by_node.items())),
        tuple(f"{word} ({len(times)})" for word, times in commands.items()),
        _period(syncs),
    )


def _command(service: str, node: int, frame: can.Message) -> str:
    """Return what only a master sends in words; empty for what drives send themselves."""
    if frame.is_remote_frame:
        return f"a request (RTR) for {service} of node {node}" if node else "a request (RTR)"
    if service == "SYNC":
        return "SYNC"
    if service == "NMT":
        return "NMT commands"
    if service == "LSS" and frame.arbitration_id == 0x7E5:
        return "LSS requests"
    if service == "SDO request":
        return f"SDO requests to node {node}"
    if service.startswith("RPDO"):
        return f"targets ({service}) for node {node}"
    return ""


def _node(node_id: int, sent: Sequence[tuple[str, can.Message]]) -> NodeTraffic:
    beats = [frame for service, frame in sent if service == "heartbeat" and len(frame.data)]
    states = [frame.data[0] & 0x7F for frame in beats]
    times = [frame.timestamp for frame, state in zip(beats, states, strict=True) if state]
    codes = [
        int.from_bytes(frame.data[:2], "little")
        for service, frame in sent
        if service == "EMCY" and len(frame.data) >= 2
    ]
    kinds = sorted({service for service, _ in sent if "PDO" in service})
    return NodeTraffic(
        node_id,
        NMT_STATES.get(states[-1], f"state 0x{states[-1]:02X}") if states else "",
        _period(times),
        0 in states,
        tuple(kinds),
        tuple(dict.fromkeys(emergency_text(code) for code in codes if code)),
    )


def _period(times: Sequence[float]) -> float | None:
    gaps = [b - a for a, b in pairwise(times)]
    return median(gaps) if gaps else None
