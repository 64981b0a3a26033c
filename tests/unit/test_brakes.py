"""Torques without what drives do at SYNCs that come late."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from fieldtool.experiment.verification.brakes import LATE, MORE, Brakes

STEP, VELOCITY, ACCELERATION = 0.01, 40.0, 2.0
FED = np.array([[VELOCITY, 10.0], [ACCELERATION, 0.0]])


def shown(targets, torques, late):
    """Return what is shown of the first axis; the second stands."""
    one = Brakes(FED, STEP)
    rows = zip(torques, targets, late, strict=True)
    return np.array([one.take([t, 1.0], [q, 0.0], seconds)[0] for t, q, seconds in rows])


def fed_at(targets):
    """Return what is fed forward at the end of each row's interval, by hand; 0 in the first three."""
    found = np.zeros(targets.size)
    for k in range(3, targets.size):
        a, b, c = targets[k - 3 : k]
        found[k] = VELOCITY * (c - b) / STEP + ACCELERATION * (c - 2 * b + a) / STEP**2
    return found


@given(st.integers(0, 2**32 - 1))
def test_what_late_syncs_take_off_is_left_out_and_nothing_else(seed):
    rng = np.random.default_rng(seed)
    rows = np.arange(120)
    targets = 0.2 * np.sin(2 * np.pi * rows * STEP / rng.uniform(0.8, 2.0))
    level = float(rng.uniform(-5.0, 5.0))
    late = np.where(rng.random(rows.size) < 0.4, rng.uniform(2 * LATE, 1e-3, rows.size), 0.0)
    late[:4] = 0.0
    gone = fed_at(targets) * rng.uniform(0.0, 1.0, rows.size) * (late > 0)
    assert np.allclose(shown(targets, level - gone, late), level)


def test_in_time_all_is_shown():
    rng = np.random.default_rng(1)
    targets, torques = np.cumsum(rng.normal(0.0, 0.01, 200)), rng.normal(0.0, 20.0, 200)
    for late in (0.0, -1e-3, LATE / 2):
        assert np.array_equal(shown(targets, torques, np.full(200, late)), torques)


def test_where_targets_stand_all_is_shown():
    torques = np.random.default_rng(2).normal(0.0, 20.0, 200)
    assert np.array_equal(shown(np.zeros(200), torques, np.full(200, 1e-3)), torques)


def test_what_falls_farther_or_the_other_way_is_shown():
    targets = 0.01 * np.arange(60)  # 1 m/s or rad/s: 40 N m
    late = np.full(60, 1e-3)
    for jump in (-1.01 * MORE * VELOCITY, 0.5, 100.0):
        torques = np.where(np.arange(60) == 30, jump, 0.0)
        assert shown(targets, torques, late)[30] == jump


def test_another_motion_begins_with_what_it_sees():
    one = Brakes(FED, STEP)
    for k in range(10):
        one.take([30.0, 0.0], [0.01 * k, 0.0], 1e-3)
    assert one.take([10.0, 0.0], [0.1, 0.0], 1e-3)[0] == 30.0
    one.begin()
    assert one.take([10.0, 0.0], [0.11, 0.0], 1e-3)[0] == 10.0
