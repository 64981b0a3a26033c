"""One inner step of every drive and of the plant, compiled: the loops that run at 8 kHz.

An inner step from t to t + h, with everything at time t sampled already::

    reference(t) ─▶ position P ─▶ velocity PI ─▶ + feed-forward ─▶ biquad 1 ─▶ biquad 2 ─▶ limit
                        ▲             ▲                                                     │
                        └─ encoder(t) ┘                   plant ◀─ current loop, 1st order ◀┘

then the plant moves, and encoder, velocity estimate and reference are sampled at t + h.  So all
values that can be read between two calls belong to the same instant.

The current loop is a first-order lag, solved exactly.  The plant gets the mean torque of the step
(held over it), not its value at the start: momentum is then exact, and torque and position that
are read at one instant belong together to a tenth of a step (8 us at 1 kHz bandwidth).

What a loop does not use at the moment follows what is measured, so that switching to it gives no
jerk: the position reference follows the position outside of the position modes, the integrator
follows the torque reference in torque mode, the torque reference follows the PI's output outside of
torque mode.

A plant with dry friction is stepped piece by piece inside the inner step; how stands in
:mod:`drives.sim.stick_slip`, which makes the tables that :class:`Holding` names.

Columns of the arrays are named by the enumerations below, which is why these live here: numba's
cache sees changes in this file only.
"""

from enum import IntEnum
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from drives.compiled import compiled

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]


class Parameter(IntEnum):
    """What can be set in a drive, per axis; rad and N m, or m and N on a linear axis."""

    POSITION_P = 0
    """1/s: velocity reference per position error."""
    VELOCITY_P = 1
    """N m s/rad: torque per velocity error."""
    VELOCITY_I = 2
    """N m/rad: torque per integral of the velocity error; 0 empties the integrator."""
    VELOCITY_FF = 3
    """Fraction of the position reference's velocity that is added to the velocity reference."""
    INERTIA_FF = 4
    """kg m2: torque per acceleration of the reference."""
    VELOCITY_FILTER = 5
    """Hz: first-order low-pass on the velocity estimate; infinite = off."""
    FILTER1_TYPE = 6
    """A ``FilterType``: 0 off, 1 notch, 2 low-pass."""
    FILTER1_FREQUENCY = 7
    """Hz."""
    FILTER1_ZERO_DAMPING = 8
    """Damping ratio of the notch's zeros."""
    FILTER1_POLE_DAMPING = 9
    """Damping ratio of the poles."""
    FILTER2_TYPE = 10
    """As filter 1."""
    FILTER2_FREQUENCY = 11
    """Hz."""
    FILTER2_ZERO_DAMPING = 12
    """As filter 1."""
    FILTER2_POLE_DAMPING = 13
    """As filter 1."""
    TORQUE_LIMIT = 14
    """N m; the hardware's peak torque holds as well."""
    FOLLOWING_ERROR_WINDOW = 15
    """rad; infinite = off."""
    FOLLOWING_ERROR_TIMEOUT = 16
    """s that the error must stay outside of the window."""
    VELOCITY_OFFSET = 17
    """rad/s, added to the velocity reference (0x60B1)."""
    TORQUE_OFFSET = 18
    """N m, added to the torque reference in every mode (0x60B2)."""
    TORQUE_SLOPE = 19
    """N m/s in torque mode; infinite = the target acts at once."""
    MAX_VELOCITY = 20
    """rad/s: limit of the velocity reference; infinite = off."""
    POSITION_MIN = 21
    """rad: position targets below are taken as this; -infinite = off."""
    POSITION_MAX = 22
    """rad: position targets above are taken as this; infinite = off."""
    VELOCITY_THRESHOLD = 23
    """rad/s: slower is standstill (0x606F)."""
    VELOCITY_THRESHOLD_TIME = 24
    """s that the axis must stay slow for standstill (0x6070)."""
    VISCOUS_FF = 25
    """N m s/rad: torque per velocity of the position reference."""


