"""An oscillation above the excitation, and noise that is none."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fieldtool.experiment.multisine.growth import out_of_band

HIGHEST = 0.1
"""Of the excitation, periods a row."""


def excitation(rng: np.random.Generator, rows: int) -> np.ndarray:
    times, lines = np.arange(rows), rng.uniform(0.01, HIGHEST, 8)
    return np.sin(2 * np.pi * np.outer(times, lines) + rng.uniform(0, 6.28, 8)).sum(axis=1)


@given(st.integers(0, 2**32 - 1), st.integers(100, 500), st.floats(0.0, 8.0), st.booleans())
@settings(deadline=None)
def test_an_oscillation_is_told_with_its_frequency_while_it_grows_or_is_cut_off(
    seed, rows, grown, cut_off
):
    rng = np.random.default_rng(seed)
    rate, frequency = grown / rows, rng.uniform(0.15, 0.47)
    swing = np.exp(rate * (np.arange(rows) - rows)) * np.sin(
        2 * np.pi * frequency * np.arange(rows)
    )
    torque = 30 * (np.clip(swing, -0.6, 0.6) if cut_off else swing)
    torque = torque + 0.2 * rng.normal(size=rows) + 0.1 * excitation(rng, rows)
    found = out_of_band(torque, HIGHEST)
    assert found is not None
    assert found == pytest.approx(frequency, abs=2 / rows + 0.02 * frequency + rate / 3)


@given(st.integers(0, 2**32 - 1), st.integers(100, 500), st.floats(0.0, 0.3))
@settings(deadline=None)
def test_noise_is_no_oscillation(seed, rows, share):
    rng = np.random.default_rng(seed)
    torque = rng.normal(size=rows) + share * excitation(rng, rows)
    assert out_of_band(torque, HIGHEST) is None


def test_the_excitation_itself_is_none(fresh_rng):
    assert out_of_band(excitation(fresh_rng, 300), HIGHEST) is None
