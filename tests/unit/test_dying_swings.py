"""Swings that die clearly are no oscillation; all others are found when they always were."""

import numpy as np
import pytest

from tests.unit.test_oscillation_watch import first_alarm, moving, watch

ROWS = 2000


def swing(shrinks, half):
    """Turns every so many rows; each time it is so many times as large as before."""
    n = np.arange(ROWS)
    return shrinks ** (n / half) * np.cos(np.pi * n / half)


def quick(signal):
    """Rows till a position's swing is found while its axis moves."""
    return first_alarm(moving(watch()), 0.4 * signal, np.zeros(ROWS))


def beside(signal):
    """Rows till the torque's of an axis beside the one that moves is found; the torque bound is wide."""
    one = watch(axes=2)
    one.move(
        np.full(2, -2.0), np.full(2, 2.0), np.full(2, 1e3), half_period=0.05, axis=1
    )  # fmt: skip
    for k, value in enumerate(signal):
        if one.take([0.0, 0.0], [100.0 * float(value), 0.0]) is not None:
            return k
    return None


def at_rest(signal):
    """Rows till a slow swing of a position is found once all references stand."""
    one = moving(watch())
    one.settle(np.array([-2.0]), np.array([2.0]), np.array([9.0]), 0.05, 0, None)
    return first_alarm(one, 0.4 * signal, np.zeros(ROWS))


@pytest.mark.parametrize(
    ("shrinks", "rows"),
    [
        (1.5, (42, 308, 308)),
        (1.0, (62, 306, 308)),
        (0.9, (62, 306, 308)),
        (0.8, (62, 306, 308)),
        (0.7, (62, 306, 309)),
        (0.6, (63, 307, 311)),
    ],
)
def test_swings_that_grow_stay_or_die_slowly_are_found_after_the_third(shrinks, rows):
    """In the same row as where every third swing far above the level counts."""
    found = quick(swing(shrinks, 20)), beside(swing(shrinks, 100)), at_rest(swing(shrinks, 100))
    assert found == rows


@pytest.mark.parametrize("shrinks", [0.45, 0.3])
def test_swings_that_are_halved_each_time_are_no_oscillation(shrinks):
    found = quick(swing(shrinks, 20)), beside(swing(shrinks, 100)), at_rest(swing(shrinks, 100))
    assert found == (None, None, None)


def test_a_swing_that_dies_at_first_and_then_stays_is_found_one_swing_later():
    n = np.arange(ROWS)
    stays = np.where(n < 40, 0.45 ** (n / 20), 0.45**2) * np.cos(np.pi * n / 20)
    assert 60 < quick(stays) <= 86
