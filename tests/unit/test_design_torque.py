"""The torque of a move with dry friction: kept within the limit by the design, or said to be above."""

from typing import Any

import pytest

from drives.units import Kind
from fieldtool.design.decide import design
from fieldtool.design.drive_side import DriveSide
from fieldtool.design.moves import TestMove
from fieldtool.design.tuning import Tuning
from fieldtool.records.model import AxisModel, Estimate, MachineModel

MASS, ACCELERATION, FRICTION = 0.05, 14.0, 0.45
NEEDED = MASS * ACCELERATION + FRICTION
MOVE = TestMove("x", 1.0, 3.0, ACCELERATION, 400.0)


def designed(limit: float, friction: float = FRICTION, kind: Kind = "rotary") -> Tuning:
    effect: dict[str, Any] = {
        "effect": "coulomb_friction",
        "axis": "x",
        "location": "motor",
        "parameters": {"torque": {"value": friction, "std": 0.01, "unit": "N m"}},
    }
    axis = AxisModel("x", kind, (Estimate(MASS, 0.01 * MASS),), (), ())
    model = MachineModel((axis,), (), (effect,) if friction else ())
    return design(model, [DriveSide("x", torque_limit=limit, kind=kind)], [MOVE])


def peak_of(tuning: Tuning) -> float:
    assert tuning.prediction is not None
    return tuning.prediction.axes[0].peak_torque


def above(tuning: Tuning) -> list[str]:
    return [note for note in tuning.notes if "torque limit" in note]


def test_friction_counts_in_the_torque_that_is_kept_within_the_limit() -> None:
    free, limit = peak_of(designed(10.0)), 1.15 * NEEDED
    assert free > 1.2 * limit, "what feedback asks for where it may"
    assert peak_of(designed(limit)) <= 1.03 * limit


def test_a_move_that_takes_more_than_the_limit_whatever_the_gains_is_said() -> None:
    """And its loops are not made useless for a limit that they can not keep."""
    tuning = designed(1.0)
    (note,) = above(tuning)
    assert f"x: its move is predicted to take {peak_of(tuning):.3g} N m" in note
    assert "above its torque limit of 1 N m" in note
    assert "typical_move" in note
    assert tuning.axes[0].parameters["position_p"] > 8.0
    assert tuning.prediction is not None
    move = tuning.prediction.axes[0].move
    assert move is not None
    assert move.settling_time < 0.1


@pytest.mark.parametrize("friction", [0.0, FRICTION])
def test_a_move_within_the_limit_has_no_such_note(friction: float) -> None:
    assert above(designed(3.0, friction)) == []


def test_forces_are_said_in_newtons() -> None:
    assert "above its torque limit of 1 N:" in above(designed(1.0, kind="linear"))[0]
