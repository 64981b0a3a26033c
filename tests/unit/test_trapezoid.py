"""Profiles from any moving start: continuous, within their limits, at rest on the target."""

from math import nan, sqrt

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drives.sim.trapezoid import SEGMENTS, plan_trapezoid

moderate = st.floats(-5.0, 5.0)
limit = st.floats(0.1, 50.0)


@given(moderate, moderate, moderate, limit, limit, limit)
@settings(max_examples=300, deadline=None)
def test_trapezoid_keeps_its_limits(
    position: float, velocity: float, target: float, speed: float, up: float, down: float
) -> None:
    plan = plan_trapezoid(position, velocity, target, speed, up, down)
    first, *later = plan.segments
    assert (first.begin, first.position, first.velocity) == (0.0, position, velocity)
    ends = [*(s.begin for s in later), plan.duration]
    states = [(s.position, s.velocity) for s in later] + [(target, 0.0)]
    for segment, end, (x, v) in zip(plan.segments, ends, states, strict=True):
        passed = end - segment.begin
        assert passed >= 0.0
        reached = segment.position + (segment.velocity + segment.acceleration * passed / 2) * passed
        assert reached == pytest.approx(x, abs=1e-9 * (1 + abs(x) + velocity**2 / down))
        assert segment.velocity + segment.acceleration * passed == pytest.approx(v, abs=1e-7)
        if passed > 1e-9:
            speeding_up = segment.acceleration * (segment.velocity + v) > 0
            allowed = up if speeding_up else down
            assert abs(segment.acceleration) <= allowed * (1 + 1e-12)
        assert abs(segment.velocity) <= max(speed, abs(velocity)) * (1 + 1e-9)
    assert len(plan.segments) == SEGMENTS


def test_durations_in_closed_form() -> None:
    long = plan_trapezoid(0.0, 0.0, 10.0, 2.0, 4.0, 8.0)
    assert long.duration == pytest.approx(0.5 + 0.25 + (10.0 - 0.5 - 0.25) / 2.0)
    short = plan_trapezoid(1.0, 0.0, 0.0, 100.0, 4.0, 4.0)
    assert short.duration == pytest.approx(2 * sqrt(1.0 / 4.0))
    assert plan_trapezoid(3.0, 0.0, 3.0, 1.0, 1.0, 1.0).duration == 0.0


def test_too_fast_to_stop_it_comes_back() -> None:
    plan = plan_trapezoid(0.0, 2.0, 0.1, 1.0, 10.0, 4.0)
    turn = plan.segments[1]
    assert turn.position == pytest.approx(2.0**2 / (2 * 4.0))
    assert turn.velocity == pytest.approx(0.0)


@pytest.mark.parametrize("values", [(nan, 0.0, 1.0), (0.0, nan, 1.0), (0.0, 0.0, nan)])
def test_start_and_target_must_be_numbers(values: tuple[float, float, float]) -> None:
    with pytest.raises(ValueError, match="must be finite"):
        plan_trapezoid(*values, 1.0, 1.0, 1.0)
