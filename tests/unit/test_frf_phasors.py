"""Sine fits: exact where they can be, and an error that is as large as it says."""

from itertools import pairwise

import numpy as np
import pytest

from fieldtool.errors import NotEnoughDataError
from fieldtool.frf.phasors import fit_block, fit_sine, settled
from fieldtool.frf.stepped.quality import distortion_share, judge
from tests.seeds import fresh_seed

PERIOD = 0.004


def new_seed() -> int:
    return fresh_seed()


def wave(time: np.ndarray, frequency: float, amplitude: complex) -> np.ndarray:
    return np.real(amplitude * np.exp(2j * np.pi * frequency * time))


@pytest.mark.parametrize(
    ("frequency", "periods"), [(1.0, 1), (7.3, 5), (8.0, 3.37), (61.7, 40), (110.0, 30)]
)
def test_a_sinusoid_on_a_drifting_offset_is_found_exactly(frequency: float, periods: float) -> None:
    rng = np.random.default_rng(new_seed())
    time = 3.0 + np.arange(round(periods / frequency / PERIOD)) * PERIOD
    truth = rng.standard_normal(3) + 1j * rng.standard_normal(3)
    signals = np.column_stack([wave(time, frequency, a) for a in truth]) + 5.0 - 0.7 * time[:, None]
    if periods >= 3 and frequency < 10:
        signals += wave(time, 3 * frequency, 0.3)[:, None]
    fit = fit_sine(time, signals, frequency)
    np.testing.assert_allclose(fit.amplitude, truth, rtol=0, atol=1e-9)
    assert np.all(fit.std < 1e-9)
    if periods >= 3 and frequency < 10:
        np.testing.assert_allclose(distortion_share(fit), 0.3 / np.abs(truth), rtol=1e-6)


@pytest.mark.parametrize("colour", ["white", "red"])
@pytest.mark.parametrize(("frequency", "rows"), [(5.0, 500), (7.77, 400), (31.0, 300)])
def test_the_standard_error_is_the_scatter_of_repetitions(
    colour: str, frequency: float, rows: int
) -> None:
    rng = np.random.default_rng(new_seed())
    time = np.arange(rows) * PERIOD
    clean = wave(time, frequency, 1.0 + 0.5j)
    errors, variances = [], []
    for _ in range(300):
        noise = rng.standard_normal((rows + 100, 2))
        if colour == "red":
            for k in range(1, noise.shape[0]):
                noise[k] += 0.8 * noise[k - 1]
        fit = fit_sine(time, clean[:, None] + 0.05 * noise[100:], frequency)
        errors.append(fit.amplitude - (1.0 + 0.5j))
        variances.append(fit.std**2)
    true = np.sqrt(np.mean(np.abs(errors) ** 2) / 2)
    claimed = np.sqrt(np.mean(variances))
    if colour == "white":
        assert claimed == pytest.approx(true, rel=0.12)
    else:  # few blocks: the residual's level counts, which is off by the colour of the noise
        assert 0.6 < claimed / true < 2.0


def test_errors_of_two_signals_with_common_noise_are_correlated() -> None:
    rng = np.random.default_rng(new_seed())
    time = np.arange(1000) * PERIOD
    common = rng.standard_normal(1000)
    signals = wave(time, 4.0, 1.0)[:, None] + np.column_stack([common, 2 * common])
    covariance = fit_sine(time, signals, 4.0).covariance
    np.testing.assert_allclose(covariance, covariance.conj().T)
    assert abs(covariance[0, 1]) == pytest.approx(
        np.sqrt(covariance[0, 0].real * covariance[1, 1].real), rel=1e-6
    )


def test_too_short_a_stretch_is_refused_with_the_numbers() -> None:
    time = np.arange(100) * PERIOD
    with pytest.raises(NotEnoughDataError, match=r"100 rows hold 0\.40 periods of 1 Hz"):
        fit_sine(time, np.zeros((100, 1)), 1.0)
    with pytest.raises(NotEnoughDataError, match="5 rows"):
        fit_sine(time[:5], np.zeros((5, 1)), 100.0)
    with pytest.raises(NotEnoughDataError, match="5 rows is too short"):
        fit_block(time[:5], np.zeros((5, 1)), 100.0)


def test_a_constant_signal_has_no_amplitude_and_no_error() -> None:
    time = np.arange(200) * PERIOD
    fit = fit_sine(time, np.full((200, 1), 3.0), 5.0)
    assert abs(fit.amplitude[0]) < 1e-12
    assert np.isnan(distortion_share(fit)[0]) or distortion_share(fit)[0] < 10


def blocks(noise: float, decay: float, seed: int) -> list[bool]:
    """Verdicts along a sinusoid of 4 Hz with a mode of 6.3 Hz that dies out (1/s)."""
    rng = np.random.default_rng(seed)
    time = np.arange(5000) * PERIOD
    signal = wave(time, 4.0, 1.0) + wave(time, 6.3, 0.5j) * np.exp(-decay * time)
    signal = signal + noise * rng.standard_normal(time.size)
    parts = [slice(k, k + 250) for k in range(0, 5000, 250)]
    fits = [fit_block(time[p], np.column_stack([signal[p]]), 4.0) for p in parts]
    return [settled(a, b) for a, b in pairwise(fits)]


@pytest.mark.parametrize("noise", [0.0, 1e-3, 1e-2])
def test_settled_waits_for_the_transient(noise: float) -> None:
    verdicts = blocks(noise, decay=0.5, seed=new_seed())
    assert not any(verdicts[:2])
    assert sum(verdicts[-5:]) >= 4


def test_settled_is_not_fooled_by_a_transient_that_stays() -> None:
    assert sum(blocks(1e-3, decay=0.02, seed=new_seed())) <= 3


def test_noise_alone_counts_as_settled() -> None:
    rng = np.random.default_rng(new_seed())
    time = np.arange(500) * PERIOD
    verdicts = []
    for _ in range(200):
        signal = wave(time, 4.0, 0.01)[:, None] + rng.standard_normal((500, 2))
        verdicts.append(
            settled(*(fit_block(time[p], signal[p], 4.0) for p in (slice(0, 250), slice(250, 500))))
        )
    assert np.mean(verdicts) > 0.97


def test_settled_refuses_what_does_not_compare() -> None:
    time = np.arange(100) * PERIOD
    one, other = (fit_block(time, np.zeros((100, 1)), f) for f in (5.0, 6.0))
    with pytest.raises(ValueError, match="do not compare"):
        settled(one, other)


def test_quality_sees_distortion_noise_and_drifting_amplitude() -> None:
    rng = np.random.default_rng(new_seed())
    time = np.arange(1000) * PERIOD
    position = wave(time, 4.0, 1.0) + wave(time, 12.0, 0.1)
    torque = wave(time, 4.0, 2.0) + 1e-3 * rng.standard_normal(1000)
    signals = np.column_stack([position, torque])
    good = judge("e", fit_sine(time, signals, 4.0), time, signals, [0])
    assert good.steady
    assert good.distortion == pytest.approx(0.1, rel=0.01)
    assert 1e3 < good.signal_to_noise < 1e5
    signals = signals * (1 + 0.1 * time)[:, None]
    assert not judge("e", fit_sine(time, signals, 4.0), time, signals, [0]).steady