class Derived(IntEnum):
    """What follows from parameters and hardware; columns after those of ``Parameter``."""

    COUNTS_PER_UNIT = 26
    VELOCITY_GAIN = 27
    """Share of the new value in the filtered velocity, 0..1."""
    TORQUE_CLAMP = 28
    """The smaller of torque limit and peak torque, N m."""
    CURRENT_DECAY = 29
    """exp(-w h) of the current loop."""
    CURRENT_MEAN = 30
    """Share of the old torque in the mean torque of a step."""
    FILTER1 = 31
    """b0, b1, b2, a1, a2."""
    FILTER2 = 36
    PER_MILLE = 41
    """1000 / rated torque, 1/(N m)."""
    NOISE_PER_MILLE = 42
    """Standard deviation of the measured torque, 1/1000 of rated torque."""
    MOTOR_SIGN = 43
    """1, or -1 where the motor's phases are swapped: it pushes against what is measured."""
    ENCODER_HELD = 44
    """1 while the encoder stands still whatever the motor does."""
    MOTOR_HELD = 45
    """1 while a brake or an obstacle holds the motor where it is."""
    ENCODER_OFFSET = 46
    """Counts by which the encoder is beside the motor."""
    COLUMNS = 47


class Reference(IntEnum):
    """What an axis follows."""

    OFF = 0
    """Power stage off, no torque."""
    POSITION = 1
    """Cyclic position targets with linear interpolation."""
    VELOCITY = 2
    """A velocity with ramps."""
    TORQUE = 3
    """A torque with a slope."""
    PROFILE = 4
    """A planned move with trapezoidal velocity."""


class Signal(IntEnum):
    """Columns of the axes' own state."""

    REFERENCE = 0
    COUNTS = 1
    POSITION = 2
    """As the drive sees it: counts / counts per unit."""
    VELOCITY = 3
    """The drive's estimate."""
    SLOW_STEPS = 4
    POSITION_REFERENCE = 5
    VELOCITY_REFERENCE = 6
    """Of the position reference, or the ramp in velocity mode."""
    ACCELERATION_REFERENCE = 7
    TORQUE_REFERENCE = 8
    """Before offset, filters and limit."""
    VELOCITY_COMMAND = 9
    """Last reference of the velocity loop, all parts added."""
    INTEGRAL = 10
    """N m."""
    TORQUE = 11
    """True motor torque."""
    LIMITED = 12
    ERROR_STEPS = 13
    ERROR_EXCEEDED = 14
    TARGET = 15
    ACCELERATION = 16
    DECELERATION = 17
    INTERVAL_START = 18
    INTERVAL_STEPS = 19
    STEP = 20
    """Inner steps since the interpolation interval or the profile began."""
    PROFILE_DURATION = 21
    PROFILE = 22
    """4 segments: begin, position, velocity, acceleration."""
    FILTER1 = 38
    """x[-1], x[-2], y[-1], y[-2]."""
    FILTER2 = 42
    COLUMNS = 46


class Progress(IntEnum):
    """Columns of what the stepping with friction remembers of an inner step."""

    STEPS = 0
    """Inner steps of this call that are done."""
    LEFT = 1
    """Ticks of the present inner step still to go; 0 before it has begun."""
    BRACKET = 2
    """The next event is known to lie within so many ticks; 0 if none is known."""
    PENDING = 3
    """A ``Pending``."""
    EVENTS = 4
    """Times that masses would have turned back since time last went on."""
    COLUMNS = 5


class Pending(IntEnum):
    """What is to be done before time goes on."""

    NOTHING = 0
    CHECK = 1
    """See whether friction can hold all masses that stand."""
    STOP = 2
    """See whether friction can hold masses whose velocity is about to pass zero."""
    REST = 3
    """Take what is left of the velocity of those that it holds."""


class Outcome(IntEnum):
    """How stepping with friction ended."""

    DONE = 0
    DIVERGED = 1
    NEEDS_SET = 2
    """The tables have nothing for the masses that stand now: add it and call again."""


