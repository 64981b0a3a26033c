"""The simulated drives' loops: every parameter acts, every limit holds, nothing jumps."""

from collections.abc import Callable, Mapping
from math import exp, inf, nan, pi, sin, tan

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drives.errors import DrivesError
from drives.sim.biquad import FilterType
from drives.sim.firmware import (
    DriveHardware,
    Parameter,
    Reference,
    SimulatedAxes,
    SimulationDivergedError,
)
from drives.sim.plant import ChainParameters, PlantParameters
from tests.seeds import fresh_seed

P = Parameter
RATE = 8000.0
COUNTS = 2**20 / (2 * pi)
INERTIA = 0.02  # kg m2, of the rigid axis
TUNED = {P.POSITION_P: 30.0, P.VELOCITY_P: 4.0, P.VELOCITY_I: 60.0, P.VELOCITY_FILTER: 1000.0}


def drive(**changes: float) -> DriveHardware:
    values = {
        "rated_torque": 10.0,
        "torque_noise": 0.0,
        "counts_per_unit": COUNTS,
        "peak_torque": 30.0,
    }
    return DriveHardware(**(values | changes))


def rigid_axis(friction: float = 0.0, seed: int = 0, **changes: float) -> SimulatedAxes:
    chain = ChainParameters((INERTIA,), (), (), friction)
    return SimulatedAxes(PlantParameters((chain,)), [drive(**changes)], seed)


def tuned_axis(friction: float = 0.0, **changes: float) -> SimulatedAxes:
    axes = rigid_axis(friction, seed=0, **changes)
    for parameter, value in TUNED.items():
        axes.set(0, parameter, value)
    return axes


def two_axes(seed: int = 0, noise: float = 0.05) -> SimulatedAxes:
    chain = ChainParameters((0.01, 0.02), (300.0,), (0.02,), 0.01)
    axes = SimulatedAxes(
        PlantParameters((chain, chain), ((0, 1, 0.005),)), [drive(torque_noise=noise)] * 2, seed
    )
    for axis in range(2):
        for parameter, value in TUNED.items():
            axes.set(axis, parameter, value / 4 if parameter == P.VELOCITY_P else value)
    return axes


def trace(axes: SimulatedAxes, steps: int, what: str = "true_position") -> np.ndarray:
    """One value after each inner step."""
    readers: dict[str, Callable[[], float]] = {
        "true_position": lambda: axes.state[0],
        "true_velocity": lambda: axes.state[axes.plant.size],
        "position": lambda: axes.position(0),
        "velocity": lambda: axes.velocity(0),
        "torque": lambda: axes.torque(0),
        "reference": lambda: axes.reference_position(0),
    }
    read = readers[what]
    values = np.empty(steps)
    for k in range(steps):
        axes.advance(1)
        values[k] = read()
    return values


# -- time and the encoder -----------------------------------------------------------------------------


def test_time_counts_steps() -> None:
    axes = rigid_axis()
    for _ in range(1000):
        axes.advance(7)
    assert axes.time == 7000 / RATE
    with pytest.raises(ValueError, match="backwards"):
        axes.advance(-1)


@given(st.floats(-1e4, 1e4), st.sampled_from([1.0, 4096 / (2 * pi), COUNTS, 1e6]))
@settings(max_examples=50, deadline=None)
def test_encoder_rounds_down(position: float, counts_per_unit: float) -> None:
    axes = rigid_axis(counts_per_unit=counts_per_unit)
    axes.set_state(np.array([position, 0.0]))
    expected = int(np.floor(position * counts_per_unit))
    assert axes.position_counts(0) == expected
    assert axes.position(0) == expected / counts_per_unit
    axes.advance(1)
    assert axes.position_counts(0) == expected
    assert axes.latch()[0].tolist() == [expected]
    assert 0.0 <= position - axes.position(0) <= (1.0 + 1e-9) / counts_per_unit


def test_velocity_is_the_difference_of_counts() -> None:
    axes = rigid_axis(counts_per_unit=1000.0)
    axes.set_state(np.array([0.0, 3.0]))
    counts = [axes.position_counts(0)]
    for _ in range(50):
        axes.advance(1)
        counts.append(axes.position_counts(0))
        assert axes.velocity(0) == pytest.approx((counts[-1] - counts[-2]) * RATE / 1000.0)
    assert set(np.diff(counts)) == {0, 1}, "3 rad/s is 0.375 counts a step"


def test_velocity_filter_is_a_first_order_lag() -> None:
    axes = rigid_axis(counts_per_unit=1e9)
    axes.set(0, P.VELOCITY_FILTER, 50.0)
    axes.set(0, P.TORQUE_LIMIT, 0.0)
    axes.set_state(np.array([0.0, 0.0]))
    axes._state[1] = 2.0  # a jump of speed that the estimate has not seen
    estimate = trace(axes, 400, "velocity")
    expected = 2.0 * (1.0 - np.exp(-2 * pi * 50.0 * np.arange(1, 401) / RATE))
    assert np.allclose(estimate, expected, atol=1e-3)


# -- off, torque mode, current loop -------------------------------------------------------------------


def test_axis_that_is_off_gives_no_torque() -> None:
    axes = tuned_axis()
    axes.follow_torque(0, 5.0)
    axes.advance(100)
    assert axes.torque(0) == pytest.approx(5.0)
    speed = axes.state[1]
    axes.off(0)
    assert axes.torque(0) == 0.0
    axes.advance(1000)
    assert axes.torque(0) == 0.0
    assert axes.state[1] == speed
    assert axes.reference(0) == Reference.OFF
    assert not axes.reference_reached(0)


def test_untuned_drive_does_not_move() -> None:
    axes = rigid_axis()
    axes.follow_position(0, 1.0, 8)
    axes.advance(1000)
    assert axes.state.tolist() == [0.0, 0.0]


