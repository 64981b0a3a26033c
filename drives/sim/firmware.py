"""The drives' control loops on the simulated plant, as real servo drives have them.

Encoder, position P, velocity PI, feed-forward, two filters, limits and the current loop of every
axis run at the inner rate (8 kHz) together with the plant, in one compiled loop; how one inner step
goes stands in :mod:`drives.sim.servo_kernel`.  This module is the side that a CANopen node talks to:
parameters, what to follow, what can be read.

What it does not imitate: the time that the loop needs to compute, the power stage's ripple and
saturation of its voltage, temperature, and a velocity limit in torque mode.

Rotary axes are in rad and N m, linear axes in m and N; docstrings say rad and N m for both.
"""

from collections.abc import Sequence
from dataclasses import astuple
from math import exp, isfinite, isnan, pi
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from drives.errors import DrivesError
from drives.sim import servo_kernel
from drives.sim.biquad import FilterType, biquad
from drives.sim.element_kernel import Elements, Shafts, late_counts, seen
from drives.sim.forced_kernel import advance_forced
from drives.sim.imperfect import element_tables, has_servo_effect, pushed_masses, shaft_tables
from drives.sim.plant import Plant, PlantParameters
from drives.sim.servo_kernel import Derived, Outcome, Parameter, Reference, Signal
from drives.sim.servo_settings import DriveHardware, ParameterRange, factory_values, ranges
from drives.sim.stick_slip import StickSlip
from drives.sim.trapezoid import plan_trapezoid

__all__ = [
    "DriveHardware",
    "FilterType",
    "Parameter",
    "ParameterRange",
    "Reference",
    "SimulatedAxes",
    "SimulationDivergedError",
]

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

_NOISE_BLOCK = 4096
_FILTERS = (
    (Parameter.FILTER1_TYPE, Derived.FILTER1),
    (Parameter.FILTER2_TYPE, Derived.FILTER2),
)
"""First of the four parameters, first of the five coefficients."""


class _Imperfect(NamedTuple):
    """What acts beside chains, dry friction and ideal shafts."""

    elements: Elements
    shafts: Shafts
    forces: FloatArray


class SimulationDivergedError(DrivesError):
    """The simulated machine's state is no number any more, or beyond what its encoder can count."""


