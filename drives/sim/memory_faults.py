"""What can go wrong with a simulated drive's non-volatile memory, besides that it refuses."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

from drives.sim.faults import Fault
from drives.sim.memory import Bank

if TYPE_CHECKING:
    from drives.sim.running import RunningMachine


@dataclass(frozen=True)
class PowerLossWhileStoring(Fault):
    """The next time that the drive stores (0x1010), its supply fails in the middle; it boots then."""

    bank: Bank = "old"
    """What is left: what was stored before, what was to be stored, or nothing that can be used."""
    share: float = 0.5
    """Of the time that storing takes, after which it happens."""

    def set(self, machine: "RunningMachine", *, present: bool) -> None:
        """Lie in wait, or give it up."""
        node = machine.node(self.node_id)

        def strike() -> None:
            node.on_store = None
            delay = self.share * node.store_time
            machine.scheduler.add(delay, node.power_cycle, (self.bank,))

        node.on_store = strike if present else None
