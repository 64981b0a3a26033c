"""What a trial's move takes of the limits: of its own axis, and of those beside it."""

from dataclasses import replace

import numpy as np
import pytest

from drives.api import AxisLimits
from fieldtool.design.moves import typical_move
from fieldtool.design.predict import predict
from fieldtool.design.rule import rule
from fieldtool.design.servo import Servo
from fieldtool.experiment.forecast import Setting
from fieldtool.experiment.verification.steps import PUSHED_ERROR
from fieldtool.workflow.trial_moves import KEPT, takes_too_much

WIDE = AxisLimits((-2.0, 2.0), 1e3, 1e3, 1e6, 1e3)
TAKES = 1.25


@pytest.mark.parametrize("row", [0, 1, 2])
def test_what_a_move_does_to_an_axis_beside_it_is_kept_within_its_limits(
    random_model, fresh_rng, row
):
    """It is named, and a move that is so much slower keeps the limit."""
    model = random_model(fresh_rng, (2, 1))
    servos = [Servo(loop) for loop in rule(model)]
    moves = [typical_move(a.name, (-2, 2), 4.0, 40.0, 100.0, a.total_mass) for a in model.axes]
    found = predict(model, servos, moves)
    setting = Setting(model, (), (WIDE, WIDE), np.zeros(2))
    for k in range(2):
        assert takes_too_much(setting, k, (found,)) == (1.0, "")
    moved, beside = 0, 1
    limit = found.axes[moved].beside[row][beside] / KEPT / TAKES
    name = ("torque", "following_error", "velocity")[row]
    if name == "following_error":  # the trial's watch stops an axis that is pushed so far
        limit /= PUSHED_ERROR
    narrow = replace(setting, limits=(WIDE, replace(WIDE, **{name: limit})))
    share, words = takes_too_much(narrow, moved, (found,))
    assert share == pytest.approx(TAKES)
    assert words.startswith(f"{model.names[beside]}: {name.replace('_', ' ')} ")
    assert f" while {model.names[moved]} moves, " in words
    factor = 0.5
    slower = replace(
        moves[moved],
        velocity=moves[moved].velocity * factor,
        acceleration=moves[moved].acceleration * factor**2,
        jerk=moves[moved].jerk * factor**3,
    )
    gentle = predict(model, servos, [slower, moves[beside]])
    assert takes_too_much(narrow, moved, (gentle,)) == (1.0, "")
