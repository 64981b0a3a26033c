"""A host that is held up while axes move: measured again if it is short, stopped if it is long."""

import numpy as np
import pytest

from drives.errors import SafetyStopError

CYCLE, BLOCK = 0.002, 50
SPEED = 5.0
"""rad/s, half of the limit."""


def held_up(group, motion, seconds, at=6, blocks=12):
    """A ramp; the host does something else for so long before one of its blocks."""
    start, done = motion.position, [0]

    def source(_before):
        if done[0] == blocks:
            return None
        if done[0] == at:
            clock = group.line.clock
            clock.wait_until(clock.now() + seconds)
        t = CYCLE * (done[0] * BLOCK + 1 + np.arange(BLOCK))
        done[0] += 1
        there = SPEED * (t - 0.05 * (1 - np.exp(-t / 0.05)))
        return start + there[:, None] * np.array([1.0, 0.0])

    return source


@pytest.fixture
def far_travel(make_bench, profile_of_two):
    for axis in profile_of_two["axes"]:
        axis["limits"]["travel"] = ["-600 deg", "600 deg"]
        axis["limits"]["following_error"] = "100 deg"
        axis["limits"]["torque"] = "12 N m"
    return make_bench(profile_of_two)


@pytest.mark.parametrize("milliseconds", [5, 30, 100])
def test_a_short_pause_is_no_runaway(far_travel, milliseconds):
    """The axis coasts on meanwhile; that is many cycles' way, not one cycle's speed."""
    bench = far_travel
    with bench.connected() as group:
        with group.motion(CYCLE) as motion:
            capture = motion.stream(held_up(group, motion, milliseconds / 1000))
        kept = group.punctuality
    assert capture.rows == 12 * BLOCK
    assert kept.late == 1
    assert kept.worst == pytest.approx(milliseconds / 1000, abs=CYCLE)
    assert capture.missing == (6 * BLOCK,), "the block with it is measured again"
    moved = np.abs(np.diff(capture.position[:, 0]))
    limit = 10.0 * CYCLE
    if milliseconds >= 30:
        assert moved[6 * BLOCK - 1] > limit, "judged by one cycle it would have been too fast"
    assert bench.powered() == {}


def test_a_long_pause_stops_all_axes(far_travel):
    bench = far_travel
    with (
        pytest.raises(
            SafetyStopError, match=r"this computer stood still for 1[67]\d ms; .* 150 ms"
        ),
        bench.connected() as group,
        group.motion(CYCLE) as motion,
    ):
        motion.stream(held_up(group, motion, 0.17))
    assert bench.powered() == {}


def test_a_speed_above_the_limit_after_a_pause_is_one(far_travel):
    """A pause is no excuse: the mean speed over it is what counts."""
    bench = far_travel
    with bench.connected() as group, group.motion(CYCLE) as motion:
        (channel, _) = motion._channels
        channel.paused = 10.0
        channel.take(
            channel.last[:2]
            + (channel.position + 12 * channel.step).to_bytes(4, "little", signed=True)
            + bytes(2)
        )
        assert abs(channel.position - channel.previous) > channel.allowed
        channel.paused = 10.0
        channel.take(
            channel.last[:2]
            + (channel.position + 10 * channel.step).to_bytes(4, "little", signed=True)
            + bytes(2)
        )
        assert abs(channel.position - channel.previous) <= channel.allowed
        assert channel.paused == 0
