"""Whole periods out of disturbed ones: every row undisturbed, and no row twice."""

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from fieldtool.experiment.multisine.passes import sound_in_a_row, sound_rows, whole_periods


@given(
    settle=st.integers(1, 20),
    samples=st.integers(4, 40),
    passes=st.integers(1, 8),
    tail=st.integers(0, 60),
    missing=st.lists(st.integers(-80, 340), max_size=12),
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
def test_whole_periods_are_passes_in_a_row_of_sound_rows(samples, periods, spare, share, seed):
    sound = np.random.default_rng(seed).random((periods + spare, samples)) >= share
    assume(sound.sum(axis=0).min() >= periods)
    whole = whole_periods(sound, periods)
    first = int(whole.own[0]) // samples
    assert whole.own.tolist() == list(range(first * samples, (first + periods) * samples))
    assert np.all(sound.ravel()[whole.sources])
    assert np.unique(whole.sources).size == whole.sources.size, "no row twice"
    assert np.array_equal(whole.sources % samples, whole.own % samples)
    kept = sound.ravel()[whole.own]
    assert np.array_equal(whole.sources[kept], whole.own[kept])
    assert whole.lent == np.count_nonzero(~kept)
    fewest = min(np.count_nonzero(~sound[k : k + periods]) for k in range(spare + 1))
    assert whole.lent == fewest
    if sound_in_a_row(sound, periods):
        assert (first, whole.lent) == (spare, 0)


def test_only_what_is_disturbed_is_taken_from_elsewhere():
    sound = np.ones((4, 10), dtype=bool)
    sound[0, 2:5] = sound[2, 5:7] = False
    whole = whole_periods(sound, 3)
    assert whole.own.tolist() == list(range(10, 40))
    assert whole.sources.tolist() == [*range(10, 25), 5, 6, *range(27, 40)]
    with_run_in = whole_periods(sound, 3, 7)
    assert with_run_in.own.tolist() == list(range(3, 40))
    assert with_run_in.sources[:7].tolist() == [13, 14, 5, 6, 7, 8, 9], "what is sound in others"
    assert with_run_in.sources[7:].tolist() == whole.sources.tolist()
    assert whole_periods(sound, 3, 25).own[0] == 0, "there is no pass before the first"


@pytest.mark.parametrize("noise", [0.0, 0.003])
@pytest.mark.parametrize("late", [(1450,), (350, 1750), (350, 1750, 2900), (900, 1100, 2500, 3300)])
def test_what_decays_or_drifts_goes_on_where_rows_are_of_another_pass(late, noise, fresh_rng):
    """Of two periods; each late cycle throws the signals off for as long as rows count as disturbed."""
    samples, passes, tail, step = 1000, 5, 200, 0.004
    t = step * np.arange(samples * passes)[:, None]
    phase = fresh_rng.uniform(0, 2 * np.pi, (8, 1, 2))
    lines = np.arange(3, 19, 2)[:, None, None]
    periodic = np.cos(2 * np.pi * lines * t / (samples * step) + phase).sum(axis=0)
    slow = np.array([0.3, -0.2]) * np.exp(-t / 1.5) + np.array([0.05, 0.02]) * t
    true = periodic + slow + noise * fresh_rng.standard_normal(periodic.shape)
    seen = true.copy()
    for row in late:
        seen[row : row + tail + 1] += 1.0
    sound = sound_rows(late, tail, 0, samples, passes)
    whole = whole_periods(sound[: 2 + len(late)], 2)
    filled = whole.filled(seen[: whole.sound.size])
    off = np.abs(filled - true[whole.own])
    assert off.max() < 0.03 + 10 * noise
    as_they_are = np.abs(seen[whole.sources] - true[whole.own]).max()
    assert as_they_are > 0.1 or not whole.lent


def test_filled_values_are_steps_that_a_drive_tells(fresh_rng):
    step, samples = 0.05, 500
    t = np.arange(4 * samples)[:, None]
    slow = 0.4 * np.exp(-t / 700)
    told = np.round((3 * np.sin(2 * np.pi * t / samples) + slow) / step) * step
    told += 0.0
    sound = np.ones((4, samples), dtype=bool)
    sound[1:, 100:250] = False
    sound[0, 300:] = sound[1, :40] = False
    sound[3, 100:250] = True
    whole = whole_periods(sound, 2)
    assert whole.lent
    filled = whole.filled(told)
    assert np.isin(filled, told).all()
    assert np.abs(filled - told[whole.own]).max() <= 2 * step


@pytest.mark.parametrize("periods", [2, 3])
def test_filling_adds_next_to_no_noise_to_the_lowest_lines(periods, fresh_rng):
    """White noise: phasors of the mean period by filled rows against those by rows as they were."""
    samples, sizes = 2500, []
    for _ in range(60):
        sound = np.ones((6, samples), dtype=bool)
        for k in range(5):
            at = int(fresh_rng.integers(0, samples - 850))
            sound[k, at : at + 850] = False
        if sound.sum(axis=0).min() < periods:
            continue
        noise = fresh_rng.standard_normal((6 * samples, 1))
        whole = whole_periods(sound, periods)
        mean = whole.filled(noise).reshape(periods, samples).mean(axis=0)
        sizes.append(np.abs(np.fft.rfft(mean)[3:9:2]) ** 2 * periods / samples)
    assert np.mean(sizes) < 2.0