class SimulatedAxes:
    """M drives and the machine that they move, in virtual time.

    Nothing moves until :meth:`advance`.  What is read in between belongs to one instant, the end of
    the last inner step.  Axes start at rest at position 0 with the power stage off and all gains
    zero.

    Switching between what an axis follows is bumpless:

    - From off or torque to anything: the position reference starts at the actual position; ramps
      and profiles start at the actual velocity (0 at standstill); the integrator starts at 0 from
      off and at the present torque reference from torque mode.
    - From a position mode to velocity: the ramp starts at the velocity loop's present reference.
    - From velocity to a profile: the profile starts at the present velocity, as far ahead of the
      actual position as the position loop needs for that velocity.
    - From velocity to cyclic position: the reference starts at the actual position; the next
      targets say how it goes on.
    - To torque: the torque reference starts at its present value and takes the slope from there.

    Parameters
    ----------
    plant_parameters
        The machine, M chains.
    hardware
        One per chain.
    seed
        Of the measurement noise; the same seed and the same calls give the same numbers.
    rate
        Inner steps per second, Hz.

    Raises
    ------
    ValueError
        If the number of drives is not that of chains, or the rate is not above 0.
    """

    def __init__(
        self,
        plant_parameters: PlantParameters,
        hardware: Sequence[DriveHardware],
        seed: int,
        rate: float = 8000.0,
    ) -> None:
        if not (isfinite(rate) and rate > 0.0):
            raise ValueError(f"rate is {rate} Hz; it must be finite and above 0")
        if len(hardware) != len(plant_parameters.chains):
            raise ValueError(
                f"the machine has {len(plant_parameters.chains)} chains, so it needs as many "
                f"drives, got {len(hardware)}"
            )
        self.plant = Plant(plant_parameters)
        self.hardware = tuple(hardware)
        self.rate = float(rate)
        self._steps, self._step = 0, 1.0 / self.rate
        self._motors = self.plant.motors.astype(np.int64)
        increment, forced = self.plant.increments(self._step)
        self._increments = np.ascontiguousarray(np.hstack([increment, forced[:, self._motors]]).T)
        self._state = np.zeros(2 * self.plant.size)
        self._stick_slip: StickSlip | None = None
        self._imperfect: _Imperfect | None = None
        elements = self.plant.elements(self._step)
        parts = [chain.effects for chain in plant_parameters.chains]
        if elements or self.plant.brakes.any() or any(has_servo_effect(own) for own in parts):
            self._imperfect = _Imperfect(
                element_tables(elements),
                shaft_tables(parts, self._step),
                np.zeros(len(pushed_masses(elements))),
            )
        if self.plant.breakaway.any() or self._imperfect is not None:
            self._stick_slip = StickSlip(self.plant, self._step, pushed_masses(elements))
        axes = len(self.hardware)
        self._signals = np.zeros((axes, Signal.COLUMNS))
        self._settings = np.zeros((axes, Derived.COLUMNS))
        self._rows, self._settings_rows = list(self._signals), list(self._settings)
        self._ranges = ranges(self.rate)
        self._random = np.random.default_rng(seed)
        self._noise: list[FloatArray] = []
        self._out = (
            np.zeros(axes, dtype=np.int64),
            np.zeros(axes, dtype=np.int64),
            np.zeros(axes),
        )
        for axis, drive in enumerate(self.hardware):
            self._install(axis, drive)

    # -- time -------------------------------------------------------------------------------------

    def advance(self, steps: int) -> None:
        """Let ``steps`` inner steps pass.

        Raises
        ------
        ValueError
            If steps is negative.
        SimulationDivergedError
            If the state is no number any more or beyond what an encoder can count.
        """
        if steps < 0:
            raise ValueError(f"can not advance by {steps} inner steps: time does not run backwards")
        if self._stick_slip is not None:
            good = self._advance_holding(steps, self._stick_slip)
        else:
            good = servo_kernel.advance(
                steps,
                self._step,
                self._state,
                self._signals,
                self._settings,
                self._increments,
                self._motors,
            )
        self._steps += steps
        if not good:
            raise SimulationDivergedError(
                f"the simulated machine diverged before t = {self.time:.6g} s: a position or "
                "velocity is not finite or beyond 2^53 encoder counts; nothing read from it is a "
                "measurement"
            )

    def _advance_holding(self, steps: int, stick_slip: StickSlip) -> bool:
        """With dry friction or other effects; tables that turn out to be missing are made on the way."""
        parts = self._imperfect
        while True:
            if parts is None:
                outcome = servo_kernel.advance_holding(
                    steps,
                    self._step,
                    self._state,
                    self._signals,
                    self._settings,
                    self._motors,
                    stick_slip.tables,
                )
            else:
                outcome = advance_forced(
                    steps,
                    self._steps,
                    self._step,
                    self._state,
                    self._signals,
                    self._settings,
                    self._motors,
                    stick_slip.tables,
                    parts.elements,
                    parts.shafts,
                    stick_slip.brakes,
                    stick_slip.brake_limits,
                    parts.forces,
                )
            if outcome != Outcome.NEEDS_SET:
                return bool(outcome == Outcome.DONE)
            stick_slip.add_set()

    @property
    def time(self) -> float:
        """Seconds since the start, from the number of inner steps: no error adds up."""
        return self._steps / self.rate

    @property
    def axes(self) -> int:
        """M."""
        return len(self.hardware)

    # -- the plant's state ------------------------------------------------------------------------

    @property
    def state(self) -> FloatArray:
        """Positions and velocities of all masses, shape (2n,); a copy."""
        return self._state.copy()

    def set_state(self, state: FloatArray) -> None:
        """Put the machine into a state (q, q'), shape (2n,), with all power stages off.

        Raises
        ------
        ValueError
            If the shape is wrong or a value not finite.
        RuntimeError
            If a power stage is on: its references would no longer fit.
        """
        if state.shape != self._state.shape or not np.all(np.isfinite(state)):
            raise ValueError(
                f"a state has shape {self._state.shape} and finite values, got {state.shape}"
            )
        on = [axis for axis in range(self.axes) if self.reference(axis) != Reference.OFF]
        if on:
            raise RuntimeError(f"axes {on} are on; switch them off before setting the state")
        self._state[:] = state
        if self._stick_slip is not None:
            self._stick_slip.set_state(state)
        for axis, row in enumerate(self._rows):
            scale = self.hardware[axis].counts_per_unit
            motor = int(self._motors[axis])
            position = float(state[motor])
            if self._imperfect is not None:
                position = seen(axis, position, self._imperfect.shafts)
                self._imperfect.shafts.queue[axis] = np.floor(position * scale)
            offset = self._settings.item(axis, Derived.ENCODER_OFFSET)
            row[Signal.COUNTS] = np.floor(position * scale) + offset
            row[Signal.POSITION] = row[Signal.COUNTS] / scale
            row[Signal.VELOCITY] = state[self.plant.size + motor]
            row[Signal.SLOW_STEPS] = 0.0
            self.off(axis)

    # -- parameters -------------------------------------------------------------------------------

    def range_of(self, parameter: Parameter) -> ParameterRange:
        """Values that :meth:`set` takes."""
        return self._ranges[parameter]

    def set(self, axis: int, parameter: Parameter, value: float) -> None:
        """Write one parameter; it acts from the next inner step on.

        Position limits act on targets that come later.  A filter that is switched or moved keeps
        its memory, so that the torque does not jump.

        Raises
        ------
        ValueError
            If the value is not a number or out of :meth:`range_of`.
        """
        allowed = self._ranges[parameter]
        if isnan(value) or not allowed.low <= value <= allowed.high:
            raise ValueError(
                f"axis {axis}: {parameter.name} = {value} {allowed.unit} is out of range; allowed "
                f"is {allowed.low:g} to {allowed.high:g}"
            )
        if parameter in (Parameter.FILTER1_TYPE, Parameter.FILTER2_TYPE) and value % 1.0:
            raise ValueError(
                f"axis {axis}: {parameter.name} = {value} is no filter type {allowed.unit}"
            )
        settings = self._settings[axis]
        settings[parameter] = value
        if Parameter.FILTER1_TYPE <= parameter <= Parameter.FILTER2_POLE_DAMPING:
            self._write_filters(settings)
        elif parameter == Parameter.VELOCITY_FILTER:
            settings[Derived.VELOCITY_GAIN] = 1.0 - exp(-2.0 * pi * value * self._step)
        elif parameter == Parameter.TORQUE_LIMIT:
            settings[Derived.TORQUE_CLAMP] = min(value, self.hardware[axis].peak_torque)

    def get(self, axis: int, parameter: Parameter) -> float:
        """Present value of one parameter."""
        return self._settings.item(axis, parameter)

    # -- defects ----------------------------------------------------------------------------------

    def reverse_motor(self, axis: int, *, defect: bool) -> None:
        """Swap the motor's phases: it pushes against the torque that is asked for and measured."""
        self._settings[axis, Derived.MOTOR_SIGN] = -1.0 if defect else 1.0

    def hold_encoder(self, axis: int, *, defect: bool) -> None:
        """Let the encoder stand where it is now; let go, it shows the true position at once."""
        self._settings[axis, Derived.ENCODER_HELD] = 1.0 if defect else 0.0

    def hold_motor(self, axis: int, *, defect: bool) -> None:
        """Let a closed brake, or an obstacle, hold the motor where it is, whatever its torque."""
        self._settings[axis, Derived.MOTOR_HELD] = 1.0 if defect else 0.0

    def shift_encoder(self, axis: int, counts: int) -> None:
        """Let the encoder jump by so many counts: it is beside the motor from now on."""
        self._settings[axis, Derived.ENCODER_OFFSET] += counts

    def scale_torque_reading(self, axis: int, factor: float) -> None:
        """Let measured torques be so many times what they are; 1 mends it."""
        drive = self.hardware[axis]
        per_mille = factor * 1000.0 / drive.rated_torque
        self._settings[axis, Derived.PER_MILLE] = per_mille
        self._settings[axis, Derived.NOISE_PER_MILLE] = per_mille * drive.torque_noise

    # -- what to follow ---------------------------------------------------------------------------

    def reference(self, axis: int) -> Reference:
        """What the axis follows now."""
        return Reference(int(self._signals.item(axis, Signal.REFERENCE)))

    def off(self, axis: int) -> None:
        """Switch the power stage off: no torque at once, loops and filters forget everything."""
        row = self._rows[axis]
        row[Signal.POSITION_REFERENCE :] = 0.0
        row[Signal.REFERENCE] = Reference.OFF
        row[Signal.POSITION_REFERENCE] = row[Signal.POSITION]
        row[Signal.VELOCITY_REFERENCE] = row[Signal.VELOCITY]

    def follow_position(self, axis: int, target_units: float, steps: int) -> None:
        """Move the position reference to a target in a straight line over ``steps`` inner steps.

        The reference's velocity in this interval is what VELOCITY_FF takes a share of; its change
        from the interval before, spread over this one, is what INERTIA_FF takes (0 in the first
        interval after another mode).  With no next target at the end, the reference stays there at
        velocity 0.  The target, rad, is clamped to POSITION_MIN and POSITION_MAX.

        Raises
        ------
        ValueError
            If the target is not finite or steps is below 1.
        """
        if steps < 1:
            raise ValueError(f"axis {axis}: an interpolation takes at least 1 step, got {steps}")
        if not isfinite(target_units):
            raise ValueError(_no_position(axis, target_units))
        servo_kernel.follow_position(
            self._rows[axis], self._settings_rows[axis], float(target_units), steps, self._step
        )

    def follow_velocity(
        self, axis: int, target: float, acceleration: float, deceleration: float
    ) -> None:
        """Ramp the velocity reference to a target, rad/s.

        Acceleration, rad/s2, holds while the speed grows, deceleration while it falls; infinite is
        a step, which INERTIA_FF does not see.

        Raises
        ------
        ValueError
            If the target is not finite or a ramp not above 0.
        """
        if not (isfinite(target) and acceleration > 0.0 and deceleration > 0.0):
            raise ValueError(
                f"axis {axis}: velocity target {target} rad/s must be finite, acceleration "
                f"{acceleration} and deceleration {deceleration} rad/s2 above 0"
            )
        row = self._rows[axis]
        if row.item(Signal.REFERENCE) != Reference.VELOCITY:
            row[Signal.VELOCITY_REFERENCE] = self._velocity_to_start_with(axis)
            row[Signal.REFERENCE] = Reference.VELOCITY
        row[Signal.TARGET] = target
        row[Signal.ACCELERATION] = acceleration
        row[Signal.DECELERATION] = deceleration

    def follow_torque(self, axis: int, target: float) -> None:
        """Move the torque reference to a target, N m, with TORQUE_SLOPE.

        Filters, torque offset, torque limit and current loop act as in every mode; there is no
        velocity limit.

        Raises
        ------
        ValueError
            If the target is not finite.
        """
        if not isfinite(target):
            raise ValueError(f"axis {axis}: torque target {target} N m must be finite")
        row = self._rows[axis]
        row[Signal.REFERENCE] = Reference.TORQUE
        row[Signal.TARGET] = target

    def follow_profile(
        self,
        axis: int,
        target: float,
        velocity: float,
        acceleration: float,
        deceleration: float,
    ) -> None:
        """Move to a target, rad, with a trapezoidal velocity; while moving, plan anew from there.

        The target is clamped to POSITION_MIN and POSITION_MAX, the velocity to MAX_VELOCITY.

        Raises
        ------
        ValueError
            If the target is not finite or a limit not above 0.
        """
        target = self._allowed_target(axis, target)
        row = self._rows[axis]
        before = int(row.item(Signal.REFERENCE))
        start, speed = row.item(Signal.POSITION_REFERENCE), row.item(Signal.VELOCITY_REFERENCE)
        if before not in (Reference.POSITION, Reference.PROFILE):
            speed = self._velocity_to_start_with(axis)
            start += self._lag(axis, speed)
        plan = plan_trapezoid(
            start,
            speed,
            target,
            min(velocity, self.get(axis, Parameter.MAX_VELOCITY)),
            acceleration,
            deceleration,
        )
        segments = np.array([astuple(segment) for segment in plan.segments])
        servo_kernel.begin_profile(row, plan.duration, plan.target, segments)

    # -- what can be read -------------------------------------------------------------------------

    def position_counts(self, axis: int) -> int:
        """Encoder, counts."""
        return int(self._signals.item(axis, Signal.COUNTS))

    def position(self, axis: int) -> float:
        """Encoder, rad, with its resolution."""
        return self._signals.item(axis, Signal.POSITION)

    def velocity(self, axis: int) -> float:
        """The drive's estimate from encoder counts, filtered, rad/s."""
        return self._signals.item(axis, Signal.VELOCITY)

    def torque(self, axis: int) -> float:
        """True motor torque, N m."""
        return self._signals.item(axis, Signal.TORQUE)

    def measured_torque_per_mille(self, axis: int) -> int:
        """Torque with fresh measurement noise, rounded to 1/1000 of the rated torque."""
        drive = self.hardware[axis]
        noisy = self.torque(axis) + float(self._draw()[axis]) * drive.torque_noise
        return round(noisy * self._settings.item(axis, Derived.PER_MILLE))

    def latch(self) -> tuple[IntArray, IntArray, FloatArray]:
        """What all drives sample at a SYNC: counts, torque in 1/1000 of rated, velocity in rad/s.

        Each of shape (M,), with fresh noise on the torque.  The arrays are used again: they are
        valid until the next call.
        """
        servo_kernel.latch(self._signals, self._settings, self._draw(), *self._out)
        if self._imperfect is not None:
            late_counts(self._imperfect.shafts, self._out[0])
        return self._out

    def reference_position(self, axis: int) -> float:
        """Position reference, rad; the actual position while no position is followed."""
        return self._signals.item(axis, Signal.POSITION_REFERENCE)

    def reference_velocity(self, axis: int) -> float:
        """Last reference of the velocity loop with all its parts, rad/s; 0 when off."""
        return self._signals.item(axis, Signal.VELOCITY_COMMAND)

    def reference_torque(self, axis: int) -> float:
        """Last torque reference before offset, filters and limit, N m; 0 when off."""
        return self._signals.item(axis, Signal.TORQUE_REFERENCE)

    def following_error(self, axis: int) -> float:
        """Position reference minus position, rad; 0 while no position is followed."""
        return self.reference_position(axis) - self.position(axis)

    def following_error_exceeded(self, axis: int) -> bool:
        """The error was outside of the window for longer than the timeout; holds until off."""
        return self._signals.item(axis, Signal.ERROR_EXCEEDED) != 0.0

    def torque_limited(self, axis: int) -> bool:
        """The torque limit acted in the last inner step."""
        return self._signals.item(axis, Signal.LIMITED) != 0.0

    def reference_reached(self, axis: int) -> bool:
        """The reference has arrived at its target (not the motor); False when off."""
        row = self._rows[axis]
        match self.reference(axis):
            case Reference.POSITION:
                return row.item(Signal.STEP) >= row.item(Signal.INTERVAL_STEPS)
            case Reference.VELOCITY:
                return row.item(Signal.VELOCITY_REFERENCE) == row.item(Signal.TARGET)
            case Reference.TORQUE:
                return row.item(Signal.TORQUE_REFERENCE) == row.item(Signal.TARGET)
            case Reference.PROFILE:
                return row.item(Signal.STEP) * self._step >= row.item(Signal.PROFILE_DURATION)
            case Reference.OFF:
                return False

    def standstill(self, axis: int) -> bool:
        """The estimate stayed within VELOCITY_THRESHOLD for VELOCITY_THRESHOLD_TIME."""
        time = self._signals.item(axis, Signal.SLOW_STEPS) * self._step
        return time >= self.get(axis, Parameter.VELOCITY_THRESHOLD_TIME)

    # -- inside -----------------------------------------------------------------------------------

    def _install(self, axis: int, drive: DriveHardware) -> None:
        settings = self._settings[axis]
        current = 2.0 * pi * drive.current_bandwidth * self._step
        settings[Derived.COUNTS_PER_UNIT] = drive.counts_per_unit
        settings[Derived.CURRENT_DECAY] = exp(-current)
        settings[Derived.CURRENT_MEAN] = (1.0 - exp(-current)) / current
        settings[Derived.PER_MILLE] = 1000.0 / drive.rated_torque
        settings[Derived.NOISE_PER_MILLE] = 1000.0 * drive.torque_noise / drive.rated_torque
        settings[Derived.MOTOR_SIGN] = 1.0
        for parameter, value in factory_values(drive, self.rate).items():
            settings[parameter] = value  # all of them before any is checked against another
        for parameter, value in factory_values(drive, self.rate).items():
            self.set(axis, parameter, value)

    def _write_filters(self, settings: FloatArray) -> None:
        for first, derived in _FILTERS:
            kind, frequency, zero, pole = (float(v) for v in settings[first : first + 4])
            filtered = biquad(FilterType(int(kind)), frequency, zero, pole, self.rate)
            settings[derived : derived + 5] = (
                filtered.b0,
                filtered.b1,
                filtered.b2,
                filtered.a1,
                filtered.a2,
            )

    def _allowed_target(self, axis: int, target: float) -> float:
        if not isfinite(target):
            raise ValueError(_no_position(axis, target))
        low, high = self.get(axis, Parameter.POSITION_MIN), self.get(axis, Parameter.POSITION_MAX)
        return min(max(target, low), high)

    def _velocity_to_start_with(self, axis: int) -> float:
        """Where a ramp or a profile takes over, rad/s."""
        row = self._rows[axis]
        match self.reference(axis):
            case Reference.VELOCITY:
                return row.item(Signal.VELOCITY_REFERENCE)
            case Reference.POSITION | Reference.PROFILE:
                return row.item(Signal.VELOCITY_COMMAND) - self.get(axis, Parameter.VELOCITY_OFFSET)
            case _:
                return 0.0 if self.standstill(axis) else row.item(Signal.VELOCITY)

    def _lag(self, axis: int, velocity: float) -> float:
        """How far a reference at constant velocity runs ahead of the axis, rad."""
        gain = self.get(axis, Parameter.POSITION_P)
        if gain == 0.0:
            return 0.0
        return (1.0 - self.get(axis, Parameter.VELOCITY_FF)) * velocity / gain

    def _draw(self) -> FloatArray:
        """One draw of the standard normal distribution per axis, shape (M,)."""
        if not self._noise:
            self._noise = list(self._random.standard_normal((_NOISE_BLOCK, self.axes)))
        return self._noise.pop()


def _no_position(axis: int, target: float) -> str:
    return f"axis {axis}: position target {target} rad must be finite"
