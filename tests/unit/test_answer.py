"""Motors that turn against their torque, told from how their axes answered before.

Motors and loads are integrated here in SI, in small steps; the watch sees counts and per mille of
torque, once a cycle.
"""

from dataclasses import dataclass

import numpy as np
import pytest

from drives.canopen_drive.answer import DECIDES, MOST, Answer, Reversed
from tests.unit.test_unseen import CYCLE, INERTIA, LIMIT, UNIT, Motor, sweep


@dataclass
class Elastic(Motor):
    """A motor that carries a load on a spring, swinging freely: torque and acceleration often differ."""

    load: float = 0.06
    frequency: float = 9.0
    """Hz, of the load on its spring while the motor is held."""
    load_angle: float = 0.0
    load_speed: float = 0.0

    def _move(self, pushed: float, step: float) -> None:
        pull = self.load * (2 * np.pi * self.frequency) ** 2 * (self.load_angle - self.angle)
        self.load_speed -= step * pull / self.load
        self.load_angle += step * self.load_speed
        super()._move(pushed + pull, step)


def watch_of(motor: Motor, answer: Answer | None = None, prior: float = INERTIA) -> Reversed:
    push = UNIT / prior * CYCLE**2 / motor.scale
    return Reversed(answer or Answer(), push, LIMIT / UNIT, CYCLE)


@pytest.mark.parametrize("counts", [4000, 60_000, 2**20])
@pytest.mark.parametrize("friction", [0.0, 0.2, 1.2])
def test_a_sound_axis_is_no_alarm(fresh_rng, counts, friction):
    motor = Motor(counts, friction, weight=float(fresh_rng.uniform(-0.5, 0.5)))
    watch = watch_of(motor, prior=INERTIA * float(fresh_rng.choice([0.5, 1.0, 2.0])))
    for target in sweep(fresh_rng, 4000, float(fresh_rng.uniform(0.02, 0.3))):
        watch.take(*motor.cycle(float(target)), friction=friction / UNIT)
        assert not watch.alarm


@pytest.mark.parametrize("counts", [60_000, 2**20])
def test_a_load_that_swings_on_a_spring_is_no_alarm(fresh_rng, counts):
    """Many torques are against the acceleration there, by which nothing is proved."""
    frequency = float(fresh_rng.uniform(3.0, 8.0))
    motor = Elastic(
        counts, 0.0, position_p=8.0, velocity_p=1.0, velocity_i=4.0, frequency=frequency
    )
    watch, against, before = watch_of(motor, prior=INERTIA * 2.5), 0, 0.0
    for target in sweep(fresh_rng, 4000, 0.1):
        shown = motor.cycle(float(target))
        watch.take(*shown)
        against += (motor.speed - before) * motor.torque < 0
        before = motor.speed
        assert not watch.alarm
    assert against > 20


@pytest.mark.parametrize("counts", [60_000, 2**20])
def test_a_load_that_swings_for_the_first_time_is_no_alarm(fresh_rng, counts):
    """What was learned from slow motion does not tell how it answers, and is not held against it."""
    frequency = float(fresh_rng.uniform(3.0, 12.0))
    load, velocity_p = float(fresh_rng.uniform(0.02, 0.2)), float(fresh_rng.uniform(0.5, 2.5))
    motor = Elastic(
        counts,
        0.0,
        position_p=float(fresh_rng.uniform(4.0, 10.0)),
        velocity_p=velocity_p,
        velocity_i=4 * velocity_p,
        frequency=frequency,
        load=load,
    )
    watch = watch_of(motor, prior=INERTIA + load)
    rows = int(fresh_rng.integers(150, 500))
    nudge = float(fresh_rng.uniform(0.01, 0.06)) * np.sin(np.linspace(0, np.pi, rows)) ** 2
    fast = sweep(fresh_rng, 300, float(fresh_rng.uniform(0.02, 0.15)))
    for target in np.concatenate([np.zeros(100), nudge, np.zeros(100), fast]):
        watch.take(*motor.cycle(float(target)))
        assert not watch.alarm


def test_torques_that_were_not_met_before_begin_no_suspicion(fresh_rng):
    """An axis that answered small torques well, and a large one the other way round, at once."""
    motor, answers = Motor(2**20, 0.0), {}
    for torque_before in (1.0, 0.05):
        watch = watch_of(motor)
        noise = fresh_rng.normal(size=600)
        position = speed = 0.0
        push = UNIT / INERTIA * CYCLE**2 / motor.scale
        for row in range(630):
            turned = row >= 600
            torque = round((1.0 if turned else torque_before * noise[row]) / UNIT)
            speed += push * torque * (-1 if turned else 1)
            position += speed
            watch.take(round(position), torque)
        answers[torque_before] = watch.alarm
    assert answers == {1.0: True, 0.05: False}


def cycles_until_told(rng: np.random.Generator, counts: int) -> tuple[int, float] | None:
    """Reverse a motor in a sweep; return cycles and radians until the alarm, None if there is none."""
    motor = Motor(counts, 0.0, position_p=8.0, velocity_p=1.0, velocity_i=4.0)
    watch = watch_of(motor, prior=INERTIA * float(rng.choice([0.5, 1.0, 2.0])))
    when = int(rng.integers(600, 1500))
    for row, target in enumerate(sweep(rng, 3000, 0.2)):
        if row == when:
            motor.sign, there, speed = -1.0, motor.angle, motor.speed
        watch.take(*motor.cycle(float(target)))
        if watch.alarm:
            assert row >= when + DECIDES / MOST - 1, "no three cycles decide"
            return row - when, motor.angle - there - speed * CYCLE * (row - when)
    return None


@pytest.mark.parametrize("counts", [60_000, 2**20])
def test_a_motor_that_is_reversed_in_motion_is_found_before_it_has_gone_far(fresh_rng, counts):
    told = cycles_until_told(fresh_rng, counts)
    assert told is not None, "it was never found"
    cycles, beside = told
    assert abs(beside) < np.radians(6.0), f"{cycles} cycles, {np.degrees(beside):.2f} degrees"


def test_an_axis_that_stops_answering_is_not_called_reversed(fresh_rng):
    """It is blocked, or its encoder stands: others tell that."""
    motor = Motor(2**20, 0.0)
    watch = watch_of(motor)
    for row, target in enumerate(sweep(fresh_rng, 2000, 0.2)):
        if row == 1000:
            motor.stuck_at = motor.encoder
        watch.take(*motor.cycle(float(target)))
        assert not watch.alarm


def test_what_was_learned_lasts_to_the_next_motion_with_the_same_cycle(fresh_rng):
    motor, answer = Motor(2**20, 0.0), Answer()
    watch = watch_of(motor, answer)
    for target in sweep(fresh_rng, 600, 0.2):
        watch.take(*motor.cycle(float(target)))
    assert answer.weights is not None
    known = answer.weights
    watch_of(motor, answer)
    assert answer.weights is known
    Reversed(answer, 0.1, LIMIT / UNIT, 2 * CYCLE)
    assert answer.weights is None
