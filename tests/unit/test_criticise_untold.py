"""Axes of which nothing unseen can be compared: what is wrong of them is not called adequate."""

import numpy as np
import pytest

from fieldtool.criticise.criticise import criticise
from fieldtool.design.moves import TestMove
from fieldtool.records.model import AxisModel, Estimate, MachineModel
from fieldtool.records.recording import AxisInfo, Experiment, Recording
from fieldtool.report.material import Material
from fieldtool.report.verdict import verdict

STEP, ROWS, MASS, COUNT = 2e-3, 4000, 5.0, 1e-6


def recorded(experiments, axes):
    infos = tuple(AxisInfo(n, "linear", torque_unit="N", position_unit="m") for n in axes)
    model = MachineModel(tuple(AxisModel(n, "linear", (Estimate(MASS),), ()) for n in axes))
    return Recording(STEP, infos, tuple(experiments)), model


def one_move(friction, rng):
    """Two moves in 8 s: every third stretch, which is kept unseen, has a pause in it."""
    time = np.arange(ROWS) * STEP
    move = TestMove("x", 0.3, 0.5, 2.0, 20.0)
    position, velocity, acceleration = (
        there - back for there, back in zip(move.at(time - 0.5), move.at(time - 3.5), strict=True)
    )
    torque = MASS * acceleration + friction * np.tanh(velocity / 1e-3)
    torque += 0.02 * rng.standard_normal(ROWS)
    position = COUNT * np.round(position / COUNT)
    one = Experiment(
        "m", "moves", ("x",), (), None, time, position[:, None], torque[:, None],
        position_reference=None,
    )  # fmt: skip
    return recorded([one], "x")


def b_only_once(friction, rng):
    """Axis a moves alone twice, b once: only the second of a is kept unseen."""
    time, experiments = np.arange(ROWS) * STEP, []
    for number, name in enumerate("aab"):
        axis = "ab".index(name)
        position = np.zeros((ROWS, 2))
        for f in (0.37, 0.61, 0.93, 1.3, 1.7, 2.1):
            position[:, axis] += 0.05 * np.cos(2 * np.pi * f * time + rng.uniform(0, 6))
        velocity = np.gradient(position[:, axis], STEP)
        torque = 0.02 * rng.standard_normal((ROWS, 2))
        torque[:, axis] += MASS * np.gradient(velocity, STEP)
        if name == "b":
            torque[:, axis] += friction * np.tanh(velocity / 1e-3)
        position += COUNT * np.round(rng.normal(0, 0.6, position.shape))
        experiments.append(
            Experiment(
                f"e{number}", "moves", (name,), (), None, time + 10 * number, position, torque,
                position_reference=None,
            )
        )  # fmt: skip
    return recorded(experiments, "ab")


@pytest.mark.parametrize(
    ("make", "axis", "friction"), [(one_move, "x", 3.0), (b_only_once, "b", 8.0)]
)
def test_what_no_unseen_data_test_is_no_reason_to_call_a_model_adequate(
    make, axis, friction, fresh_rng
):
    criticism = criticise(*make(friction, fresh_rng)).criticism
    assert criticism.held_out.error_before[axis].torque is None
    assert criticism.verdict == "unexplained"
    (sentence,) = [s for s in criticism.unexplained if s.startswith(f"{axis}: ")]
    assert "follows the sign of the velocity" in sentence
    assert sentence.endswith("there are no unseen data of it, so no cause of it can be shown")
    assert all("chance" not in r.why for r in criticism.rejected if axis in np.atleast_1d(r.axis))
    words, _ = verdict(Material("x", criticism=criticism))
    assert sentence in words
    assert "not known" not in words


def test_without_an_error_such_an_axis_is_adequate_and_the_report_says_what_is_not_tested(
    fresh_rng,
):
    criticism = criticise(*b_only_once(0.0, fresh_rng)).criticism
    assert criticism.verdict == "adequate"
    assert any(
        n.startswith("b: the unseen data tell nothing of its torque") for n in criticism.notes
    )
    words, _ = verdict(Material("x", criticism=criticism))
    assert "They say nothing of b." in words
