"""A python-can bus whose far end is a simulated machine in virtual time.

The host opens it like any other: ``can.Bus(interface="fieldsim", channel="paper-3x3")``.  There are
no sleeps and no threads: time is a number, and it passes

- by one communication cycle with every SYNC that the host sends;
- while the thread that opened the bus waits in :meth:`LockstepBus.recv` with nothing to receive;
- when that is asked for: ``bus.clock.wait_until(t)``.
"""

import contextlib
import threading
from collections import deque
from collections.abc import Callable, Sequence
from importlib.resources import files
from typing import Any, Protocol

import can
from can.typechecking import AutoDetectedConfig, CanFilters, Channel

from drives.bus import is_data
from drives.errors import DrivesError
from drives.profile import SIMULATED
from drives.sim.firmware import SimulationDivergedError
from drives.sim.machine import SimulatedMachine, simulated_machine
from drives.sim.running import CycleTimeError, RunningMachine
from drives.sim.scheduler import NANOSECONDS, Timer, nanoseconds

SILENCE_LIMIT = 60.0
"""Virtual seconds after which ``recv(timeout=None)`` gives up: nothing will ever come."""

NOT_IMITATED: tuple[str, ...] = (
    "arbitration, and frames that wait for the bus: a frame takes no time",
    "bit rate and bus load: any number of frames fits into a cycle",
    "bit errors, error frames, bus off, lost and repeated frames",
    "jitter of SYNC and of the host, and late or doubled SYNCs that the host did not send",
    "the nodes' time to answer: all but storing parameters is answered at once",
    "boot-up times, and the operating temperature and ageing of drives",
    "what drives hold from one command to the next: they begin anew with each",
)
"""What the lock-step bus leaves out; what reports on simulated results repeats."""

Entry = tuple[int, int, bytes] | can.Message
"""A received frame: time (ns), identifier, data; or a host's message as it was sent."""


class Clock(Protocol):
    """The time in which the bus and everything behind it lives."""

    def now(self) -> float:
        """Seconds since the bus began."""
        ...

    def wait_until(self, time: float) -> None:
        """Return when it is that time (s), or at once if that has passed."""
        ...


class _Line:
    """What all bus objects on one machine share: the machine, one lock, who listens."""

    def __init__(self, machine: RunningMachine) -> None:
        self.machine = machine
        self.lock = threading.RLock()
        self.buses: tuple[LockstepBus, ...] = ()
        self._advancing = False
        machine.listen(self._from_node)

    def now(self) -> float:
        """Virtual time, s."""
        return self.machine.now

    def wait_until(self, time: float) -> None:
        """Let virtual time pass until then, s."""
        with self.lock:
            self.advance_to(nanoseconds(time))

    def transmit(self, sender: "LockstepBus", message: can.Message) -> None:
        """Carry a host's frame to the nodes and to the other bus objects."""
        if len(self.buses) > 1:
            self._to_others(sender, message)
        if not is_data(message):
            return  # no service of these nodes uses them
        machine = self.machine
        try:
            is_sync = machine.receive(message.arbitration_id, message.data)
            if is_sync and not self._advancing:
                self.advance_to(machine.time + machine.period)
        except (CycleTimeError, SimulationDivergedError) as error:
            raise can.CanOperationError(str(error)) from error

    def advance_to(self, time: int) -> None:
        """Let time pass until ``time``, ns."""
        with self._passing_time():
            self.machine.advance_to(time)

    def advance_until(self, time: int, enough: Callable[[], bool]) -> None:
        """Let time pass until ``time`` (ns) or until it is enough."""
        machine = self.machine
        with self._passing_time():
            while machine.time < time and not enough():
                machine.step_towards(time)

    @contextlib.contextmanager
    def _passing_time(self) -> Any:
        if self._advancing:
            raise can.CanOperationError(
                "virtual time is passing already; a listener must not wait for frames or for time"
            )
        self._advancing = True
        try:
            yield
        except SimulationDivergedError as error:
            raise can.CanOperationError(str(error)) from error
        finally:
            self._advancing = False

    def _from_node(self, time: int, cob_id: int, data: bytes) -> None:
        for bus in self.buses:
            bus.enqueue((time, cob_id, data))

    def _to_others(self, sender: "LockstepBus", message: can.Message) -> None:
        for bus in self.buses:
            if bus is not sender:
                bus.enqueue(_copy(message, self.machine.now))


