"""What dry friction and weights make of a move: linear in frequency, and what they add in time.

The machine under its loops is linear but for friction at some masses, and for torques that go with the
position of some, so with x the state of the closed loops and v0 what the reference alone does to the
velocities of these masses::

    x[k+1] = F x[k] + G f[k]          v[k+1] = v0[k+1] + V x[k+1]

f is held over a step.  A torque by position is that of where its mass comes without it, less that at the
beginning, which the loops hold already.  Friction is what Coulomb's law at the end of the step makes it:
as much as it takes to stand, where that is within the limit, else the limit against the motion (time
stepping after Moreau; see Acary and Brogliato, Numerical Methods for Nonsmooth Dynamical Systems, 2008,
chapter 10).  So a mass stands where it stands, without a smoothing constant.  Several masses are solved
in turn (Gauss and Seidel, projected); the problem is convex.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
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
    """What friction and weights add to a motion, shape (N,) each, at the end of each step; SI."""

    motor: FloatArray
    load: FloatArray
    torque: FloatArray


def rubbing(
    machine: Machine, response: Response, motors: ComplexArray, torques: ComplexArray
) -> ComplexArray:
    """Return the positions of D masses with dry friction and P with a pull, (F, D + P).

    Parameters
    ----------
    machine
        Each of these masses is a motor or a last mass.
    response
        Of the machine to torques, at F frequencies.
    motors, torques
        Positions of all motors, torques of all drives, (F, M).
    """
    loads = np.einsum("fjk,fk->fj", response.loads, torques)
    columns = [
        (motors if place in machine.motors else loads)[:, machine.axis_of(place)]
        for place in machine.places
    ]
    return np.stack(columns, axis=-1)


def dragged(
    machine: Machine,
    servos: tuple[Servo, ...],
    axis: int,
    step: float,
    velocities: FloatArray,
    positions: FloatArray | None = None,
) -> Dragged:
    """Return what friction and weights add to the motion of an axis that begins at rest.

    Parameters
    ----------
    machine
        With friction on D masses and pulls on P.
    servos
        One an axis.
    axis
        Whose motor, last mass and torque are wanted.
    step
        s.
    velocities
        Of the D masses without all that, shape (N, D), rad/s or m/s, from rest.
    positions
        Of the P masses, shape (N, P), rad or m, from 0; None: weights are left out.
    """
    machine = machine if positions is not None else replace(machine, pulls=())
    paths = np.zeros((velocities.shape[0], 0)) if positions is None else positions
    a, torques = state_space(machine, servos)
    n, size = machine.mass.shape[0], a.shape[0]
    places = np.array(machine.places)
    pushed = np.zeros((size, places.size))
    pushed[n : 2 * n] = np.linalg.inv(machine.mass)[:, places]
    whole = np.zeros((size + places.size,) * 2)
    whole[:size, :size], whole[:size, size:] = a, pushed
    exact = expm(whole * step)
    seen = np.zeros((3, size))
    seen[0, machine.motors[axis]] = seen[1, machine.loads[axis]] = 1.0
    seen[2] = torques[axis]
    limits = np.array([[d.forward, d.backward, d.extra, d.velocity] for d in machine.dry])
    laws = np.array([[pull.torque, pull.order, pull.phase] for pull in machine.pulls])
    out = _march(
        np.ascontiguousarray(exact[:size, :size]),
        np.ascontiguousarray(exact[:size, size:]),
        n,
        places,
        seen,
        limits.reshape(-1, 4),
        np.ascontiguousarray(velocities),
        laws.reshape(-1, 3),
        np.ascontiguousarray(paths),
    )
    return Dragged(out[:, 0], out[:, 1], out[:, 2])


@compiled()
def _march(
    ahead: FloatArray,
    pushed: FloatArray,
    count: int,
    places: NDArray[np.intp],
    seen: FloatArray,
    limits: FloatArray,
    velocities: FloatArray,
    laws: FloatArray,
    positions: FloatArray,
) -> FloatArray:
    steps, masses = velocities.shape
    pulled = positions.shape[1]
    rows = count + places
    out = np.zeros((steps, 3))
    x = np.zeros(ahead.shape[0])
    force = np.zeros(masses + pulled)
    speed = velocities[0].copy()
    largest = 0.0
    for i in range(masses):
        largest = max(largest, limits[i, :3].max())
    for k in range(1, steps):
        x = ahead @ x
        for i in range(pulled):
            there = positions[k, i] + x[places[masses + i]]
            torque, order, phase = laws[i]
            force[masses + i] = torque * (np.sin(phase) - np.sin(order * there + phase))
        free = velocities[k].copy()
        for i in range(masses):
            free[i] += x[rows[i]]
        for _ in range(SWEEPS):
            change = 0.0
            for i in range(masses):
                v = free[i]
                for j in range(masses + pulled):
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
