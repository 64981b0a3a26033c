"""Steady amplitudes from closed-loop records whose transients still decay."""

import numpy as np
import pytest

from fieldtool.frf.multisine.transient import noise_covariance, steady_spectra
from fieldtool.records.closed_loop import AxisLoop, ClosedLoop
from fieldtool.records.model import AxisModel, Coupling, Estimate, MachineModel

STEP = 0.004
LOOPS = (AxisLoop(6, 30, 60, 0.0), AxisLoop(6, 120, 240, 0.0), AxisLoop(6, 200, 400, 0.0))


def case_study():
    """The machine of the paper's case study with dampers; loops with poles at -1 +- 5j rad/s."""
    masses = [(0.7, 2, 3), (4, 5, 6), (7, 8, 9)]
    springs = [(1000, 2000), (3000, 4000), (5000, 6000)]
    dampers = [(0.5, 1), (1.5, 2), (2.5, 3)]
    rows = zip(masses, springs, dampers, strict=True)
    axes = tuple(
        AxisModel(f"axis{k + 1}", "rotary", *(tuple(map(Estimate, values)) for values in row))
        for k, row in enumerate(rows)
    )
    pairs = ((("axis1", "axis2"), 1.0), (("axis1", "axis3"), 2.0), (("axis2", "axis3"), 3.0))
    return MachineModel(axes, tuple(Coupling(axes, value) for axes, value in pairs))


def closed_loop_records(rng, period, periods, settle):
    """Three experiments on the case study's machine from rest; signals (rows, 18) and lines."""
    lines = np.arange(1, int(10 * period), 2)
    rows = round((settle + periods * period) / STEP)
    time = (np.arange(rows) - round(settle / STEP)) * STEP
    waves = np.exp(2j * np.pi * np.outer(time, lines / period))
    phases = np.exp(2j * np.pi * rng.random((lines.size, 3)))
    loop = ClosedLoop(case_study(), LOOPS)
    signals = []
    for turn in range(3):
        turned = phases * np.exp(2j * np.pi * turn * np.arange(3) / 3)
        reference = 0.02 * np.real(waves @ (turned / np.maximum(lines / period, 1)[:, None]))
        signals += loop.simulate(reference, STEP)
    return np.hstack(signals)[-round(periods * period / STEP) :], lines


def matrix(mean, lines):
    """G at the lines from the phasors of three experiments of three axes."""
    columns = mean[lines - 1].reshape(lines.size, 3, 6).transpose(0, 2, 1)
    return columns[:, :3] @ np.linalg.inv(columns[:, 3:])


def relative(G, truth):
    size = np.sqrt(np.abs(np.einsum("fii->fi", truth)))
    return np.abs(G - truth) / (size[:, :, None] * size[:, None, :])


@pytest.mark.parametrize(("period", "periods"), [(4.0, 2), (6.0, 2), (4.0, 3), (8.0, 2), (4.0, 4)])
def test_transient_is_removed_from_the_response(fresh_rng, period, periods):
    seed = fresh_rng.integers(2**31)
    signals, lines = closed_loop_records(np.random.default_rng(seed), period, periods, 1.0)
    settled, _ = closed_loop_records(np.random.default_rng(seed), period, 2, 30.0)
    found = steady_spectra(signals, periods, int(lines[-1]), STEP)
    N = round(period / STEP)
    truth = matrix(np.fft.fft(settled[-N:], axis=0)[1:] * (2 / N), lines)
    raw = relative(matrix(found.mean + found.transient, lines), truth)
    clean = relative(matrix(found.mean, lines), truth)
    assert np.sqrt(np.mean(raw**2)) > 1e-3
    assert clean.max() < 1e-5
    slowest = found.poles[np.argmin(np.abs(found.poles.real))]
    assert slowest == pytest.approx(-0.98 + 5.36j, abs=0.02)


