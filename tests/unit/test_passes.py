"""Whole periods out of disturbed ones: every row undisturbed, and no row twice."""

import numpy as np
from hypothesis import assume, given
from hypothesis import strategies as st

from fieldtool.experiment.multisine.passes import sound_rows, whole_periods


@given(
    settle=st.integers(1, 20),
    samples=st.integers(4, 40),
    passes=st.integers(1, 8),
    tail=st.integers(0, 60),
    missing=st.lists(st.integers(0, 340), max_size=12),
)
def test_a_row_is_sound_if_nothing_came_shortly_before(settle, samples, passes, tail, missing):
    sound = sound_rows(missing, tail, settle, samples, passes)
    assert sound.shape == (passes, samples)
    for k, n in np.ndindex(sound.shape):
        row = settle + k * samples + n
        assert sound[k, n] != any(row - tail <= m <= row for m in missing)


@given(
    samples=st.integers(4, 30),
    periods=st.integers(1, 4),
    spare=st.integers(0, 5),
    share=st.floats(0.0, 0.5),
    seed=st.integers(0, 2**31),
)
def test_whole_periods_are_sound_and_no_row_is_in_two(samples, periods, spare, share, seed):
    sound = np.random.default_rng(seed).random((periods + spare, samples)) >= share
    assume(sound.sum(axis=0).min() >= periods)
    chosen = whole_periods(sound, periods)
    assert chosen.shape == (periods, samples)
    n = np.arange(samples)
    assert np.all(sound[chosen, n])
    for column in chosen.T:
        assert np.unique(column).size == periods
    if sound.all():
        assert np.array_equal(chosen, np.tile(np.arange(spare, spare + periods)[:, None], samples))


def test_only_what_is_disturbed_is_taken_from_elsewhere():
    sound = np.ones((4, 10), dtype=bool)
    sound[0, 2:5] = sound[2, 5:7] = False
    assert whole_periods(sound, 3).tolist() == [
        [1] * 10,
        [2, 2, 2, 2, 2, 0, 0, 2, 2, 2],
        [3] * 10,
    ]
