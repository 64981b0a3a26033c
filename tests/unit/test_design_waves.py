"""Half-waves: phasors of odd harmonics to signals and back."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldtool.design.waves import HalfWave


@given(st.integers(1, 64), st.floats(1e-3, 1e3), st.integers(0, 2**32 - 1))
def test_a_signal_is_the_sum_of_its_phasors(quarter: int, duration: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    wave = HalfWave(duration, 4 * quarter)
    shape = (2, 3, 2 * quarter)
    phasors = rng.standard_normal(shape) + 1j * rng.standard_normal(shape)
    turning = np.exp(1j * np.outer(wave.omega, wave.time))
    expected = 2 * np.real(phasors @ turning) / wave.samples
    assert wave.signal(phasors) == pytest.approx(expected, rel=1e-9, abs=1e-9)


@given(st.integers(1, 64), st.integers(0, 2**32 - 1))
def test_a_signal_comes_back_from_its_phasors(quarter: int, seed: int) -> None:
    wave = HalfWave(2.0, 4 * quarter)
    signal = np.random.default_rng(seed).standard_normal(wave.samples)
    assert wave.signal(wave.spectrum(signal)) == pytest.approx(signal, abs=1e-10)
