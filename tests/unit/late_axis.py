"""Recordings of a linear machine of two axes in closed loop, one of them measured late."""

import numpy as np

from fieldtool.records.closed_loop import AxisLoop, ClosedLoop
from fieldtool.records.model import AxisModel, Coupling, Estimate, MachineModel
from fieldtool.records.recording import AxisInfo, Controller, Experiment, Recording

STEP, FINE, ROWS, PERIODS = 1e-3, 8, 1024, 4
GAINS = (15.0, 1.2, 8.0)


def numbers(*values):
    return tuple(Estimate(v, 0.01 * v) for v in values)


MODEL = MachineModel(
    (
        AxisModel(
            "a", "rotary", numbers(0.02, 0.03), numbers(190.0), numbers(0.03), Estimate(0.02)
        ),
        AxisModel("b", "rotary", numbers(0.04), (), (), Estimate(0.015)),
    ),
    (Coupling(("a", "b"), 0.006, 1e-5),),
)


def recorded(rng, delay, suffix="", description=""):
    """Record two axes in closed loop; the position of b is measured late."""
    loop = ClosedLoop(MODEL, (AxisLoop(*GAINS), AxisLoop(*GAINS)))
    time = np.arange(ROWS * FINE) * STEP / FINE
    experiments = []
    for number in range(4):
        fine = np.zeros((time.size, 2))
        for axis in range(2):
            for k in range(1, 26, 2):
                f = k / (ROWS * STEP)
                fine[:, axis] += (
                    0.02 / (1 + f / 4) * np.sin(2 * np.pi * f * time + rng.uniform(0, 6))
                )
        fine = np.tile(fine, (PERIODS + 2, 1))
        position, torque = loop.simulate(fine, STEP / FINE)
        torque[1:] = (torque[1:] + torque[:-1]) / 2.0
        late = np.column_stack(
            [position[:, 0], np.roll(position[:, 1], round(delay * FINE / STEP))]
        )
        rows = slice(2 * ROWS * FINE, None, FINE)
        tau = torque[rows] + 0.004 * rng.normal(size=torque[rows].shape)
        counts = 2**20 / (2 * np.pi)
        experiments.append(
            Experiment(
                f"run {number}{suffix}", "multisine", ("a", "b"), (), ROWS * STEP,
                STEP * np.arange(len(tau)), np.round(late[rows] * counts) / counts, tau,
                position_reference=fine[rows],
            )
        )  # fmt: skip
    axes = tuple(
        AxisInfo(axis.name, "rotary", len(axis.masses), controller=Controller(*GAINS, 6.0))
        for axis in MODEL.axes
    )
    return Recording(STEP, axes, tuple(experiments), description)
