"""Machines that a design has to hold for, and whether it does."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from fieldtool.design.loops import Loops, stable, system_matrix
from fieldtool.design.machine import Machine, machine_of, respond
from fieldtool.design.predict import frequencies
from fieldtool.design.servo import Servo
from fieldtool.design.uncertainty import corners_of, samples_of
from fieldtool.records.model import FloatArray, MachineModel

DRAWN, KEPT = 24, 4
"""Machines that are drawn, and how many of them, far apart, a design is made for."""
FRESH = 40
"""Machines that a design is checked on, none of which it was made for."""
MAY_FAIL = 0.05
"""Share of the fresh machines on which a margin may be missed."""
SLACK = 1.02
"""Factor of the bound from which a margin counts as missed."""


@dataclass(frozen=True, eq=False)
class Checked:
    """Peaks of sensitivity on a set of machines."""

    peaks: FloatArray
    """(K, M); infinite where a machine is not stable."""
    machines: tuple[Machine, ...]

    def missed(self, bound: float) -> FloatArray:
        """Return the share of machines on which each axis misses a bound, shape (M,)."""
        return np.asarray((self.peaks > SLACK * bound).mean(axis=0))

    def worst(self, count: int) -> list[Machine]:
        """Return the machines with the largest peaks."""
        order = np.argsort(-self.peaks.max(axis=1))
        return [self.machines[int(k)] for k in order[:count]]


def machines_for(model: MachineModel, rng: np.random.Generator) -> list[Machine]:
    """Return the machine, what nonlinear effects make of it, and some drawn ones that are far apart.

    A delay of measurement is taken as being in the drive's loop in one of them, where nobody knows.
    """
    nominal = machine_of(model)
    out = [nominal, *(machine_of(corner) for corner in corners_of(model))]
    if nominal.delay.any():
        out.append(replace(nominal, lag=nominal.lag + nominal.delay))
    drawn = [machine_of(one) for one in samples_of(model, DRAWN, rng)]
    traits = np.array([_traits(one) for one in (nominal, *drawn)])
    spread = traits.std(axis=0)
    traits = (traits - traits[0]) / np.where(spread > 0, spread, 1.0)
    chosen = [0]
    for _ in range(KEPT):
        away = np.min([np.abs(traits - traits[k]).sum(axis=1) for k in chosen], axis=0)
        chosen.append(int(np.argmax(away)))
    return [*out, *(drawn[k - 1] for k in chosen[1:] if k > 0)]


def _traits(machine: Machine) -> FloatArray:
    """Return the logarithms of modes and of the inertia that each motor has to move."""
    total = np.diag(machine.mass)
    bounds = [*machine.motors.tolist(), machine.mass.shape[0]]
    inertia = [total[a:b].sum() for a, b in pairwise(bounds)]
    return np.asarray(np.log(np.concatenate([machine.modes, machine.held_modes, inertia])))


def stable_on_all(machines: Sequence[Machine], servos: tuple[Servo, ...]) -> bool:
    """Return whether the loops are stable on every machine."""
    return all(stable(machine, servos) for machine in machines)


def fresh_check(
    model: MachineModel, servos: tuple[Servo, ...], rng: np.random.Generator, count: int = FRESH
) -> Checked:
    """Return the peaks of sensitivity on newly drawn machines."""
    machines = [machine_of(one) for one in samples_of(model, count, rng)]
    return check(machines, servos)


def check(machines: Sequence[Machine], servos: tuple[Servo, ...]) -> Checked:
    """Return the peaks of sensitivity on these machines."""
    peaks = np.full((len(machines), len(servos)), np.inf)
    for k, machine in enumerate(machines):
        values = np.linalg.eigvals(system_matrix(machine, servos)).astype(np.complex128)
        if values.real.max() < 1e-9 * np.abs(values).max():
            loops = Loops(respond(machine, frequencies(machine, values)), servos)
            peaks[k] = np.abs(loops.sensitivity).max(axis=0)
    return Checked(peaks, tuple(machines))
