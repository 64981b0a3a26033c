"""Frequencies and responses of all machines that one design looks at, and what it has to keep."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fieldtool.design.machine import Machine, respond
from fieldtool.design.waves import HalfWave
from fieldtool.records.model import FloatArray

ComplexArray = NDArray[np.complexfloating[Any, Any]]
PER_MODE = 9
BESIDE = np.linspace(-1, 1, PER_MODE)
GRID = 150
FAR_GAIN = 0.5
"""Largest gain of the closed loop beyond the frequencies that were measured: there the machine may
be three times what the model says without making the loop unstable."""


@dataclass(frozen=True)
class Bounds:
    """What one axis' parameters have to keep."""

    sensitivity: float
    """Peak of every axis' sensitivity."""
    noise: float
    """RMS of the torque from the encoder's steps, N m or N; infinite: not looked at."""
    torque: float
    """Largest torque of the move, N m or N."""
    resolution: float
    """Of the encoder, rad or m; NaN: not known."""
    top: float
    """rad/s: highest frequency that the model was measured at."""
    compliance: float = np.inf
    """Largest motor position per torque at the motor, rad/(N m) or m/N: a wish."""
    softest: float = np.inf
    """The same, but to be kept."""
    far: float = FAR_GAIN
    """Largest gain of the closed loop beyond ``top``."""
    bandwidths: tuple[float, ...] = ()
    """rad/s, one an axis: least ones, of the first machine; none where there are none."""


@dataclass(frozen=True, eq=False)
class Grids:
    """Frequencies of J machines, and their responses, shared by all axes of a design."""

    machines: tuple[Machine, ...]
    omega: FloatArray
    """(J, F) rad/s."""
    motors: ComplexArray
    """(J, F, M, M)."""
    wave: HalfWave
    slow: ComplexArray
    """(W, M, M): motors of the first machine at the wave's frequencies."""
    loads: ComplexArray
    """(W, M, M)."""


def grids_of(
    machines: Sequence[Machine],
    low: float,
    high: float,
    wave: HalfWave,
    also: Sequence[float] = (),
) -> Grids:
    """Return frequencies from ``low`` to ``high``, with more at every mode and ``also`` these, rad/s."""
    omegas = []
    for machine in machines:
        modes = np.concatenate([machine.modes, machine.held_modes])
        width = 0.03
        beside = (modes[:, None] * (1 + width * BESIDE)).ravel()
        omegas.append(np.sort(np.concatenate([np.geomspace(low, high, GRID), beside, also])))
    responses = [
        respond(machine, omega).motors for machine, omega in zip(machines, omegas, strict=True)
    ]
    slow = respond(machines[0], wave.omega)
    return Grids(
        tuple(machines), np.stack(omegas), np.stack(responses), wave, slow.motors, slow.loads
    )


def without(gains: ComplexArray, axis: int) -> ComplexArray:
    """Return controllers' gains (..., M) with one axis' loop open."""
    out = gains.copy()
    out[..., axis] = 0.0
    return out


def closed_compliance(plant: ComplexArray, gains: ComplexArray) -> ComplexArray:
    """Return motor positions per added torque with loops closed, (..., M, M)."""
    eye = np.eye(plant.shape[-1])
    return np.linalg.solve(eye + plant * gains[..., None, :], plant)
