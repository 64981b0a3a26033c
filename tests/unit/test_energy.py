"""Motors that turn against their torque, told from the machine's energy.

Motors and loads are integrated here in SI, in small steps; the watch sees counts and per mille of
torque, once a cycle.
"""

from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm

from drives.canopen_drive.energy import SCALE, Balance, reversed_axis
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


class Watched:
    """One axis alone under the watch."""

    def __init__(self, motor: Motor, inertia: float = INERTIA) -> None:
        self.motor, weight = motor, 0.0 if motor.weight else None
        self.balance = Balance(motor.scale, UNIT, LIMIT, inertia, CYCLE, weight)

    def cycle(self, target: float) -> bool:
        """Let the motor follow for a cycle; return whether that was an alarm."""
        position, torque = self.motor.cycle(target)
        self.balance.take(position, torque, round(target / self.motor.scale), 1.0, enabled=True)
        return reversed_axis([self.balance]) is not None


@pytest.mark.parametrize("counts", [4000, 60_000, 2**20])
@pytest.mark.parametrize("friction", [0.0, 0.2, 1.2])
def test_a_sound_axis_is_no_alarm(fresh_rng, counts, friction):
    motor = Motor(counts, friction, weight=float(fresh_rng.uniform(-0.5, 0.5)))
    watch = Watched(motor, INERTIA * float(fresh_rng.choice([0.5, 1.0, 2.0])))
    for target in sweep(fresh_rng, 4000, float(fresh_rng.uniform(0.02, 0.3))):
        assert not watch.cycle(float(target))


@pytest.mark.parametrize("counts", [60_000, 2**20])
def test_a_load_that_swings_on_a_spring_is_no_alarm(fresh_rng, counts):
    """Many torques are against the acceleration there, by which nothing is proved."""
    load, velocity_p = float(fresh_rng.uniform(0.02, 0.2)), float(fresh_rng.uniform(0.5, 2.5))
    motor = Elastic(
        counts,
        0.0,
        position_p=float(fresh_rng.uniform(4.0, 10.0)),
        velocity_p=velocity_p,
        velocity_i=4 * velocity_p,
        frequency=float(fresh_rng.uniform(3.0, 12.0)),
        load=load,
    )
    watch, against, before = Watched(motor, INERTIA + load), 0, 0.0
    rows = int(fresh_rng.integers(150, 500))
    nudge = float(fresh_rng.uniform(0.01, 0.06)) * np.sin(np.linspace(0, np.pi, rows)) ** 2
    fast = sweep(fresh_rng, 2000, float(fresh_rng.uniform(0.02, 0.15)))
    for target in np.concatenate([np.zeros(100), nudge, np.zeros(100), fast]):
        alarm = watch.cycle(float(target))
        against += (motor.speed - before) * motor.torque < 0
        before = motor.speed
        assert not alarm
    assert against > 20


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 4), st.floats(0.0, 0.003))
def test_coupled_masses_and_springs_never_give_back_more_than_they_were_given(seed, axes, delay):
    """Whatever torques do to them: noise, swings, motors that hold others or are off."""
    rng = np.random.default_rng(seed)
    n = 2 * axes
    root = rng.normal(size=(n, n)) * 0.1
    mass = np.diag(rng.uniform(0.01, 1.0, n)) + root @ root.T
    root = rng.normal(size=(n, n)) * np.exp(rng.uniform(0.0, 4.0, (n, 1)))
    stiffness = root @ root.T
    inverse = np.linalg.inv(mass)
    damping = 0.004 * stiffness + 0.05 * mass
    dynamics = np.block([[np.zeros((n, n)), np.eye(n)], [-inverse @ stiffness, -inverse @ damping]])
    push = np.vstack([np.zeros((n, axes)), inverse[:, :axes]])
    whole = np.block([[dynamics, push], [np.zeros((axes, 2 * n + axes))]])
    substeps = 8
    over = expm(whole * CYCLE / substeps)[: 2 * n]
    told_wrong = 1 + rng.uniform(-SCALE, SCALE, axes) / 2
    unit = 2 * np.pi / 2**20
    limits = rng.uniform(1.0, 10.0, axes)
    balances = [Balance(unit, t / 1500, t, mass[k, k], CYCLE) for k, t in enumerate(limits)]
    state = np.zeros(2 * n)
    frequency, phase = rng.uniform(0.2, 40.0, axes), rng.uniform(0, 6.28, axes)
    places = [state[:axes]] * (round(delay / CYCLE * substeps) + 1)
    gain = rng.uniform(0.0, 20.0, axes)
    for k in range(600):
        for sub in range(substeps):
            time = (k + sub / substeps) * CYCLE
            torque = 0.3 * limits * np.sin(6.28 * frequency * time + phase)
            torque = np.clip(torque - gain * state[n : n + axes], -limits, limits)
            state = over @ np.concatenate([state, torque])
            places = [*places[1:], state[:axes]]
        for axis, one in enumerate(balances):
            told = round(float(torque[axis] * told_wrong[axis] / limits[axis]) * 1500)
            one.take(round(float(places[0][axis]) / unit), told, 0, 1.0, enabled=True)
        assert reversed_axis(balances) is None, k


