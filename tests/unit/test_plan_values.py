"""Tones on whole cycles and periods, ways between them without a kink, moves within limits."""

from itertools import islice

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldtool.experiment.stepped.plan import (
    BLOCK_CYCLES,
    Sweep,
    SweepPlan,
    Tone,
    smooth_move,
    tone_blocks,
    tone_near,
    transition,
)

cycle_times = st.sampled_from([0.001, 0.002, 0.004, 0.005, 0.01])


@st.composite
def tones(draw: st.DrawFn, cycle_time: float | None = None) -> Tone:
    step = draw(cycle_times) if cycle_time is None else cycle_time
    frequency = draw(st.floats(0.1, 0.1 / step))
    return tone_near(frequency, draw(st.floats(1e-4, 1.0)), step)


@st.composite
def pairs(draw: st.DrawFn) -> tuple[Tone, Tone]:
    step = draw(cycle_times)
    first = draw(tones(step))
    ratio = draw(st.floats(0.7, 1.4))
    frequency = float(np.clip(first.frequency * ratio, 0.1, 0.1 / step))
    return first, tone_near(frequency, draw(st.floats(1e-4, 1.0)), step)


@given(st.floats(0.02, 250.0), cycle_times, st.floats(0, 1))
def test_blocks_have_whole_cycles_and_whole_periods(
    frequency: float, step: float, amplitude: float
) -> None:
    if frequency > 0.25 / step:
        with pytest.raises(ValueError, match=f"at most a quarter .* {0.25 / step:g} Hz"):
            tone_near(frequency, amplitude, step)
        return
    tone = tone_near(frequency, amplitude, step)
    assert isinstance(tone.periods, int)
    assert isinstance(tone.samples, int)
    assert tone.samples >= BLOCK_CYCLES
    assert tone.periods >= 1
    assert tone.frequency == pytest.approx(frequency, rel=2e-3)
    assert tone.block_time == tone.samples * step
    _, block, again = islice(tone_blocks(tone, None), 3)
    np.testing.assert_array_equal(block, again)
    assert block.size == tone.samples
    # a whole number of periods: all of the block's power is in that one line
    lines = np.abs(np.fft.rfft(block)) * 2 / block.size
    assert lines[tone.periods] == pytest.approx(amplitude, abs=1e-9)
    assert np.delete(lines, tone.periods).max() < 1e-9


@pytest.mark.parametrize("frequency", [0.0, -1.0, float("nan")])
def test_no_tone_without_a_frequency(frequency: float) -> None:
    with pytest.raises(ValueError, match="must be positive"):
        tone_near(frequency, 0.1, 0.004)


def kinks(way: np.ndarray, largest: float) -> float:
    """Largest change of the speed within one cycle, as a share of the largest speed."""
    speed = np.diff(way)
    return float(np.abs(np.diff(speed)).max() / largest)


@given(pairs())
def test_the_way_to_the_next_tone_has_no_kink(pair: tuple[Tone, Tone]) -> None:
    first, second = pair
    old = list(islice(tone_blocks(first, None), 2))
    new = list(islice(tone_blocks(second, first), 2))
    way = np.concatenate([*old, *new])
    # the speed of a smooth sine changes by (2 pi f T) of itself in a cycle; a phase that jumps, or
    # a frequency that does, changes it by a share that does not get smaller with T
    turn = 2 * np.pi * max(first.frequency, second.frequency) * first.cycle_time
    largest = turn * max(first.amplitude, second.amplitude)
    assert np.abs(np.diff(way)).max() <= 1.9 * largest
    assert kinks(way, largest) <= 2.6 * turn
    assert np.abs(way).max() <= max(first.amplitude, second.amplitude) * (1 + 1e-9)


@given(tones())
def test_from_rest_and_to_rest(tone: Tone) -> None:
    there, back = transition(tone, None), transition(None, tone)
    way = np.concatenate([np.zeros(3), there, next(islice(tone_blocks(tone, None), 1, None)), back])
    turn = 2 * np.pi * tone.frequency * tone.cycle_time
    assert kinks(np.concatenate([way, np.zeros(3)]), turn * tone.amplitude) <= 2.6 * turn
    assert there[0] == 0.0
    assert abs(back[-1]) <= 0.1 * tone.amplitude


def test_where_a_block_begins_the_speed_is_the_tones() -> None:
    """With cycles short against the period, the speed just before and after agree to a few per mille."""
    for frequency in np.geomspace(0.5, 5.0, 12):
        tone = tone_near(float(frequency), 1.0, 0.0005)
        there = transition(tone, None)
        block = next(islice(tone_blocks(tone, None), 1, None))
        before, after = there[-1] - there[-2], block[1] - block[0]
        assert before == pytest.approx(after, rel=0.02)
        assert block[0] - there[-1] == pytest.approx(after, rel=0.02)


def test_a_way_needs_a_tone() -> None:
    with pytest.raises(ValueError, match="needs a tone"):
        transition(None, None)


@given(
    st.floats(-10, 10),
    st.floats(1e-3, 10),
    st.floats(1e-2, 1e3),
    cycle_times,
)
def test_moves_respect_velocity_and_acceleration(
    distance: float, velocity: float, acceleration: float, step: float
) -> None:
    if abs(distance) > 1e4 * step * velocity:
        distance = float(np.sign(distance) * 1e4 * step * velocity)
    move = smooth_move(distance, velocity, acceleration, step)
    assert move[-1] == distance
    way = np.concatenate([np.zeros(3), move, np.full(3, move[-1])])
    rounding = 1e-12 * max(abs(distance), 1e-12) / step
    assert np.abs(np.diff(way)).max() / step <= velocity + rounding
    assert np.abs(np.diff(way, 2)).max() / step**2 <= acceleration + 4 * rounding / step
    assert np.all(np.diff(way) * np.sign(distance) >= -rounding * step)


@given(st.floats(0.01, 1), st.floats(0.5, 5), st.floats(5, 50))
def test_moves_do_not_dawdle(distance: float, velocity: float, acceleration: float) -> None:
    """One of both limits is used to the full."""
    step = 1e-4
    move = smooth_move(distance, velocity, acceleration, step)
    way = np.concatenate([[0.0], move])
    speed = np.abs(np.diff(way)).max() / step
    push = np.abs(np.diff(way, 2)).max() / step**2
    assert max(speed / velocity, push / acceleration) > 0.98


def test_a_plan_counts_its_tones_and_its_time() -> None:
    tone = Tone(2, 500, 0.004, 0.1)
    sweep = Sweep("direct, others free", "x", ("y",), (tone, tone), blocks=3)
    cross = Sweep("cross-coupled", "y", ("x",), (tone,), blocks=6, label="again")
    plan = SweepPlan(0.004, (sweep, cross))
    assert plan.tones == 3
    assert plan.expected_duration(5.0) == pytest.approx(3 * 5.0 + 2 * (2 * 4 + 7))
    assert sweep.name == "x direct, others free"
    assert cross.name == "y cross-coupled (x), again"
