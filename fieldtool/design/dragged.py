"""What dry friction makes of a move: the linear response in frequency, and friction's own in time.

The machine under its loops is linear but for friction at some masses, so with x the state of the closed
loops and v0 what the reference alone does to the velocities of these masses::

    x[k+1] = F x[k] + G f[k]          v[k+1] = v0[k+1] + V x[k+1]

f is held over a step.  It is what Coulomb's law at the end of the step makes it: as much as it takes to
stand, where that is within the limit, else the limit against the motion (time stepping after Moreau; see
Acary and Brogliato, Numerical Methods for Nonsmooth Dynamical Systems, 2008, chapter 10).  So a mass
stands where it stands, without a smoothing constant.  Several masses are solved in turn (Gauss and
Seidel, projected); the problem is convex.
"""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import expm

from drives.compiled import compiled
from fieldtool.design.loops import ComplexArray, state_space
from fieldtool.design.machine import Machine, Response
from fieldtool.design.servo import Servo
from fieldtool.records.model import FloatArray

SWEEPS = 12
CLOSE = 1e-9
"""Of the largest friction: what a sweep may still change."""


@dataclass(frozen=True, eq=False)
class Dragged:
    """What friction adds to a motion, shape (N,) each, at the end of each step; SI."""

    motor: FloatArray
    load: FloatArray
    torque: FloatArray


def rubbing(
    machine: Machine, response: Response, motors: ComplexArray, torques: ComplexArray
) -> ComplexArray:
    """Return the positions of the D masses with dry friction, (F, D).

    Parameters
    ----------
    machine
        With friction on D masses, each a motor or a last mass.
    response
        Of the machine to torques, at F frequencies.
    motors, torques
        Positions of all motors, torques of all drives, (F, M).
    """
    loads = np.einsum("fjk,fk->fj", response.loads, torques)
    columns = [
        motors[:, np.flatnonzero(machine.motors == dry.place)[0]]
        if dry.place in machine.motors
        else loads[:, np.flatnonzero(machine.loads == dry.place)[0]]
        for dry in machine.dry
    ]
    return np.stack(columns, axis=-1)


def dragged(
    machine: Machine, servos: tuple[Servo, ...], axis: int, step: float, velocities: FloatArray
) -> Dragged:
    """Return what dry friction adds to the motion of an axis that begins at rest.

    Parameters
    ----------
    machine
        With friction on D masses.
    servos
        One an axis.
    axis
        Whose motor, last mass and torque are wanted.
    step
        s.
    velocities
        Of the D masses without friction, shape (N, D), rad/s or m/s, from rest.
    """
    a, torques = state_space(machine, servos)
    n, size = machine.mass.shape[0], a.shape[0]
    places = np.array([dry.place for dry in machine.dry])
    pushed = np.zeros((size, places.size))
    pushed[n : 2 * n] = np.linalg.inv(machine.mass)[:, places]
    whole = np.zeros((size + places.size,) * 2)
    whole[:size, :size], whole[:size, size:] = a, pushed
    exact = expm(whole * step)
    seen = np.zeros((3, size))
    seen[0, machine.motors[axis]] = seen[1, machine.loads[axis]] = 1.0
    seen[2] = torques[axis]
    limits = np.array([[d.forward, d.backward, d.extra, d.velocity] for d in machine.dry])
    out = _march(
        np.ascontiguousarray(exact[:size, :size]),
        np.ascontiguousarray(exact[:size, size:]),
        n + places,
        seen,
        limits,
        np.ascontiguousarray(velocities),
    )
    return Dragged(out[:, 0], out[:, 1], out[:, 2])


@compiled()
def _march(
    ahead: FloatArray,
    pushed: FloatArray,
    rows: FloatArray,
    seen: FloatArray,
    limits: FloatArray,
    velocities: FloatArray,
) -> FloatArray:
    count, masses = velocities.shape
    out = np.zeros((count, 3))
    x = np.zeros(ahead.shape[0])
    force = np.zeros(masses)
    speed = velocities[0].copy()
    largest = limits[:, :3].max()
    for k in range(1, count):
        x = ahead @ x
        free = velocities[k].copy()
        for i in range(masses):
            free[i] += x[rows[i]]
        for _ in range(SWEEPS):
            change = 0.0
            for i in range(masses):
                v = free[i]
                for j in range(masses):
                    v += pushed[rows[i], j] * force[j]
                extra = limits[i, 2] * np.exp(-((speed[i] / limits[i, 3]) ** 2))
                wanted = force[i] - v / pushed[rows[i], i]
                held = min(max(wanted, -limits[i, 0] - extra), limits[i, 1] + extra)
                change = max(change, abs(held - force[i]))
                force[i] = held
            if change <= CLOSE * largest:
                break
        x = x + pushed @ force
        for i in range(masses):
            speed[i] = velocities[k, i] + x[rows[i]]
        out[k] = seen @ x
    return out
