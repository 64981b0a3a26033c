"""A simulated machine at work: nodes, firmware and plant in one virtual time, on no bus yet.

Whoever carries frames (the lock-step bus, :mod:`drives.sim.serve`) hands the host's in with
:meth:`RunningMachine.receive`, listens for the nodes' with :meth:`RunningMachine.listen`, and lets
time pass with :meth:`RunningMachine.advance_to`.
"""

from collections.abc import Callable
from functools import partial
from typing import Protocol

from drives.sim.firmware import SimulatedAxes
from drives.sim.machine import SimulatedMachine
from drives.sim.node import DriveNode
from drives.sim.port import BusPort, Switchboard
from drives.sim.scheduler import NANOSECONDS, VirtualScheduler, nanoseconds
from drives.sim.wire import Adapter, Tamper, Wire, carried

INNER_RATE = 8000
"""Steps of the firmware per second."""
INNER_STEP = NANOSECONDS // INNER_RATE
TASK_PERIOD = 1_000_000
"""Of the drives' communication task, ns."""

Listener = Callable[[int, int, bytes], None]
"""Gets time (ns), identifier and data of a frame that a node sends."""


class CycleTimeError(ValueError):
    """The nodes' communication cycles do not agree, or the drives can not keep them."""


class Defect(Protocol):
    """What can befall a machine (``drives.sim.faults``)."""

    def check(self, machine: "RunningMachine") -> None:
        """Raise KeyError if it can not befall this machine."""

    def set(self, machine: "RunningMachine", *, present: bool) -> None:
        """Bring it about or end it."""


