"""Standard errors of criticism against the scatter of fits to data that differ in noise alone."""

import numpy as np
import pytest

from fieldtool.criticise.search.prepare import prepare
from fieldtool.criticise.search.search import settled
from fieldtool.records.model import AxisModel, Estimate, MachineModel
from fieldtool.records.recording import AxisInfo, Experiment, Recording

STEP, ROWS, PERIODS = 0.002, 1000, 3
INERTIA, NOISE, COUNT = 0.05, 0.3, 1e-6
DRAWS = 40


def recorded(rng: np.random.Generator, idle: int) -> Recording:
    """One rigid axis in three multisines, beside others that stand."""
    time = np.arange(PERIODS * ROWS) * STEP
    experiments = []
    for k in range(3):
        phases = np.random.default_rng(k).uniform(0, 2 * np.pi, 20)
        position, torque = np.zeros_like(time), NOISE * rng.standard_normal(time.size)
        for line, phase in zip(range(1, 41, 2), phases, strict=True):
            omega = 2 * np.pi * line / (ROWS * STEP)
            one = 0.5 / (1 + line) * np.cos(omega * time + phase)
            position, torque = position + one, torque - INERTIA * omega**2 * one
        still = [COUNT * rng.standard_normal(time.size) for _ in range(idle)]
        pushed = [0.01 * rng.standard_normal(time.size) for _ in range(idle)]
        experiments.append(
            Experiment(
                name=f"e{k}",
                kind="multisine",
                driven=("a",),
                free=(),
                period=ROWS * STEP,
                time=time,
                position=np.column_stack(
                    [position + COUNT * rng.standard_normal(time.size), *still]
                ),
                torque=np.column_stack([torque, *pushed]),
                position_reference=None,
            )
        )
    names = "abcd"[: 1 + idle]
    axes = tuple(AxisInfo(name=name, kind="rotary") for name in names)
    return Recording(STEP, axes, tuple(experiments))


@pytest.mark.parametrize("idle", [0, 3])
def test_axes_that_stand_make_no_number_surer(fresh_rng, idle):
    """A chi-square of the draws: their scatter is what is told, but for chance (one in 100 000)."""
    names = "abcd"[: 1 + idle]
    model = MachineModel(tuple(AxisModel(n, "rotary", (Estimate(INERTIA),), (), ()) for n in names))
    values, told = [], []
    for _ in range(DRAWS):
        prepared = prepare(recorded(fresh_rng, idle), model)
        _, found = settled(prepared, prepared.start)
        k = found.names.index("a.mass1")
        values.append(found.values[k])
        told.append(found.std[k])
    share = np.var(values, ddof=1) / np.mean(np.square(told))
    assert 0.3 < share < 3.0, share
