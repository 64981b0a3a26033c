"""The bandwidth that a stiffer response has to keep, whatever frequencies its search looks at."""

import numpy as np
import pytest

from fieldtool.design.axis_motion import Fed
from fieldtool.design.axis_problem import AxisProblem
from fieldtool.design.grids import Bounds, grids_of
from fieldtool.design.loops import Loops
from fieldtool.design.machine import machine_of, respond
from fieldtool.design.margins import margins_of
from fieldtool.design.moves import TestMove
from fieldtool.design.rule import rule
from fieldtool.design.servo import Servo
from fieldtool.design.start import slower
from fieldtool.design.waves import HalfWave
from tests.conftest import RandomModel


@pytest.mark.parametrize("shift", np.linspace(0.0, 1.0, 7))
def test_a_bandwidth_counts_where_it_is(
    random_model: RandomModel, fresh_rng: np.random.Generator, shift: float
) -> None:
    model = random_model(fresh_rng, (2,))
    machine = machine_of(model)
    [loop] = rule(model)
    fast, slow = Servo(loop), slower(Servo(loop), 0.97)
    omega = np.geomspace(1e-2, 1e4, 40_000)
    widths = [
        2
        * np.pi
        * margins_of(omega, Loops(respond(machine, omega), (one,)).sensitivity[:, 0]).bandwidth
        for one in (slow, fast)
    ]
    assert widths[0] < 0.99 * widths[1]
    kept = 0.998 * widths[1]
    low = 0.01 * kept * 1.08**shift
    grids = grids_of([machine], low, 300 * kept, HalfWave(10.0, 1024), [kept])
    bounds = Bounds(1e9, np.inf, np.inf, np.nan, 1e9, bandwidths=(kept,))
    move = TestMove("axis1", 1.0, 1.0, 1.0, 10.0)
    fed = Fed(True, True, False, model.axes[0].total_mass, 0.0)
    problem = AxisProblem(grids, [fast], 0, [move], bounds, fed)
    assert problem.figures(fast)[1] <= 0.0
    assert problem.figures(slow)[1] > 0.0
