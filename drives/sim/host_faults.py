"""Faults of the host and its CAN adapter, as the simulated bus shows them to it."""

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from drives.sim.faults import Fault
from drives.sim.scheduler import nanoseconds
from drives.sim.wire import Adapter

if TYPE_CHECKING:
    from drives.sim.running import RunningMachine


@dataclass(frozen=True)
class HostFault(Fault):
    """A defect that belongs to no node."""

    node_id: int = 0

    def check(self, machine: "RunningMachine") -> None:
        """Nothing has to be there."""

    def fault(self) -> dict[str, object]:
        """Return what is the matter with the adapter, by field."""
        raise NotImplementedError

    def set(self, machine: "RunningMachine", *, present: bool) -> None:
        """Spoil the adapter, or mend it."""
        machine.adapter = replace(Adapter(), **self.fault()) if present else Adapter()


@dataclass(frozen=True)
class BusOff(HostFault):
    """The adapter's controller went bus off: it takes no frame and hears none."""

    def fault(self) -> dict[str, object]:
        """Sending fails."""
        return {"sending": "Transmit buffer full (bus off) [Error Code 105]", "deaf": True}


@dataclass(frozen=True)
class InterfaceDown(HostFault):
    """The interface was taken down, or its adapter pulled out."""

    def fault(self) -> dict[str, object]:
        """Both ways fail."""
        down = "Network is down [Error Code 100]"
        return {"sending": down, "receiving": down}


@dataclass(frozen=True)
class ReceiverDead(HostFault):
    """What receives on the host has died without a word, while frames still go out."""

    def fault(self) -> dict[str, object]:
        """Nothing is heard."""
        return {"deaf": True}


@dataclass(frozen=True)
class HostKilled(HostFault):
    """The host is gone: from now on nothing of it reaches the bus."""

    def fault(self) -> dict[str, object]:
        """Nothing is said nor heard."""
        return {"mute": True, "deaf": True}


@dataclass(frozen=True)
class HostStalls(HostFault):
    """The host's process stands still for a while (swapping, a suspended laptop, a debugger)."""

    seconds: float = 0.5

    def fault(self) -> dict[str, object]:
        """It goes on afterwards."""
        return {"stall": nanoseconds(self.seconds)}
