"""What may befall frames between the nodes and the host, and the host's adapter: for faults.

A sound machine has nothing here, and then nothing is spent on it.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field

Sent = tuple[int, int, bytes]
"""Delay in ns, identifier and data of a frame that goes on."""
Tamper = Callable[[int, bytes], Iterable[Sent]]
"""Gets identifier and data of a frame; returns what goes on in its place, perhaps nothing."""


def unchanged(cob_id: int, data: bytes) -> tuple[Sent, ...]:
    """Let a frame pass."""
    return ((0, cob_id, data),)


@dataclass
class Wire:
    """What is done to frames on their way, by whom."""

    from_nodes: dict[object, Tamper] = field(default_factory=dict)
    """By the fault that does it; each sees what the one before lets through."""
    to_nodes: dict[object, Tamper] = field(default_factory=dict)


def carried(tampers: dict[object, Tamper], cob_id: int, data: bytes) -> list[Sent]:
    """Return what becomes of a frame."""
    frames: list[Sent] = [(0, cob_id, data)]
    for tamper in list(tampers.values()):
        frames = [
            (delay + more, changed_id, changed)
            for delay, one, content in frames
            for more, changed_id, changed in tamper(one, content)
        ]
    return frames


@dataclass
class Adapter:
    """How the host's CAN adapter, and the host behind it, fare."""

    sending: str = ""
    """Error that every attempt to send ends with; empty: none."""
    receiving: str = ""
    """Error that every attempt to receive ends with; empty: none."""
    deaf: bool = False
    """Nothing is received any more, without an error."""
    mute: bool = False
    """What is sent reaches nobody, without an error."""
    stall: int = 0
    """Time for which the host does nothing before it sends the next frame, ns; then 0 again."""

    @property
    def sound(self) -> bool:
        """Whether all is well."""
        return not (self.sending or self.receiving or self.deaf or self.mute or self.stall)
