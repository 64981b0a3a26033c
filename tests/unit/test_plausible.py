"""What inertia a small move shows: sound machines are no alarm, wrong scales are."""

import numpy as np
import pytest

from fieldtool.experiment.plausible import coefficient_std, inertia_of_move
from fieldtool.experiment.stepped.plan import smooth_move

STEP, ROWS = 0.002, 150


def small_move(
    rng: np.random.Generator,
    *,
    cogging: float = 0.0,
    noise: float = 0.01,
    friction: float = 0.1,
    swing: float = 0.0,
) -> tuple[float, np.ndarray, np.ndarray, np.ndarray]:
    """Return inertia, reference, position and torque of a motor that follows a move there and back.

    Sizes are shares of the largest torque for inertia; the swing is of a load that rings on.
    """
    way = rng.uniform(0.02, 0.3)
    there = smooth_move(way, 1.0, rng.uniform(2.0, 20.0), STEP, 1.0)
    rest, away = np.zeros(ROWS), np.full(ROWS, way)
    reference = np.concatenate([rest, there, away, way - there, rest])
    time = STEP * np.arange(reference.size)
    lag = rng.uniform(0.0, 0.05)
    position = np.interp(time - lag, time, reference)
    speed = np.gradient(position, STEP)
    acceleration = np.gradient(speed, STEP)
    inertia = float(np.exp(rng.uniform(-5.0, 5.0)))
    largest = inertia * np.abs(acceleration).max()
    torque = inertia * acceleration + friction * largest * np.tanh(30 * speed / np.abs(speed).max())
    waves, phases = rng.uniform(0.2, 3.0), rng.uniform(0.0, 2 * np.pi, 2)
    torque += cogging * largest * np.sin(2 * np.pi * waves * position / way + phases[0])
    torque += swing * largest * np.sin(2 * np.pi * rng.uniform(1.0, 15.0) * time + phases[1])
    torque += noise * largest * rng.normal(size=torque.size)
    return inertia, reference, position, torque


def test_no_alarm_where_cogging_and_swings_hide_the_inertia(fresh_rng):
    alarms = 0
    for _ in range(1500):
        inertia, *move = small_move(
            fresh_rng,
            cogging=fresh_rng.uniform(0.0, 30.0),
            swing=fresh_rng.choice([0.0, 0.2]),
            friction=fresh_rng.choice([0.0, 0.2]),
            noise=fresh_rng.uniform(0.001, 0.1),
        )
        shown = inertia_of_move(*move, STEP)
        alarms += shown.factor_off(inertia * fresh_rng.uniform(0.5, 2.0)) is not None
    print(alarms)
    assert alarms <= 25  # some 10; taken for white noise, some 40


def test_a_scale_that_is_wrong_by_ten_is_seen(fresh_rng):
    seen = []
    for _ in range(100):
        inertia, *move = small_move(fresh_rng, noise=fresh_rng.uniform(0.001, 0.03))
        shown = inertia_of_move(*move, STEP)
        for scale in (10.0, 0.1):
            factor = shown.factor_off(inertia * scale)
            seen.append(factor is not None)
            if factor is not None:
                assert 0.3 < factor * scale < 3.0
    print(sum(seen))
    assert sum(seen) > 180


def test_standard_errors_of_white_noise_and_of_waves(fresh_rng):
    weights = np.hanning(1000) / 1000  # a smooth sum, as those of slow moves are
    draws = fresh_rng.normal(size=(200, 1000))
    expected = float(np.linalg.norm(weights))
    told_of_white = np.median([coefficient_std(weights, white) for white in draws])
    assert told_of_white == pytest.approx(expected, rel=0.2)
    walks = [np.convolve(fresh_rng.normal(size=1200), np.ones(50))[100:1100] for _ in range(200)]
    told = np.median([coefficient_std(weights, walk) for walk in walks])
    happens = np.std([weights @ walk for walk in walks])
    assert 0.6 * happens < told < 1.4 * happens
    assert told > 4 * np.linalg.norm(weights) * np.std(walks)  # what white noise of its size makes
    assert coefficient_std(weights, np.zeros(1000)) == 0.0
