"""The filters' coefficients; their response in the loop stands in the firmware's tests."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drives.sim.biquad import Biquad, FilterType, biquad

RATE = 8000.0


@given(st.floats(0.1, 3900.0), st.floats(0.0, 10.0), st.floats(1e-3, 10.0))
@settings(max_examples=100, deadline=None)
def test_filters_are_stable_and_pass_a_constant(f: float, zero: float, pole: float) -> None:
    for kind in (FilterType.NOTCH, FilterType.LOW_PASS):
        c = biquad(kind, f, zero, pole, RATE)
        assert np.all(np.abs(np.roots([1.0, c.a1, c.a2])) < 1.0)
        assert c.b0 + c.b1 + c.b2 == pytest.approx(1 + c.a1 + c.a2, rel=1e-6, abs=1e-15)


def test_off_passes_everything() -> None:
    assert biquad(FilterType.OFF, 0.0, 0.0, 0.0, RATE) == Biquad(1.0, 0.0, 0.0, 0.0, 0.0)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ((4000.0, 0.1, 0.5), "below 4000.0 Hz"),
        ((0.0, 0.1, 0.5), "above 0"),
        ((100.0, -0.1, 0.5), "zero, at least 0"),
        ((100.0, 0.1, 0.0), "pole, above 0"),
    ],
)
def test_filters_that_can_not_be(values: tuple[float, float, float], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        biquad(FilterType.NOTCH, *values, RATE)