def test_current_loop_is_an_exact_lag_and_momentum_is_its_integral() -> None:
    axes = rigid_axis(current_bandwidth=300.0)
    axes.follow_torque(0, 4.0)
    torque = trace(axes, 80, "torque")
    t = np.arange(1, 81) / RATE
    lag = 1.0 / (2 * pi * 300.0)
    assert np.allclose(torque, 4.0 * (1.0 - np.exp(-t / lag)), rtol=1e-12)
    impulse = 4.0 * (t[-1] - lag * (1.0 - exp(-t[-1] / lag)))
    assert axes.state[1] * INERTIA == pytest.approx(impulse, rel=1e-12)


def test_torque_and_position_read_together_show_no_delay() -> None:
    """-w2 J theta / tau is 1 with no phase: a step of skew would be 4.5 degrees at 100 Hz."""
    axes = rigid_axis(counts_per_unit=1e10)
    n, line = 800, 10
    wave = np.sin(2 * pi * line * np.arange(n) / n)
    for value in wave:
        axes.follow_torque(0, 2.0 * value)
        axes.advance(1)
    positions, torques = np.empty(n), np.empty(n)
    for k in range(n):
        axes.follow_torque(0, 2.0 * wave[k])
        axes.advance(1)
        positions[k], torques[k] = axes.state[0], axes.torque(0)
    window = np.arange(n)
    drift = np.polynomial.Polynomial.fit(window[:: n // line], positions[:: n // line], 1)
    spectrum = np.fft.rfft(positions - drift(window))[line] / np.fft.rfft(torques)[line]
    ratio = spectrum * -((2 * pi * line * RATE / n) ** 2) * INERTIA
    assert abs(np.angle(ratio, deg=True)) < 0.1 * 4.5
    assert abs(ratio) == pytest.approx(1.0, abs=2e-3)


def test_torque_slope() -> None:
    axes = rigid_axis(current_bandwidth=1e5)
    axes.set(0, P.TORQUE_SLOPE, 100.0)
    axes.follow_torque(0, 5.0)
    torque = trace(axes, 800, "torque")
    assert np.allclose(torque[:399], 100.0 * np.arange(1, 400) / RATE, rtol=1e-9)
    assert np.allclose(torque[402:], 5.0)
    assert axes.reference_reached(0)
    axes.follow_torque(0, -5.0)
    assert not axes.reference_reached(0)
    axes.advance(400)
    assert axes.torque(0) == pytest.approx(0.0, abs=0.02)


def test_torque_limit_and_peak() -> None:
    axes = rigid_axis()
    axes.follow_torque(0, 1000.0)
    axes.advance(100)
    assert axes.torque(0) == pytest.approx(30.0)
    assert axes.torque_limited(0)
    axes.set(0, P.TORQUE_LIMIT, 7.0)
    axes.advance(100)
    assert axes.torque(0) == pytest.approx(7.0)
    axes.set(0, P.TORQUE_LIMIT, 100.0)
    axes.advance(100)
    assert axes.torque(0) == pytest.approx(30.0), "the hardware's peak holds"
    axes.follow_torque(0, -3.0)
    axes.advance(100)
    assert not axes.torque_limited(0)
    assert axes.torque(0) == pytest.approx(-3.0)


# -- torque measurement -------------------------------------------------------------------------------


def test_measured_torque_has_the_noise_and_the_resolution_it_should() -> None:
    seed = fresh_seed()
    axes = rigid_axis(seed=seed, torque_noise=0.2)
    axes.follow_torque(0, 4.0)
    axes.advance(200)
    single = np.array([axes.measured_torque_per_mille(0) for _ in range(20_000)])
    latched = np.array([axes.latch()[1][0] for _ in range(20_000)])
    for values in (single, latched):
        assert values.dtype == np.int64
        assert np.mean(values) == pytest.approx(400.0, abs=5 * 20.0 / np.sqrt(20_000))
        assert np.std(values) == pytest.approx(20.0, rel=0.03)
        centred = values - values.mean()
        assert abs(np.mean(centred[1:] * centred[:-1])) < 5 * 400.0 / np.sqrt(20_000), "white"
    assert axes.torque(0) == pytest.approx(4.0), "the motor does not feel the noise"


def test_noise_of_axes_differs_and_repeats_with_the_seed() -> None:
    def values(seed: int) -> np.ndarray:
        axes = two_axes(seed)
        return np.array([axes.latch()[1].copy() for _ in range(6000)])

    first, second = values(3).T
    assert abs(np.corrcoef(first, second)[0, 1]) < 0.08
    assert np.array_equal(values(3), values(3))
    assert not np.array_equal(values(3), values(4))


def test_whole_run_repeats_bit_for_bit() -> None:
    def run() -> tuple[np.ndarray, list[int]]:
        axes = two_axes(seed=9)
        seen: list[int] = []
        for k in range(300):
            for axis in range(2):
                axes.follow_position(axis, 0.3 * sin(0.05 * k * (axis + 1)), 8)
            axes.advance(8)
            counts, torque, _ = axes.latch()
            seen += [*counts.tolist(), *torque.tolist()]
        return axes.state, seen

    (state_a, seen_a), (state_b, seen_b) = run(), run()
    assert np.array_equal(state_a, state_b)
    assert seen_a == seen_b


def test_advancing_in_pieces_is_the_same() -> None:
    whole, pieces = two_axes(), two_axes()
    for axes in (whole, pieces):
        axes.follow_profile(0, 1.0, 2.0, 20.0, 30.0)
        axes.follow_velocity(1, 1.0, 5.0, 5.0)
    whole.advance(5000)
    for steps in (1, 8, 991, 3000, 1000):
        pieces.advance(steps)
    assert np.array_equal(whole.state, pieces.state)


# -- position: interpolation, lag, feed-forward -------------------------------------------------------


def test_interpolation_is_a_straight_line_that_ends_on_the_target() -> None:
    axes = tuned_axis()
    axes.follow_position(0, 0.8, 8)
    assert np.allclose(trace(axes, 8, "reference"), 0.1 * np.arange(1, 9), rtol=1e-12)
    assert axes.reference_position(0) == 0.8
    assert axes.reference_reached(0)
    axes.follow_position(0, -0.2, 5)
    assert not axes.reference_reached(0)
    assert np.allclose(trace(axes, 3, "reference"), [0.6, 0.4, 0.2], rtol=1e-12)
    axes.follow_position(0, 1.2, 4)  # a new target before the old one was reached
    assert np.allclose(trace(axes, 6, "reference"), [0.45, 0.7, 0.95, 1.2, 1.2, 1.2], rtol=1e-12)


def test_interval_ends_exactly_on_any_target() -> None:
    seed = fresh_seed()
    axes = rigid_axis()
    for target in np.random.default_rng(seed).uniform(-3.0, 3.0, 500):
        axes.follow_position(0, target, 7)
        axes.advance(7)
        assert axes.reference_position(0) == target


@pytest.mark.parametrize("fraction", [0.0, 0.4, 1.0])
def test_velocity_feed_forward_takes_the_lag_away(fraction: float) -> None:
    axes = tuned_axis()
    axes.set(0, P.VELOCITY_FF, fraction)
    speed = 2.0
    for k in range(1, 2001):
        axes.follow_position(0, speed * k * 8 / RATE, 8)
        axes.advance(8)
    lag = (1.0 - fraction) * speed / TUNED[P.POSITION_P]
    assert axes.following_error(0) == pytest.approx(lag, abs=3e-5)


def test_feed_forward_ends_with_the_last_target() -> None:
    axes = tuned_axis()
    for k in range(1, 401):
        axes.follow_position(0, k * 1e-3, 8)
        axes.advance(8)
    axes.advance(1)
    assert axes.reference_velocity(0) == pytest.approx(
        TUNED[P.POSITION_P] * axes.following_error(0), abs=0.02
    )
    axes.advance(8000)
    assert axes.state[0] == pytest.approx(0.4, abs=1e-4)


def test_inertia_feed_forward_needs_no_error() -> None:
    """With the right inertia nearly no following error is left while accelerating."""

    def worst(inertia: float) -> float:
        axes = tuned_axis(current_bandwidth=3e4)
        axes.set(0, P.VELOCITY_FILTER, inf)
        axes.set(0, P.INERTIA_FF, inertia)
        errors = []
        for k in range(1, 1001):
            t = k * 8 / RATE
            axes.follow_position(0, 0.5 * 40.0 * t * t, 8)
            axes.advance(8)
            errors.append(abs(axes.following_error(0)))
        return max(errors)

    assert worst(INERTIA) < 0.1 * worst(0.0)
    assert worst(2 * INERTIA) > 0.5 * worst(0.0)


def test_first_interval_has_no_acceleration() -> None:
    """What the reference did before the mode began is not known, so nothing is fed forward."""
    axes = rigid_axis()
    axes.set(0, P.INERTIA_FF, 1.0)
    axes.follow_position(0, 0.01, 8)
    axes.advance(8)
    assert axes.torque(0) == 0.0
    axes.follow_position(0, 0.03, 8)
    axes.advance(1)
    assert axes.reference_torque(0) == pytest.approx(0.01 * (RATE / 8) ** 2)


@pytest.mark.parametrize("late", [0, 1, 5])
def test_a_target_that_comes_late_is_no_jerk(late: int) -> None:
    """The reference waits at the last target; what is fed forward is the targets' second difference."""
    axes = rigid_axis()
    axes.set(0, P.INERTIA_FF, 1.0)
    for target, steps in ((0.01, 8), (0.03, 8 + late), (0.06, 1)):
        axes.follow_position(0, target, 8)
        axes.advance(steps)
    assert axes.reference_torque(0) == pytest.approx(0.01 * (RATE / 8) ** 2)


def test_position_limits_clamp_targets() -> None:
    axes = tuned_axis()
    axes.set(0, P.POSITION_MIN, -0.1)
    axes.set(0, P.POSITION_MAX, 0.2)
    axes.follow_position(0, 5.0, 80)
    axes.advance(800)
    assert axes.reference_position(0) == 0.2
    axes.follow_profile(0, -5.0, 1.0, 10.0, 10.0)
    axes.advance(8000)
    assert axes.reference_position(0) == -0.1
    assert axes.state[0] == pytest.approx(-0.1, abs=1e-3)


def test_max_velocity_limits_the_loop_and_the_profile() -> None:
    axes = tuned_axis()
    axes.set(0, P.MAX_VELOCITY, 0.5)
    axes.follow_position(0, 1.0, 1)
    axes.advance(4000)
    assert axes.state[1] == pytest.approx(0.5, abs=0.01)
    axes.advance(16000)
    assert axes.state[0] == pytest.approx(1.0, abs=1e-3)
    axes.follow_profile(0, 0.0, 10.0, 100.0, 100.0)
    speeds = np.diff(trace(axes, 17000, "reference")) * RATE
    assert np.max(np.abs(speeds)) == pytest.approx(0.5, rel=1e-6)
    assert axes.reference_reached(0)


# -- offsets and the velocity loop --------------------------------------------------------------------


def test_velocity_offset_moves_the_velocity() -> None:
    axes = tuned_axis()
    axes.follow_velocity(0, 1.0, inf, inf)
    axes.set(0, P.VELOCITY_OFFSET, 0.5)
    axes.advance(8000)
    assert axes.state[1] == pytest.approx(1.5, abs=0.01)
    axes.off(0)
    axes.set_state(np.zeros(2))
    axes.follow_position(0, 0.0, 8)
    axes.advance(16000)
    assert axes.following_error(0) == pytest.approx(-0.5 / TUNED[P.POSITION_P], abs=1e-4)


def test_torque_offset_is_added_in_every_mode() -> None:
    axes = rigid_axis()
    axes.set(0, P.TORQUE_OFFSET, 1.5)
    axes.follow_torque(0, 2.0)
    axes.advance(100)
    assert axes.torque(0) == pytest.approx(3.5)
    axes.off(0)
    axes.follow_velocity(0, 0.0, 1.0, 1.0)
    axes.advance(100)
    assert axes.torque(0) == pytest.approx(1.5)


def test_velocity_gain_and_integral() -> None:
    """Against friction, P alone leaves an error of friction torque / gain; I takes it away."""
    axes = rigid_axis(friction=0.5)
    axes.set(0, P.VELOCITY_P, 4.0)
    axes.follow_velocity(0, 2.0, inf, inf)
    axes.advance(8000)
    assert axes.state[1] == pytest.approx(2.0 * 4.0 / 4.5, abs=0.01)
    axes.set(0, P.VELOCITY_I, 60.0)
    axes.advance(16000)
    assert axes.state[1] == pytest.approx(2.0, abs=0.01)
    axes.set(0, P.VELOCITY_I, 0.0)
    axes.advance(8000)
    assert axes.state[1] == pytest.approx(2.0 * 4.0 / 4.5, abs=0.01), "an I of 0 holds nothing"


def test_velocity_ramps() -> None:
    axes = tuned_axis()
    axes.follow_velocity(0, 2.0, 10.0, 40.0)
    axes.advance(800)
    assert axes.reference_velocity(0) == pytest.approx(1.0, rel=1e-9)
    assert not axes.reference_reached(0)
    axes.advance(801)
    assert axes.reference_velocity(0) == pytest.approx(2.0)
    assert axes.reference_reached(0)
    axes.follow_velocity(0, -1.0, 10.0, 40.0)  # brakes at 40 through 0.05 s, then 10
    axes.advance(400)
    assert axes.reference_velocity(0) == pytest.approx(0.0, abs=1e-9)
    axes.advance(400)
    assert axes.reference_velocity(0) == pytest.approx(-0.5, abs=1.3e-3), "one step at 0"
    axes.follow_velocity(0, -0.2, 10.0, 40.0)
    axes.advance(30)
    assert axes.reference_velocity(0) == pytest.approx(-0.35, abs=1.3e-3)
    axes.advance(31)
    assert axes.reference_velocity(0) == pytest.approx(-0.2, abs=1e-9)
    assert axes.reference_reached(0)


def test_infinite_ramp_is_a_step_that_inertia_does_not_see() -> None:
    axes = rigid_axis()
    axes.set(0, P.INERTIA_FF, 1.0)
    axes.follow_velocity(0, 3.0, inf, inf)
    axes.advance(1)
    assert axes.reference_velocity(0) == 3.0
    assert axes.reference_torque(0) == 0.0
    axes.follow_velocity(0, -3.0, inf, inf)
    axes.advance(1)
    assert axes.reference_velocity(0) == -3.0


def test_integrator_does_not_wind_up() -> None:
    """Held back by its torque limit for a second, the axis must not pay for it afterwards."""
    axes = tuned_axis(friction=0.5)
    axes.set(0, P.TORQUE_LIMIT, 0.5)  # friction holds it at 1 rad/s
    axes.follow_velocity(0, 4.0, inf, inf)
    axes.advance(16000)
    assert axes.state[1] == pytest.approx(1.0, abs=0.01)
    assert axes.torque_limited(0)
    axes.follow_velocity(0, 0.5, inf, inf)
    speed = trace(axes, 4000, "true_velocity")
    assert np.min(np.abs(speed[:400] - 0.5)) < 0.02, "it reacts at once"
    assert speed.min() > 0.25
    assert not axes.torque_limited(0)


# -- filters ------------------------------------------------------------------------------------------


def torque_response(axes: SimulatedAxes, frequencies: np.ndarray) -> np.ndarray:
    """Sine sweep of the torque reference: torque reference -> torque, without the current loop."""
    decay = exp(-2 * pi * axes.hardware[0].current_bandwidth / RATE)
    response = []
    for frequency in frequencies:
        settle, n = 12_000, 8000
        k = np.arange(settle + n)
        wave = np.sin(2 * pi * frequency * k / RATE)
        torque = np.empty(settle + n)
        for i in k:
            axes.follow_torque(0, wave[i])
            axes.advance(1)
            torque[i] = axes.torque(0)
        line = np.exp(-2j * pi * frequency * k[settle:] / RATE)
        current = (1 - decay) / (1 - decay * np.exp(-2j * pi * frequency / RATE))
        response.append((torque[settle:] @ line) / (wave[settle:] @ line) / current)
    return np.array(response)


@pytest.mark.parametrize("number", [1, 2])
def test_notch_has_the_response_of_its_formula(number: int) -> None:
    frequency, zero, pole = 200.0, 0.05, 0.6
    axes = rigid_axis()
    axes.set(0, Parameter[f"FILTER{number}_FREQUENCY"], frequency)
    axes.set(0, Parameter[f"FILTER{number}_ZERO_DAMPING"], zero)
    axes.set(0, Parameter[f"FILTER{number}_POLE_DAMPING"], pole)
    axes.set(0, Parameter[f"FILTER{number}_TYPE"], FilterType.NOTCH)
    f = np.array([10.0, 120.0, 200.0, 350.0, 1500.0])
    got = torque_response(axes, f)
    s, w = 2j * pi * f, 2 * pi * frequency
    analogue = (s**2 + 2 * zero * w * s + w**2) / (s**2 + 2 * pole * w * s + w**2)
    assert np.all(np.abs(got[:3] - analogue[:3]) < 5e-3)
    assert abs(got[2]) == pytest.approx(zero / pole, rel=1e-6), "exact where it was asked for"
    warped = 1j * w / tan(w / RATE / 2) * np.tan(pi * f / RATE)
    exact = (warped**2 + 2 * zero * w * warped + w**2) / (warped**2 + 2 * pole * w * warped + w**2)
    assert np.all(np.abs(got - exact) < 1e-6)


def test_low_pass_has_the_response_of_its_formula() -> None:
    axes = rigid_axis()
    axes.set(0, P.FILTER1_TYPE, FilterType.LOW_PASS)
    axes.set(0, P.FILTER1_FREQUENCY, 300.0)
    axes.set(0, P.FILTER1_POLE_DAMPING, 0.7)
    f, w = np.array([20.0, 300.0, 1200.0]), 2 * pi * 300.0
    warped = 1j * w / tan(w / RATE / 2) * np.tan(pi * f / RATE)
    exact = w**2 / (warped**2 + 2 * 0.7 * w * warped + w**2)
    got = torque_response(axes, f)
    assert np.all(np.abs(got - exact) < 1e-6)
    assert abs(got[1]) == pytest.approx(1 / 1.4, rel=1e-6)


def test_two_filters_multiply() -> None:
    axes = rigid_axis()
    for number, frequency in ((1, 100.0), (2, 500.0)):
        axes.set(0, Parameter[f"FILTER{number}_TYPE"], FilterType.NOTCH)
        axes.set(0, Parameter[f"FILTER{number}_FREQUENCY"], frequency)
    f = np.array([100.0, 250.0])
    both = torque_response(axes, f)
    axes.set(0, P.FILTER2_TYPE, FilterType.OFF)
    first = torque_response(axes, f)
    axes.set(0, P.FILTER1_TYPE, FilterType.OFF)
    axes.set(0, P.FILTER2_TYPE, FilterType.NOTCH)
    second = torque_response(axes, f)
    assert np.allclose(both, first * second, atol=1e-8)
    axes.set(0, P.FILTER2_TYPE, FilterType.OFF)
    assert np.allclose(torque_response(axes, f), 1.0, atol=1e-9)


@pytest.mark.parametrize("kind", [FilterType.NOTCH, FilterType.LOW_PASS])
def test_switching_a_filter_does_not_jerk(kind: FilterType) -> None:
    axes = rigid_axis()
    axes.follow_torque(0, 5.0)
    axes.advance(100)
    axes.set(0, P.FILTER1_FREQUENCY, 150.0)
    axes.set(0, P.FILTER1_TYPE, kind)
    assert np.allclose(trace(axes, 200, "torque"), 5.0, rtol=1e-9)
    axes.set(0, P.FILTER1_FREQUENCY, 50.0)
    assert np.allclose(trace(axes, 200, "torque"), 5.0, rtol=1e-9)


# -- profiles -----------------------------------------------------------------------------------------


def test_profile_is_a_trapezoid() -> None:
    axes = tuned_axis()
    axes.follow_profile(0, 2.0, 4.0, 20.0, 40.0)
    assert not axes.reference_reached(0)
    reference = trace(axes, 8000, "reference")
    velocity = np.diff(reference, prepend=0.0) * RATE
    acceleration = np.diff(velocity) * RATE
    assert np.max(velocity) == pytest.approx(4.0, rel=1e-9)
    assert np.max(acceleration) == pytest.approx(20.0, rel=1e-4)
    assert np.min(acceleration) == pytest.approx(-40.0, rel=1e-4)
    assert reference[-1] == 2.0
    moving = 4.0 / 20.0 + 4.0 / 40.0 + (2.0 - 0.4 - 0.2) / 4.0
    assert np.argmax(reference == 2.0) / RATE == pytest.approx(moving, abs=2 / RATE)
    assert axes.reference_reached(0)
    assert axes.standstill(0)
    assert axes.state[0] == pytest.approx(2.0, abs=1e-4)


def test_short_profile_is_a_triangle() -> None:
    axes = tuned_axis()
    axes.follow_profile(0, -0.1, 100.0, 20.0, 20.0)
    velocity = np.diff(trace(axes, 2000, "reference"), prepend=0.0) * RATE
    assert np.min(velocity) == pytest.approx(-((0.1 * 20.0) ** 0.5), rel=1e-2)
    assert axes.reference_position(0) == -0.1


@pytest.mark.parametrize("target", [5.0, 0.3, -2.0])
def test_profile_plans_anew_while_moving(target: float) -> None:
    axes = tuned_axis()
    axes.follow_profile(0, 2.0, 3.0, 30.0, 30.0)
    before = trace(axes, 1500, "reference")
    axes.follow_profile(0, target, 3.0, 30.0, 30.0)
    after = trace(axes, 30_000, "reference")
    velocity = np.diff(np.concatenate([before, after])) * RATE
    assert np.max(np.abs(velocity)) <= 3.0 * (1 + 1e-9)
    assert np.max(np.abs(np.diff(velocity))) * RATE <= 30.0 * (1 + 1e-3)
    assert after[-1] == target


@pytest.mark.parametrize(
    "limits", [(0.0, 1.0, 1.0), (1.0, 0.0, 1.0), (1.0, 1.0, -1.0), (1.0, inf, 1.0), (1.0, 1.0, nan)]
)
def test_profile_without_limits_is_refused(limits: tuple[float, float, float]) -> None:
    with pytest.raises(ValueError, match="above 0"):
        tuned_axis().follow_profile(0, 1.0, *limits)


# -- switching ----------------------------------------------------------------------------------------


def test_from_off_the_reference_is_where_the_axis_is() -> None:
    axes = tuned_axis()
    axes.set_state(np.array([3.2, 0.0]))
    axes.follow_position(0, axes.position(0), 8)
    torque = trace(axes, 400, "torque")
    assert np.max(np.abs(torque)) < 1e-9
    assert axes.reference_position(0) == axes.position(0)


def test_integrator_is_empty_after_off() -> None:
    axes = tuned_axis(friction=0.5)
    axes.follow_velocity(0, 2.0, inf, inf)
    axes.advance(16000)
    axes.off(0)
    axes.advance(80_000)  # the friction stops it
    assert axes.standstill(0)
    axes.follow_velocity(0, 0.0, 1.0, 1.0)
    assert np.max(np.abs(trace(axes, 100, "torque"))) < 0.05


SWITCHES: dict[str, Callable[[SimulatedAxes], None]] = {
    "torque": lambda axes: axes.follow_torque(0, axes.reference_torque(0)),
    "velocity": lambda axes: axes.follow_velocity(0, 2.0, 50.0, 50.0),
    "profile": lambda axes: axes.follow_profile(0, axes.position(0) + 100.0, 2.0, 50.0, 50.0),
}


@pytest.mark.parametrize("feed_forward", [0.0, 1.0])
@pytest.mark.parametrize("new", SWITCHES)
@pytest.mark.parametrize("old", SWITCHES)
def test_switching_on_the_move_does_not_jerk(old: str, new: str, feed_forward: float) -> None:
    """At 2 rad/s against 1 N m of friction the torque stays within the encoder's ripple."""
    axes = tuned_axis(friction=0.5)
    axes.set(0, P.VELOCITY_FF, feed_forward)
    axes.follow_velocity(0, 2.0, 50.0, 50.0)
    axes.advance(16_000)
    SWITCHES[old](axes)
    before = trace(axes, 8000, "torque")
    ripple = np.ptp(before[4000:])
    SWITCHES[new](axes)
    after = trace(axes, 8000, "torque")
    assert before[-1] == pytest.approx(1.0, abs=0.2)
    assert np.max(np.abs(after - 1.0)) < 0.05 + 1.5 * ripple
    # In torque mode a moment of that ripple is held, and the friction decides on the speed.
    assert axes.state[1] == pytest.approx(2.0, abs=0.02 + 1.5 * ripple / 0.5)


def test_velocity_to_cyclic_position_starts_where_the_axis_is() -> None:
    axes = tuned_axis(friction=0.5)
    axes.follow_velocity(0, 2.0, 50.0, 50.0)
    axes.advance(16_000)
    start = axes.position(0)
    torque = []
    for k in range(1, 500):
        axes.follow_position(0, start + 2.0 * k * 8 / RATE, 8)
        torque.append(trace(axes, 8, "torque"))
    assert np.max(np.abs(np.concatenate(torque) - 1.0)) < 0.2
    assert abs(axes.following_error(0)) < 1e-3


def test_velocity_offset_is_not_added_twice_when_switching() -> None:
    axes = tuned_axis(friction=0.5)
    axes.set(0, P.VELOCITY_OFFSET, 1.0)
    axes.follow_profile(0, 100.0, 2.0, 50.0, 50.0)
    axes.advance(16_000)
    assert axes.reference_velocity(0) == pytest.approx(2.0, abs=0.05)
    axes.follow_velocity(0, 1.0, 50.0, 50.0)
    torque = trace(axes, 8000, "torque")
    assert axes.reference_velocity(0) == pytest.approx(2.0)
    assert np.max(np.abs(torque - 1.0)) < 0.3


def test_stopping_with_a_ramp_from_cyclic_position() -> None:
    """Quick stop: the ramp begins at the speed that the position loop asked for."""
    axes = tuned_axis()
    for k in range(1, 301):
        axes.follow_position(0, 2.0 * k * 8 / RATE, 8)
        axes.advance(8)
    axes.follow_velocity(0, 0.0, 20.0, 20.0)
    speed = trace(axes, 1600, "true_velocity")
    assert np.max(speed) < 2.05
    assert speed[400] == pytest.approx(1.0, abs=0.1)
    assert abs(speed[-1]) < 0.02
    assert axes.reference_reached(0)


# -- what is watched ----------------------------------------------------------------------------------


def test_following_error_window_and_timeout() -> None:
    axes = tuned_axis()
    axes.set(0, P.FOLLOWING_ERROR_WINDOW, 0.05)
    axes.set(0, P.FOLLOWING_ERROR_TIMEOUT, 0.005)
    axes.set(0, P.MAX_VELOCITY, 1.0)
    axes.follow_position(0, 0.04, 1)
    axes.advance(800)
    assert not axes.following_error_exceeded(0), "inside the window"
    axes.follow_position(0, 1.0, 1)
    axes.advance(40)
    assert axes.following_error(0) > 0.05
    assert not axes.following_error_exceeded(0), "not for long enough"
    axes.advance(1)
    assert axes.following_error_exceeded(0)
    axes.advance(16000)
    assert abs(axes.following_error(0)) < 0.05
    assert axes.following_error_exceeded(0), "holds until the stage is switched off"
    axes.off(0)
    assert not axes.following_error_exceeded(0)


def test_short_excursion_is_forgiven() -> None:
    axes = tuned_axis()
    axes.set(0, P.FOLLOWING_ERROR_WINDOW, 0.05)
    axes.set(0, P.FOLLOWING_ERROR_TIMEOUT, 0.005)
    axes.set(0, P.POSITION_P, 0.0)
    for _ in range(5):
        axes.follow_position(0, 0.2, 1)
        axes.advance(35)
        axes.follow_position(0, 0.0, 1)
        axes.advance(5)
    assert not axes.following_error_exceeded(0)


def test_following_error_is_not_watched_in_velocity_and_torque_mode() -> None:
    axes = tuned_axis()
    axes.set(0, P.FOLLOWING_ERROR_WINDOW, 1e-4)
    axes.set(0, P.FOLLOWING_ERROR_TIMEOUT, 0.0)
    axes.follow_velocity(0, 5.0, inf, inf)
    axes.advance(1000)
    axes.follow_torque(0, 1.0)
    axes.advance(1000)
    assert not axes.following_error_exceeded(0)
    assert axes.following_error(0) == 0.0


def test_standstill_threshold() -> None:
    axes = tuned_axis()
    axes.set(0, P.VELOCITY_THRESHOLD, 0.5)
    axes.set(0, P.VELOCITY_THRESHOLD_TIME, 0.05)
    axes.advance(401)
    assert axes.standstill(0)
    axes.follow_velocity(0, 2.0, inf, inf)
    axes.advance(800)
    assert not axes.standstill(0)
    axes.follow_velocity(0, 0.2, inf, inf)
    axes.advance(400)
    assert not axes.standstill(0)
    axes.advance(800)
    assert axes.standstill(0)


# -- defects ------------------------------------------------------------------------------------------


def test_reversed_motor_pushes_against_its_torque() -> None:
    axes = rigid_axis()
    axes.reverse_motor(0, defect=True)
    axes.follow_torque(0, 2.0)
    axes.advance(400)
    assert axes.torque(0) == pytest.approx(2.0)
    speed = axes.state[1]
    assert speed == pytest.approx(-2.0 * 0.05 / INERTIA, rel=0.01)
    axes.reverse_motor(0, defect=False)
    axes.advance(800)
    assert axes.state[1] > 0.0


def test_held_encoder_stands_still_until_let_go() -> None:
    axes = rigid_axis()
    axes.set_state(np.array([1.0, 3.0]))
    axes.hold_encoder(0, defect=True)
    counts = axes.position_counts(0)
    axes.advance(800)
    assert axes.position_counts(0) == counts
    assert axes.velocity(0) == 0.0
    assert axes.state[0] == pytest.approx(1.3)
    axes.hold_encoder(0, defect=False)
    axes.advance(1)
    assert axes.position(0) == pytest.approx(axes.state[0], abs=1 / COUNTS)


# -- every parameter acts -----------------------------------------------------------------------------

EVERY_PARAMETER: dict[Parameter, tuple[float, str, dict[Parameter, float]]] = {
    P.POSITION_P: (60.0, "position", {}),
    P.VELOCITY_P: (2.0, "position", {}),
    P.VELOCITY_I: (200.0, "position", {}),
    P.VELOCITY_FF: (0.5, "position", {}),
    P.INERTIA_FF: (INERTIA, "position", {}),
    P.VISCOUS_FF: (0.5, "position", {}),
    P.VELOCITY_FILTER: (100.0, "position", {}),
    P.FILTER1_TYPE: (1, "position", {}),
    P.FILTER1_FREQUENCY: (300.0, "position", {P.FILTER1_TYPE: 1}),
    P.FILTER1_ZERO_DAMPING: (0.4, "position", {P.FILTER1_TYPE: 1}),
    P.FILTER1_POLE_DAMPING: (1.0, "position", {P.FILTER1_TYPE: 1}),
    P.FILTER2_TYPE: (2, "position", {}),
    P.FILTER2_FREQUENCY: (300.0, "position", {P.FILTER2_TYPE: 2}),
    P.FILTER2_ZERO_DAMPING: (0.4, "position", {P.FILTER2_TYPE: 1}),
    P.FILTER2_POLE_DAMPING: (1.0, "position", {P.FILTER2_TYPE: 2}),
    P.TORQUE_LIMIT: (0.2, "position", {}),
    P.VELOCITY_OFFSET: (0.1, "position", {}),
    P.TORQUE_OFFSET: (0.3, "position", {}),
    P.TORQUE_SLOPE: (50.0, "torque", {}),
    P.MAX_VELOCITY: (0.5, "position", {}),
    P.POSITION_MIN: (0.1, "position", {}),
    P.POSITION_MAX: (0.1, "position", {}),
}
ONLY_WATCHED = {
    P.FOLLOWING_ERROR_WINDOW,
    P.FOLLOWING_ERROR_TIMEOUT,
    P.VELOCITY_THRESHOLD,
    P.VELOCITY_THRESHOLD_TIME,
}


def motion(kind: str, changes: Mapping[Parameter, float]) -> np.ndarray:
    axes = tuned_axis(friction=0.05, counts_per_unit=1e8)
    for parameter, value in changes.items():
        axes.set(0, parameter, value)
        assert axes.get(0, parameter) == value
    positions = []
    for k in range(1, 401):
        if kind == "position":
            axes.follow_position(0, 0.2 * (1 - np.cos(20.0 * k * 8 / RATE)), 8)
        else:
            axes.follow_torque(0, 1.0)
        axes.advance(8)
        positions.append(axes.state[0])
    return np.array(positions)


@pytest.mark.parametrize("parameter", Parameter, ids=lambda p: p.name)
def test_every_parameter_acts_on_the_motion(parameter: Parameter) -> None:
    if parameter in ONLY_WATCHED:  # their own tests show what they do; the motion stays the same
        value = 0.3
        assert np.array_equal(motion("position", {}), motion("position", {parameter: value}))
        return
    value, kind, before = EVERY_PARAMETER[parameter]
    changed = motion(kind, before | {parameter: value}) - motion(kind, before)
    assert np.max(np.abs(changed)) > 1e-5, "rad; the encoder resolves 1e-8"
    other = two_axes()
    other.set(0, parameter, value)
    assert other.get(1, parameter) == two_axes().get(1, parameter), "only this axis"


# -- the closed loop as a whole -----------------------------------------------------------------------


def test_closed_loop_against_an_independent_simulation() -> None:
    """The same loops in plain Python, written from the block diagram, give the same motion."""
    axes = tuned_axis(friction=0.3)
    axes.set(0, P.VELOCITY_FF, 0.7)
    axes.set(0, P.VISCOUS_FF, 0.2)
    axes.set(0, P.TORQUE_LIMIT, 3.0)
    h, w = 1 / RATE, 2 * pi * 1000.0
    x = v = velocity = integral = torque = counts = 0.0
    reference, low_pass = 0.0, 1 - exp(-2 * pi * TUNED[P.VELOCITY_FILTER] * h)
    decay = exp(-0.3 / INERTIA * h)
    for k in range(250):
        target = 0.3 * sin(0.05 * k)
        start, speed = reference, (target - reference) / (8 * h)
        axes.follow_position(0, target, 8)
        for j in range(8):
            error = TUNED[P.POSITION_P] * (reference - counts / COUNTS) + 0.7 * speed - velocity
            wanted = TUNED[P.VELOCITY_P] * error + integral + 0.2 * speed
            given = min(max(wanted, -3.0), 3.0)
            if given == wanted or (wanted > given) != (error > 0):
                integral = min(max(integral + TUNED[P.VELOCITY_I] * error * h, -3.0), 3.0)
            mean = given + (torque - given) * (1 - exp(-w * h)) / (w * h)
            torque = given + (torque - given) * exp(-w * h)
            end = mean / 0.3
            x += end * h + (v - end) * INERTIA / 0.3 * (1 - decay)
            v = end + (v - end) * decay
            before, counts = counts, float(np.floor(x * COUNTS))
            velocity += low_pass * ((counts - before) / COUNTS / h - velocity)
            reference = start + (target - start) * (j + 1) / 8
        axes.advance(8)
        assert axes.state == pytest.approx([x, v], rel=1e-6, abs=2e-5)
        assert axes.torque(0) == pytest.approx(torque, abs=2e-2)
        assert axes.velocity(0) == pytest.approx(velocity, abs=0.05)


def test_linear_axis_works_in_metres() -> None:
    chain = ChainParameters((50.0,), (), ())
    hardware = DriveHardware(500.0, 0.0, counts_per_unit=1e7, peak_torque=1500.0)
    axes = SimulatedAxes(PlantParameters((chain,)), [hardware], seed=0)
    for parameter, value in ((P.POSITION_P, 20.0), (P.VELOCITY_P, 5e3), (P.VELOCITY_I, 5e4)):
        axes.set(0, parameter, value)
    axes.follow_profile(0, 0.5, 0.4, 3.0, 3.0)
    axes.advance(24_000)
    assert axes.state[0] == pytest.approx(0.5, abs=1e-5)


# -- what is refused ----------------------------------------------------------------------------------


@pytest.mark.parametrize("parameter", Parameter, ids=lambda p: p.name)
def test_values_out_of_range_are_refused_and_change_nothing(parameter: Parameter) -> None:
    axes = tuned_axis()
    before, allowed = axes.get(0, parameter), axes.range_of(parameter)
    bad = [nan]
    bad += [np.nextafter(allowed.high, inf)] if allowed.high < inf else []
    bad += [np.nextafter(allowed.low, -inf)] if allowed.low > -inf else []
    for value in bad:
        with pytest.raises(ValueError, match=f"axis 0: {parameter.name} = .* out of range"):
            axes.set(0, parameter, value)
    assert axes.get(0, parameter) == before
    for value in (allowed.low, allowed.high):
        axes.set(0, parameter, value)
        assert axes.get(0, parameter) == value


def test_filter_type_between_two_types_is_refused() -> None:
    with pytest.raises(ValueError, match="no filter type"):
        tuned_axis().set(0, P.FILTER1_TYPE, 0.5)


@pytest.mark.parametrize("bad", [nan, inf, -inf])
def test_targets_that_are_no_numbers_are_refused(bad: float) -> None:
    axes = tuned_axis()
    calls: tuple[Callable[[], None], ...] = (
        lambda: axes.follow_position(0, bad, 8),
        lambda: axes.follow_velocity(0, bad, 1.0, 1.0),
        lambda: axes.follow_torque(0, bad),
        lambda: axes.follow_profile(0, bad, 1.0, 1.0, 1.0),
    )
    for call in calls:
        with pytest.raises(ValueError, match="must be finite"):
            call()
    assert axes.reference(0) == Reference.OFF
    with pytest.raises(ValueError, match="at least 1 step"):
        axes.follow_position(0, 1.0, 0)
    with pytest.raises(ValueError, match="above 0"):
        axes.follow_velocity(0, 1.0, 0.0, 1.0)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"rated_torque": 0.0}, "rated_torque is 0.0 N m"),
        ({"torque_noise": -1.0}, "torque_noise is -1.0 N m"),
        ({"counts_per_unit": inf}, "counts_per_unit is inf"),
        ({"current_bandwidth": nan}, "current_bandwidth is nan Hz"),
        ({"peak_torque": 0.0}, "peak_torque is 0.0 N m"),
    ],
)
def test_hardware_that_can_not_be(changes: dict[str, float], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        drive(**changes)


def test_drives_and_chains_must_be_as_many() -> None:
    chain = ChainParameters((1.0,), (), ())
    with pytest.raises(ValueError, match="1 chains, so it needs as many drives, got 2"):
        SimulatedAxes(PlantParameters((chain,)), [drive(), drive()], 0)
    with pytest.raises(ValueError, match="rate is 0"):
        SimulatedAxes(PlantParameters((chain,)), [drive()], 0, rate=0.0)


def test_state_can_be_set_only_while_off() -> None:
    axes = tuned_axis()
    with pytest.raises(ValueError, match="shape"):
        axes.set_state(np.zeros(3))
    with pytest.raises(ValueError, match="finite"):
        axes.set_state(np.array([0.0, nan]))
    axes.follow_torque(0, 0.0)
    with pytest.raises(RuntimeError, match=r"axes \[0\] are on"):
        axes.set_state(np.zeros(2))
    axes.state[:] = 7.0
    assert axes.state.tolist() == [0.0, 0.0], "what is read is a copy"


@pytest.mark.parametrize("bad", [nan, inf, 1e300])
def test_diverged_simulation_is_an_error_from_then_on(bad: float) -> None:
    axes = two_axes()
    axes._state[1] = bad
    for _ in range(2):
        with pytest.raises(SimulationDivergedError, match="diverged before t ="):
            axes.advance(8)
    assert issubclass(SimulationDivergedError, DrivesError)
