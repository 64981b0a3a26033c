"""Faults of the host and its CAN adapter, as the simulated bus shows them to it."""

from dataclasses import dataclass

from drives.sim.faults import Fault
from drives.sim.running import RunningMachine
from drives.sim.scheduler import nanoseconds
from drives.sim.wire import Adapter


@dataclass(frozen=True)
class HostFault(Fault):
    """A defect that belongs to no node."""

    node_id: int = 0

    def check(self, machine: RunningMachine) -> None:
        """Nothing has to be there."""

    def adapter(self) -> Adapter:
        """Return the adapter with its defect."""
        raise NotImplementedError

    def set(self, machine: RunningMachine, *, present: bool) -> None:
        """Spoil the adapter, or mend it."""
        machine.adapter = self.adapter() if present else Adapter()


@dataclass(frozen=True)
class BusOff(HostFault):
    """The adapter's controller went bus off: it takes no frame and hears none."""

    def adapter(self) -> Adapter:
        """Sending fails."""
        return Adapter(sending="Transmit buffer full (bus off) [Error Code 105]", deaf=True)


@dataclass(frozen=True)
class InterfaceDown(HostFault):
    """The interface was taken down, or its adapter pulled out."""

    def adapter(self) -> Adapter:
        """Both ways fail."""
        down = "Network is down [Error Code 100]"
        return Adapter(sending=down, receiving=down)


@dataclass(frozen=True)
class ReceiverDead(HostFault):
    """What receives on the host has died without a word, while frames still go out."""

    def adapter(self) -> Adapter:
        """Nothing is heard."""
        return Adapter(deaf=True)


@dataclass(frozen=True)
class HostKilled(HostFault):
    """The host is gone: from now on nothing of it reaches the bus."""

    def adapter(self) -> Adapter:
        """Nothing is said nor heard."""
        return Adapter(mute=True, deaf=True)


@dataclass(frozen=True)
class HostStalls(HostFault):
    """The host's process stands still for a while (swapping, a suspended laptop, a debugger)."""

    seconds: float = 0.5

    def adapter(self) -> Adapter:
        """It goes on afterwards."""
        return Adapter(stall=nanoseconds(self.seconds))
