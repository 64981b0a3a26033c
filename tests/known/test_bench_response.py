"""The real two-mass bench: what its response, its distortion and its hidden load encoder say.

The fit here is a plain least-squares fit of two masses, a spring, a damper, two frictions and a
delay to the logarithm of the drive-point response: an independent check of the response.
"""

import os
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import least_squares

from fieldtool.frf.matrix import column_responses
from fieldtool.frf.multisine.single_axis import MultisineResult, analyse_multisine
from fieldtool.identify.prediction import predict_load
from fieldtool.records.csv_folder import read_folder
from fieldtool.records.model import AxisModel, Estimate, MachineModel
from fieldtool.records.recording import Recording


@pytest.fixture(scope="module")
def bench() -> Recording:
    beside = Path(__file__).resolve().parents[3] / "shared" / "data"
    folder = Path(os.environ.get("FIELDTOOL_DATA", beside)) / "two-mass-bench"
    if not folder.is_dir():
        pytest.skip("no real measurements beside the project; set FIELDTOOL_DATA")
    return read_folder(folder)


def analysed(bench: Recording, name: str) -> MultisineResult:
    return analyse_multisine(bench, bench.experiment(name))


def drive_point(x: NDArray[np.float64], w: NDArray[np.float64]) -> NDArray[np.complex128]:
    m1, m2, k, d = np.exp(x[:4])
    spring = k + 1j * w * d
    motor, load = (-(w**2) * m + 1j * w * c + spring for m, c in ((m1, x[4]), (m2, x[6])))
    return np.exp(-1j * w * x[5]) * load / (motor * load - spring**2)


def fitted(result: MultisineResult) -> NDArray[np.float64]:
    f, G, _ = column_responses([result.phasors])["others free"].element("motor", "motor")
    w = 2 * np.pi * f
    m = float(np.median(-np.real(1 / G[:5]) / w[:5] ** 2)) / 2
    k = m * (2 * np.pi * 54) ** 2
    start = np.array([np.log(m), np.log(m), np.log(k), np.log(0.02 * np.sqrt(k * m)), 0, 1e-4, 0])

    def misfit(x: NDArray[np.float64]) -> NDArray[np.float64]:
        ratio = np.log(drive_point(x, w) / G)
        return np.concatenate([ratio.real, ratio.imag])

    scale = np.array([1, 1, 1, 1, m, 1e-4, m])
    return least_squares(misfit, start, x_scale=scale, loss="soft_l1", f_scale=0.02).x


def test_lines_and_periods(bench: Recording) -> None:
    a, b = analysed(bench, "type-a"), analysed(bench, "type-b")
    np.testing.assert_array_equal(a.phasors.frequencies, np.arange(11, 251))
    np.testing.assert_array_equal(b.phasors.frequencies, np.arange(13, 250, 4))
    assert (a.periods + a.skipped, b.periods + b.skipped) == (20, 20)
    assert a.skipped <= 3
    assert b.skipped <= 3
    assert a.distortion is None


def test_distortion_after_what_the_current_explains(bench: Recording) -> None:
    distortion = analysed(bench, "type-b").distortion
    assert distortion is not None
    levels = distortion.levels(13, 30)
    found = [20 * np.log10(v) for v in (levels.excited, levels.odd, levels.even, levels.noise)]
    np.testing.assert_allclose(found, [-36, -75, -76, -99], atol=1.0)


@pytest.mark.parametrize("name", ["type-a", "type-b"])
def test_two_masses_and_a_delay_and_the_hidden_load(bench: Recording, name: str) -> None:
    x = fitted(analysed(bench, name))
    m1, m2, k, d = np.exp(x[:4])
    assert np.sqrt(k / m2) / (2 * np.pi) == pytest.approx(54.0, abs=0.3)
    assert np.sqrt(k / m1 + k / m2) / (2 * np.pi) == pytest.approx(76.1, abs=0.4)
    assert m2 / m1 == pytest.approx(1.0, abs=0.02)
    assert x[5] == pytest.approx(0.11e-3, abs=0.01e-3)
    estimates = [Estimate(float(value)) for value in (m1, m2, k, d, x[4])]
    motor = AxisModel(
        "motor", "rotary", tuple(estimates[:2]), (estimates[2],), (estimates[3],), estimates[4]
    )
    for found in predict_load(
        MachineModel((motor,)), float(x[5]), bench, load_friction=float(x[6])
    ):
        print(found.experiment, found.median_db, found.median_degrees)
        assert found.median_db <= 0.3
        assert found.median_degrees <= 2.5
