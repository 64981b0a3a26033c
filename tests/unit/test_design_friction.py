"""Feed-forward against friction: what it should be on a rigid axis, and what it brings."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import lsq_linear

from drives.profile.loading import load_drive
from fieldtool.design.axis_motion import _least_squares
from fieldtool.design.decide import design
from fieldtool.design.drive_side import DriveSide
from fieldtool.design.moves import TestMove
from fieldtool.design.no_worse import arrival
from fieldtool.design.servo import Timing
from fieldtool.records.model import AxisModel, Estimate, MachineModel

TIMING = Timing(1e-6, 1e-6)
STEP = 2 * np.pi / 2**20
DUAL_LOOP = load_drive("epos4-dual-loop").tunable
assert "viscous_ff" in DUAL_LOOP
assert "velocity_ff" not in DUAL_LOOP


def test_a_rigid_axis_gets_its_inertia_and_its_friction_fed_forward(
    fresh_rng: np.random.Generator,
) -> None:
    """The drive feeds the whole velocity forward by itself, so torque is all that is lacking."""
    mass, friction = fresh_rng.uniform(0.02, 0.2), fresh_rng.uniform(0.1, 1.0)
    axis = AxisModel("x", "rotary", (Estimate(mass, 0.001 * mass),), (), ())
    axis = replace(axis, viscous_friction=Estimate(friction, 0.001 * friction))
    present = {"position_p": 1.0, "velocity_p": 1.0, "velocity_i": 0.0, "velocity_ff": 1.0}
    side = DriveSide("x", DUAL_LOOP, TIMING, 100.0, present=present)
    found = design(MachineModel((axis,)), [side]).axes[0].parameters
    assert found["inertia_ff"] == pytest.approx(mass, rel=0.1)
    assert found["viscous_ff"] == pytest.approx(friction, rel=0.05)


def test_moves_follow_closer_with_it_and_arrive_no_later(fresh_rng: np.random.Generator) -> None:
    """In the mean of rigid axes: the search does not end at the very best of each."""
    ratios = []
    for share in (0.0, 1.0, 1.0, 1.0):
        mass, damping = fresh_rng.uniform(0.02, 0.2), fresh_rng.uniform(4.0, 10.0)
        axis = AxisModel("x", "rotary", (Estimate(mass),), (), ())
        axis = replace(axis, viscous_friction=Estimate(damping * mass))
        move = TestMove("x", 1.0, 6.0, 100.0, 2000.0)
        found = []
        for tunable in (DUAL_LOOP - {"viscous_ff"}, DUAL_LOOP):
            timing, present = Timing(0.22e-3, 0.125e-3, 0.004), {"velocity_ff": share}
            side = DriveSide("x", tunable, timing, 400 * mass, STEP, present=present)
            prediction = design(MachineModel((axis,)), [side], [move]).prediction
            assert prediction is not None
            found.append(prediction.axes[0])
        before, after = found
        assert before.move is not None
        assert after.move is not None
        closer = after.move.following_error / before.move.following_error
        ratios.append((closer, arrival(after) / arrival(before)))
    closer, later = np.exp(np.log(ratios).mean(axis=0))
    assert closer < 0.95
    assert later < 1.05


@pytest.mark.parametrize("alike", [0.0, 0.99])
@pytest.mark.parametrize("none", [False, True], ids=["", "nothing of the last"])
@pytest.mark.parametrize("count", [1, 2, 3])
def test_shares_are_the_best_within_their_bounds(
    fresh_rng: np.random.Generator, count: int, none: bool, alike: float
) -> None:
    """Against a bounded least squares of other hands; columns nearly alike, a bound of nothing."""
    seen = fresh_rng.standard_normal((2, 1 + count, 40))
    seen[:, 1:] = (1 - alike) * seen[:, 1:] + alike * fresh_rng.standard_normal((2, 1, 40))
    seen[:, 0] -= np.tensordot(seen[:, 1:], fresh_rng.uniform(-0.5, 1.5, count), (1, 0))
    most = fresh_rng.uniform(0.5, 1.5, count)
    if none:
        most[-1] = 0.0
    best = _least_squares(seen, np.zeros(count), np.ones(count, dtype=bool), most)
    assert np.all((best >= 0) & (best <= most))
    columns, right = seen[:, 1:].transpose(0, 2, 1).reshape(-1, count), -seen[:, 0].ravel()
    bounds = (np.zeros(count), np.maximum(most, 1e-12))
    right_ones = lsq_linear(columns, right, bounds, tol=1e-12).x

    def left(shares: np.ndarray) -> float:
        return float(((columns @ shares - right) ** 2).sum())

    assert left(best) <= (1 + 1e-8) * left(right_ones)


def test_friction_that_would_bring_energy_in_is_not_fed_forward() -> None:
    axis = AxisModel("x", "rotary", (Estimate(0.05),), (), (), Estimate(-0.05))
    found = design(MachineModel((axis,)), [DriveSide("x", DUAL_LOOP, TIMING, 10.0)])
    assert found.axes[0].parameters["viscous_ff"] == 0.0
