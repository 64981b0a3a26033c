"""Test moves and figures: bounds that hold, and answers known beforehand."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fieldtool.design.figures import (
    last_outside,
    move_figures,
    oscillation,
    sensitivity_peak,
    step_figures,
)
from fieldtool.design.moves import TestMove, typical_move

bound = st.floats(1e-3, 1e3)


def test_moves_keep_their_bounds(fresh_rng: np.random.Generator) -> None:
    for _ in range(200):
        size, v, a, j = 10 ** fresh_rng.uniform(-3, 3, 4)
        move = TestMove("x", float(size * fresh_rng.choice([-1.0, 1.0])), v, a, j)
        t = np.linspace(-0.1, 1.1, 4001) * move.duration
        position, velocity, acceleration = move.at(t)
        step = t[1] - t[0]
        assert np.abs(velocity).max() <= v * (1 + 1e-6)
        assert np.abs(acceleration).max() <= a * (1 + 1e-6)
        rounding = 1e-9 * np.abs(acceleration).max()
        assert np.abs(np.diff(acceleration)).max() <= j * step * (1 + 1e-6) + rounding
        assert position[0] == 0.0
        assert position[-1] == move.distance
        # one is the derivative of the other, by another route than the polynomials
        jump = np.abs(np.diff(velocity)).max()
        middle = (velocity[1:] + velocity[:-1]) / 2
        assert np.abs(np.diff(position) / step - middle).max() <= jump * (1 + 1e-6)
        middle = (acceleration[1:] + acceleration[:-1]) / 2
        off = np.abs(np.diff(velocity) / step - middle).max()
        assert off <= j * step + rounding
        # as fast as the bounds allow: at any time velocity, acceleration or jerk is at its own
        rises = np.abs(np.gradient(acceleration, t)) > 0.99 * j
        used = (np.abs(velocity) > 0.999 * v) | (np.abs(acceleration) > 0.999 * a) | rises
        assert np.mean(used[(t > 0) & (t < move.duration)]) > 0.95


def test_a_long_move_by_hand() -> None:
    """Jerk 8: 0.25 s to 2 rad/s2, held 0.25 s, to 1 rad/s: 1 rad/s for the rest."""
    move = TestMove("x", 2.75, 1.0, 2.0, 8.0)
    assert move.parts == pytest.approx((0.25, 0.25, 2.0))
    assert move.duration == pytest.approx(3.5)
    samples = move.reference(0.004)
    assert samples.size == 876
    assert samples[0] == 0.0
    assert samples[-1] == 2.75
    assert move.settling_band == pytest.approx(0.0275)


@pytest.mark.parametrize(
    "changed", [{"distance": 0.0}, {"velocity": 0.0}, {"jerk": np.inf}, {"band": -1.0}]
)
def test_what_is_no_move_is_refused(changed: dict[str, float]) -> None:
    values = {"distance": 1.0, "velocity": 1.0, "acceleration": 1.0, "jerk": 1.0}
    with pytest.raises(ValueError, match="x"):
        TestMove("x", **(values | changed))


@given(bound, bound, bound, bound, bound)
@settings(max_examples=50, deadline=None)
def test_a_typical_move_keeps_well_within_limits(
    travel: float, v: float, a: float, torque: float, mass: float
) -> None:
    move = typical_move("x", (-travel, travel), v, a, torque, mass)
    assert move.velocity <= 0.5 * v
    assert move.acceleration <= 0.5 * a * (1 + 1e-9)
    assert move.acceleration * mass <= 0.5 * torque * (1 + 1e-9)
    assert 0 < move.distance <= 0.4 * travel * (1 + 1e-9)


def test_figures_of_a_damped_swing() -> None:
    """exp(-t) cos(20 t): the last peak above 0.05 is known; overshoot and residual are its size."""
    t = np.arange(0, 8, 1e-3)
    move = TestMove("x", 1.0, 4.0, 20.0, 400.0)
    r = move.at(t)[0]
    after = t - move.duration
    position = r + np.where(after > 0, 0.2 * np.exp(-after) * np.sin(20 * after), 0.0)
    found = move_figures(t, r, position, 0.05)
    crossing = np.log(0.2 / 0.05)  # of the envelope; the last peak above it is within half a period
    assert crossing - np.pi / 20 <= found.settling_time <= crossing
    assert found.positioning_time == pytest.approx(found.settling_time + move.duration, abs=2e-3)
    peak = 0.2 * np.exp(-np.pi / 40) * np.sin(20 * np.pi / 40)
    assert found.overshoot == pytest.approx(peak, rel=0.01)
    assert found.following_error == pytest.approx(peak, rel=0.01)
    assert found.residual_peak == pytest.approx(peak, rel=0.1)
    energy = 0.2**2 / 4 / (8 - move.duration)  # of the swing, integral of exp(-2t) sin^2
    assert found.residual_rms == pytest.approx(np.sqrt(energy), rel=0.1)


@given(
    st.floats(0.1, 30.0),
    st.floats(3.0, 60.0),
    st.floats(0.01, 3.0),
    st.floats(0.5, 6.0),
    st.sampled_from([1.5, 3.0, 40.0]),
)
@settings(max_examples=40, deadline=None)
def test_vibration_over_the_same_time_does_not_depend_on_how_long_was_recorded(
    decay: float, omega: float, creep: float, watched: float, times: float
) -> None:
    """A swing and a creep, on records of different length: one figure."""
    move = TestMove("x", 1.0, 4.0, 20.0, 400.0)
    found = []
    for more in (1.0, times):
        t = np.arange(0.0, move.duration + more * watched + 2e-3, 1e-3)
        after = np.maximum(t - move.duration, 0.0)
        swing = 0.1 * np.exp(-decay * after) * np.sin(omega * after)
        reference = move.at(t)[0]
        position = reference + swing + np.where(after > 0, 0.05 * np.exp(-after / creep), 0.0)
        found.append(move_figures(t, reference, position, 0.05, watched))
    assert found[1].residual_peak == pytest.approx(found[0].residual_peak, rel=1e-9, abs=1e-12)


def test_creep_is_no_swing() -> None:
    t = np.arange(0, 5, 1e-3)
    assert np.abs(oscillation(t, 0.3 * np.exp(-t / 0.4) + 0.02)).max() < 0.02 * 0.3
    swing = 0.1 * np.exp(-t) * np.sin(30 * t)
    left = oscillation(t, 0.3 * np.exp(-t / 0.4) + swing)
    assert np.sqrt(np.mean((left - swing) ** 2)) < 0.4 * np.sqrt(np.mean(swing**2))
    assert not oscillation(t[:3], t[:3]).any()


def test_what_does_not_arrive_is_infinite() -> None:
    t = np.linspace(0, 1, 101)
    assert last_outside(t, np.full(101, 0.2), 0.1) == np.inf
    assert last_outside(t, np.zeros(101), 0.1) == 0.0
    assert last_outside(t, 1 - t, 0.105) == pytest.approx(0.895)
    r = np.minimum(t, 0.5)
    assert move_figures(t, r, np.zeros(101), 0.1).settling_time == np.inf
    with pytest.raises(ValueError, match="does not move"):
        move_figures(t, np.zeros(101), t, 0.1)
    with pytest.raises(ValueError, match="band"):
        move_figures(t, r, t, 0.0)


def test_a_step_of_second_order() -> None:
    """Damping 0.5: overshoot exp(-pi z / sqrt(1 - z^2)) = 0.163."""
    t, z = np.arange(0, 20, 1e-3), 0.5
    wd = np.sqrt(1 - z * z)
    y = 1 - np.exp(-z * t) * (np.cos(wd * t) + z / wd * np.sin(wd * t))
    found = step_figures(t, 3 * y, 3.0)
    assert found.overshoot == pytest.approx(0.163, abs=1e-3)
    assert found.rise_time == pytest.approx(1.638, abs=0.02)
    assert found.settling_time == pytest.approx(8.07, abs=0.05)


def test_peak_of_one_loop_and_of_all() -> None:
    assert sensitivity_peak(np.array([0.1, 2j, -1.0])) == 2.0
    rotated = np.array([[[0.0, 3.0], [1.0, 0.0]]], dtype=complex)
    assert sensitivity_peak(rotated) == pytest.approx(3.0)
