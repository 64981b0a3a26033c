"""Direction check and watch of stuck encoders on drives with friction and with coarse encoders."""

from copy import deepcopy
from dataclasses import replace

import numpy as np
import pytest

from drives.canopen_drive.channel import INPUT, channel_of
from drives.errors import SafetyStopError
from fieldtool.experiment.axes import Axes
from fieldtool.experiment.directions import check_directions

CYCLE = 0.002
FRICTION = {"effects": [{"effect": "coulomb_friction", "torque": 0.4, "location": "motor"}]}


def machine(profile, changes):
    for axis in profile["simulation"]["axes"]:
        axis.update(deepcopy(changes))
    return profile


@pytest.mark.parametrize("changes", [FRICTION, {"encoder_counts_per_rev": 2000}])
def test_friction_and_coarse_encoders_are_no_wrong_direction(make_bench, profile_of_two, changes):
    bench = make_bench(machine(profile_of_two, changes))
    kept = []
    with bench.connected() as group:
        limits = tuple(drive.limits for drive in group.drives)
        counts = np.array([drive.scaling.position for drive in group.drives])
        axes = Axes(group.axes, limits, np.zeros(2), ("rad", "rad"), counts)
        check_directions(group, axes, CYCLE, kept.append)
    assert [e.complete for e in kept] == [True, True]
    assert bench.powered() == {}


def test_slow_loops_are_given_the_time_that_they_need(make_bench, profile_of_two):
    """As a machine of 0.5 Hz has them: an axis comes to its target within seconds, not within one."""
    slow = {"position_p": 0.55, "velocity_p": 0.1, "velocity_i": 0.05, "velocity_ff": 0.0}
    bench = make_bench(machine(profile_of_two, {"gains": slow}))
    kept = []
    with bench.connected() as group:
        limits = tuple(drive.limits for drive in group.drives)
        counts = np.array([drive.scaling.position for drive in group.drives])
        axes = Axes(group.axes, limits, np.zeros(2), ("rad", "rad"), counts)
        with pytest.raises(SafetyStopError, match="does not follow"):
            check_directions(group, axes, CYCLE, lambda _: None)
        group.drives[0].wait(5.0)
        paced = replace(axes, pace=np.full(2, slow["position_p"]))
        check_directions(group, paced, CYCLE, kept.append)
    assert [e.complete for e in kept] == [True, True]
    assert bench.powered() == {}


@pytest.mark.parametrize(("counts", "longest"), [(2**20, 0.025), (8000, 0.045), (2000, 0.07)])
def test_a_stuck_encoder_is_found_as_soon_as_its_counts_allow(
    make_bench, profile_of_two, counts, longest
):
    """A reversal within one count may last: 20 ms with 8000 counts a turn.  More is a fault."""
    bench = make_bench(machine(profile_of_two, {"encoder_counts_per_rev": counts}))
    with bench.connected() as group:
        channel = channel_of(group.drives[0], CYCLE, False)
    speed = 4.0 * CYCLE * counts / (2 * np.pi)  # 4 rad/s
    row = 0
    while not channel.is_stuck(round(speed * row)):
        channel.take(INPUT.pack(0x1237, 0, 0))
        row += 1
    assert row * CYCLE <= longest
    if counts < 10_000:
        assert row * CYCLE > 0.03