class LockstepBus(can.BusABC):
    """One end of the simulated bus; several can be open on the same machine.

    A second bus object on a machine (a logger, say) receives all frames, the host's included, and
    may send.  Time stamps are virtual seconds.  Periodic messages (``send_periodic``) go out in
    virtual time.

    It does not imitate: arbitration (a frame takes no time), bit rate and bus load, bit errors and
    lost frames, jitter and late SYNCs, the time that nodes need to answer (but for storing
    parameters), boot-up times; see ``NOT_IMITATED``.

    Parameters
    ----------
    channel
        Name of a machine: one that was registered with :func:`register`, or that of a machine
        profile (or its file) with a ``simulation`` section.  The same name opened twice is the
        same machine, for as long as one of the two is open.
    machine
        The machine itself, in place of a channel's: a description, which is started, or one that
        is running, which is joined.
    can_filters
        As everywhere in python-can.
    receive_own_messages
        Whether this object receives what it sends.
    bitrate
        Checked (10 000 to 1 000 000) and otherwise without effect.

    Raises
    ------
    TypeError
        If an option is not known.
    can.CanInitializationError
        If there is no such machine, or it can not be simulated.
    """

    not_imitated = NOT_IMITATED
    """What differs from a real bus, for whoever reports results; see :data:`NOT_IMITATED`."""

    of_this_process = True
    """No other process can have to do with it."""

    def __init__(
        self,
        channel: Channel | None = None,
        can_filters: CanFilters | None = None,
        machine: SimulatedMachine | RunningMachine | None = None,
        receive_own_messages: bool = False,
        bitrate: int = 1_000_000,
        **unknown: object,
    ) -> None:
        if unknown:
            raise TypeError(
                f"{SIMULATED} has no option {', '.join(sorted(unknown))}; it has channel, "
                "can_filters, machine, receive_own_messages, bitrate"
            )
        if not 10_000 <= int(bitrate) <= 1_000_000:
            raise can.CanInitializationError(
                f"{SIMULATED}: bit rate {bitrate} bit/s is not within 10 000 and 1 000 000"
            )
        self._queue: deque[Entry] = deque()
        self._frame_came = threading.Condition()
        self._waiting = 0
        self._owner = threading.get_ident()
        self._receive_own = receive_own_messages
        self._can_protocol = can.CanProtocol.CAN_20
        known = str(channel) in _registered or str(channel) in _open_channels
        self.drives_begin_anew = machine is None and not known
        """Whether its drives were switched on with this bus, and end with the last one."""
        self._line = _open(channel, machine)
        self.channel = str(channel) if channel is not None else SIMULATED
        self.channel_info = f"{SIMULATED} {self.channel}: simulated machine in virtual time"
        self.clock: Clock = self._line
        """Virtual time; the host paces itself by it."""
        super().__init__(channel=self.channel, can_filters=can_filters)
        with self._line.lock:
            self._line.buses = (*self._line.buses, self)

    @property
    def machine(self) -> RunningMachine:
        """The machine at the far end: for tests, and to inject faults."""
        return self._line.machine

    def send(self, msg: can.Message, timeout: float | None = None) -> None:  # noqa: ARG002
        """Send a frame.  Nodes answer at once; a SYNC lets one communication cycle pass.

        Raises
        ------
        can.CanOperationError
            If the bus is shut down, the frame is CAN FD, the nodes do not agree on the cycle, or
            the simulated machine diverges.
        """
        if self._is_shutdown:
            raise can.CanOperationError(f"{self.channel_info}: the bus is shut down")
        if msg.is_fd:
            raise can.CanOperationError(f"{self.channel_info}: CAN FD is not supported")
        line = self._line
        with line.lock:
            if not line.machine.adapter.sound and not self._passes():
                return
            if self._receive_own:
                self.enqueue(_copy(msg, line.machine.now, received=False))
            line.transmit(self, msg)

    def _passes(self) -> bool:
        """Whether a faulty adapter lets a frame out; raise if it says that it does not."""
        adapter, line = self._line.machine.adapter, self._line
        if adapter.stall:
            stall, adapter.stall = adapter.stall, 0
            line.advance_to(line.machine.time + stall)
        if adapter.sending:
            raise can.CanOperationError(f"{self.channel_info}: {adapter.sending}")
        return not adapter.mute

    def recv(self, timeout: float | None = None) -> can.Message | None:
        """Return the next frame, or None if none comes in time.

        Called by the thread that opened the bus, an empty queue lets virtual time pass, until a
        frame comes or for ``timeout`` virtual seconds.  Called by another thread (a notifier's),
        it waits in wall time, and virtual time does not pass.

        Raises
        ------
        can.CanOperationError
            If the bus is shut down, or the simulated machine diverges.
        can.CanTimeoutError
            If ``timeout`` is None and nothing comes for ``SILENCE_LIMIT`` virtual seconds.
        """
        queue, adapter = self._queue, self._line.machine.adapter
        if adapter.receiving:
            raise can.CanOperationError(f"{self.channel_info}: {adapter.receiving}")
        if queue and self._filters is None:
            with contextlib.suppress(IndexError):  # another thread may have been faster
                return _message(queue.popleft())
        if self._is_shutdown:
            raise can.CanOperationError(f"{self.channel_info}: the bus is shut down")
        if threading.get_ident() == self._owner:
            return self._receive_in_virtual_time(timeout)
        return self._receive_in_wall_time(timeout)

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        return self.recv(timeout), True

    def _receive_in_virtual_time(self, timeout: float | None) -> can.Message | None:
        line = self._line
        with line.lock:
            limit = SILENCE_LIMIT if timeout is None else timeout
            end = line.machine.time + nanoseconds(limit)
            while True:
                message = self._next_matching()
                if message is not None:
                    return message
                if line.machine.time >= end:
                    break
                line.advance_until(end, lambda: bool(self._queue))
        if timeout is None:
            raise can.CanTimeoutError(
                f"{self.channel_info}: no frame for {SILENCE_LIMIT:g} s of virtual time, and none "
                "will come unless one is sent; give recv() a timeout"
            )
        return None

    def _receive_in_wall_time(self, timeout: float | None) -> can.Message | None:
        with self._frame_came:
            self._waiting += 1
            try:
                found: list[can.Message] = []
                self._frame_came.wait_for(lambda: self._found_or_shut(found), timeout)
            finally:
                self._waiting -= 1
        return found[0] if found else None

    def _found_or_shut(self, found: list[can.Message]) -> bool:
        message = self._next_matching()
        if message is not None:
            found.append(message)
        return bool(found) or self._is_shutdown

    def _next_matching(self) -> can.Message | None:
        queue = self._queue
        while queue:
            try:
                message = _message(queue.popleft())
            except IndexError:  # another thread was faster
                break
            if self._matches_filters(message):
                return message
        return None

    def enqueue(self, entry: Entry) -> None:
        """Take a frame in (called by what is at the far end)."""
        if self._line.machine.adapter.deaf:
            return
        self._queue.append(entry)
        if self._waiting:
            with self._frame_came:
                self._frame_came.notify_all()

    def _send_periodic_internal(
        self,
        msgs: Sequence[can.Message] | can.Message,
        period: float,
        duration: float | None = None,
        autostart: bool = True,
        modifier_callback: Callable[[can.Message], None] | None = None,
    ) -> can.CyclicSendTaskABC:
        task = _VirtualCyclicTask(self, msgs, period, duration, modifier_callback)
        if autostart:
            task.start()
        return task

    @property
    def state(self) -> can.BusState:
        """Always active: this bus has no errors."""
        return can.BusState.ACTIVE

    @state.setter
    def state(self, new_state: can.BusState) -> None:
        if new_state is not can.BusState.ACTIVE:
            raise NotImplementedError(f"{SIMULATED} is always active, it can not be {new_state}")

    def flush_tx_buffer(self) -> None:
        """Do nothing: nothing waits to be sent."""

    def shutdown(self) -> None:
        """Leave the machine; whoever waits in :meth:`recv` gets None."""
        if not self._is_shutdown:
            with self._line.lock:
                super().shutdown()
                self._line.buses = tuple(bus for bus in self._line.buses if bus is not self)
            _forget_unless_open(self._line)
        with self._frame_came:
            self._frame_came.notify_all()

    @staticmethod
    def _detect_available_configs() -> Sequence[AutoDetectedConfig]:
        machines = files("profiles").joinpath("machines").iterdir()
        packaged = (m.name.removesuffix(".yaml") for m in machines if m.name.endswith(".yaml"))
        return [{"interface": SIMULATED, "channel": name} for name in (*_registered, *packaged)]


