"""A machine under its drives' loops: what is closed, by frequency, and whether it is stable."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fieldtool.design.machine import Machine, Response
from fieldtool.design.servo import OFF, Servo, gains_of
from fieldtool.records.model import FloatArray

ComplexArray = NDArray[np.complexfloating[Any, Any]]
TINY_LAG = 1e-9


@dataclass(frozen=True, eq=False)
class Loops:
    """All loops closed on a machine's response."""

    response: Response
    servos: tuple[Servo, ...]

    @cached_property
    def gains(self) -> ComplexArray:
        """Torque per position error of each axis, shape (F, M)."""
        return gains_of(self.servos, self.response.omega)

    @cached_property
    def compliance(self) -> ComplexArray:
        """Motor positions per torque that is added at the motors, all loops closed, (F, M, M)."""
        plant = self.response.motors
        eye = np.eye(len(self.servos))
        return np.linalg.solve(eye + plant * self.gains[:, None, :], plant)

    @cached_property
    def input_sensitivity(self) -> ComplexArray:
        """Torques that act per torque that is added, all loops closed, (F, M, M)."""
        loaded = self.gains[:, :, None] * self.compliance
        return np.asarray(np.eye(len(self.servos)) - loaded)

    @cached_property
    def sensitivity(self) -> ComplexArray:
        """1 / (1 + L) of each axis with all others closed, shape (F, M)."""
        return np.asarray(np.einsum("fkk->fk", self.input_sensitivity))

    def motion(self, axis: int, drive: ComplexArray) -> tuple[ComplexArray, ...]:
        """Return what a torque that is added at one motor does.

        Parameters
        ----------
        axis
            Index.
        drive
            Torque phasors, shape (F,), N m or N.

        Returns
        -------
        motor, load, torque
            Position of the axis' motor and of its last mass, and the torque that its drive gives,
            shape (F,).
        """
        motors, torques = self.moved(axis, drive)
        return motors[:, axis], self.load(axis, torques), torques[:, axis]

    def load(self, axis: int, torques: ComplexArray) -> ComplexArray:
        """Return the position of an axis' last mass under the torques of all drives, (F, M)."""
        return np.asarray(np.einsum("fk,fk->f", self.response.loads[:, axis, :], torques))

    def moved(self, axis: int, drive: ComplexArray) -> tuple[ComplexArray, ComplexArray]:
        """Return the positions of all motors, and the torques of all drives, (F, M), as above."""
        motors = self.compliance[:, :, axis] * drive[:, None]
        torques = -self.gains * motors
        torques[:, axis] += drive
        return motors, torques


def stable(machine: Machine, servos: tuple[Servo, ...]) -> bool:
    """Return whether all loops together are stable: every eigenvalue has a negative real part.

    Delays are Pade approximations of second order, which hold far beyond the loops' bandwidth.
    """
    values = np.linalg.eigvals(system_matrix(machine, servos))
    return bool(values.real.max() < 1e-9 * np.abs(values).max())


def system_matrix(machine: Machine, servos: tuple[Servo, ...]) -> FloatArray:
    """Return A of x' = A x with all references at rest, as :func:`state_space` has it."""
    return state_space(machine, servos)[0]


def state_space(machine: Machine, servos: tuple[Servo, ...]) -> tuple[FloatArray, FloatArray]:
    """Return A of x' = A x with all references at rest, and the rows of the motors' torques, (M, N).

    State: positions, velocities; then for each axis the velocity's delay and filter, the
    integrator, two states a torque filter, two of the delay and one of the motor's lag, where there
    are such.  Structural damping is viscous here, equal at the highest mode.
    """
    n = machine.mass.shape[0]
    inverse = np.linalg.inv(machine.mass)
    counts = [_states(servo, lag) for servo, lag in zip(servos, machine.lag, strict=True)]
    size = 2 * n + sum(counts)
    a = np.zeros((size, size))
    a[:n, n : 2 * n] = np.eye(n)
    a[n : 2 * n, :n] = -inverse @ machine.stiffness
    a[n : 2 * n, n : 2 * n] = -inverse @ (machine.damping + _viscous(machine))
    place = 2 * n
    torques = []
    for k, servo in enumerate(servos):
        row, used = _controller(a, place, int(machine.motors[k]), n, servo, float(machine.lag[k]))
        a[n : 2 * n] += machine.scale[k] * np.outer(inverse[:, machine.motors[k]], row)
        torques.append(row)
        place += used
    return a, np.stack(torques)


def _viscous(machine: Machine) -> FloatArray:
    if not machine.loss.any():
        return np.zeros_like(machine.loss)
    modes = machine.modes
    return machine.loss / (modes[-1] if modes.size else 1.0)


def _states(servo: Servo, lag: float) -> int:
    t = servo.timing
    filtered = int(servo.velocity_filter != OFF) + int(t.period > 0)
    late = 2 * int(t.lag > TINY_LAG) + int(lag > TINY_LAG)
    return filtered + 1 + 2 * len(servo.loop.filters) + late


def _controller(
    a: FloatArray, place: int, motor: int, n: int, servo: Servo, lag: float
) -> tuple[FloatArray, int]:
    """Put one controller's states in at ``place``; return the row of its torque and their number."""
    loop, begin = servo.loop, place
    error = np.zeros(a.shape[0])
    error[motor] = -loop.position_p
    velocity = n + motor
    for corner in (
        2 / servo.timing.period if servo.timing.period > 0 else OFF,
        2 * np.pi * servo.velocity_filter,
    ):
        if corner != OFF:
            a[place, velocity], a[place, place] = corner, -corner
            velocity = place
            place += 1
    error[velocity] = -1.0
    a[place] = error
    row = loop.velocity_p * error
    row[place] += loop.velocity_i
    place += 1
    for biquad in loop.filters:
        row = _second_order(a, place, row, biquad.numerator, biquad.denominator)
        place += 2
    if servo.timing.lag > TINY_LAG:
        t = servo.timing.lag
        row = _second_order(a, place, row, (1.0, -6 / t, 12 / t**2), (6 / t, 12 / t**2))
        place += 2
    if lag > TINY_LAG:
        a[place] = row / lag
        a[place, place] -= 1 / lag
        row = np.zeros(a.shape[0])
        row[place] = 1.0
        place += 1
    return row, place - begin


def _second_order(
    a: FloatArray,
    place: int,
    row: FloatArray,
    numerator: tuple[float, float, float],
    denominator: tuple[float, float],
) -> FloatArray:
    (n2, n1, n0), (d1, d0) = numerator, denominator
    a[place, place + 1] = 1.0
    a[place + 1] = row
    a[place + 1, place] -= d0
    a[place + 1, place + 1] -= d1
    out = n2 * row
    out[place] += n0 - n2 * d0
    out[place + 1] += n1 - n2 * d1
    return out