class Holding(NamedTuple):
    """Dry friction of a plant: F masses that can stick, S sets of standing masses tabulated so far.

    C = 2n + M + F columns stand for state, motor torques and friction torques; more may follow, for
    forces on further masses.
    """

    masses: IntArray
    """Numbers of the masses, shape (F,)."""
    limits: FloatArray
    """Friction torques, N m, shape (F,)."""
    accelerations: FloatArray
    """Of the masses with friction while all move, per column, shape (F, C)."""
    mobility: FloatArray
    """Of the masses with friction per friction torque, 1/(kg m2), shape (F, F)."""
    directions: FloatArray
    """-1, 1: slides that way, 0: stands; shape (F,), changed."""
    passing: BoolArray
    """Velocity passes zero in the present tick; shape (F,), changed."""
    inputs: FloatArray
    """Shape (C,), changed."""
    progress: IntArray
    """Shape (Progress.COLUMNS,), changed."""
    standing: BoolArray
    """The sets, shape (S, F)."""
    increments: FloatArray
    """What each column adds to the state in a piece, shape (S, LEVELS, C, 2n); level k has
    TICKS / 2^k ticks."""
    reactions: FloatArray
    """Friction torque that keeps a standing mass where it is, shape (S, F, C)."""
    carried: FloatArray
    """Velocity that all masses get per velocity taken from one that stops, shape (S, F, n)."""


LEVELS = 9
TICKS = 2 ** (LEVELS - 1)
"""Of an inner step: events are located to one tick, 0.5 us at 8 kHz."""
SWEEPS = 200
"""At most, over masses that break away together."""
POSITION_MODE, PROFILE_MODE = int(Reference.POSITION), int(Reference.PROFILE)
LARGEST_COUNT = 2.0**53
"""Counts beyond this are no longer whole numbers in float64."""
VANISHED = 1e-150


@compiled()
def _settled(value):  # type: ignore[no-untyped-def]
    """A decay that has become immeasurably small ends at 0; denormal numbers are slow."""
    return value if abs(value) > VANISHED else 0.0


@compiled()
def _filtered(signals, settings, state, first, x):  # type: ignore[no-untyped-def]
    """One biquad, direct form I: its memory holds signals, so new coefficients make no jump."""
    y = (
        settings[first] * x
        + settings[first + 1] * signals[state]
        + settings[first + 2] * signals[state + 1]
        - settings[first + 3] * signals[state + 2]
        - settings[first + 4] * signals[state + 3]
    )
    signals[state + 1] = signals[state]
    signals[state] = x
    signals[state + 3] = signals[state + 2]
    signals[state + 2] = _settled(y)
    return signals[state + 2]


@compiled()
def _ramp_velocity(signals, step):  # type: ignore[no-untyped-def]
    """Move the velocity reference one step towards its target; slow down first, then speed up."""
    velocity, target = signals[Signal.VELOCITY_REFERENCE], signals[Signal.TARGET]
    difference = target - velocity
    if velocity * difference < 0.0:
        change = signals[Signal.DECELERATION]
        gradual = change < np.inf or signals[Signal.ACCELERATION] < np.inf
        if gradual and target * velocity < 0.0:
            difference = -velocity  # through zero, where the other ramp begins
    else:
        change = signals[Signal.ACCELERATION]
    if abs(difference) > change * step:
        signals[Signal.VELOCITY_REFERENCE] = velocity + np.copysign(change * step, difference)
        signals[Signal.ACCELERATION_REFERENCE] = np.copysign(change, difference)
    else:
        signals[Signal.VELOCITY_REFERENCE] = velocity + difference
        ramped = change < np.inf
        signals[Signal.ACCELERATION_REFERENCE] = difference / step if ramped else 0.0


