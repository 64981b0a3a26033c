"""Dry friction beside a linear model: found with the size it was simulated with, or not at all."""

from dataclasses import replace

import numpy as np
import pytest
from numba import njit

from fieldtool.frf.phasors import Phasors
from fieldtool.frf.velocity_band import position_noise
from fieldtool.identify.multisine.dry_friction import dry_friction, without_dry_friction
from fieldtool.identify.multisine.local_friction import local_friction
from fieldtool.identify.multisine.records import settled
from fieldtool.identify.multisine.sliding import Sliding, directions
from fieldtool.records.model import AxisModel, Estimate, MachineModel
from fieldtool.records.recording import Experiment

STEP, SAMPLES, PERIODS, SETTLE = 1e-3, 1000, 3, 16
MASS, VISCOUS = 0.5, 0.3


@njit
def slid(push: np.ndarray, h: float, friction: float) -> np.ndarray:
    """Positions of the mass: in each short step friction takes velocity, no more than there is."""
    position = np.zeros(push.size)
    x, velocity, slip = 0.0, 0.0, h * friction / MASS
    for k in range(push.size):
        position[k] = x
        wanted = velocity + h * (push[k] - VISCOUS * velocity) / MASS
        velocity = np.sign(wanted) * max(abs(wanted) - slip, 0.0)
        x += h * velocity
    return position


def sliding(friction: float, rng: np.random.Generator, late: int = 0) -> Experiment:
    """A rigid mass that is pushed by a multisine: integrated with friction as in a textbook.

    `late`: rows by which its position is told too late.
    """
    lines = np.array([3, 5, 7, 11, 13])
    phases = rng.uniform(0, 2 * np.pi, lines.size)
    fine = 10
    n = SAMPLES * PERIODS
    t = np.arange((n + SETTLE * SAMPLES) * fine) * STEP / fine
    push = np.sum(3.0 * np.cos(2 * np.pi * np.outer(t, lines) + phases), axis=1)
    position = slid(push, STEP / fine, friction)
    rows, position = slice(-n * fine, None), np.roll(position, late * fine)
    return Experiment(
        "slide", "multisine", ("a",), (), SAMPLES * STEP, np.arange(n) * STEP,
        position[rows][::fine, None], push[rows][::fine, None] + rng.normal(0, 0.01, (n, 1)),
    )  # fmt: skip


def rigid(viscous: float = VISCOUS) -> MachineModel:
    axis = AxisModel("a", "rotary", (Estimate(MASS),), (), (), Estimate(viscous))
    return MachineModel((axis,), ())


@pytest.mark.parametrize("friction", [0.2, 1.0])
def test_friction_is_found(friction: float, fresh_rng: np.random.Generator) -> None:
    experiment = sliding(friction, fresh_rng)
    for viscous in (VISCOUS, 0.0):  # what a linear fit would have put down to viscous friction
        found = dry_friction([experiment], STEP, (3.0, 13.0), rigid(viscous), np.zeros(1))
        one = found.torque[0]
        assert one.value == pytest.approx(friction, rel=0.2)  # one in ten is 7 % off
        assert abs(one.value - friction) < 6 * one.std + 0.02 * friction
        assert found.seen(5.0) == (0,)
        assert 0 < found.share[0] < 1


@pytest.mark.parametrize("friction", [0.2, 1.5])
def test_friction_is_found_of_a_position_that_is_told_late(
    friction: float, fresh_rng: np.random.Generator
) -> None:
    late = 4
    experiment, delays = sliding(friction, fresh_rng, late), np.array([late * STEP])
    found = dry_friction([experiment], STEP, (3.0, 13.0), rigid(), delays, np.array([friction]))
    assert found.torque[0].value == pytest.approx(friction, rel=0.02)


def test_friction_is_found_without_a_model(fresh_rng: np.random.Generator) -> None:
    friction = float(fresh_rng.uniform(0.3, 2.0))
    experiments = [sliding(friction, fresh_rng) for _ in range(3)]
    found, _ = local_friction(("a",), experiments, STEP, (3.0, 13.0))
    assert found.torque[0].value == pytest.approx(friction, rel=0.25)  # one in ten is 5 % off
    assert found.seen(5.0) == (0,)


def test_without_friction_none_is_found_without_a_model(fresh_rng: np.random.Generator) -> None:
    experiments = [sliding(0.0, fresh_rng) for _ in range(3)]
    found, _ = local_friction(("a",), experiments, STEP, (3.0, 13.0))
    assert found.seen(5.0) == ()
    assert found.share[0] < 0.02


