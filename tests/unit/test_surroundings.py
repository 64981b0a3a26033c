"""A spring to ground and a mode above the band: found where they are, kept out where they are not."""

import numpy as np
import pytest

from fieldtool.identify.likelihood.refine import refine
from fieldtool.identify.likelihood.response_data import ResponseMatrix
from fieldtool.identify.surroundings import with_surroundings
from fieldtool.records.model import AxisModel, Estimate, MachineModel

MOTOR, LOAD, SPRING, DAMPER, RUBS = 0.005, 0.004, 500.0, 0.02, 0.05
NOISE = 0.003


def measured(rng, ground=0.0, third=0.0):
    """Response of motor, load, and a third mass on a stiff spring at the motor; relative noise."""
    w = 2 * np.pi * np.arange(8.0, 200.0, 1.5)
    response = np.empty(w.size, complex)
    for k, s in enumerate(1j * w):
        joint, stiff = SPRING + DAMPER * s, 8000.0 + 0.05 * s
        behind = third * s**2 * stiff / (third * s**2 + stiff) if third else 0.0
        load = LOAD * s**2 + RUBS * s
        motor = MOTOR * s**2 + RUBS * s + ground + behind
        response[k] = 1 / (motor + joint * load / (joint + load))
    std = NOISE * np.abs(response)
    error = rng.normal(size=(2, w.size)) * std / np.sqrt(2)
    values = response + error[0] + 1j * error[1]
    return ResponseMatrix(("x",), w, values[:, None, None], std[:, None, None])


def fitted(data):
    start = MachineModel(
        (
            AxisModel(
                "x",
                "rotary",
                (Estimate(0.0055), Estimate(0.0045)),
                (Estimate(550.0),),
                (Estimate(0.03),),
            ),
        ),
        (),
    )
    alone = refine(start, data, fit_delay=True, fit_friction=True, fit_load_friction=True)
    return with_surroundings(alone, data)


def test_a_spring_to_ground_is_found_and_biases_nothing(fresh_rng):
    found, beside = fitted(measured(fresh_rng, ground=1.5))
    assert beside.spring is not None
    assert abs(beside.spring.value - 1.5) < 5 * beside.spring.std < 1.0
    assert beside.upper_mode is None
    for value, true in zip(found.model.axes[0].masses, (MOTOR, LOAD), strict=True):
        assert abs(value.value - true) < 5 * value.std < 0.1 * true
    assert found.chi2 < 1.4 * found.degrees_of_freedom


def test_a_mode_above_the_band_is_found(fresh_rng):
    found, beside = fitted(measured(fresh_rng, third=0.002))
    assert beside.upper_mode is not None
    third_mode = np.sqrt(8000 * (1 / 0.002 + 1 / MOTOR)) / (2 * np.pi)
    assert beside.upper_mode.value == pytest.approx(third_mode, rel=0.3)
    assert found.model.axes[0].masses[0].value == pytest.approx(MOTOR + 0.002, rel=0.02)
    assert found.chi2 < 1.4 * found.degrees_of_freedom


def test_a_chain_alone_keeps_nothing_beside_it(fresh_rng):
    """By chance one in twenty keeps a spring: nine of forty do in two of ten thousand such tests."""
    kept = [fitted(measured(fresh_rng))[1] for _ in range(40)]
    assert sum(one.spring is not None for one in kept) <= 8
    assert sum(one.upper_mode is not None for one in kept) <= 3