class _VirtualCyclicTask(
    can.LimitedDurationCyclicSendTaskABC,
    can.ModifiableCyclicTaskABC,
    can.RestartableCyclicTaskABC,
):
    """Sends messages with a period of virtual time; a SYNC among them lets no time pass."""

    def __init__(
        self,
        bus: LockstepBus,
        messages: Sequence[can.Message] | can.Message,
        period: float,
        duration: float | None,
        modifier: Callable[[can.Message], None] | None,
    ) -> None:
        super().__init__(messages, period, duration)
        if self.period_ns <= 0:
            raise ValueError(f"a period must be above 0, got {period} s")
        self._bus, self._modifier = bus, modifier
        self._scheduler = bus.machine.scheduler
        self._timer: Timer | None = None
        self._next = 0

    def start(self) -> None:
        """Begin, or begin again; the first message goes out as soon as time passes."""
        self.stop()
        now = self._scheduler.now
        self.end_time = None if self.duration is None else now / NANOSECONDS + self.duration
        self._timer = self._scheduler.add_at(now, self._send)

    def stop(self) -> None:
        """End; nothing happens if it has ended."""
        if self._timer is not None:
            self._scheduler.cancel(self._timer)
            self._timer = None

    def _send(self) -> None:
        now = self._scheduler.now
        if self.end_time is not None and now > nanoseconds(self.end_time):
            self._timer = None
            return
        self._timer = self._scheduler.add_at(now + self.period_ns, self._send)
        message = self.messages[self._next % len(self.messages)]
        self._next += 1
        if self._modifier is not None:
            self._modifier(message)
        self._bus.send(message)


