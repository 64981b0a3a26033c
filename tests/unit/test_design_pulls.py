"""Moves against gravity and cogging: predicted as a simulation of other hands has them."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from fieldtool.design.axis_motion import AxisMotion, Fed
from fieldtool.design.grids import Bounds, grids_of
from fieldtool.design.machine import machine_of
from fieldtool.design.moves import TestMove
from fieldtool.design.predict import predict
from fieldtool.design.servo import Servo
from fieldtool.design.waves import HalfWave
from fieldtool.records.closed_loop import AxisLoop
from fieldtool.records.model import AxisModel, Estimate, MachineModel

MASSES, SPRING, DAMPING = (0.6, 0.4), 4000.0, 1.5
WEIGHT, COGS = (3.0, 0.7), (1.0, 9.0, -0.4)
"""Torque and phase of the weight on the last mass; torque, order and phase of the motor's magnets."""
LOOP = AxisLoop(12.0, 40.0, 160.0, 0.7, 0.9)
MOVE = TestMove("x", 0.8, 3.0, 20.0, 400.0, band=0.0008, start=0.45)


def effect(kind: str, location: str, **numbers: float) -> dict[str, object]:
    return {"effect": kind, "axis": "x", "location": location, "parameters": numbers}


def model() -> MachineModel:
    axis = AxisModel(
        "x", "rotary", tuple(map(Estimate, MASSES)), (Estimate(SPRING),), (Estimate(DAMPING),)
    )
    effects = (
        effect("gravity", "load", torque=WEIGHT[0], phase=WEIGHT[1]),
        effect("cogging", "motor", amplitude=COGS[0], order=COGS[1], phase=COGS[2]),
    )
    return MachineModel((axis,), effects=effects)


def weight(position: float) -> float:
    return WEIGHT[0] * np.sin(position + WEIGHT[1])


def cogs(position: float) -> float:
    return COGS[0] * np.sin(COGS[1] * position + COGS[2])


def simulated(turn: float, time: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return motor and last mass on the way out, and from ``turn`` on back; positions as told."""
    at = MOVE.start or 0.0
    hangs = brentq(lambda q: SPRING * (at - q) - weight(q), at - 1, at + 1)

    def reference(t: float) -> tuple[float, float, float]:
        p, v, a = (float(one[0]) for one in MOVE.at(np.array([t if t < turn else t - turn])))
        return (at + p, v, a) if t < turn else (at + MOVE.distance - p, -v, -a)

    def step(t: float, x: np.ndarray) -> list[float]:
        q, end, v, w, summed = x
        r, speed, rate = reference(t)
        error = LOOP.position_p * (r - q) + LOOP.velocity_ff * speed - v
        torque = LOOP.velocity_p * error + LOOP.velocity_i * summed + LOOP.inertia_ff * rate
        spring = SPRING * (q - end) + DAMPING * (v - w)
        motor, load = (torque - spring - cogs(q)) / MASSES[0], (spring - weight(end)) / MASSES[1]
        return [v, w, motor, load, error]

    x = np.array([at, hangs, 0.0, 0.0, (cogs(at) + weight(hangs)) / LOOP.velocity_i])
    parts = []
    for begin, end in pairwise([0.0, turn, float(time[-1])]):
        inside = time[(time >= begin) & (time < end)]
        found = solve_ivp(
            step, (begin, end), x, rtol=1e-8, atol=1e-11, dense_output=True, max_step=0.002
        )
        parts.append(found.sol(inside)[:2])
        x = found.y[:, -1]
    motor, load = np.concatenate(parts, axis=1)
    return motor, load - hangs + at


def test_a_move_out_and_back_is_that_of_a_simulation() -> None:
    [axis] = predict(model(), [Servo(LOOP)], [MOVE]).axes
    [bare] = predict(replace(model(), effects=()), [Servo(LOOP)], [MOVE]).axes
    assert axis.curves is not None
    assert bare.curves is not None
    time = axis.curves.time
    turn = float(time[-1] + time[1] - time[0])
    motor, load = simulated(turn, np.concatenate([time, turn + time, [2 * turn]]))
    at, count = MOVE.start or 0.0, time.size
    effects = np.abs(axis.curves.position - bare.curves.position).max()
    assert effects > 0.001  # what is compared is there
    for found, true in (
        (axis.curves.position, motor[:count] - at),
        (axis.curves.back, MOVE.distance - (motor[count:] - at)),
        (axis.curves.load, load[:count] - at),
    ):
        assert np.abs(found - true).max() < 0.03 * effects
    assert axis.move is not None
    assert bare.move is not None
    assert axis.move.residual_peak > 2 * bare.move.residual_peak


def test_where_nobody_knows_the_start_nothing_is_added() -> None:
    moves = [replace(MOVE, start=None)]
    [axis] = predict(model(), [Servo(LOOP)], moves).axes
    [bare] = predict(replace(model(), effects=()), [Servo(LOOP)], moves).axes
    assert axis.as_dict() == bare.as_dict()


def test_a_design_pays_for_what_a_weight_leaves_after_a_move() -> None:
    """The cost sees what the prediction sees: a stronger integral is worth more with the weight."""
    gains = (40.0, 640.0)
    costs = []
    for one in (model(), replace(model(), effects=())):
        machine, servo = machine_of(one), Servo(LOOP)
        grids = grids_of([machine], 0.5, 2000.0, HalfWave(6.0, 1024))
        bounds = Bounds(2.0, np.inf, np.inf, np.nan, 1000.0)
        fed = Fed(True, True, False, sum(MASSES), 0.0)
        motion = AxisMotion(grids, [servo], 0, [MOVE], bounds, fed)
        weak, strong = (motion.figures(Servo(replace(LOOP, velocity_i=gain)))[0] for gain in gains)
        costs.append(weak - strong)
    with_weight, without = costs
    assert with_weight > without + 0.1
    assert without == pytest.approx(0.0, abs=0.1)
