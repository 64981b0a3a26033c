"""A cross gain extrapolated to zero frequency: of either sign, with an error that holds."""

import numpy as np
import pytest

from fieldtool.errors import NotEnoughDataError
from fieldtool.frf.low_frequency import low_frequency_gain

F = np.geomspace(0.4, 0.95, 8)


def measured(
    rng: np.random.Generator, gain: float, noise: float, mode: float = 2.2
) -> tuple[np.ndarray, np.ndarray]:
    """A gain that rises towards a mode, and its errors, larger at low frequency."""
    std = noise * (F.max() / F) ** 2
    values = gain / (1 - (F / mode) ** 2)
    return values + std * rng.standard_normal(F.size), std


@pytest.mark.parametrize("gain", [0.02, -0.02])
def test_gain_of_either_sign_and_its_error(gain: float, fresh_rng: np.random.Generator) -> None:
    z = []
    for _ in range(300):
        values, std = measured(fresh_rng, gain, 1e-5)
        found = low_frequency_gain(F, values, std, "cross gain")
        assert np.sign(found.gain) == np.sign(gain)
        z.append((found.gain - gain) / found.std)
    assert abs(np.mean(z)) < 1.0
    assert 0.3 < np.std(z) < 1.3
    assert np.quantile(np.abs(z), 0.95) < 3.0


def test_exact_values_are_extrapolated_exactly(fresh_rng: np.random.Generator) -> None:
    """A polynomial in the frequency's square of degree 2 comes back to rounding."""
    a, b, c = fresh_rng.normal(size=3)
    w2 = (2 * np.pi * F) ** 2
    values = a + b * w2 / w2.max() + c * (w2 / w2.max()) ** 2
    found = low_frequency_gain(F, values, np.full(F.size, 1e-9), "cross gain")
    assert found.degree >= 2
    assert found.gain == pytest.approx(a, abs=1e-7)
    np.testing.assert_array_equal(found.values, values)


def test_the_degree_follows_from_the_noise(fresh_rng: np.random.Generator) -> None:
    fine = low_frequency_gain(F, *measured(fresh_rng, 0.02, 1e-9), "cross gain")
    coarse = low_frequency_gain(F, *measured(fresh_rng, 0.02, 1e-1), "cross gain")
    assert fine.degree == 3
    assert coarse.degree < 3  # noise looks like a higher degree now and then
    assert coarse.std > 1e3 * fine.std


def test_what_one_more_term_would_change_is_in_the_error() -> None:
    """Degree 3 of an endless series: the error says what was cut off, though noise is nothing."""
    rng = np.random.default_rng(0)
    values, std = measured(rng, 0.02, 1e-12, mode=1.3)
    found = low_frequency_gain(F, values, std, "cross gain")
    assert 0 < abs(found.gain - 0.02) <= 5 * found.std
    assert found.std > 100 * std.min()


def test_the_error_is_not_below_what_one_more_term_changes(fresh_rng: np.random.Generator) -> None:
    for _ in range(50):
        values, std = measured(fresh_rng, 0.02, 10.0 ** fresh_rng.uniform(-6, -3))
        found = low_frequency_gain(F, values, std, "cross gain")
        w2 = (F / F.max()) ** 2
        fits = [np.polyfit(w2, values, found.degree + more, w=1 / std)[-1] for more in (0, 1)]
        assert found.gain == pytest.approx(fits[0], abs=1e-6)
        assert found.std >= 0.999 * abs(fits[1] - fits[0])


def test_points_that_scatter_more_raise_the_error(fresh_rng: np.random.Generator) -> None:
    values, std = measured(fresh_rng, 0.02, 1e-4, mode=100.0)
    quiet = low_frequency_gain(F, values, std, "cross gain")
    noisy = low_frequency_gain(F, values, std / 30, "cross gain")
    assert noisy.scatter > 3 * quiet.scatter
    assert noisy.std > std.min() / 3


def test_too_few_and_no_errors() -> None:
    values, std = np.ones(2), np.ones(2)
    with pytest.raises(NotEnoughDataError, match="cross gain of a and b: 2 settled frequencies"):
        low_frequency_gain(F[:2], values, std, "cross gain of a and b")
    with pytest.raises(ValueError, match="gain: std must be above 0"):
        low_frequency_gain(F, np.ones(8), np.zeros(8), "gain")