@compiled()
def _ramp_torque(signals, settings, step):  # type: ignore[no-untyped-def]
    torque, target = signals[Signal.TORQUE_REFERENCE], signals[Signal.TARGET]
    change = settings[Parameter.TORQUE_SLOPE] * step
    if abs(target - torque) > change:
        torque += np.copysign(change, target - torque)
    else:
        torque = target
    signals[Signal.TORQUE_REFERENCE] = torque


@compiled()
def _velocity_error(signals, settings, mode, step):  # type: ignore[no-untyped-def]
    """Position loop, and what else makes the velocity reference."""
    if mode == Reference.VELOCITY:
        _ramp_velocity(signals, step)
        command = signals[Signal.VELOCITY_REFERENCE]
    else:
        if mode == Reference.POSITION and signals[Signal.STEP] >= signals[Signal.INTERVAL_STEPS]:
            signals[Signal.VELOCITY_REFERENCE] = 0.0
            signals[Signal.ACCELERATION_REFERENCE] = 0.0
        error = signals[Signal.POSITION_REFERENCE] - signals[Signal.POSITION]
        command = (
            settings[Parameter.POSITION_P] * error
            + settings[Parameter.VELOCITY_FF] * signals[Signal.VELOCITY_REFERENCE]
        )
    fastest = settings[Parameter.MAX_VELOCITY]
    command = min(max(command + settings[Parameter.VELOCITY_OFFSET], -fastest), fastest)
    signals[Signal.VELOCITY_COMMAND] = command
    return command - signals[Signal.VELOCITY]


@compiled()
def _control(signals, settings, step):  # type: ignore[no-untyped-def]
    """All loops of one axis; returns the mean torque of this inner step."""
    mode = int(signals[Signal.REFERENCE])
    if mode == Reference.OFF:
        return 0.0
    limit = settings[Derived.TORQUE_CLAMP]
    gain = settings[Parameter.VELOCITY_I]
    error = 0.0
    if mode == Reference.TORQUE:
        _ramp_torque(signals, settings, step)
    else:
        error = _velocity_error(signals, settings, mode, step)
        if gain == 0.0:
            signals[Signal.INTEGRAL] = 0.0
        signals[Signal.TORQUE_REFERENCE] = (
            settings[Parameter.VELOCITY_P] * error
            + signals[Signal.INTEGRAL]
            + settings[Parameter.INERTIA_FF] * signals[Signal.ACCELERATION_REFERENCE]
        )
        if mode != Reference.VELOCITY:
            signals[Signal.TORQUE_REFERENCE] += (
                settings[Parameter.VISCOUS_FF] * signals[Signal.VELOCITY_REFERENCE]
            )
    wanted = signals[Signal.TORQUE_REFERENCE] + settings[Parameter.TORQUE_OFFSET]
    wanted = _filtered(signals, settings, Signal.FILTER1, Derived.FILTER1, wanted)
    wanted = _filtered(signals, settings, Signal.FILTER2, Derived.FILTER2, wanted)
    given = min(max(wanted, -limit), limit)
    signals[Signal.LIMITED] = 1.0 if given != wanted else 0.0
    if mode == Reference.TORQUE:
        integral = signals[Signal.TORQUE_REFERENCE]
    else:
        integral = signals[Signal.INTEGRAL]
        if (wanted - given) * error <= 0.0:  # else it would only push further into the limit
            integral += gain * error * step
    signals[Signal.INTEGRAL] = min(max(integral, -limit), limit)
    lag = signals[Signal.TORQUE] - given
    signals[Signal.TORQUE] = _settled(given + settings[Derived.CURRENT_DECAY] * lag)
    return given + settings[Derived.CURRENT_MEAN] * lag


