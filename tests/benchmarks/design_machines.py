"""Random machines with new tooling, their drives, and what an identification says of them."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from drives.profile.loading import load_drive
from fieldtool.design.drive_side import DriveSide
from fieldtool.design.moves import TestMove, typical_move
from fieldtool.design.rule import rule
from fieldtool.design.servo import Servo, Timing
from fieldtool.design.tuning import as_parameters
from fieldtool.records.model import AxisModel, Coupling, Estimate, MachineModel

TIMING = Timing(0.22e-3, 0.125e-3, 0.004)
RESOLUTION = 2 * np.pi / 2**20
TUNABLE = load_drive("reference").tunable
TOOLING = (0.5, 3.0)
"""Factor of the end mass, and a joint up to three times as soft."""


@dataclass(frozen=True)
class Case:
    """A machine with new tooling, and the drives as they were tuned for the old one."""

    true: MachineModel
    found: MachineModel
    """As identified: off by its errors, which it knows of."""
    sides: tuple[DriveSide, ...]
    moves: tuple[TestMove, ...]
    old: tuple[Servo, ...]


def machine(rng: np.random.Generator, lengths: Sequence[int], std: float = 0.0) -> MachineModel:
    """Return chains with modes between some 3 and 40 Hz."""
    axes = []
    for i, n in enumerate(lengths):
        scale = float(10 ** rng.uniform(-2, 1))
        masses = scale * np.exp(rng.uniform(-0.7, 0.7, n))
        w = 2 * np.pi * rng.uniform(5, 20, n - 1)
        springs = masses[1:] * w**2
        dampers = springs / w * 2 * rng.uniform(0.005, 0.03, n - 1)
        axes.append(
            AxisModel(
                f"axis{i + 1}",
                "rotary",
                tuple(Estimate(float(v), std * float(v)) for v in masses),
                tuple(Estimate(float(v), std * float(v)) for v in springs),
                tuple(Estimate(float(v), std * float(v)) for v in dampers),
                Estimate(float(0.05 * scale * rng.uniform(0.1, 1)), 0.0),
            )
        )
    couplings = []
    for i in range(len(axes)):
        for j in range(i + 1, len(axes)):
            ends = axes[i].masses[-1].value * axes[j].masses[-1].value
            share = rng.uniform(0.1, 0.6) / (len(axes) - 1) * rng.choice([-1.0, 1.0])
            couplings.append(
                Coupling((axes[i].name, axes[j].name), float(share * np.sqrt(ends)), 0.0)
            )
    return MachineModel(tuple(axes), tuple(couplings))


def case(rng: np.random.Generator, lengths: Sequence[int], error: float) -> Case:
    """Return a machine whose tooling was changed; its drives have the rule's gains of the old one."""
    before = machine(rng, lengths)
    axes = []
    for axis in before.axes:
        masses, springs = list(axis.masses), list(axis.springs)
        factor = float(np.exp(rng.uniform(*np.log(TOOLING))))
        masses[-1] = replace(masses[-1], value=masses[-1].value * factor)
        if springs:
            softer = float(rng.uniform(1 / 3, 1))
            springs[-1] = replace(springs[-1], value=springs[-1].value * softer)
        axes.append(replace(axis, masses=tuple(masses), springs=tuple(springs)))
    ends = {
        a.name: a.masses[-1].value / b.masses[-1].value
        for a, b in zip(axes, before.axes, strict=True)
    }
    couplings = tuple(
        replace(c, value=c.value * float(np.sqrt(ends[c.axes[0]] * ends[c.axes[1]])))
        for c in before.couplings
    )
    true = MachineModel(tuple(axes), couplings)
    old = tuple(Servo(replace(loop, inertia_ff=0.0), 150.0, TIMING) for loop in rule(before))
    moves, sides = [], []
    for axis, servo in zip(true.axes, old, strict=True):
        total = axis.total_mass
        torque = 200.0 * total
        moves.append(typical_move(axis.name, (-2.0, 2.0), 6.0, 100.0, torque, total))
        sides.append(
            DriveSide(axis.name, TUNABLE, TIMING, torque, RESOLUTION, {}, as_parameters(servo))
        )
    return Case(true, identified(true, error, rng), tuple(sides), tuple(moves), old)


def identified(true: MachineModel, error: float, rng: np.random.Generator) -> MachineModel:
    """Return a model off by relative errors that it knows of; exact where ``error`` is 0."""

    def off(values: Sequence[Estimate], share: float = 1.0) -> tuple[Estimate, ...]:
        return tuple(
            Estimate(
                e.value * float(np.exp(share * error * np.clip(rng.standard_normal(), -2, 2))),
                share * error * e.value,
            )
            for e in values
        )

    axes = tuple(
        replace(a, masses=off(a.masses), springs=off(a.springs), dampers=off(a.dampers, 3.0))
        for a in true.axes
    )
    couplings = tuple(
        replace(
            c,
            value=c.value + error * abs(c.value) * float(np.clip(rng.standard_normal(), -2, 2)),
            std=error * abs(c.value),
        )
        for c in true.couplings
    )
    return MachineModel(axes, couplings)