class RunningMachine:
    """The nodes of one machine and everything behind them.

    Time begins at 0 with all drives switched on: they have sent their boot-up messages (to nobody)
    and are pre-operational.  Several machines in one process share nothing.

    Parameters
    ----------
    machine
        What it is made of.
    """

    def __init__(self, machine: SimulatedMachine) -> None:
        self.description = machine
        self.scheduler = VirtualScheduler()
        hardware = [drive.hardware for drive in machine.drives]
        self.axes = SimulatedAxes(machine.plant, hardware, machine.seed, float(INNER_RATE))
        self.carrier: object | None = None
        """What carries its frames, if several share that."""
        self.wire = Wire()
        """Fault injection: what befalls frames on their way."""
        self.adapter = Adapter()
        """Fault injection: how the host's adapter fares."""
        self.syncs_missed: dict[int, float] = {}
        """Fault injection: node ids that do not hear so many of the next SYNCs."""
        self.sync_count = 0
        """SYNCs handled since the start."""
        self._now = 0
        self._next_task = TASK_PERIOD
        self._listeners: tuple[Listener, ...] = ()
        self._switchboard = Switchboard()
        self._sync_faults: dict[int, list[Defect]] = {}
        self._by_sync: dict[int, list[DriveNode]] | None = None
        self._period: int | None = None
        self.nodes: tuple[DriveNode, ...] = ()
        self.nodes = tuple(self._make_node(axis) for axis in range(len(machine.drives)))
        self._by_id = {node.node_id: node for node in self.nodes}

    def _make_node(self, axis: int) -> DriveNode:
        drive = self.description.drives[axis]
        return DriveNode(
            drive.name,
            drive.node_id,
            BusPort(self._switchboard, self._transmit),
            self.axes,
            axis,
            drive.scales,
            drive.factory_objects,
            self.scheduler,
            drive.store_time,
            self._communication_changed,
            drive.loops,
            drive.face,
        )

    # -- who is there -----------------------------------------------------------------------------

    def node(self, node_id: int) -> DriveNode:
        """Return the node that started with this id.

        Raises
        ------
        KeyError
            If there is none.
        """
        if node_id not in self._by_id:
            raise KeyError(f"no simulated node {node_id}; there are {sorted(self._by_id)}")
        return self._by_id[node_id]

    @property
    def now(self) -> float:
        """Virtual time since the start, s."""
        return self._now / NANOSECONDS

    @property
    def time(self) -> int:
        """Virtual time since the start, ns."""
        return self._now

    # -- frames -----------------------------------------------------------------------------------

    def listen(self, listener: Listener) -> None:
        """Hand the nodes' frames to this listener too, from now on."""
        self._listeners = (*self._listeners, listener)

    def unlisten(self, listener: Listener) -> None:
        """End it."""
        self._listeners = tuple(each for each in self._listeners if each != listener)

    def receive(self, cob_id: int, data: bytes | bytearray) -> bool:
        """Let the nodes handle a frame of the host's at the present time; True if it was a SYNC.

        A SYNC latches the inputs and lets received outputs act; it does not let time pass.
        """
        if self.wire.to_nodes:
            return self._carry(self.wire.to_nodes, self._deliver, cob_id, bytes(data))
        return self._deliver(cob_id, data)

    def _carry(
        self,
        tampers: dict[object, Tamper],
        hand_on: Callable[[int, bytes], object],
        cob_id: int,
        data: bytes,
    ) -> bool:
        """Hand on what becomes of a frame, now or later; True if a SYNC was handed on now."""
        synchronised = False
        for delay, one, content in carried(tampers, cob_id, data):
            if delay:
                self.scheduler.add_at(self.scheduler.now + delay, hand_on, (one, content))
            else:
                synchronised = bool(hand_on(one, content)) or synchronised
        return synchronised

    def _deliver(self, cob_id: int, data: bytes | bytearray) -> bool:
        if self._by_sync is None:
            self._by_sync = self._listening_to_sync()
        synchronised = self._by_sync.get(cob_id)
        if synchronised is not None:
            self._synchronise(synchronised)
            return True
        self._switchboard.deliver(cob_id, data)
        return False

    def _transmit(self, cob_id: int, data: bytes) -> None:
        if self.wire.from_nodes:
            self._carry(self.wire.from_nodes, self.announce, cob_id, bytes(data))
            return
        self.announce(cob_id, data)

    def announce(self, cob_id: int, data: bytes) -> None:
        """Let all listeners hear a frame, as if a node (or somebody else on the bus) sent it."""
        now = self.scheduler.now
        for listener in self._listeners:
            listener(now, cob_id, data)

    def _synchronise(self, nodes: list[DriveNode]) -> None:
        self.sync_count += 1
        if self._sync_faults:
            for fault in self._sync_faults.pop(self.sync_count, ()):
                fault.set(self, present=True)
        sampled = self.axes.latch()
        counts, torques, velocities = (values.tolist() for values in sampled)
        for node in nodes:
            if node.network.connected and not (self.syncs_missed and self._misses(node)):
                axis = node.axis
                node.at_sync(counts[axis], torques[axis], velocities[axis])

    def _misses(self, node: DriveNode) -> bool:
        left = self.syncs_missed.get(node.node_id, 0)
        if left > 0:
            self.syncs_missed[node.node_id] = left - 1
        return left > 0

    def _listening_to_sync(self) -> dict[int, list[DriveNode]]:
        """Operational nodes by the SYNC identifier they are set to; the others' with no node."""
        found: dict[int, list[DriveNode]] = {}
        for node in self.nodes:
            nodes = found.setdefault(node.sync_identifier, [])
            if node.nmt.operational:
                nodes.append(node)
        return found

    def _communication_changed(self) -> None:
        self._by_sync, self._period = None, None

    # -- time -------------------------------------------------------------------------------------

    @property
    def period(self) -> int:
        """Communication cycle, ns, that the nodes are set to.

        Operational nodes count; where there is none, all nodes do.

        Raises
        ------
        CycleTimeError
            If they are set to different cycles, or to one that is no multiple of the firmware's.
        """
        if self._period is None:
            self._period = self._common_period()
        return self._period

    def _common_period(self) -> int:
        nodes = [node for node in self.nodes if node.nmt.operational] or list(self.nodes)
        periods = {node.period for node in nodes}
        if len(periods) > 1:
            each = ", ".join(f"node {n.node_id}: {n.period / 1e6:g} ms" for n in nodes)
            raise CycleTimeError(
                f"the simulated nodes are set to different communication cycles ({each}); set "
                "0x60C2 (and 0x1006, where it is not 0) of all of them to the same time"
            )
        period = periods.pop()
        if period % INNER_STEP:
            raise CycleTimeError(
                f"the simulated nodes are set to a communication cycle of {period / 1e3:g} us, "
                f"which is no multiple of their control period of {INNER_STEP / 1e3:g} us; set "
                "0x60C2 or 0x1006 to one that is"
            )
        return period

    def advance_to(self, time: int) -> None:
        """Let time pass until ``time``, ns; nothing happens if that has passed."""
        while self._now < time:
            self.step_towards(time)

    def step_towards(self, time: int) -> None:
        """Let time pass until ``time`` (ns), the next timer or the next communication task.

        Whichever comes first; frames that the nodes send have been handed on then.
        """
        stop = min(time, self._next_task)
        due = self.scheduler.next_due
        if due is not None and due < stop:
            stop = max(due, self._now)
        steps = stop // INNER_STEP - self._now // INNER_STEP
        if steps:
            self.axes.advance(steps)
        self._now = stop
        self.scheduler.run_due(stop)
        if stop == self._next_task:
            self._next_task = stop + TASK_PERIOD
            for node in self.nodes:
                node.at_task(stop)

    # -- faults -----------------------------------------------------------------------------------

    def inject(
        self, fault: Defect, *, at_time: float | None = None, at_sync: int | None = None
    ) -> None:
        """Bring a fault about: at once, at a virtual time (s), or right before a SYNC acts.

        Raises
        ------
        ValueError
            If both a time and a SYNC are given, or what is given has passed.
        KeyError
            If there is no such node.
        """
        fault.check(self)
        if at_time is not None and at_sync is not None:
            raise ValueError(f"{fault}: give either a time or a number of SYNCs, not both")
        if at_time is not None:
            due = nanoseconds(at_time)
            if due < self._now:
                raise ValueError(f"{fault}: {at_time} s has passed, it is {self.now} s")
            self.scheduler.add_at(due, partial(fault.set, self, present=True))
        elif at_sync is not None:
            if at_sync <= self.sync_count:
                raise ValueError(
                    f"{fault}: SYNC {at_sync} has passed, there were {self.sync_count}"
                )
            self._sync_faults.setdefault(at_sync, []).append(fault)
        else:
            fault.set(self, present=True)

    def lift(self, fault: Defect) -> None:
        """End a fault."""
        fault.set(self, present=False)