@compiled()
def _move_reference(signals, step):  # type: ignore[no-untyped-def]
    """Position reference at the end of the inner step."""
    mode = int(signals[Signal.REFERENCE])
    if mode == Reference.POSITION:
        steps = signals[Signal.INTERVAL_STEPS]
        passed = min(signals[Signal.STEP] + 1.0, steps)
        signals[Signal.STEP] = passed
        start, target = signals[Signal.INTERVAL_START], signals[Signal.TARGET]
        moved = start + (target - start) * (passed / steps)
        signals[Signal.POSITION_REFERENCE] = moved if passed < steps else target
    elif mode == Reference.PROFILE:
        signals[Signal.STEP] += 1.0
        _place_on_profile(signals, signals[Signal.STEP] * step)
    else:
        signals[Signal.POSITION_REFERENCE] = signals[Signal.POSITION]
        if mode != Reference.VELOCITY:
            signals[Signal.VELOCITY_REFERENCE] = signals[Signal.VELOCITY]


@compiled()
def _place_on_profile(signals, time):  # type: ignore[no-untyped-def]
    """Reference, its velocity and its acceleration at a time since the profile began."""
    if time >= signals[Signal.PROFILE_DURATION]:
        signals[Signal.POSITION_REFERENCE] = signals[Signal.TARGET]
        signals[Signal.VELOCITY_REFERENCE] = 0.0
        signals[Signal.ACCELERATION_REFERENCE] = 0.0
        return
    segment = 0
    for later in range(1, 4):
        if time >= signals[Signal.PROFILE + 4 * later]:
            segment = later
    at = Signal.PROFILE + 4 * segment
    passed = time - signals[at]
    velocity, acceleration = signals[at + 2], signals[at + 3]
    signals[Signal.POSITION_REFERENCE] = (
        signals[at + 1] + (velocity + 0.5 * acceleration * passed) * passed
    )
    signals[Signal.VELOCITY_REFERENCE] = velocity + acceleration * passed
    signals[Signal.ACCELERATION_REFERENCE] = acceleration


@compiled()
def _sample(signals, settings, position, step):  # type: ignore[no-untyped-def]
    """Encoder, velocity estimate, reference and what is watched, at the end of the inner step."""
    counts = np.floor(position * settings[Derived.COUNTS_PER_UNIT])
    counts += settings[Derived.ENCODER_OFFSET]
    if settings[Derived.ENCODER_HELD] != 0.0:
        counts = signals[Signal.COUNTS]
    moved = (counts - signals[Signal.COUNTS]) / settings[Derived.COUNTS_PER_UNIT]
    signals[Signal.COUNTS] = counts
    signals[Signal.POSITION] = counts / settings[Derived.COUNTS_PER_UNIT]
    velocity = signals[Signal.VELOCITY]
    velocity += settings[Derived.VELOCITY_GAIN] * (moved / step - velocity)
    signals[Signal.VELOCITY] = _settled(velocity)
    slow = abs(velocity) <= settings[Parameter.VELOCITY_THRESHOLD]
    signals[Signal.SLOW_STEPS] = signals[Signal.SLOW_STEPS] + 1.0 if slow else 0.0
    _move_reference(signals, step)
    error = abs(signals[Signal.POSITION_REFERENCE] - signals[Signal.POSITION])
    if error > settings[Parameter.FOLLOWING_ERROR_WINDOW]:
        signals[Signal.ERROR_STEPS] += 1.0
        if signals[Signal.ERROR_STEPS] * step > settings[Parameter.FOLLOWING_ERROR_TIMEOUT]:
            signals[Signal.ERROR_EXCEEDED] = 1.0
    else:
        signals[Signal.ERROR_STEPS] = 0.0


