"""One inner step of drives and plant with elements and imperfect shafts.

As :func:`drives.sim.servo_kernel.advance_holding`, which does without both.  It is compiled anew in
every process that needs it (one or two seconds), because numba's cache would not see changes in the
files that its parts stand in.
"""

from numba import njit

from drives.sim.element_kernel import delivered, element_forces, queue_counts, seen
from drives.sim.servo_kernel import (
    TICKS,
    Derived,
    Outcome,
    Pending,
    Progress,
    Reference,
    Signal,
    _control,
    _countable,
    _hold_motor,
    _move_holding,
    _sample,
)


@njit
def advance_forced(  # type: ignore[no-untyped-def]
    steps,
    done,
    step,
    state,
    signals,
    settings,
    motors,
    holding,
    elements,
    shafts,
    brakes,
    released,
    forces,
):
    """Step plant and drives; returns an ``Outcome``.

    After NEEDS_SET the same call goes on where it stopped, even within an inner step.

    Parameters
    ----------
    steps, step, state, signals, settings, motors, holding
        As for ``advance_holding``; ``holding.inputs`` ends with the forces of the pushed masses.
    done
        Inner steps since the start of time, before this call.
    elements, shafts
        What else acts.
    brakes
        Place of each axis' brake among the masses that can be held, shape (M,); -1: none.
    released
        Friction of each axis' brake mass with the brake open, and closed, N m, shape (M, 2).
    forces
        Work space, shape (F,).
    """
    order, axes = state.size, motors.size
    progress, inputs = holding.progress, holding.inputs
    first = order + axes + holding.masses.size
    change, before = state.copy(), state[motors]
    while progress[Progress.STEPS] < steps:
        if progress[Progress.LEFT] == 0:
            before[:] = state[motors]
            time = (done + progress[Progress.STEPS]) * step
            for axis in range(axes):
                torque = delivered(axis, _control(signals[axis], settings[axis], step), shafts)
                inputs[order + axis] = settings[axis, Derived.MOTOR_SIGN] * torque
                if brakes[axis] >= 0:
                    off = int(signals[axis, Signal.REFERENCE]) == Reference.OFF
                    holding.limits[brakes[axis]] = released[axis, 1 if off else 0]
            element_forces(state, elements, time, step, forces)
            for k in range(forces.size):
                inputs[first + k] = forces[k]
            progress[Progress.LEFT] = TICKS
            progress[Progress.BRACKET] = 0
            progress[Progress.PENDING] = Pending.CHECK
            progress[Progress.EVENTS] = 0
        if not _move_holding(state, axes, holding, change):
            return Outcome.NEEDS_SET
        shafts.places[0] = (shafts.places[0] + 1) % shafts.queue.shape[1]
        for axis in range(axes):
            if settings[axis, Derived.MOTOR_HELD] != 0.0:
                _hold_motor(state, motors[axis], before[axis])
            _sample(signals[axis], settings[axis], seen(axis, state[motors[axis]], shafts), step)
            queue_counts(axis, signals[axis, Signal.COUNTS], shafts)
        progress[Progress.STEPS] += 1
    progress[Progress.STEPS] = 0
    if _countable(state, settings, motors):
        return Outcome.DONE
    return Outcome.DIVERGED
