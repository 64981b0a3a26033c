"""SYNCs that come a little late: drives have their reference at rest by then, and torques show it."""

from dataclasses import replace
from pathlib import Path
from unittest.mock import patch

import numpy as np
import pytest

from drives.canopen_drive import connect
from drives.canopen_drive.sync import HostSync
from drives.errors import SafetyStopError
from drives.profile import load_machine
from drives.sim.faults import MotorReversed
from drives.sim.lockstep_bus import register, unregister
from drives.sim.machine import simulated_machine
from fieldtool.experiment.verification.trial import run_trial
from tests.late_syncs import giving_late
from tests.session.test_trial import Gains, axes_of, move, trial

MACHINE = Path(__file__).parents[1] / "socketcan" / "machine.yaml"
CHANNEL = "late-sync"
SECONDS = 8.0


@pytest.fixture
def machine():
    read = load_machine(MACHINE)
    bus = read.bus.model_copy(
        update={"interface": "fieldsim", "channel": CHANNEL, "shortest_cycle": 0.001}
    )
    yield read.model_copy(update={"bus": bus})
    unregister(CHANNEL)


def wobbling(group, rng, mean):
    """Let one SYNC in three come late, by this mean time, s."""
    bus = group.line.can_bus
    send = bus.send

    def late(message, timeout=None):
        if message.arbitration_id == 0x080 and rng.random() < 0.3:
            bus.clock.wait_until(bus.clock.now() + rng.exponential(mean))
        send(message, timeout)

    bus.send = late


def sines(start, cycle, at=None, then=lambda: None):
    """Return a source of gentle sines, which does something at a row."""
    rows = round(0.1 / cycle)
    done = 0

    def source(_before):
        nonlocal done
        if at is not None and done <= at < done + rows:
            then()
        if done * cycle >= SECONDS:
            return None
        t = cycle * (done + np.arange(rows))
        done += rows
        return start + (0.1 * np.sin(2 * t))[:, None] * np.ones(start.size)

    return source


@pytest.mark.parametrize("cycle", [0.02, 0.01, 0.005])
@pytest.mark.parametrize("share", [0.01, 0.05])
def test_late_syncs_are_no_reversed_motor(machine, fresh_rng, cycle, share):
    register(CHANNEL, simulated_machine(machine))
    with connect(machine) as group, group.motion(cycle) as motion:
        wobbling(group, fresh_rng, share * cycle)
        capture = motion.stream(sines(motion.position, cycle))
    assert capture.rows == round(SECONDS / cycle)


@pytest.mark.parametrize("cycle", [0.02, 0.01, 0.005])
def test_and_hide_none(machine, fresh_rng, cycle):
    running = register(CHANNEL, simulated_machine(machine))
    node = int(fresh_rng.choice([11, 12]))
    begun = []

    def reverse():
        running.inject(MotorReversed(node))
        begun.append(running.now)

    with (
        pytest.raises(SafetyStopError),
        connect(machine) as group,
        group.motion(cycle) as motion,
    ):
        wobbling(group, fresh_rng, 0.05 * cycle)
        at = int(fresh_rng.integers(1.0 / cycle, 6.0 / cycle))
        try:
            motion.stream(sines(motion.position, cycle, at, reverse))
        finally:
            taken = running.now - begun[0]
    assert taken < 0.7  # up to 0.3 s of targets were on their way to the drives before


STEP = 0.01
FED = np.array([[40.0, 80.0], [0.0, 0.0]])
"""What the loops of the machine feed forward."""


def late_by(rng, mean):
    """Have one SYNC in three come late by this mean time, s, and those after it in time again."""

    def seconds(cycle):
        return min(rng.exponential(mean), 0.2 * cycle) if rng.random() < 0.3 else 0.0

    return patch.object(HostSync, "give", giving_late(seconds))


def slow_trial():
    """Each axis by 0.5 rad out and back, at up to 1.2 rad/s."""
    with patch("tests.session.test_trial.STEP", STEP):
        moves = (move(0, 0.5, 0.8, [60.0, 60.0]), move(1, -0.5, 0.8, [40.0, 160.0]))
    return replace(trial(), cycle_time=STEP, moves=moves)


def try_late(machine, rng, fed, before=lambda _: None):
    running = register(CHANNEL, simulated_machine(machine))
    kept = []
    with connect(machine) as group, late_by(rng, 0.06 * STEP):
        before(running)
        run_trial(
            group, slow_trial(), axes_of(group), kept.append, "before", trusts_loops=True, fed=fed
        )
    return kept


def test_a_trial_stands_late_syncs(machine, fresh_rng):
    kept = try_late(machine, fresh_rng, FED)
    assert [e.name for e in kept] == ["before: move of table", "before: move of arm"]


def test_it_would_not_without_leaving_out_what_drives_do_then(machine, fresh_rng):
    """What the test above is worth."""
    with pytest.raises(SafetyStopError, match="oscillates at about"):
        try_late(machine, fresh_rng, None)


def test_late_syncs_hide_no_loop_that_swings(machine, fresh_rng):
    node = int(fresh_rng.choice([11, 12]))
    with pytest.raises(SafetyStopError, match=r"oscillates|runs away or swings|its torque went"):
        try_late(machine, fresh_rng, FED, lambda running: running.inject(Gains(node, factor=25.0)))