_registered: dict[str, RunningMachine] = {}
_open_channels: dict[str, RunningMachine] = {}
_opening = threading.Lock()


def register(name: str, machine: SimulatedMachine | RunningMachine) -> RunningMachine:
    """Make a machine known by name to this process, and start it; return the running machine.

    It runs on when all bus objects are closed (stored parameters survive), until
    :func:`unregister`.

    Raises
    ------
    ValueError
        If another machine has this name.
    """
    if name in _registered:
        raise ValueError(f"a simulated machine {name!r} is registered already; unregister it first")
    _registered[name] = _started(machine)
    return _registered[name]


def unregister(name: str) -> None:
    """Forget a registered machine; nothing happens if there is none of this name."""
    _registered.pop(name, None)


def _started(machine: SimulatedMachine | RunningMachine) -> RunningMachine:
    return machine if isinstance(machine, RunningMachine) else RunningMachine(machine)


def _open(channel: Channel | None, machine: SimulatedMachine | RunningMachine | None) -> _Line:
    with _opening:
        running = _started(machine) if machine is not None else _of_channel(channel)
        if not isinstance(running.carrier, _Line):
            running.carrier = _Line(running)
        return running.carrier


def _forget_unless_open(line: _Line) -> None:
    """Let go of a machine that a channel's name started and that no bus object holds any more."""
    with _opening:
        for name, machine in list(_open_channels.items()):
            if machine is line.machine and not line.buses:
                del _open_channels[name]


def _of_channel(channel: Channel | None) -> RunningMachine:
    if channel is None or channel == "":
        raise can.CanInitializationError(
            f"{SIMULATED} needs a channel (name of a machine) or a machine"
        )
    name = str(channel)
    running = _registered.get(name) or _open_channels.get(name)
    if running is None:
        running = _open_channels[name] = _load(name)
    return running


def _load(name: str) -> RunningMachine:
    from drives.profile import load_machine

    try:
        return RunningMachine(simulated_machine(load_machine(name)))
    except (DrivesError, ValueError, KeyError) as error:
        raise can.CanInitializationError(f"{SIMULATED}: {error}") from error


def _message(entry: Entry) -> can.Message:
    if isinstance(entry, can.Message):
        return entry
    time, cob_id, data = entry
    return can.Message(
        timestamp=time / NANOSECONDS, arbitration_id=cob_id, is_extended_id=False, data=data
    )


def _copy(message: can.Message, timestamp: float, *, received: bool = True) -> can.Message:
    return can.Message(
        timestamp=timestamp,
        arbitration_id=message.arbitration_id,
        is_extended_id=message.is_extended_id,
        is_remote_frame=message.is_remote_frame,
        is_error_frame=message.is_error_frame,
        channel=message.channel,
        dlc=message.dlc,
        data=bytes(message.data),
        is_rx=received,
    )
