"""Recordings that nobody plans and somebody has: a motor that stands, bands that differ, late positions.

Two masses on a spring each, in steady state, from the equations of motion in each line.
"""

import numpy as np
import pytest

from fieldtool.errors import IdentificationError
from fieldtool.identify.multisine import fit, identify
from fieldtool.identify.multisine.dry_friction import DryFriction
from fieldtool.identify.multisine.identify import JointIdentified, identify_joint
from fieldtool.records.model import Estimate
from fieldtool.records.recording import AxisInfo, Experiment, Recording

STEP, SAMPLES, PERIODS = 1e-3, 1000, 4
MOTOR, LOAD, SPRING, DAMPER, VISCOUS = 0.02, 0.03, 296.0, 0.05, 0.3
TORQUE_NOISE, POSITION_NOISE = 1e-2, 1e-6
LINES = np.array([k for k in range(3, 60) if k % 4])


def moved(omega: np.ndarray) -> np.ndarray:
    """Motion of a motor over its torque."""
    joint = SPRING + 1j * omega * DAMPER
    load = LOAD * omega**2 * joint / (joint - LOAD * omega**2)
    return 1.0 / (-MOTOR * omega**2 - load + 1j * omega * VISCOUS)


def experiment(
    rng: np.random.Generator,
    axes: int,
    *,
    lines: np.ndarray = LINES,
    friction: float = 0.0,
    speed: float = 0.0,
    stands: int | None = None,
    late: float = 0.0,
) -> Experiment:
    """One experiment; `speed`: constant velocity beside it; `late`: s by which positions are told."""
    names = "abc"[:axes]
    time = np.arange(SAMPLES * PERIODS) * STEP
    omega = 2 * np.pi * lines / (SAMPLES * STEP)
    size = 2.0 / np.sqrt(lines.size)
    push = size * np.exp(2j * np.pi * rng.random((lines.size, axes)))
    motion = moved(omega)[:, None] * push
    waves = np.exp(1j * np.outer(time, omega))
    velocity = (waves @ (1j * omega[:, None] * motion)).real + speed
    torque = (waves @ push).real + friction * np.sign(velocity) + VISCOUS * speed
    told = motion * np.exp(-1j * omega * late)[:, None]
    position = 0.4 + (waves @ told).real + speed * time[:, None]
    position += rng.normal(0.0, POSITION_NOISE, position.shape)
    if stands is not None:
        position[:, stands], torque[:, stands] = 0.4, 0.0
    torque += rng.normal(0.0, TORQUE_NOISE, torque.shape)
    return Experiment(
        f"m{rng.integers(1_000_000)}", "multisine", tuple(names), (), SAMPLES * STEP, time, position,
        torque,
    )  # fmt: skip


def identified(*experiments: Experiment) -> JointIdentified:
    names = experiments[0].driven
    infos = tuple(AxisInfo(name, "rotary", controller=None) for name in names)
    recording = Recording(STEP, infos, experiments)
    return identify_joint(recording, dict.fromkeys(names, 2), dict.fromkeys(names, "rotary"))


def check(found: JointIdentified, friction: float) -> None:
    for axis, dry in zip(found.model.axes, found.friction.torque, strict=True):
        assert axis.masses[0].value == pytest.approx(MOTOR, rel=0.005)
        assert axis.masses[1].value == pytest.approx(LOAD, rel=0.005)
        assert axis.springs[0].value == pytest.approx(SPRING, rel=0.005)
        assert dry.value == pytest.approx(friction, abs=0.02 * friction + 0.01)


@pytest.mark.parametrize("axis", [0, 1])
def test_dry_friction_that_only_makes_the_fit_worse_was_none(
    fresh_rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch, axis: int
) -> None:
    """A motion that is not steady yet leaves between the lines what looks like it, large as its push."""
    sizes = [Estimate(0.0, 0.1), Estimate(0.0, 0.1)]
    sizes[axis] = Estimate(1.0, 0.1)
    told = DryFriction(("a", "b"), tuple(sizes), np.array([0.5, 0.5]))
    monkeypatch.setattr(fit, "dry_friction", lambda *_: told)
    found = identified(*[experiment(fresh_rng, 2) for _ in range(2)])
    for one in found.model.axes:
        assert one.masses[0].value == pytest.approx(MOTOR, rel=0.005)
        assert one.masses[1].value == pytest.approx(LOAD, rel=0.005)
        assert one.viscous_friction.value == pytest.approx(VISCOUS, rel=0.02)
    assert not any(one["effect"] == "coulomb_friction" for one in found.model.effects)


def test_a_motor_that_stands_in_one_experiment(fresh_rng: np.random.Generator) -> None:
    ones = [experiment(fresh_rng, 2, friction=0.4) for _ in range(2)]
    check(identified(experiment(fresh_rng, 2, friction=0.4, stands=1), *ones), 0.4)


def test_experiments_of_different_bands(fresh_rng: np.random.Generator) -> None:
    low, high = LINES[LINES < 35], LINES[LINES > 25]
    ones = [experiment(fresh_rng, 1, lines=lines) for lines in (low, high)]
    check(identified(*ones), 0.0)


def test_friction_that_never_turns_is_none(fresh_rng: np.random.Generator) -> None:
    found = identified(experiment(fresh_rng, 1, friction=0.5, speed=20.0))
    check(found, 0.0)


@pytest.mark.parametrize("late", [1.5, 4.0])
def test_friction_beside_positions_that_are_told_late(
    late: float, fresh_rng: np.random.Generator
) -> None:
    found = identified(experiment(fresh_rng, 1, friction=0.5, late=late * STEP))
    check(found, 0.5)
    assert found.fitted.delays[0].value == pytest.approx(late * STEP, rel=0.01)


def test_a_fit_that_runs_away_is_said_in_a_sentence(
    fresh_rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As of data of so little noise that what friction leaves is all that is fitted."""

    def singular(*_: object) -> None:
        np.linalg.inv(np.zeros((2, 2)))

    monkeypatch.setattr(identify, "with_free_motion", singular)
    with pytest.raises(IdentificationError, match="runs away") as told:
        identified(experiment(fresh_rng, 1, friction=0.5))
    assert "strongly non-linear" in told.value.__notes__[0]
