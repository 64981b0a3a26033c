"""One drive's loops as they act on the machine: gains, filters, sampling and delay, by frequency.

::

    e      = position_p (r - q) + velocity_ff r' - v       v = low-pass( q' )
    torque = delay( filters( velocity_p e + velocity_i integral(e) + viscous_ff r' + inertia_ff r'' ) )

A drive's loops are sampled.  At frequencies well below their rate the sampling shows as delays: half a
period of the velocity's difference quotient, half a period that the torque is held, and the current
loop's lag (Franklin, Powell, Workman, Digital Control of Dynamic Systems, 1998, section 5.8).
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.signal import step

from fieldtool.records.closed_loop import AxisLoop, loop_from_parameters
from fieldtool.records.model import FloatArray

ComplexArray = NDArray[np.complexfloating[Any, Any]]
CAUTIOUS_LAG = 1e-3
"""s: from torque reference to torque, of a drive whose profile does not know it."""
CAUTIOUS_PERIOD = 0.5e-3
"""s: period of the loops of such a drive."""
OFF = float("inf")
POINTS = 400
"""In time, of an answer to a step."""


@dataclass(frozen=True)
class Timing:
    """When a drive's loops act."""

    lag: float = CAUTIOUS_LAG
    """s, from the torque reference to the torque: computing, holding, current loop."""
    period: float = CAUTIOUS_PERIOD
    """s, of position and velocity loop."""
    cycle: float = 0.0
    """s, from one cyclic target to the next: the reference's acceleration is held so long; 0: it
    is followed at once."""


AT_ONCE = Timing(0.0, 0.0)
"""Loops without any delay."""


@dataclass(frozen=True)
class Servo:
    """One axis' controller in its drive, SI."""

    loop: AxisLoop
    velocity_filter: float = OFF
    """First-order low-pass on the measured velocity, Hz; infinite: none."""
    timing: Timing = AT_ONCE

    def gain(self, s: ComplexArray) -> ComplexArray:
        """Return torque per position error of the standing reference, shape of ``s``, rad/s."""
        position = self.loop.position_p + s * self._velocity(s)
        return self._torque(s) * self._pi(s) * position

    def reference_gain(self, s: ComplexArray) -> ComplexArray:
        """Return torque per reference with the axis locked, shape of ``s``, rad/s."""
        loop = self.loop
        followed = self._pi(s) * (loop.position_p + loop.velocity_ff * s)
        fed = loop.viscous_ff * s + loop.inertia_ff * s * s * self._held(s)
        return self._torque(s) * (followed + fed)

    def offset_gain(self, s: ComplexArray) -> ComplexArray:
        """Return torque per torque that is added before the filters, shape of ``s``, rad/s."""
        return self._torque(s)

    def step_gain(self, s: ComplexArray) -> ComplexArray:
        """Return torque per reference without feed-forward, as a step of the reference needs it."""
        return self._torque(s) * self._pi(s) * self.loop.position_p

    def _pi(self, s: ComplexArray) -> ComplexArray:
        return self.loop.velocity_p + self.loop.velocity_i / s

    def _velocity(self, s: ComplexArray) -> ComplexArray:
        late: ComplexArray = np.exp(-0.5 * self.timing.period * s)
        if self.velocity_filter == OFF:
            return late
        return np.asarray(late / (1 + s / (2 * np.pi * self.velocity_filter)))

    def _torque(self, s: ComplexArray) -> ComplexArray:
        return np.asarray(np.exp(-self.timing.lag * s) * self.loop.filtered(s))

    def _held(self, s: ComplexArray) -> ComplexArray:
        x = self.timing.cycle * s
        return np.where(np.abs(x) < 1e-6, 1.0, -np.expm1(-x) / np.where(x == 0, 1.0, x))

    @property
    def fed(self) -> tuple[float, float]:
        """Torque per velocity, and per acceleration, of a reference that is followed."""
        loop = self.loop
        return loop.velocity_ff * loop.velocity_p + loop.viscous_ff, loop.inertia_ff

    def target_noise(self, resolution: float) -> float:
        """Return the RMS of the torque that the steps of cyclic targets make while they move, N m or N.

        Targets are rounded to whole steps, as white noise of a step / sqrt(12) at the cycle's rate;
        their first differences are fed forward as velocity, their second ones as acceleration, both
        held from target to target.  Torque filters are not reckoned with.  0 where the cycle is not
        known.

        Parameters
        ----------
        resolution
            One step of the targets, rad or m.
        """
        cycle = self.timing.cycle
        if cycle <= 0:
            return 0.0
        per_velocity, per_acceleration = self.fed
        velocity = np.sqrt(2.0) / cycle * per_velocity
        acceleration = np.sqrt(6.0) / cycle**2 * per_acceleration
        return float(resolution / np.sqrt(12) * np.hypot(velocity, acceleration))

    def torque_noise(self, resolution: float) -> float:
        """Return the RMS of the torque reference that an encoder's steps make at standstill, N m or N.

        The rounding of positions is taken as white noise of a step / sqrt(12) at the loops' rate; the
        machine does not answer at the high frequencies that matter.

        Parameters
        ----------
        resolution
            One step of the encoder, rad or m.
        """
        period = self.timing.period or CAUTIOUS_PERIOD
        omega, s, rate = _rates(period)
        nyquist = np.pi / period
        velocity = rate
        if self.velocity_filter != OFF:
            share = -np.expm1(-2 * np.pi * self.velocity_filter * period)
            velocity = rate * share / (1 - (1 - share) * np.exp(-period * s))
        gain = self.loop.filtered(s) * self.loop.velocity_p * (self.loop.position_p + velocity)
        power = np.trapezoid(np.abs(gain) ** 2, omega) / nyquist
        return float(resolution / np.sqrt(12) * np.sqrt(power))

    def count_torque(self, resolution: float) -> float:
        """Return the largest torque reference that one step of the encoder makes, N m or N.

        An axis that stands where its encoder just turns over answers to single steps now and then:
        rarely, so that their RMS says little of them.  The integrator is left out: it is slow.

        Parameters
        ----------
        resolution
            One step of the encoder, rad or m.
        """
        rate = 1 / (self.timing.period or CAUTIOUS_PERIOD)
        w = min(2 * np.pi * self.velocity_filter, rate)
        p = self.loop.position_p
        numerator, denominator = np.array([p + w, p * w]), np.array([1.0, w])
        slowest = w
        for biquad in self.loop.filters:
            numerator = np.polymul(numerator, biquad.numerator)
            denominator = np.polymul(denominator, (1.0, *biquad.denominator))
            slowest = min(slowest, np.sqrt(biquad.denominator[1]))
        answers = [
            step((np.trim_zeros(numerator, "f"), denominator), T=np.linspace(0.0, end, POINTS))[1]
            for end in (5 / w, 10 / slowest)
        ]
        return float(resolution * self.loop.velocity_p * np.abs(answers).max())