@compiled()
def _hold_motor(state, motor, position):  # type: ignore[no-untyped-def]
    """Leave a motor where it was, at rest: what holds it is stronger than anything else."""
    state[motor] = position
    state[state.size // 2 + motor] = 0.0


@compiled()
def advance(steps, step, state, signals, settings, increments, motors):  # type: ignore[no-untyped-def]
    """Step plant and drives; True if every number is still good.

    Parameters
    ----------
    steps
        Number of inner steps.
    step
        Duration of one, s.
    state
        (q, q'), shape (2n,); changed.
    signals, settings
        Shapes (M, Signal.COLUMNS), changed, and (M, Derived.COLUMNS).
    increments
        Shape (2n + M, 2n): rows are what a unit of each state and of each motor torque adds to the
        state in one step, the transposes of Ad - I and of Bd's motor columns.
    motors
        Number of each motor's mass, shape (M,).
    """
    order, axes = state.size, motors.size
    old = np.empty(order + axes)
    for _ in range(steps):
        for i in range(order):
            old[i] = state[i]
        for axis in range(axes):
            torque = _control(signals[axis], settings[axis], step)
            old[order + axis] = settings[axis, Derived.MOTOR_SIGN] * torque
        for j in range(order + axes):
            value = old[j]
            for i in range(order):
                state[i] += increments[j, i] * value
        for axis in range(axes):
            if settings[axis, Derived.MOTOR_HELD] != 0.0:
                _hold_motor(state, motors[axis], old[motors[axis]])
            _sample(signals[axis], settings[axis], state[motors[axis]], step)
    return _countable(state, settings, motors)


@compiled()
def _countable(state, settings, motors):  # type: ignore[no-untyped-def]
    """Every number is finite and within what the encoders can count."""
    good = True
    for i in range(state.size):
        good = good and np.isfinite(state[i])
    for axis in range(motors.size):
        counts = state[motors[axis]] * settings[axis, Derived.COUNTS_PER_UNIT]
        good = good and abs(counts) <= LARGEST_COUNT
    return good


@compiled()
def advance_holding(steps, step, state, signals, settings, motors, holding):  # type: ignore[no-untyped-def]
    """Step plant and drives as :func:`advance`, with friction; returns an ``Outcome``.

    After NEEDS_SET the same call goes on where it stopped, even within an inner step.

    Parameters
    ----------
    steps, step, state, signals, settings, motors
        As for :func:`advance`.
    holding
        A ``Holding``; its progress begins with zeros.
    """
    order, axes = state.size, motors.size
    progress, inputs = holding.progress, holding.inputs
    change = np.empty(order)
    before = np.empty(axes)
    for axis in range(axes):
        before[axis] = state[motors[axis]]
    while progress[Progress.STEPS] < steps:
        if progress[Progress.LEFT] == 0:
            for axis in range(axes):
                before[axis] = state[motors[axis]]
                torque = _control(signals[axis], settings[axis], step)
                inputs[order + axis] = settings[axis, Derived.MOTOR_SIGN] * torque
            progress[Progress.LEFT] = TICKS
            progress[Progress.BRACKET] = 0
            progress[Progress.PENDING] = Pending.CHECK
            progress[Progress.EVENTS] = 0
        if not _move_holding(state, axes, holding, change):
            return Outcome.NEEDS_SET
        for axis in range(axes):
            if settings[axis, Derived.MOTOR_HELD] != 0.0:
                _hold_motor(state, motors[axis], before[axis])
            _sample(signals[axis], settings[axis], state[motors[axis]], step)
        progress[Progress.STEPS] += 1
    progress[Progress.STEPS] = 0
    if _countable(state, settings, motors):
        return Outcome.DONE
    return Outcome.DIVERGED


@compiled()
def _move_holding(state, axes, holding, change):  # type: ignore[no-untyped-def]
    """Move the plant to the end of the inner step, piece by piece; False if a set is missing."""
    order, progress, inputs = state.size, holding.progress, holding.inputs
    while progress[Progress.LEFT] > 0:
        found = _find_set(holding)
        if found < 0:
            return False
        pending = progress[Progress.PENDING]
        if pending == Pending.REST:
            _take_velocity(state, holding, found)
        for i in range(order):
            inputs[i] = state[i]
        for k in range(holding.masses.size):
            acts = not holding.passing[k]
            inputs[order + axes + k] = -holding.limits[k] * holding.directions[k] * acts
        progress[Progress.PENDING] = Pending.NOTHING
        if pending == Pending.CHECK or pending == Pending.STOP:  # noqa: PLR1714
            freed = not _holds(holding, found) and _break_away(holding)
            if pending == Pending.STOP:
                for k in range(holding.masses.size):
                    holding.passing[k] = holding.passing[k] and holding.directions[k] != 0.0
                progress[Progress.PENDING] = Pending.REST
            if freed or pending == Pending.STOP:
                continue
        _try_piece(state, holding, found, change)
    return True


@compiled()
def _try_piece(state, holding, found, change):  # type: ignore[no-untyped-def]
    """Take a piece of the step if nothing happens in it, else look closer or note the event."""
    order, progress, inputs = state.size, holding.progress, holding.inputs
    wanted = progress[Progress.LEFT]
    if holding.passing.any():
        wanted = 1
    elif progress[Progress.BRACKET] > 0:
        wanted = max(progress[Progress.BRACKET] // 2, 1)
    level, ticks = 0, TICKS
    while ticks > wanted:
        level, ticks = level + 1, ticks // 2
    table = holding.increments[found, level]
    for i in range(order):
        change[i] = 0.0
    for j in range(inputs.size):
        value = inputs[j]
        for i in range(order):
            change[i] += table[j, i] * value
    last = ticks == 1
    if _turns_back(state, holding, change, last):
        progress[Progress.BRACKET] = 0 if last else ticks
        return
    for i in range(order):
        inputs[i] = state[i] + change[i]
    holds = _holds(holding, found)
    if not (holds or last):
        progress[Progress.BRACKET] = ticks
        return
    for i in range(order):
        state[i] += change[i]
    progress[Progress.LEFT] -= ticks
    progress[Progress.BRACKET] = max(progress[Progress.BRACKET] - ticks, 0)
    progress[Progress.EVENTS] = 0
    holding.passing[:] = False
    if not holds:
        progress[Progress.BRACKET] = 0
        progress[Progress.PENDING] = Pending.CHECK


@compiled()
def _find_set(holding):  # type: ignore[no-untyped-def]
    """Row of the tables for the masses that stand now, or -1."""
    for row in range(holding.standing.shape[0]):
        same = True
        for k in range(holding.masses.size):
            same = same and holding.standing[row, k] == (holding.directions[k] == 0.0)
        if same:
            return row
    return -1


@compiled()
def _take_velocity(state, holding, found):  # type: ignore[no-untyped-def]
    """Bring standing masses to velocity 0 by a push on them alone: the others' momentum stays."""
    size = state.size // 2
    for k in range(holding.masses.size):
        mass = holding.masses[k]
        velocity = state[size + mass]
        if holding.directions[k] == 0.0 and velocity != 0.0:
            for i in range(size):
                state[size + i] += holding.carried[found, k, i] * velocity
            state[size + mass] = 0.0


@compiled()
def _turns_back(state, holding, change, last):  # type: ignore[no-untyped-def]
    """A sliding mass would go against its direction in this piece; if it is the last, note which.

    Where there is none, friction takes energy out of the machine in this piece.
    """
    size, count, progress = state.size // 2, holding.masses.size, holding.progress
    endless = progress[Progress.EVENTS] > 2 * count
    found = False
    for k in range(count):
        mass, direction = holding.masses[k], holding.directions[k]
        velocity = state[size + mass] + change[size + mass]
        against = direction * velocity < 0.0 or direction * change[mass] < 0.0
        if against and not holding.passing[k]:
            found = True
            if last:
                holding.passing[k] = True
                if not endless:
                    holding.directions[k] = 0.0
    if found and last:
        progress[Progress.EVENTS] += 1
        if not endless:
            progress[Progress.PENDING] = Pending.STOP
    return found


@compiled()
def _holds(holding, found):  # type: ignore[no-untyped-def]
    """Friction can keep every standing mass where it is, with the state that inputs hold."""
    for k in range(holding.masses.size):
        if holding.directions[k] == 0.0:
            needed = 0.0
            for j in range(holding.inputs.size):
                needed += holding.reactions[found, k, j] * holding.inputs[j]
            if abs(needed) > holding.limits[k]:
                return False
    return True


@compiled()
def _break_away(holding):  # type: ignore[no-untyped-def]
    """Let go what friction can not hold; True if that is any mass.

    Friction r of the standing masses is the one minimum of r' W r / 2 + r' a within the limits,
    with W the mobility and a the accelerations without it: a mass whose friction stays within
    stands, one at its limit accelerates against it.  Found by relaxing mass after mass.
    """
    count = holding.masses.size
    friction, acceleration = np.zeros(count), holding.accelerations @ holding.inputs
    for _ in range(SWEEPS):
        moved = False
        for k in range(count):
            if holding.directions[k] == 0.0:
                limit, own = holding.limits[k], holding.mobility[k, k]
                wanted = min(max(friction[k] - acceleration[k] / own, -limit), limit)
                difference = wanted - friction[k]
                moved = moved or abs(difference) > 1e-14 * limit
                friction[k] = wanted
                for i in range(count):
                    acceleration[i] += holding.mobility[i, k] * difference
        if not moved:
            break
    freed = False
    for k in range(count):
        pushed = abs(friction[k]) == holding.limits[k] and friction[k] * acceleration[k] < 0.0
        if holding.directions[k] == 0.0 and pushed:
            holding.directions[k] = np.sign(acceleration[k])
            freed = True
    return freed


@compiled()
def follow_position(signals, settings, target, steps, step):  # type: ignore[no-untyped-def]
    """Begin a new interpolation interval of one axis; it has ``steps`` inner steps."""
    target = min(max(target, settings[Parameter.POSITION_MIN]), settings[Parameter.POSITION_MAX])
    before = int(signals[Signal.REFERENCE])
    velocity = (target - signals[Signal.POSITION_REFERENCE]) / (steps * step)
    change = 0.0
    if before == Reference.POSITION or before == Reference.PROFILE:  # noqa: PLR1714
        last = signals[Signal.VELOCITY_REFERENCE]
        if before == Reference.POSITION and last == 0.0:  # it stands at its target: a late SYNC
            way = signals[Signal.TARGET] - signals[Signal.INTERVAL_START]
            last = way / (signals[Signal.INTERVAL_STEPS] * step)
        change = velocity - last
    signals[Signal.REFERENCE] = float(POSITION_MODE)
    signals[Signal.INTERVAL_START] = signals[Signal.POSITION_REFERENCE]
    signals[Signal.INTERVAL_STEPS] = steps
    signals[Signal.STEP] = 0.0
    signals[Signal.TARGET] = target
    signals[Signal.VELOCITY_REFERENCE] = velocity
    signals[Signal.ACCELERATION_REFERENCE] = change / (steps * step)


@compiled()
def begin_profile(signals, duration, target, segments):  # type: ignore[no-untyped-def]
    """Take over a planned profile: ``segments``, shape (4, 4), as columns from PROFILE have them."""
    signals[Signal.REFERENCE] = float(PROFILE_MODE)
    signals[Signal.TARGET] = target
    signals[Signal.PROFILE_DURATION] = duration
    for number in range(segments.shape[0]):
        for part in range(segments.shape[1]):
            signals[Signal.PROFILE + 4 * number + part] = segments[number, part]
    signals[Signal.STEP] = 0.0
    _place_on_profile(signals, 0.0)


@compiled()
def latch(signals, settings, noise, counts, torque, velocity):  # type: ignore[no-untyped-def]
    """Write counts, torque in 1/1000 of rated torque and velocity of all axes, each shape (M,).

    ``noise``, shape (M,), holds one draw of the standard normal distribution per axis.
    """
    for axis in range(counts.size):
        counts[axis] = np.int64(signals[axis, Signal.COUNTS])
        true = signals[axis, Signal.TORQUE] * settings[axis, Derived.PER_MILLE]
        noisy = true + noise[axis] * settings[axis, Derived.NOISE_PER_MILLE]
        torque[axis] = np.int64(np.rint(noisy))
        velocity[axis] = signals[axis, Signal.VELOCITY]
