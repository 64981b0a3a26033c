"""Axes that stand dead still, drives that are switched off, and torques that end at a limit."""

import numpy as np
import pytest

from fieldtool.criticise.criticise import criticise
from fieldtool.criticise.notes import share_at_limit
from fieldtool.records.model import AxisModel, Estimate, MachineModel
from fieldtool.records.recording import AxisInfo, Experiment, Recording

STEP, PERIOD, PERIODS, INERTIA = 2e-3, 1000, 3, 0.05


def recorded(rng, idle_torque):
    """Axis a is excited in three experiments; b stands still, and its drive says 0 or its noise."""
    time = np.arange(PERIODS * PERIOD) * STEP
    experiments = []
    for number in range(3):
        position, acceleration = np.zeros(time.size), np.zeros(time.size)
        for k in range(1, 40, 2):
            w = 2 * np.pi * k / (PERIOD * STEP)
            wave = 0.5 / (1 + k) * np.cos(w * time + rng.uniform(0, 6))
            position += wave
            acceleration -= w**2 * wave
        torque = INERTIA * acceleration + 0.3 * rng.standard_normal(time.size)
        experiments.append(
            Experiment(
                f"e{number}", "multisine", ("a", "b"), (), PERIOD * STEP,
                time + number * time.size * STEP,
                np.column_stack([position, np.zeros(time.size)]),
                np.column_stack([torque, idle_torque * rng.standard_normal(time.size)]),
                position_reference=None,
            )
        )  # fmt: skip
    axes = tuple(AxisInfo(name, "rotary") for name in "ab")
    model = MachineModel(tuple(AxisModel(n, "rotary", (Estimate(INERTIA),), ()) for n in "ab"))
    return Recording(STEP, axes, tuple(experiments)), model


@pytest.mark.parametrize("idle_torque", [0.0, 0.2])
def test_of_an_axis_that_stands_dead_still_nothing_is_said(idle_torque, fresh_rng):
    criticism = criticise(*recorded(fresh_rng, idle_torque)).criticism
    assert criticism.where[1] == (
        "b: nothing can be said of its torque: it stands still in all that is compared"
    )
    assert criticism.verdict == "adequate"
    assert not any("largest value" in note for note in criticism.notes)
    assert criticism.held_out.error_before["b"].torque is None
    assert (criticism.held_out.noise_floor["b"] or 0.0) < 1.0


def course(rng, size=4000):
    """A torque of many sines."""
    time = np.arange(size) / size
    return sum(np.cos(2 * np.pi * k * time + rng.uniform(0, 6)) for k in range(1, 30))


def test_a_torque_is_at_its_limit_where_it_is_flat_at_the_largest_of_all_experiments(fresh_rng):
    limit = 0.5 * np.abs(course(fresh_rng)).max()
    small, large = (
        np.clip(0.1 * course(fresh_rng), -limit, limit),
        np.clip(course(fresh_rng), -limit, limit),
    )
    at = np.abs(large) == np.abs(large).max()
    wanted = np.sum(at[1:] & at[:-1]) / (2 * large.size)
    assert share_at_limit([small, large]) == pytest.approx(wanted, rel=0.05)
    assert share_at_limit([small, large], limit) == pytest.approx(wanted, rel=0.05)
    assert wanted > 0.0


@pytest.mark.parametrize(
    "torque",
    [np.zeros(1000), np.full(1000, 0.3), np.repeat([0.0, 1.0, 0.0, 0.0, -1.0, 0.0], 50)],
    ids=["none", "the same all the time", "single steps of its measurement"],
)
def test_a_torque_without_a_limit_is_at_none(torque):
    assert share_at_limit([torque]) == 0.0


def test_a_torque_that_always_is_the_stated_limit_is_at_it():
    assert share_at_limit([np.full(1000, 0.3)], 0.3) == pytest.approx(0.999)
