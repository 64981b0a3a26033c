"""What can go wrong with a simulated drive, on command.

Each fault is a value.  ``machine.inject(fault)`` brings it about at once, ``inject(fault,
at_time=12.5)`` at a virtual time, ``inject(fault, at_sync=1000)`` right before the SYNC of that
number acts (``machine.sync_count`` counts them); ``machine.lift(fault)`` ends it.
"""

from dataclasses import dataclass

from drives.sim.abort_codes import Abort
from drives.sim.emergency import ErrorRegister
from drives.sim.running import RunningMachine


@dataclass(frozen=True)
class Fault:
    """A defect of one node."""

    node_id: int

    def check(self, machine: RunningMachine) -> None:
        """Raise KeyError if the machine has no such node."""
        machine.node(self.node_id)

    def set(self, machine: RunningMachine, *, present: bool) -> None:
        """Bring it about or end it."""
        raise NotImplementedError


@dataclass(frozen=True)
class NodeVanishes(Fault):
    """The node is off the bus: it hears nothing, sends nothing, and goes on by itself."""

    def set(self, machine: RunningMachine, *, present: bool) -> None:
        """Pull the plug, or put it in."""
        machine.node(self.node_id).network.connect(not present)


@dataclass(frozen=True)
class DriveFault(Fault):
    """The drive finds an error, sends EMCY and reacts as 0x605E says; lifted by a fault reset."""

    code: int = 0x2310
    """Emergency error code; 0x2310 is continuous over-current."""
    register: int = int(ErrorRegister.CURRENT)
    """Bits of the error register."""
    data: bytes = b""
    """At most five bytes of the manufacturer's."""

    def set(self, machine: RunningMachine, *, present: bool) -> None:
        """Raise the error; only the host's fault reset ends it."""
        if present:
            machine.node(self.node_id).motion.fault(self.code, self.register, self.data)


@dataclass(frozen=True)
class EmergencyOnly(Fault):
    """The node sends EMCY, but the drive works on (a warning)."""

    code: int = 0x4210
    """0x4210 is excess temperature of the device."""
    register: int = int(ErrorRegister.TEMPERATURE)
    data: bytes = b""

    def set(self, machine: RunningMachine, *, present: bool) -> None:
        """Report the error, or its end."""
        emergency = machine.node(self.node_id).emergency
        if present:
            emergency.report(self.code, self.register, self.data)
        else:
            emergency.clear(self.code)


@dataclass(frozen=True)
class NoTransmitPdos(Fault):
    """The node sends no TPDO; everything else works."""

    def set(self, machine: RunningMachine, *, present: bool) -> None:
        """Mute or unmute."""
        machine.node(self.node_id).pdo.muted = present


@dataclass(frozen=True)
class SdoRefused(Fault):
    """Transfers of one entry, in either direction, are aborted."""

    index: int
    subindex: int = 0
    code: int = int(Abort.GENERAL)

    def set(self, machine: RunningMachine, *, present: bool) -> None:
        """Refuse or serve."""
        aborting = machine.node(self.node_id).sdo.aborting
        if present:
            aborting[self.index, self.subindex] = self.code
        else:
            aborting.pop((self.index, self.subindex), None)


@dataclass(frozen=True)
class SdoSilent(Fault):
    """Requests for one entry are not answered."""

    index: int
    subindex: int = 0

    def set(self, machine: RunningMachine, *, present: bool) -> None:
        """Be silent or answer."""
        silent = machine.node(self.node_id).sdo.silent
        if present:
            silent.add((self.index, self.subindex))
        else:
            silent.discard((self.index, self.subindex))


@dataclass(frozen=True)
class WriteAltered(Fault):
    """The drive confirms a write but keeps another value: reading back shows it."""

    index: int
    subindex: int = 0
    value: float = 0
    """What it keeps, raw."""

    def set(self, machine: RunningMachine, *, present: bool) -> None:
        """Alter writes or take them as they are."""
        alterations = machine.node(self.node_id).dictionary.alterations
        if present:
            alterations[self.index, self.subindex] = lambda _: self.value
        else:
            alterations.pop((self.index, self.subindex), None)


@dataclass(frozen=True)
class StoreFails(Fault):
    """0x1010 and 0x1011 end with an abort, and nothing is stored."""

    code: int = int(Abort.HARDWARE)

    def set(self, machine: RunningMachine, *, present: bool) -> None:
        """Break or mend the memory."""
        machine.node(self.node_id).store_fails = self.code if present else None


@dataclass(frozen=True)
class StoreForgets(Fault):
    """0x1010 answers as if it had stored, and nothing is stored."""

    def set(self, machine: RunningMachine, *, present: bool) -> None:
        """Break or mend the memory."""
        machine.node(self.node_id).store_forgets = present


@dataclass(frozen=True)
class EncoderStuck(Fault):
    """The encoder stays where it is, for the loops and for the host."""

    def set(self, machine: RunningMachine, *, present: bool) -> None:
        """Hold or let go."""
        machine.axes.hold_encoder(machine.node(self.node_id).axis, defect=present)


@dataclass(frozen=True)
class MotorReversed(Fault):
    """The motor turns against the torque asked for (swapped phases)."""

    def set(self, machine: RunningMachine, *, present: bool) -> None:
        """Swap the phases, or swap them back."""
        machine.axes.reverse_motor(machine.node(self.node_id).axis, defect=present)


@dataclass(frozen=True)
class PowerLoss(Fault):
    """The drive's supply fails for a moment: it boots, and what was not stored is gone."""

    def set(self, machine: RunningMachine, *, present: bool) -> None:
        """Switch off and on again."""
        if present:
            machine.node(self.node_id).power_cycle()