@pytest.mark.parametrize("counts", [4000, 60_000, 2**20])
def test_a_motor_that_is_reversed_in_motion_is_found_before_it_has_gone_far(fresh_rng, counts):
    motor = Motor(counts, 0.0, position_p=8.0, velocity_p=1.0, velocity_i=4.0)
    watch = Watched(motor, INERTIA * float(fresh_rng.choice([0.5, 1.0, 2.0])))
    when = int(fresh_rng.integers(100, 1500))
    for row, target in enumerate(sweep(fresh_rng, 3000, 0.2)):
        if row == when:
            motor.sign, there, speed = -1.0, motor.angle, motor.speed
        if watch.cycle(float(target)):
            break
    assert when < row < when + 150
    assert abs(motor.angle - there - speed * CYCLE * (row - when)) < np.radians(30.0)


def test_work_and_doubt_are_what_they_are_by_hand():
    """From rest at 2 N m for 1 rad, then back by 1 N m: 2 J in, 1 J out."""
    one = Balance(1e-3, 1e-2, 0.0, 1.0, 1e-9)  # so short a cycle that nothing fades
    for position in range(0, 1001, 10):
        one.take(position, 200, position, 1.0, enabled=True)
    assert one.lately == pytest.approx(2.0, rel=1e-4)
    assert one.brought == pytest.approx(2.0 * (1 + SCALE), rel=1e-4)
    one.take(1000, 0, 1000, 1.0, enabled=True)
    before = one.lately
    for position in range(1000, -1, -10):
        one.take(position, 100, position, 1.0, enabled=True)
    assert before - one.lately == pytest.approx(1.0, rel=1e-4)


@given(
    st.floats(0.002, 2.0),
    st.floats(0.0, 0.01),
    st.floats(0.02, 1.0),
    st.floats(0.1, 4.0),
    st.booleans(),
)
def test_an_axis_that_hardly_loses_anything_may_cruise_for_long_and_brake(
    inertia, friction, share, cruise, weighs
):
    """What a moving mass holds does not fade, however heavy it is, or wrong by two its prior is."""
    torque, position, speed = share * LIMIT, 0.0, 0.0
    lost = friction * LIMIT
    scale = 2 * np.pi / 2**20
    prior = inertia * (0.5 if weighs else 2.0)
    one = Balance(scale, LIMIT / 1500, LIMIT, prior, CYCLE, 0.0 if weighs else None)
    ramp, steady = 100, round(cruise / CYCLE)
    for row in range(2 * ramp + steady):
        pushed = torque if row < ramp else lost if row < ramp + steady else -torque
        for _ in range(10):
            speed += 0.1 * CYCLE * (pushed - lost * np.sign(speed)) / inertia
            position += 0.1 * CYCLE * speed
        place = round(position / scale)
        one.take(place, round(1500 * pushed / LIMIT), place, 1.0, enabled=True)
        assert reversed_axis([one]) is None, row


def test_a_weight_that_sinks_is_no_alarm_and_one_that_is_not_there_is():
    """It was lifted before anybody looked; its motor holds it all the way down."""
    held, free = (Balance(1e-3, 1e-2, 5.0, 1.0, CYCLE, weight) for weight in (0.0, None))
    for row in range(1000):
        for one in (held, free):
            place = -row if row > 30 else 0
            one.take(place, 100, place, 1.0, enabled=True)
        if row > 500:
            assert reversed_axis([held]) is None
            assert reversed_axis([free]) == 0


def test_the_axis_that_gave_back_is_named_though_another_braked():
    """The second brings energy in for itself, the first takes some of it away."""
    axes = [Balance(1e-3, 1e-2, 1.0, 1.0, CYCLE) for _ in range(3)]
    for row in range(-30, 400):  # at rest first: none of these torques is a weight's
        for one, torque in zip(axes, (-20, -90, 10), strict=True):
            place = max(row, 0)
            one.take(place, torque if row > 0 else 0, place, 1.0, enabled=True)
    assert reversed_axis(axes) == 1


