"""Faults of a drive, its motor, its encoder and its supply."""

from dataclasses import dataclass

from drives.sim.emergency import ErrorRegister
from drives.sim.faults import Fault
from drives.sim.memory import Bank
from drives.sim.running import RunningMachine
from drives.sim.state_machine import State, Status

UNDER_VOLTAGE = 0x3220
"""Emergency error code: the DC link is under its lowest voltage."""


@dataclass(frozen=True)
class EncoderJumps(Fault):
    """The encoder's count jumps once (lost counts, a disturbed index): all positions are beside."""

    counts: int = 2**17

    def set(self, machine: RunningMachine, *, present: bool) -> None:
        """Let it jump, there or back."""
        axis = machine.node(self.node_id).axis
        machine.axes.shift_encoder(axis, self.counts if present else -self.counts)


@dataclass(frozen=True)
class TorqueScaleWrong(Fault):
    """The drive shows so many times the torque that it gives."""

    factor: float = 10.0

    def set(self, machine: RunningMachine, *, present: bool) -> None:
        """Spoil or mend the scale."""
        axis = machine.node(self.node_id).axis
        machine.axes.scale_torque_reading(axis, self.factor if present else 1.0)


@dataclass(frozen=True)
class BrakeClosed(Fault):
    """A brake, or an obstacle, holds the motor where it is; the drive does not know."""

    def set(self, machine: RunningMachine, *, present: bool) -> None:
        """Close or open it."""
        machine.axes.hold_motor(machine.node(self.node_id).axis, defect=present)


@dataclass(frozen=True)
class SupplySags(Fault):
    """The supply breaks down: little torque at once, and the drive's fault shortly after."""

    share: float = 0.1
    """Of the torque limit that is left."""
    delay: float = 0.005
    """s until the drive sees it."""

    def set(self, machine: RunningMachine, *, present: bool) -> None:
        """Let it sag; mended, the torque comes back, and the fault waits for its reset."""
        node = machine.node(self.node_id)
        limit = node.dictionary.read(0x6072, 0)
        node.limit_torque(limit * self.share if present else limit)
        if present:
            machine.scheduler.add(
                self.delay, node.motion.fault, (UNDER_VOLTAGE, int(ErrorRegister.VOLTAGE))
            )


@dataclass(frozen=True)
class OperationLost(Fault):
    """The drive leaves operation enabled by itself, without an emergency (its enable input)."""

    def set(self, machine: RunningMachine, *, present: bool) -> None:
        """Switch the power stage off."""
        if present:
            machine.node(self.node_id).motion.disable_voltage()


@dataclass(frozen=True)
class ModeChanges(Fault):
    """The drive goes into another mode of operation by itself; 0x6061 shows it."""

    mode: int = 1

    def set(self, machine: RunningMachine, *, present: bool) -> None:
        """Change it."""
        if present:
            machine.node(self.node_id).motion.set_mode(self.mode)


@dataclass(frozen=True)
class LimitSwitchHit(Fault):
    """A limit switch stops the drive: it brakes by itself and shows an internal limit."""

    def set(self, machine: RunningMachine, *, present: bool) -> None:
        """Hit it, or leave it."""
        motion = machine.node(self.node_id).motion
        motion.forced_bits = int(Status.INTERNAL_LIMIT) if present else 0
        if present:
            motion.quick_stop()


@dataclass(frozen=True)
class CanNotBeEnabled(Fault):
    """The drive stays in switched on, whatever it is told (its enable input is open)."""

    def set(self, machine: RunningMachine, *, present: bool) -> None:
        """Open or close the input."""
        motion = machine.node(self.node_id).motion
        motion.enabling = not present
        if present and motion.state is State.OPERATION_ENABLED:
            motion.disable_voltage()


@dataclass(frozen=True)
class PowerLossWhileStoring(Fault):
    """The drive's supply fails the next time that it stores its parameters; it boots then."""

    after: float = 0.05
    """s after storing began."""
    bank: Bank = "old"
    """What its memory holds then: what was there before, what was to be stored, or neither."""

    def set(self, machine: RunningMachine, *, present: bool) -> None:
        """Lie in wait, or not."""
        node = machine.node(self.node_id)

        def at_store() -> None:
            node.on_store = None
            machine.scheduler.add(self.after, node.power_cycle, (self.bank,))

        node.on_store = at_store if present else None


@dataclass(frozen=True)
class TorqueLimited(Fault):
    """The drive gives at most so much of its rated torque, and does not say so."""

    share: float = 0.01

    def set(self, machine: RunningMachine, *, present: bool) -> None:
        """Limit it, or not."""
        node = machine.node(self.node_id)
        limit = node.dictionary.read(0x6072, 0)
        node.limit_torque(1000.0 * self.share if present else limit)
