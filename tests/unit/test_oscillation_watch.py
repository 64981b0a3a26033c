"""The watch for loops that swing: what it finds and when, and what it leaves alone."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drives.api import AxisLimits
from fieldtool.experiment.verification.hiss import hiss
from fieldtool.experiment.verification.oscillation import (
    HOLD_LEVEL,
    HOLD_TURNS,
    MOVE_LEVEL,
    MOVE_TURNS,
    OscillationWatch,
)
from fieldtool.experiment.verification.swings import Swings

STEP = 0.001
LIMITS = AxisLimits((-2.0, 2.0), 5.0, 100.0, 10.0, 0.5)
STILL = 0.004


def watch(step=STEP, axes=1):
    return OscillationWatch(
        [f"x{k}" for k in range(axes)],
        [LIMITS] * axes,
        np.full(axes, 1e-5),
        np.full(axes, STILL),
        step,
        trusts_loops=False,
        units=["rad"] * axes,
    )


def moving(one):
    one.move(np.array([-2.0]), np.array([2.0]), np.array([9.0]))
    return one


def first_alarm(one, position, torque):
    for k, (q, t) in enumerate(zip(position, torque, strict=True)):
        if one.take([float(q)], [float(t)]) is not None:
            return k
    return None


def when_above(torque, level):
    """The first row whose amplitude so far, as a swing from its mean, is above half a level."""
    return int(np.argmax(np.abs(torque) > level / 2))


@settings(max_examples=60, deadline=None)
@given(
    frequency=st.floats(30.0, 400.0),
    doubling=st.floats(0.01, 0.3),
    phase=st.floats(0.0, 6.28),
    offset=st.floats(-3.0, 3.0),
)
def test_a_growing_swing_at_rest_is_found_within_50_ms_of_reaching_the_level(
    frequency, doubling, phase, offset
):
    t = np.arange(4000) * STEP
    swing = 0.01 * 2 ** (t / doubling) * np.sin(2 * np.pi * frequency * t + phase)
    swing = np.clip(swing, -10, 10)
    # sampled once a cycle it may look smaller than it is for a while: near a third of the rate, say
    width = round(1.0 / frequency / STEP) + 1
    spans = np.ptp(np.lib.stride_tricks.sliding_window_view(swing, width), axis=1)
    if not np.any(spans > HOLD_LEVEL * LIMITS.torque):
        return
    seen = int(np.argmax(spans > HOLD_LEVEL * LIMITS.torque)) + width - 1
    found = first_alarm(watch(), np.zeros(4000), offset + swing)
    assert found is not None
    assert (found - seen) * STEP <= 0.05 + 1.0 / frequency


@settings(max_examples=40, deadline=None)
@given(frequency=st.floats(30.0, 300.0), doubling=st.floats(0.01, 0.1))
def test_a_growing_swing_during_a_move_is_found(frequency, doubling):
    t = np.arange(3000) * STEP
    push = 3.0 * np.sin(2 * np.pi * t / 3.0)
    swing = np.clip(0.01 * 2 ** (t / doubling) * np.sin(2 * np.pi * frequency * t), -8, 8)
    seen = when_above(swing, MOVE_LEVEL * LIMITS.torque)
    found = first_alarm(moving(watch()), 0.3 * t, push + swing)
    assert found is not None
    growth = 0.6 * doubling  # until it is half as large again
    assert (found - seen) * STEP <= 0.05 + growth + (MOVE_TURNS + 1) / frequency


@settings(max_examples=40, deadline=None)
@given(
    frequency=st.floats(4.0, 60.0),
    damping=st.floats(0.005, 0.3),
    size=st.floats(0.1, 3.5),
)
def test_what_rings_after_a_move_and_dies_out_is_left_alone(frequency, damping, size):
    t = np.arange(3000) * STEP
    decay = np.exp(-2 * np.pi * frequency * damping * t)
    torque = size * decay * np.cos(2 * np.pi * frequency * t)
    position = 0.004 * decay * np.cos(2 * np.pi * frequency * t)
    assert first_alarm(moving(watch()), position, torque) is None


def test_a_move_out_and_back_is_left_alone():
    u = np.linspace(0, 1, 500)
    s = u**3 * (10 - 15 * u + 6 * u * u)
    out = np.concatenate([s, np.ones(300), 1 - s, np.zeros(300)])
    torque = 5.0 * np.gradient(np.gradient(out)) / np.abs(np.gradient(np.gradient(s))).max()
    one = watch()
    one.move(np.array([-0.2]), np.array([1.5]), np.array([9.0]), 0.6 * 0.25)
    assert first_alarm(one, out, torque) is None


SHORT = 0.05
"""Half period of a quick move, s: nothing slower than 10 Hz swings by it."""


def settled(one, foreseen=(0.8, 0.01), beside=lambda _: 0.0):
    """Let the first axis have come to 1 rad by a quick move; it may be 0.3 rad off."""
    axes = len(one._names)
    one.hold(np.zeros(axes))
    ends = np.full(axes, 0.7), np.full(axes, 1.3)
    one.move(np.full(axes, -1.0), np.full(axes, 2.0), np.full(axes, 9.0), SHORT, axis=0)
    for k in range(100):
        torques = [2 * np.sin(2 * np.pi * k / 99), *[beside(k * STEP)] * (axes - 1)]
        assert one.take([k / 99] * axes, torques) is None
    one.settle(*ends, np.full(axes, 9.0), SHORT, 0, foreseen)
    return one


@settings(max_examples=40, deadline=None)
@given(frequency=st.floats(2.2, 60.0), share=st.floats(0.1, 0.9), phase=st.floats(0.0, 6.28))
def test_a_slow_swing_about_the_target_is_found_within_two_of_its_periods(frequency, share, phase):
    t = np.arange(2000) * STEP
    swing = share * LIMITS.torque * np.sin(2 * np.pi * frequency * t + phase)
    found = first_alarm(settled(watch()), 1 + 0 * t, swing)
    assert found is not None
    assert found * STEP <= 2.0 / frequency + 0.01


@settings(max_examples=40, deadline=None)
@given(frequency=st.floats(2.2, 60.0), phase=st.floats(0.0, 6.28))
def test_a_position_that_swings_about_the_target_without_torque_is_found(frequency, phase):
    t = np.arange(2000) * STEP
    swing = 1 + 0.25 * np.sin(2 * np.pi * frequency * t + phase)
    found = first_alarm(settled(watch()), swing, 0 * t)
    assert found is not None
    assert found * STEP <= 2.0 / frequency + 0.01


@settings(max_examples=40, deadline=None)
@given(
    frequency=st.floats(2.2, 60.0),
    damping=st.floats(0.0, 0.3),
    size=st.floats(0.1, 4.0),
    wrong=st.floats(0.0, 0.95),
)
def test_what_the_model_foresees_after_a_move_is_left_alone(frequency, damping, size, wrong):
    """Levels are what is foreseen, peak to peak; also where it hardly dies out."""
    t = np.arange(2000) * STEP
    ring = np.exp(-2 * np.pi * frequency * damping * t) * np.cos(2 * np.pi * frequency * t)
    one = settled(watch(), (2 * size, 0.02))
    assert first_alarm(one, 1 + wrong * 0.01 * ring, wrong * size * ring) is None


@settings(max_examples=30, deadline=None)
@given(frequency=st.floats(2.2, 60.0), share=st.floats(0.2, 0.3))
def test_an_axis_beside_that_swings_on_when_all_should_rest_is_found(frequency, share):
    """Without a prediction what dies out is left alone, what does not is found within four periods."""
    for dying, found in ((0.05, False), (0.0, True)):

        def swing(time, dying=dying):
            turn = 2 * np.pi * frequency * time
            return float(share * LIMITS.torque * np.exp(-dying * turn) * np.cos(turn))

        one = settled(watch(axes=2), beside=swing)
        alarm = None
        for k in range(4000):
            alarm = one.take([1.0, 1.0], [0.0, swing(0.1 + k * STEP)])
            if alarm:
                break
        assert (alarm is not None) == found
        if alarm:
            assert alarm.axis == "x1"
            assert k * STEP <= 4.6 / frequency + 0.01


def test_turns_of_the_move_itself_do_not_count_when_it_rests():
    one = settled(watch(), (0.8, 0.01))
    assert first_alarm(one, np.ones(500), np.zeros(500)) is None


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("which", ["position", "torque"])
def test_what_is_no_number_is_an_alarm_at_once(bad, which):
    for one in (watch(), moving(watch()), settled(watch())):
        values = (bad, 0.0) if which == "position" else (1.0, bad)
        alarm = one.take(*([v] for v in values))
        assert alarm is not None
        assert "no number" in alarm.sentence


def test_noise_below_the_level_is_left_alone(fresh_rng):
    noise = np.clip(fresh_rng.normal(0, 0.12, 20_000), -0.39, 0.39)
    assert first_alarm(watch(), np.zeros(20_000), noise) is None


def test_an_axis_that_runs_away_leaves_its_corridor():
    t = np.arange(500) * STEP
    position = 1e-5 * np.exp(t / 0.02)
    found = first_alarm(watch(), position, 0 * t)
    assert found == int(np.argmax(position > position[0] + STILL))


def test_the_corridor_begins_where_the_axis_is_first_seen():
    assert first_alarm(watch(), np.full(100, 1.7), np.zeros(100)) is None


def test_a_steady_load_is_no_alarm_and_its_torque_counts_as_that_at_rest():
    one = watch()
    assert first_alarm(one, np.zeros(400), np.full(400, 6.0)) is None
    one.move(np.array([-1.0]), np.array([1.0]), np.array([1.0]))
    assert one.take([0.0], [6.9]) is None
    alarm = one.take([0.0], [7.2])
    assert alarm is not None
    assert "1.2 N m" in alarm.sentence
    assert "x0" in alarm.sentence


def test_all_axes_that_swing_lose_their_power():
    one = watch(axes=3)
    alarm = None
    for k in range(100):
        s = float(np.sin(2 * np.pi * 50 * k * STEP + 0.3)) * 2
        alarm = alarm or one.take([0.0] * 3, [s, 0.0, s])
    assert alarm is not None
    assert alarm.power_off == {"x0", "x2"}
    assert one.alarm is not None


@given(st.lists(st.floats(-1, 1), min_size=2, max_size=200))
@settings(max_examples=100, deadline=None)
def test_swings_against_turns_found_in_hindsight(values):
    """Every swing is at least the level, and there are as many as a walk over all extremes finds."""
    swings = Swings()
    swings.restart(0.5)
    seen = [swings.take(v) for v in values]
    low = high = values[0]
    direction, count = 0, 0
    for v in values:
        low, high = min(low, v), max(high, v)
        if direction >= 0 and high - v >= 0.5:
            count += direction != 0
            direction, low, high = -1, v, v
        elif direction <= 0 and v - low >= 0.5:
            count += direction != 0
            direction, low, high = 1, v, v
    assert sum(seen) == count
    assert all(size >= 0.5 for size in swings.sizes)


def test_the_frequency_is_told():
    one = watch()
    for k in range(1000):
        alarm = one.take([0.0], [2 * float(np.sin(2 * np.pi * 40 * k * STEP))])
        if alarm:
            break
    assert alarm is not None
    told = float(alarm.sentence.split("about ")[1].split(" Hz")[0])
    assert told == pytest.approx(40, rel=0.15)
    assert HOLD_TURNS == 2


def test_a_torque_that_hisses_is_no_swing_and_one_that_swings_is_no_hiss():
    rng = np.random.default_rng(3)
    time = np.arange(3000) * STEP
    noise = 0.02 * LIMITS.torque * rng.standard_normal(3000)

    def good():
        one = watch()
        return OscillationWatch(
            ["x"], [LIMITS], np.array([1e-5]), np.array([STILL]), one._step, trusts_loops=True
        )

    assert first_alarm(good(), np.zeros(3000), noise) is None
    assert hiss(noise[:100]) == pytest.approx(0.02 * LIMITS.torque, rel=0.3)
    for frequency in (5.0, 20.0, 70.0, 160.0, 300.0, 410.0):
        swing = 0.06 * LIMITS.torque * np.sin(2 * np.pi * frequency * time)
        assert hiss(swing[:100]) == 0
        found = first_alarm(good(), np.zeros(3000), swing)
        assert found is not None
        assert found * STEP < 0.1 + 3 / frequency


def test_what_a_move_is_foreseen_to_shake_is_no_swing_and_more_is_one():
    time = np.arange(600) * STEP
    push = 4.0 * np.sin(2 * np.pi * time / 0.6)
    ring = np.where(time < 0.3, 0.5, 1.6) * np.sin(2 * np.pi * 25.0 * time)
    ways = (np.array([-2.0]), np.array([2.0]), np.array([9.0]), 0.1)

    def found(size, shakes):
        one = watch()
        one.move(*ways, axis=0, shakes=shakes)
        return first_alarm(one, 0.3 * time, push + size * ring)

    assert found(1.0, 0.0) is not None, "it would be taken for a swing that grows"
    assert found(1.0, 1.5 * 3.2) is None
    assert found(2.0, 1.5 * 3.2) is not None
