"""Recordings of a linear machine in closed loop: nothing hidden, nothing named; a delay is named."""

from dataclasses import replace

import numpy as np
import pytest

from fieldtool.criticise.criticise import criticise
from fieldtool.criticise.search.hypothesis import Simulator
from fieldtool.criticise.search.prepare import prepare
from fieldtool.errors import NotEnoughDataError
from fieldtool.records.closed_loop import AxisLoop, ClosedLoop
from fieldtool.records.model import AxisModel, Coupling, Estimate, MachineModel
from fieldtool.records.recording import AxisInfo, Controller, Experiment, Recording

STEP, FINE, ROWS, PERIODS = 1e-3, 8, 1024, 4
GAINS = (15.0, 1.2, 8.0)


def numbers(*values):
    return tuple(Estimate(v) for v in values)


MODEL = MachineModel(
    (
        AxisModel(
            "a", "rotary", numbers(0.02, 0.03), numbers(190.0), numbers(0.03), Estimate(0.02)
        ),
        AxisModel("b", "rotary", numbers(0.04), (), (), Estimate(0.015)),
    ),
    (Coupling(("a", "b"), 0.006),),
)


def reference_of(rng, size):
    time = np.arange(ROWS * FINE) * STEP / FINE
    out = np.zeros((time.size, 2))
    for axis in range(2):
        for k in range(1, 26, 2):
            frequency = k / (ROWS * STEP)
            phase = rng.uniform(0, 2 * np.pi)
            out[:, axis] += (
                size / (1 + frequency / 4) * np.sin(2 * np.pi * frequency * time + phase)
            )
    return np.tile(out, (PERIODS + 2, 1))


def recorded(rng, delay, model=MODEL):
    loop = ClosedLoop(model, (AxisLoop(*GAINS), AxisLoop(*GAINS)))
    experiments = []
    for number in range(4):
        fine = reference_of(rng, 0.02)
        position, torque = loop.simulate(fine, STEP / FINE)
        torque[1:] = (torque[1:] + torque[:-1]) / 2.0  # a reference bends at every fine row
        late = np.column_stack(
            [position[:, 0], np.roll(position[:, 1], round(delay * FINE / STEP))]
        )
        rows = slice(2 * ROWS * FINE, None, FINE)  # the run-in is left out
        q, tau = late[rows], torque[rows] + 0.004 * rng.normal(size=torque[rows].shape)
        counts = 2**20 / (2 * np.pi)
        experiments.append(
            Experiment(
                f"run {number}", "multisine", ("a", "b"), (), ROWS * STEP, STEP * np.arange(len(q)),
                np.round(q * counts) / counts, tau, position_reference=fine[rows],
            )
        )  # fmt: skip
    axes = tuple(
        AxisInfo(axis.name, "rotary", len(axis.masses), controller=Controller(*GAINS, 6.0))
        for axis in MODEL.axes
    )
    return Recording(STEP, axes, tuple(experiments))


def test_nothing_hidden_nothing_named(fresh_rng):
    criticism = criticise(recorded(fresh_rng, 0.0), MODEL, MODEL).criticism
    assert criticism.causes == ()
    assert criticism.verdict == "adequate"
    assert criticism.unexplained == ()


def test_a_delay_is_named_with_its_axis_and_size(fresh_rng):
    delay = float(fresh_rng.integers(10, 20)) * STEP / FINE
    criticism = criticise(recorded(fresh_rng, delay), MODEL, MODEL).criticism
    assert [(c.effect, c.axis) for c in criticism.causes] == [("measurement_delay", "b")]
    assert criticism.causes[0].parameters["delay"].value == pytest.approx(delay, rel=0.1)
    held = criticism.held_out
    assert held.split == "experiments"
    assert held.error_after["b"].torque < 0.3 * held.error_before["b"].torque


def test_a_library_without_it_gives_no_other_name_to_a_delay(fresh_rng):
    without = frozenset({"measurement_delay", "torque_lag"})
    criticism = criticise(recorded(fresh_rng, 0.002), MODEL, MODEL, without).criticism
    assert criticism.verdict in ("unexplained", "partly explained")
    assert criticism.unexplained


def test_a_model_of_other_axes_is_refused(fresh_rng):
    other = replace(MODEL, axes=(MODEL.axes[0],), couplings=())
    with pytest.raises(NotEnoughDataError, match="same names and kinds in the same order"):
        criticise(recorded(fresh_rng, 0.0), other)


def test_a_hypothesis_whose_hidden_masses_run_away_is_worse_than_any(fresh_rng, monkeypatch):
    """No error of the program: what it tries on its way may be no machine that can stand."""
    prepared = prepare(recorded(fresh_rng, 0.0), MODEL)
    simulator, start = prepared.simulator, prepared.start
    assert np.all(np.isfinite(simulator.residual(start, "fit")))
    quiet = Simulator._free_motions
    monkeypatch.setattr(Simulator, "_free_motions", lambda *a: 1e200 * np.exp(quiet(*a)))
    again = Simulator(simulator.motions, simulator.lines)
    with np.errstate(all="ignore"):
        values = again.residual(start, "fit")
        assert not np.isfinite(values @ values)
