"""The simulated nodes in real time on any python-can bus."""

import time
from collections.abc import Callable

import can

from drives.sim.running import RunningMachine
from drives.sim.scheduler import NANOSECONDS

WAIT = 0.0005
"""Longest wait for a frame, s: as often, at least, time passes for the nodes."""
LARGEST_STEP = 0.05
"""Wall time, s, that is made up for at most at once; what a longer pause held is left out."""


def serve(
    machine: RunningMachine,
    bus: can.BusABC,
    stop: Callable[[], bool],
    *,
    clock: Callable[[], float] = time.monotonic,
) -> float:
    """Let the nodes of a machine live on a bus until ``stop`` returns True.

    Frames are handled as they come; a SYNC latches inputs and lets outputs act at the moment at
    which it is received.  Time passes by the wall clock, so the drives' behaviour has the jitter
    of this computer.

    Parameters
    ----------
    machine
        What is served; its present virtual time belongs to the moment of the call.
    bus
        Open; it is left open.
    stop
        Asked at least every ``WAIT`` seconds.
    clock
        Seconds that never go back.

    Returns
    -------
    float
        Seconds of wall time that were left out because the computer was too slow or paused;
        0 if it kept up.

    Raises
    ------
    can.CanError
        If the bus fails.
    """
    outgoing: list[can.Message] = []

    def transmit(_time: int, cob_id: int, data: bytes) -> None:
        outgoing.append(can.Message(arbitration_id=cob_id, is_extended_id=False, data=data))

    machine.listen(transmit)
    left_out = 0.0
    began, virtual_began = clock(), machine.time
    try:
        while not stop():
            message = bus.recv(WAIT)
            now = virtual_began + int((clock() - began - left_out) * NANOSECONDS)
            behind = (now - machine.time) / NANOSECONDS
            if behind > LARGEST_STEP:
                left_out += behind - LARGEST_STEP
                now = machine.time + int(LARGEST_STEP * NANOSECONDS)
            machine.advance_to(now)
            if message is not None and _is_for_nodes(message):
                machine.receive(message.arbitration_id, bytes(message.data))
            for answer in outgoing:
                bus.send(answer)
            outgoing.clear()
    finally:
        machine.unlisten(transmit)
    return left_out


def _is_for_nodes(message: can.Message) -> bool:
    return not (message.is_extended_id or message.is_remote_frame or message.is_error_frame)
