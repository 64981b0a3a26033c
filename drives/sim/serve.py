"""The simulated nodes in real time on any python-can bus."""

import time
from collections.abc import Callable
from dataclasses import dataclass

import can

from drives.bus import WallClock, is_data
from drives.canopen_drive.pace import undisturbed
from drives.cia402 import Mode
from drives.sim.running import RunningMachine
from drives.sim.scheduler import NANOSECONDS, nanoseconds

WAIT = 0.001
"""Longest wait for a frame, s: as often, at least, time passes for the nodes."""
LARGEST_STEP = 0.05
"""Wall time, s, that is made up for at most at once; what a longer pause held is left out."""
LATE = 0.002
"""Seconds between two looks at the bus above which the computer did not keep up."""
WARM_UP = 0.002
"""Virtual seconds of each step that another machine of the kind does first, so that all is compiled."""
PAUSE = 0.01
"""Seconds between two tries of a bus that takes and gives nothing."""


@dataclass(frozen=True)
class Served:
    """How serving went; times in s of wall time."""

    seconds: float
    frames: int
    """Received and handled."""
    late: int
    """Looks at the bus that came more than ``LATE`` after the one before."""
    worst: float
    """Longest time between two looks."""
    left_out: float
    """Time that did not pass for the nodes, because the computer was too slow or paused."""
    bus_away: float
    """Time for which the bus neither took nor gave frames."""

    @property
    def sentence(self) -> str:
        """All of it for a person."""
        parts = [
            f"Served {self.frames} frames in {self.seconds:.1f} s",
            f"frames waited {1000 * self.worst:.2g} ms at most",
            f"{self.late} times more than {1000 * LATE:g} ms",
        ]
        if self.left_out:
            parts.append(f"{self.left_out:.2g} s were left out, because this computer was too slow")
        if self.bus_away:
            parts.append(f"the bus was away for {self.bus_away:.2g} s")
        return "; ".join(parts) + "."


def serve(
    machine: RunningMachine,
    bus: can.BusABC,
    stop: Callable[[], bool],
    *,
    begun: Callable[[], None] = lambda: None,
    clock: Callable[[], float] = time.monotonic,
) -> Served:
    """Let the nodes of a machine live on a bus until ``stop`` returns True.

    A SYNC latches inputs and lets outputs act at the moment at which it came, by its time stamp where
    that is one of this computer's clock, as in a drive that handles it at once; what the nodes answer
    is as late as this computer is.  Time passes by the wall clock.  A bus that goes away does not stop
    the drives: they miss frames, and time passes for them, as for real ones whose cable was pulled.

    Parameters
    ----------
    machine
        What is served; its present virtual time belongs to the moment of the call.
    bus
        Open; it is left open.
    stop
        Asked at least every ``PAUSE`` seconds.
    begun
        Called when the nodes can be spoken to; they have sent their boot-up messages then.
    clock
        Seconds that never go back.
    """
    _compile(machine)
    with undisturbed(WallClock()):
        return _served(machine, bus, stop, begun, clock)


def _served(
    machine: RunningMachine,
    bus: can.BusABC,
    stop: Callable[[], bool],
    begun: Callable[[], None],
    clock: Callable[[], float],
) -> Served:
    line = _Line(machine, bus)
    begun()
    began, virtual_began = clock(), machine.time
    last, late, worst, left_out = began, 0, 0.0, 0.0
    try:
        while not stop():
            message = line.receive()
            present = clock()
            waits = 0.0 if message is None else _age(message)
            pause, last = present - last, present
            waited = pause - (WAIT if message is None else 0.0)
            late, worst = late + (waited > LATE), max(worst, waited)
            now = virtual_began + int((present - waits - began - left_out) * NANOSECONDS)
            behind = (now - machine.time) / NANOSECONDS
            if behind > LARGEST_STEP:
                left_out += behind - LARGEST_STEP
                now = machine.time + int(LARGEST_STEP * NANOSECONDS)
            machine.advance_to(now)
            if message is not None and is_data(message):
                machine.receive(message.arbitration_id, bytes(message.data))
            line.flush()
    finally:
        line.close()
    return Served(last - began, line.frames, late, worst, left_out, line.away)


def _age(message: can.Message) -> float:
    """Return for how long a frame has waited, s; 0 where its stamp is of another clock."""
    age = time.time() - message.timestamp
    return age if 0.0 < age <= LARGEST_STEP else 0.0


class _Line:
    """The bus as the nodes have it: what can not be sent is lost, what can not be received is not."""

    def __init__(self, machine: RunningMachine, bus: can.BusABC) -> None:
        self._machine, self._bus = machine, bus
        self._outgoing: list[can.Message] = []
        self.frames, self.away = 0, 0.0
        machine.listen(self._transmit)
        for node in machine.nodes:
            self._transmit(0, 0x700 + node.node_id, b"\0")
        self.flush()

    def receive(self) -> can.Message | None:
        """Return the next frame; None if none comes within ``WAIT``."""
        try:
            message = self._bus.recv(WAIT)
        except (can.CanError, OSError):
            begin = time.monotonic()
            time.sleep(PAUSE)
            self.away += time.monotonic() - begin
            return None
        self.frames += message is not None
        return message

    def flush(self) -> None:
        """Send what the nodes have to say."""
        for answer in self._outgoing:
            try:
                self._bus.send(answer)
            except (can.CanError, OSError):
                break
        self._outgoing.clear()

    def close(self) -> None:
        """Listen to the nodes no more."""
        self._machine.unlisten(self._transmit)

    def _transmit(self, _time: int, cob_id: int, data: bytes) -> None:
        self._outgoing.append(can.Message(arbitration_id=cob_id, is_extended_id=False, data=data))


def _compile(machine: RunningMachine) -> None:
    """Let another machine of the kind do once whatever a drive has to do in time."""
    other = RunningMachine(machine.description)
    for node in other.nodes:
        other.receive(0, bytes((1, node.node_id)))
        node.dictionary.write(0x6060, 0, Mode.CYCLIC_POSITION.value)
    for word in (0x06, 0x07, 0x0F, 0x0F, 0x02, 0x00):
        for node in other.nodes:
            node.motion.write_controlword(word)
            node.motion.set_target_position(10 * word)
        for _ in range(3):
            other.receive(0x80, b"")
            other.advance_to(other.time + nanoseconds(WARM_UP))