def test_noise_costs_little_and_is_told(fresh_rng):
    signals, lines = closed_loop_records(fresh_rng, 4.0, 2, 1.0)
    clean = steady_spectra(signals, 2, int(lines[-1]), STEP)
    std = np.tile([2e-5, 2e-5, 2e-5, 0.05, 0.12, 0.2], 3)
    ratios = []
    for _ in range(12):
        noisy = signals + std * fresh_rng.normal(size=signals.shape)
        found = steady_spectra(noisy, 2, int(lines[-1]), STEP)
        columns = [np.arange(6 * e, 6 * e + 6) for e in range(3)]
        covariance, freedom = noise_covariance(found, columns, 90)
        assert np.all(freedom >= 90)
        assert np.all(freedom < 110)
        error = (found.mean - clean.mean).reshape(-1, 3, 6)
        variance = np.einsum("lii->li", covariance).real
        ratios.append(np.mean(np.abs(error) ** 2 / variance[:, None], axis=(0, 1)))
    assert np.mean(ratios) == pytest.approx(1.0, abs=0.1)
    plain = 4 * std[:6] ** 2 / signals.shape[0]
    assert np.all(variance.mean(axis=0) < 2.2 * plain)
    assert np.all(variance.mean(axis=0) > 0.8 * plain)


def test_drift_is_taken_out_exactly(fresh_rng):
    N, P = 500, 3
    time = np.arange(P * N)
    lines = np.arange(1, 40, 2)
    truth = fresh_rng.normal(size=(lines.size, 4)) + 1j * fresh_rng.normal(size=(lines.size, 4))
    steady = np.real(np.exp(2j * np.pi * np.outer(time, lines) / N) @ truth)
    drift = fresh_rng.normal(size=4) * 50 / (P * N)
    found = steady_spectra(steady + drift * time[:, None] + 7.0, P, 40, 0.001)
    assert np.allclose(found.mean[lines - 1], truth, atol=1e-9)
    even = np.setdiff1d(np.arange(1, 41), lines)
    assert np.allclose(found.mean[even - 1], 0, atol=1e-9)


def test_pure_noise_has_no_poles_and_the_right_covariance(fresh_rng):
    mixing = fresh_rng.normal(size=(4, 4))
    signals = fresh_rng.normal(size=(4 * 1000, 4)) @ mixing.T
    found = steady_spectra(signals, 4, 200, 0.001)
    covariance, freedom = noise_covariance(found, [np.arange(4)], 500)
    truth = mixing @ mixing.T * 4 / 4000
    whiten = np.linalg.inv(np.linalg.cholesky(truth))
    power = np.einsum("ij,ljk,ik->li", whiten, covariance, whiten).real
    assert np.mean(power) == pytest.approx(1.0, abs=0.12)
    assert freedom[100] >= 500
    assert found.poles.size <= 3


def test_noise_follows_its_colour(fresh_rng):
    """A floor that falls by 20 dB over the band is followed by the windows."""
    white = fresh_rng.normal(size=(8 * 2000, 2))
    colour = np.fft.rfft(white, axis=0)
    share = np.linspace(0, 1, colour.shape[0])[:, None]
    shape = 10 ** (-np.minimum(share * 4, 1.0))
    signals = np.fft.irfft(colour * shape, axis=0)
    found = steady_spectra(signals, 8, 400, 0.001)
    covariance, _ = noise_covariance(found, [np.array([0]), np.array([1])], 60)
    expected = (4 / 16000) * 10 ** (-2 * np.minimum(np.arange(1, 401) / 1000 * 4, 1.0))
    ratio = covariance[:, 0, 0].real / expected
    assert np.mean(np.log(ratio)) == pytest.approx(0.0, abs=0.2)
    assert np.all((ratio[20:] > 0.4) & (ratio[20:] < 2.5))


@pytest.mark.parametrize(
    ("rows", "periods", "lines"), [(1000, 1, 10), (999, 2, 10), (1000, 2, 250)]
)
def test_wrong_shapes_are_refused(rows, periods, lines):
    with pytest.raises(ValueError, match="whole periods"):
        steady_spectra(np.zeros((rows, 2)), periods, lines, 0.001)
