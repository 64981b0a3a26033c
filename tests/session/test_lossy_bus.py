"""A bus that loses a cycle now and then: an encoder that does not count is found all the same."""

import numpy as np
import pytest

from drives.errors import SafetyStopError
from drives.sim.faults import EncoderStuck
from drives.sim.frame_faults import PdoMissing
from tests.faults.table import with_friction

TABLE, ARM = 11, 12
CYCLE, BLOCK = 0.002, 25
"""s, and rows of a block; in each block a PDO of each drive is missing."""
STUCK_AT = 40
"""Blocks until the encoder sticks."""


def swing(bench, motion, stuck: bool):
    """Swing both axes slowly to and fro, over lost cycles; perhaps the arm's encoder sticks."""
    start, done = motion.position, [0]

    def source(_before):
        if done[0] == 100:
            return None
        for node in (TABLE, ARM):
            bench.inject(PdoMissing(node, 1))
        if stuck and done[0] == STUCK_AT:
            bench.inject(EncoderStuck(ARM))
            bench.angle_then = arm_angle(bench)
        t = CYCLE * (done[0] * BLOCK + np.arange(BLOCK))
        done[0] += 1
        return start + 0.1 * np.sin(2 * np.pi * t)[:, None] * np.minimum(t, 1.0)[:, None]

    return source


def arm_angle(bench):
    axes, (_, arm) = bench.machine.axes, bench.machine.nodes
    return float(axes.state[axes.plant.motors[arm.axis]])


@pytest.mark.parametrize("friction", [False, True])
def test_a_sound_axis_goes_on(make_bench, profile_of_two, friction):
    bench = make_bench(with_friction() if friction else profile_of_two)
    with bench.connected() as group, group.motion(CYCLE) as motion:
        capture = motion.stream(swing(bench, motion, stuck=False))
        if friction:
            assert motion._channels[1].unseen.knows, "it has learned what friction holds"
    assert capture.rows == 100 * BLOCK
    assert len(capture.missing) >= 90
    assert bench.powered() == {}


@pytest.mark.parametrize("friction", [False, True])
def test_a_stuck_encoder_is_found(make_bench, profile_of_two, friction):
    bench = make_bench(with_friction() if friction else profile_of_two)
    with (
        pytest.raises(SafetyStopError, match=r"arm: stands .*encoder does not count.*brake"),
        bench.connected() as group,
        group.motion(CYCLE) as motion,
    ):
        motion.stream(swing(bench, motion, stuck=True))
    assert bench.powered() == {}
    assert abs(arm_angle(bench) - bench.angle_then) < np.radians(4.0)
