"""The prediction of the load side: exact for the machine that made the data, off for another."""

import numpy as np
import pytest

from fieldtool.errors import NotEnoughDataError
from fieldtool.identify.prediction import load_responses, predict_load
from fieldtool.records.model import AxisModel, Estimate, MachineModel
from fieldtool.records.recording import AxisInfo, Experiment, Recording
from tests.seeds import fresh_seed

N, RATE, PERIODS, DELAY = 500, 500.0, 5, 3e-4
LINES = np.arange(5, 120)


def machine(load: float = 2.0, friction: float = 0.5) -> MachineModel:
    return MachineModel(
        (
            AxisModel(
                "x",
                "rotary",
                (Estimate(1.0), Estimate(load)),
                (Estimate(30_000.0),),
                (Estimate(6.0),),
                Estimate(friction),
            ),
        )
    )


def recorded(load_friction: float = 0.0) -> Recording:
    seed = fresh_seed()
    rng = np.random.default_rng(seed)
    torque = np.zeros(N // 2 + 1, dtype=complex)
    torque[LINES] = np.exp(2j * np.pi * rng.random(LINES.size)) * N
    load, motor = np.zeros_like(torque), np.zeros_like(torque)
    per_motor, per_torque = load_responses(machine(), "x", DELAY, LINES * RATE / N, load_friction)
    load[LINES] = torque[LINES] * per_torque
    motor[LINES] = load[LINES] / per_motor
    tau, q, ql = (np.tile(np.fft.irfft(v, N), PERIODS) for v in (torque, motor, load))
    noise = 1e-9 * rng.standard_normal((3, tau.size))
    one = Experiment(
        "m", "multisine", ("x",), (), N / RATE, np.arange(tau.size) / RATE,
        (q + noise[0])[:, None], (tau + noise[1])[:, None], extra={"x.load_position": ql + noise[2]},
    )  # fmt: skip
    return Recording(1 / RATE, (AxisInfo("x", "rotary"),), (one,))


def test_the_right_machine_predicts_its_own_load() -> None:
    (found,) = predict_load(machine(), DELAY, recorded())
    assert found.frequencies[0] == 11.0
    assert found.frequencies[-1] == 119.0
    assert found.median_db < 1e-3
    assert found.median_degrees < 1e-2


def test_a_wrong_load_or_delay_or_friction_shows() -> None:
    data = recorded()
    (heavy,) = predict_load(machine(load=2.2), DELAY, data)
    assert heavy.per_position.median_db > 0.3
    (late,) = predict_load(machine(), DELAY + 1e-3, data)
    assert late.per_position.median_degrees < 1e-2
    assert late.per_torque.median_degrees > 10
    rough = recorded(load_friction=20.0)
    (without,) = predict_load(machine(), DELAY, rough)
    (with_it,) = predict_load(machine(), DELAY, rough, load_friction=20.0)
    assert without.median_degrees > 0.5
    assert with_it.median_degrees < 1e-2


def test_what_can_not_be_compared_is_said() -> None:
    data = recorded()
    with pytest.raises(NotEnoughDataError, match=r"has the signal 'x\.camera'"):
        predict_load(machine(), DELAY, data, extra="camera")
    with pytest.raises(NotEnoughDataError, match="no excited line between 200 and 240 Hz"):
        predict_load(machine(), DELAY, data, band=(200.0, 240.0))
    with pytest.raises(ValueError, match="the model has no axis 'y'"):
        predict_load(machine(), DELAY, data, axis="y")
    rigid = MachineModel((AxisModel("x", "rotary", (Estimate(1.0),), ()),))
    with pytest.raises(ValueError, match="has one mass in the model"):
        predict_load(rigid, DELAY, data)
    pair = MachineModel((*machine().axes, AxisModel("y", "rotary", (Estimate(1.0),), ())))
    with pytest.raises(ValueError, match="say which axis: the model has x, y"):
        predict_load(pair, DELAY, data)