def test_a_motor_that_stands_has_the_friction_that_holds_it(fresh_rng: np.random.Generator) -> None:
    friction = 6.0  # of pushes of up to 15 N m: it stands at many turns
    experiment = sliding(friction, fresh_rng)
    one = Sliding.of(experiment, STEP, 13.0, np.zeros(1))
    still = one.direction[:, 0] == 0
    assert 0.05 < np.mean(still) < 0.9
    held = one.standing(rigid(), np.zeros(1), np.array([friction]))[:, 0]
    assert np.all(held[~still] == 0)
    assert np.abs(held).max() <= friction
    # Friction is what the torque is, while the velocity is none.
    inner = still & np.roll(still, 3) & np.roll(still, -3)
    assert np.sqrt(np.mean((held - one.torque[:, 0])[inner] ** 2)) < 0.05 * friction


def test_no_friction_is_not_found(fresh_rng: np.random.Generator) -> None:
    experiment = sliding(0.0, fresh_rng)
    found = dry_friction([experiment], STEP, (3.0, 13.0), rigid(), np.zeros(1))
    assert abs(found.torque[0].value) < 0.02
    assert found.seen(8.0) == ()


def test_phasors_without_friction_are_those_of_the_linear_machine(
    fresh_rng: np.random.Generator,
) -> None:
    experiment = sliding(0.8, fresh_rng)
    lines = np.array([3, 5, 7, 11, 13])
    spectra = [
        np.fft.rfft(v.reshape(PERIODS, SAMPLES).mean(axis=0))[lines] * 2 / SAMPLES
        for v in (experiment.position[:, 0], experiment.torque[:, 0])
    ]
    phasors = Phasors(
        "slide", ("a",), ("a",), (), lines / (SAMPLES * STEP), spectra[0][:, None],
        spectra[1][:, None], np.broadcast_to(np.eye(2) * 1e-8, (5, 2, 2)).astype(complex),
    )  # fmt: skip
    (freed,) = without_dry_friction(
        [phasors], [experiment], STEP, np.array([0.8]), rigid(), np.zeros(1)
    )
    omega = 2 * np.pi * lines
    linear = (-MASS * omega**2 + 1j * omega * VISCOUS) * phasors.position[:, 0]
    before = np.abs(phasors.torque[:, 0] - linear).max()
    after = np.abs(freed.torque[:, 0] - linear).max()
    assert after < 0.12 * before


def test_a_constant_velocity_keeps_friction_out(fresh_rng: np.random.Generator) -> None:
    """The sign of a velocity that never reverses has no lines: there is nothing to be found."""
    experiment = sliding(0.0, fresh_rng)
    t = experiment.time[:, None]
    moved = Experiment(
        "slide", "multisine", ("a",), (), SAMPLES * STEP, experiment.time,
        experiment.position + 50.0 * t, experiment.torque + 1.0 + VISCOUS * 50.0,
    )  # fmt: skip
    found = dry_friction([moved], STEP, (3.0, 13.0), rigid(), np.zeros(1))
    assert found.torque[0].value == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize("shown", ["nothing", "a count now and then", "rounded numbers"])
def test_a_motor_that_stands_throughout_turns_in_no_direction(
    shown: str, fresh_rng: np.random.Generator
) -> None:
    count, n = 1e-4, SAMPLES * PERIODS
    place = count * float(fresh_rng.integers(1000, 5000))
    if shown == "a count now and then":
        jitter = count * (fresh_rng.random((n, 1)) < 0.02)
    elif shown == "rounded numbers":
        jitter = np.spacing(place) * fresh_rng.integers(-1, 2, (n, 1))
    else:
        jitter = np.zeros((n, 1))
    one = Experiment(
        "stand", "multisine", ("a",), (), SAMPLES * STEP, np.arange(n) * STEP,
        place + jitter, fresh_rng.normal(0, 0.01, (n, 1)),
    )  # fmt: skip
    for taken in (one, settled(one, STEP)):
        sliding_one = Sliding.of(taken, STEP, 13.0, np.zeros(1))
        assert np.mean(sliding_one.direction != 0) < 0.02
        assert np.mean(directions(taken, STEP, 13.0, np.zeros(1)) != 0) < 0.02


def test_an_encoder_is_as_coarse_after_its_periods_were_joined(
    fresh_rng: np.random.Generator,
) -> None:
    one = sliding(0.5, fresh_rng)
    count = float(np.ptp(one.position)) / 200
    coarse = replace(one, position=count * np.round(one.position / count))
    joined = settled(coarse, STEP)
    for taken in (coarse, joined):
        assert position_noise(taken.position)[0] >= 0.99 * count / 12**0.5