def test_what_a_disabled_drive_tells_as_torque_is_none():
    one = Balance(1e-3, 1e-2, 1.0, 1.0, CYCLE)
    for row in range(400):
        one.take(row, -500, row, 1.0, enabled=False)
    assert reversed_axis([one]) is None


def test_a_weight_whose_torque_is_built_up_slowly_is_none_either():
    """The axis sags as its brake opens, its loop takes half a second to hold it, then it is let down."""
    one, position = Balance(1e-3, 1e-2, 5.0, 1.0, CYCLE, 0.0), 0.0
    for row in range(3000):
        held = min(row / 250, 1.0)
        position -= 0.2 * (1 - held) if row < 400 else 0.5
        one.take(round(position), round(100 * held), round(position), 1.0, enabled=True)
        assert reversed_axis([one]) is None, row


@given(
    st.floats(0.02, 0.4), st.floats(-3.2, 3.2), st.floats(-1.2, 1.2), st.floats(0.4, 3.0),
    st.floats(0.0, 0.1), st.floats(0.01, 1.0),
)  # fmt: skip
def test_an_arm_with_weight_may_be_let_down_from_wherever_it_stands(
    share, angle, way, time, late, inertia
):
    """Its torque holds it after its brake has opened, on the whole way, whichever way that is."""
    scale, place = 2 * np.pi / 2**20, 0.0
    one = Balance(scale, LIMIT / 1500, LIMIT, inertia, CYCLE, 0.0)
    rows, begin = round(time / CYCLE), round(0.3 / CYCLE)
    for row in range(begin + rows + 200):
        part = np.clip((row - begin) / rows, 0, 1)
        place = way * (part - np.sin(2 * np.pi * part) / (2 * np.pi))
        acceleration = way * 2 * np.pi / time**2 * np.sin(2 * np.pi * part)
        held = share * LIMIT * np.sin(angle + place) * (row * CYCLE > late)
        torque = held + inertia * acceleration * (0 < part < 1)
        at = round(place / scale)
        one.take(at, round(1500 * torque / LIMIT), at, 1.0, enabled=True)
        assert reversed_axis([one]) is None, row


@given(
    st.integers(0, 2**32 - 1), st.sampled_from([0.001, 0.005, 0.02]), st.floats(0.0, 0.6),
    st.floats(0.02, 1.0), st.floats(0.3, 4.0),
)  # fmt: skip
def test_a_drive_that_brakes_at_the_end_of_its_interval_is_no_alarm(
    seed, cycle, late, viscous, velocity_p
):
    """A SYNC that comes late finds the reference at rest already, and the drive braking: what the
    sample tells then is not what moved the axis there."""
    rng, inertia = np.random.default_rng(seed), 0.04
    one = Balance(2 * np.pi / 2**20, LIMIT / 1500, LIMIT, inertia, cycle)
    runs = rng.random() < 0.5
    is_late = False
    for row in range(round(min(6.0, 1200 * cycle) / cycle)):
        rate = 3.0 * row * cycle
        place, speed = 0.1 * (1 - np.cos(rate)), 0.3 * np.sin(rate)
        torque = viscous * speed + inertia * 0.9 * np.cos(rate)
        if rng.random() < (0.4 if runs else 1.0):
            is_late = bool(rng.random() < late)
        torque -= velocity_p * speed * is_late
        at = round(place / 2 / np.pi * 2**20)
        one.take(at, round(1500 * torque / LIMIT), at, 1.0, enabled=True)
        assert reversed_axis([one]) is None, row


@pytest.mark.parametrize("steady", [False, True])
def test_targets_that_go_on_hide_no_motor_that_turns_the_other_way(fresh_rng, steady):
    """What they allow is no more than they go themselves, however much the torque jumps."""
    unit, cycle = 2 * np.pi / 2**20, 0.02
    one = Balance(unit, LIMIT / 1500, LIMIT, 0.04, cycle)
    place = speed = asked = 0.0
    for row in range(200):
        found = row
        asked += 0.2 * cycle
        torque = min(0.5 * LIMIT, 20.0 * abs(asked - place))
        jump = 0.0 if steady else float(fresh_rng.choice([-1.0, 0.0])) * torque
        speed -= cycle * torque / 0.04
        place += cycle * speed
        told = round(1500 * (torque + jump) / LIMIT)
        one.take(round(place / unit), told, round(asked / unit), 1.0, enabled=True)
        if reversed_axis([one]) is not None:
            break
    assert found < 12
