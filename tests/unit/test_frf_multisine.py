"""Periodic data: response, its error, excited lines, distortion, transient."""

from dataclasses import replace

import numpy as np
import pytest

from fieldtool.errors import NotEnoughDataError
from fieldtool.frf.matrix import column_responses
from fieldtool.frf.multisine.periods import average_periods
from fieldtool.frf.multisine.single_axis import MultisineResult, analyse_multisine
from fieldtool.records.recording import AxisInfo, Experiment, Recording
from tests.seeds import fresh_seed

N, PERIODS, RATE = 500, 12, 500.0
LINES = np.arange(5, 100, 4)


def response(f: np.ndarray) -> np.ndarray:
    """Two masses and a spring: antiresonance near 25 Hz, resonance near 36 Hz."""
    s = 2j * np.pi * np.asarray(f, dtype=float)
    spring = 25_000.0 + 10 * s
    first, second = s * s + 2 * s + spring, s * s + spring
    return second / (first * second - spring**2)


def bench(
    seed: int,
    *,
    input_noise: float = 0.0,
    output_noise: float = 0.0,
    stray: float = 0.0,
    cubic: float = 0.0,
    transient: float = 0.0,
    drift: float = 0.0,
    reference: str | None = "torque_reference",
    periods: int = PERIODS,
) -> Recording:
    """One axis under a multisine; ``stray`` is torque at lines nobody asked for."""
    rng = np.random.default_rng(seed)
    asked = np.zeros(N // 2 + 1, dtype=complex)
    asked[LINES] = np.exp(2j * np.pi * rng.random(LINES.size)) * N / 2
    actual = asked.copy()
    between = np.setdiff1d(np.arange(4, 101), LINES)
    actual[between] = stray * np.exp(2j * np.pi * rng.random(between.size)) * N / 2
    f = np.arange(N // 2 + 1) * RATE / N
    theta = np.zeros_like(actual)
    theta[1:] = actual[1:] * response(f[1:])
    one_tau, one_theta = np.fft.irfft(actual, N), np.fft.irfft(theta, N)
    one_theta = one_theta + cubic * one_theta**3 / np.max(np.abs(one_theta)) ** 2
    time = np.arange(N * periods) / RATE
    scale = np.abs(theta[LINES]).max() * 2 / N
    position = np.tile(one_theta, periods) + output_noise * scale * rng.standard_normal(time.size)
    position += transient * scale * np.exp(-1.0 * time) * np.cos(2 * np.pi * 7.3 * time)
    position += drift * scale * time
    torque = np.tile(one_tau, periods) + input_noise * rng.standard_normal(time.size)
    given: dict[str, np.ndarray] = {}
    if reference == "torque_reference":
        given[reference] = np.tile(np.fft.irfft(asked, N), periods)[:, None]
    elif reference == "position_reference":
        wanted = np.where(np.abs(asked) > 0, theta, 0)
        given[reference] = np.tile(np.fft.irfft(wanted, N), periods)[:, None]
    one = Experiment(
        "m", "multisine", ("x",), (), N / RATE, time, position[:, None], torque[:, None], **given
    )
    return Recording(1 / RATE, (AxisInfo("x", "rotary"),), (one,))


def analyse(recording: Recording, **options: int) -> MultisineResult:
    return analyse_multisine(recording, recording.experiments[0], **options)  # type: ignore[arg-type]


def new_seed() -> int:
    return fresh_seed() // 2


@pytest.mark.parametrize("reference", ["torque_reference", "position_reference", None])
def test_the_response_at_the_excited_lines(reference: str | None) -> None:
    recording = bench(
        new_seed(), reference=reference, drift=5.0, stray=0.02, input_noise=0.02, output_noise=1e-4
    )
    result = analyse(recording)
    np.testing.assert_array_equal(result.phasors.frequencies, LINES * RATE / N)
    found = column_responses([result.phasors])["others free"]
    truth = response(found.frequencies)
    error = np.abs(found.response[:, 0, 0] - truth) / (np.sqrt(2) * found.std[:, 0, 0])
    assert np.sqrt(np.mean(error**2)) < 2
    np.testing.assert_allclose(np.abs(found.response[:, 0, 0]), np.abs(truth), rtol=0.1)


def test_the_standard_error_is_the_scatter_of_repetitions() -> None:
    start, errors, claimed = new_seed(), [], []
    for seed in range(start, start + 150):
        result = analyse(bench(seed, input_noise=0.3, output_noise=0.02))
        found = column_responses([result.phasors])["others free"]
        errors.append(found.response[:, 0, 0] - response(found.frequencies))
        claimed.append(found.std[:, 0, 0])
    true = np.sqrt(np.mean(np.abs(errors) ** 2, axis=0) / 2)
    np.testing.assert_allclose(np.sqrt(np.mean(np.square(claimed), axis=0)), true, rtol=0.3)
    assert np.mean(np.mean(np.square(claimed), axis=0) / true**2) == pytest.approx(1.0, abs=0.12)


def test_a_transient_is_left_out() -> None:
    quiet = analyse(bench(1, output_noise=1e-4))
    shaken = analyse(bench(1, output_noise=1e-4, transient=2.0))
    assert quiet.skipped == 1
    assert 3 <= shaken.skipped <= PERIODS // 2
    assert shaken.periods == PERIODS - shaken.skipped
    assert analyse(bench(1), skip=4).skipped == 4


def test_stray_torque_is_not_taken_for_distortion() -> None:
    result = analyse(bench(new_seed(), stray=0.03, output_noise=1e-6, input_noise=1e-6))
    assert result.distortion is not None
    raw = result.distortion.levels(10, 90, raw=True)
    clean = result.distortion.levels(10, 90)
    assert clean.even < 0.2 * raw.even
    assert clean.odd < 0.2 * raw.odd
    assert clean.excited == raw.excited


def test_an_odd_distortion_shows_on_odd_lines() -> None:
    result = analyse(bench(new_seed(), cubic=0.05, stray=1e-6, output_noise=1e-6))
    assert result.distortion is not None
    levels = result.distortion.levels(10, 90)
    assert levels.odd > 20 * levels.noise
    assert levels.odd > 20 * levels.even


def test_lines_can_be_given() -> None:
    recording = bench(3)
    result = analyse_multisine(recording, recording.experiments[0], lines=[9, 13, 13])
    np.testing.assert_array_equal(result.phasors.frequencies, np.array([9, 13]) * RATE / N)
    assert result.distortion is None
    with pytest.raises(NotEnoughDataError, match="between 1 and 249"):
        analyse_multisine(recording, recording.experiments[0], lines=[0, 4])


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"period": None}, "without a period"),
        ({"driven": ()}, "without a driven axis"),
        ({"period": 1.0007}, "must be a whole number of samples"),
        ({"period": 7.0}, "1 whole periods of 7 s, 1 of them left out, are too few"),
    ],
)
def test_data_that_can_not_be_used_are_refused(changes: dict[str, object], words: str) -> None:
    recording = bench(4)
    one = replace(recording.experiments[0], **changes)  # type: ignore[arg-type]
    with pytest.raises(NotEnoughDataError, match=words):
        analyse_multisine(recording, one)


def test_noise_alone_has_no_excited_line() -> None:
    rng = np.random.default_rng(0)
    recording = bench(5, reference=None)
    noise = replace(recording.experiments[0], torque=rng.standard_normal((N * PERIODS, 1)))
    with pytest.raises(NotEnoughDataError, match="no line of the torque stands out"):
        analyse_multisine(recording, noise)


def test_amplitudes_are_peak_values_on_a_drifting_signal() -> None:
    time = np.arange(10 * N) / RATE
    signal = 3 + 0.5 * time + 2 * np.cos(2 * np.pi * 10 * time)
    average = average_periods(signal[:, None], N / RATE, 1 / RATE)
    assert average.mean[9, 0] == pytest.approx(2.0, abs=1e-9)
    assert np.abs(np.delete(average.mean[:, 0], 9)).max() < 1e-9
    np.testing.assert_allclose(average.frequencies[:3], [1, 2, 3])
