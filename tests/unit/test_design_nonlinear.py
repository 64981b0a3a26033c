"""What effects that no prediction has mean for a loop, in words."""

import pytest

from fieldtool.design.moves import TestMove
from fieldtool.design.nonlinear import notes_of
from fieldtool.design.servo import Servo
from fieldtool.records.closed_loop import AxisLoop
from fieldtool.records.model import AxisModel, Estimate, MachineModel

LOOP = AxisLoop(5.0, 80.0, 100.0, 1.0)
"""Holds with 500 N m/rad, and takes away in 0.8 s what pulls."""


def told(
    effect: str,
    kind: str = "rotary",
    loop: AxisLoop = LOOP,
    start: float | None = None,
    **numbers: float,
) -> list[str]:
    axis = AxisModel("x", kind, (Estimate(1.0),), (), ())
    one = {"effect": effect, "axis": "x", "location": "motor", "parameters": numbers}
    moves = [TestMove("x", 1.0, 1.0, 1.0, 1.0, start=start)]
    return notes_of(MachineModel((axis,), effects=(one,)), [Servo(loop)], moves)


@pytest.mark.parametrize(("effect", "name"), [("cogging", "amplitude"), ("gravity", "torque")])
def test_a_torque_that_goes_with_the_position_is_in_predictions_from_a_known_start(
    effect: str, name: str
) -> None:
    [note] = told(effect, **{name: -2.0})
    assert note.startswith(
        f"x: {effect} of 2 N m may pull the motor up to 0.004 rad off its target for about 0.8 s "
    )
    assert "what is predicted of moves does not have it" in note
    [known] = told(effect, start=0.25, **{name: -2.0})
    assert "what is predicted of moves has it in, for moves that start at 0.25 rad." in known
    [stays] = told(effect, loop=AxisLoop(5.0, 80.0, 0.0, 1.0), **{name: 2.0})
    assert "up to 0.005 rad off its target; what is predicted" in stays


def test_the_weight_of_a_linear_axis_is_the_same_everywhere_and_its_magnets_are_not() -> None:
    assert told("gravity", "linear", torque=20.0) == []
    [note] = told("cogging", "linear", amplitude=2.0)
    assert note.startswith("x: cogging of 2 N may pull the motor up to 0.004 m off")


def test_dry_friction_is_said_with_what_it_holds() -> None:
    [note] = told("coulomb_friction", torque=2.0)
    assert "of 2 N m may hold the motor up to 0.004 rad off its target for about 0.8 s" in note
    assert told("coulomb_friction", torque=0.0) == []
