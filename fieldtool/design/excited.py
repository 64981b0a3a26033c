"""What a small periodic excitation does to a machine with dry friction: what a trial would record.

Friction that holds an axis makes a small excitation look stiff, whatever the loop is worth.  So what is
measured can only be compared with what the same excitation does by the model, friction included.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fieldtool.design.dragged import dragged, rubbing
from fieldtool.design.loops import Loops
from fieldtool.design.machine import Machine, respond
from fieldtool.design.servo import Servo
from fieldtool.records.model import FloatArray

ComplexArray = NDArray[np.complexfloating[Any, Any]]
LONGEST_STEP = 0.5e-3
"""s, in which friction is taken as constant."""
PERIODS = 2
"""From rest: one to get into the motion, and the one that counts."""


@dataclass(frozen=True, eq=False)
class Periodic:
    """What is sent, as peak phasors at lines: Re sum U exp(2 pi j line n / samples)."""

    lines: NDArray[np.int64]
    """Periods in a period, shape (L,)."""
    samples: int
    """Cycles of a period."""
    step: float
    """s, of a cycle."""
    references: ComplexArray
    """(L, M), rad or m."""
    offsets: ComplexArray
    """(L, M), of torque, N m or N; held from cycle to cycle."""

    @property
    def omega(self) -> FloatArray:
        """rad/s, shape (L,)."""
        return np.asarray(2 * np.pi * self.lines / (self.samples * self.step), dtype=np.float64)

    def signals(self, phasors: ComplexArray, finer: int = 1) -> FloatArray:
        """Return a period of signals, shape (samples finer, M)."""
        count = self.samples * finer
        spectrum = np.zeros((count // 2 + 1, phasors.shape[1]), dtype=np.complex128)
        spectrum[self.lines] = phasors * (count / 2)
        return np.asarray(np.fft.irfft(spectrum, count, axis=0))


def excited(
    machine: Machine, servos: Sequence[Servo], sent: Periodic, axis: int
) -> tuple[FloatArray, FloatArray]:
    """Return position and torque of one axis in a steady period, cycle by cycle, shape (samples,).

    Parameters
    ----------
    machine
        With its dry friction.
    servos
        One an axis; stable.
    sent
        To all axes at the same time.
    axis
        Whose are wanted.
    """
    servos, s = tuple(servos), 1j * sent.omega
    loops = Loops(respond(machine, sent.omega), servos)
    held = np.exp(-0.5 * sent.step * s) * np.sinc(sent.omega * sent.step / (2 * np.pi))
    drives = np.stack(
        [
            servo.reference_gain(s) * sent.references[:, k]
            + servo.offset_gain(s) * held * sent.offsets[:, k]
            for k, servo in enumerate(servos)
        ],
        axis=-1,
    )
    motors, torques = np.zeros_like(drives), np.zeros_like(drives)
    for k in range(len(servos)):
        moved, pushed = loops.moved(k, drives[:, k])
        motors, torques = motors + moved, torques + pushed
    finer = max(1, int(np.ceil(sent.step / LONGEST_STEP - 1e-9)))
    position = sent.signals(motors[:, [axis]])[:, 0]
    torque = sent.signals(torques[:, [axis]])[:, 0]
    if not machine.dry:
        return position, torque
    machine = replace(machine, pulls=())  # about the same all over a small motion
    speeds = s[:, None] * rubbing(machine, loops.response, motors, torques)
    velocities = np.tile(sent.signals(speeds, finer), (PERIODS, 1))
    added = dragged(machine, servos, axis, sent.step / finer, velocities)
    last = slice(-sent.samples * finer, None, finer)
    return position + added.motor[last], torque + added.torque[last]