@cache
def _rates(period: float) -> tuple[FloatArray, ComplexArray, ComplexArray]:
    """Return frequencies up to half the rate, j times them, and the difference quotient there."""
    omega = np.geomspace(np.pi / period / 1e4, np.pi / period, 120)
    s = 1j * omega
    return omega, s, (1 - np.exp(-period * s)) / period


@dataclass(frozen=True, eq=False)
class Sampled:
    """A drive's controller at fixed frequencies, its delays computed once."""

    s: ComplexArray
    delay: ComplexArray
    velocity: ComplexArray
    """s times the velocity's delay."""
    acceleration: ComplexArray
    """s^2 times what holding the acceleration does."""

    @classmethod
    def of(cls, s: ComplexArray, timing: Timing) -> "Sampled":
        """Return what all controllers with this timing have in common at complex frequencies, rad/s."""
        bare = Servo(AxisLoop(1.0, 1.0, 0.0, 0.0, 1.0), OFF, timing)
        late = np.exp(-timing.lag * s)
        # inertia alone: reference_gain less position_p velocity_p
        held = bare.reference_gain(s) / late - 1.0
        return cls(s, late, s * np.exp(-0.5 * timing.period * s), held)

    def gain(self, servo: Servo) -> tuple[ComplexArray, ComplexArray, ComplexArray]:
        """Return torque per position error, its filters with the delay, and those with the PI."""
        loop, s = servo.loop, self.s
        torque = self.delay
        for biquad in loop.filters:
            torque = torque * biquad.response(s)
        pi = torque * (loop.velocity_p + loop.velocity_i / s)
        rate = self.velocity
        if servo.velocity_filter != OFF:
            rate = rate / (1 + s / (2 * np.pi * servo.velocity_filter))
        return pi * (loop.position_p + rate), torque, pi


def servo_from_parameters(values: Mapping[str, float], timing: Timing) -> Servo:
    """Return the controller that a drive's parameters describe.

    Parameters
    ----------
    values
        As :func:`fieldtool.records.closed_loop.loop_from_parameters` has them, and where there is
        one ``velocity_filter``, Hz (0 or infinite: off).
    timing
        Of the drive.

    Raises
    ------
    KeyError
        If a loop gain is missing.
    """
    corner = values.get("velocity_filter", OFF)
    return Servo(loop_from_parameters(values), corner if corner > 0 else OFF, timing)


def gains_of(servos: tuple[Servo, ...], omega: FloatArray) -> ComplexArray:
    """Return all axes' torque per position error, shape (F, M), at ``omega``, rad/s."""
    s = 1j * omega
    return np.column_stack([servo.gain(s) for servo in servos])
