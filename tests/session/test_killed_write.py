"""A few random moments of kill -9, with real processes; ``bench_kill.py`` tries 200 of them."""

import os
import signal
import time

import numpy as np
import pytest

from tests.apart import MachineApart, is_download, object_of
from tests.kills import random_moment, tried

pytestmark = pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="no SIGKILL on Windows")
AXES, MOMENTS = 2, 5
MOVING = 0.1
"""rad/s of a motor that moves, for sure."""
STORE_TIME = 0.2


@pytest.fixture
def machine(tmp_path):
    with MachineApart(tmp_path, AXES) as machine:
        yield machine


def test_a_killed_write_leaves_all_drives_old_or_all_new(machine, fresh_rng: np.random.Generator):
    for k in range(MOMENTS):
        moment = random_moment(fresh_rng, AXES, STORE_TIME)
        trial = tried(machine, moment, f"moment-{k}")
        assert trial.fault == "", moment
        assert trial.backup_whole
        assert "mixed" not in (trial.working, trial.stored)


def test_the_check_would_see_a_mixed_machine(machine, fresh_rng: np.random.Generator):
    """Without the restore, drives of which one has taken new values are not all old nor all new."""
    moment = random_moment(fresh_rng, AXES, STORE_TIME)
    machine.set_up(moment.old, store=True)
    session = machine.session("half", moment.new)
    seen = []

    def kill_at_second_drive(message):
        if message.arbitration_id == 0x600 + 12 and message.data[0] >> 5 == 1 and not seen:
            seen.append(message)
            tool.kill()

    machine.bus.on_frame = kill_at_second_drive
    tool = machine.start("write", session, "--yes")
    assert tool.wait().code == -9
    working = machine.working()
    assert working[11][0x2010, 1] == round(moment.new["position_p"] * 1000)
    assert working[12][0x2010, 1] == round(moment.old["position_p"] * 1000)
    machine.bus.on_frame = lambda _: None
    assert machine.run("restore", session).code == 0


@pytest.mark.parametrize("command", ["measure", "check"])
def test_a_killed_measurement_leaves_a_note_and_is_taken_back(machine, command):
    """Feed-forward is off while axes move: no later backup may take that for the machine's own."""
    machine.ask(lambda: [node.dictionary.write(0x2010, 4, 900) for node in machine.nodes])
    before = machine.working()
    syncs = []

    def kill_in_motion(message):
        if message.arbitration_id == 0x80:
            syncs.append(message)
            if len(syncs) == 200:
                tool.kill()

    machine.bus.on_frame = kill_in_motion
    session = machine.folder / "measured"
    out = ("--out", session) if command == "measure" else ()
    tool = machine.start(command, machine.profile, "--yes", *out)
    assert tool.wait().code == -9
    machine.bus.on_frame = lambda _: None
    if command == "check":
        (session,) = (machine.folder / "sessions").iterdir()
    assert machine.working()[11][0x2010, 4] == 0
    assert (session / "parameters-before.yaml").is_file()
    machine.ask(lambda: machine.machine.advance_to(machine.machine.time + 1_000_000_000))
    for node in machine.nodes:
        assert not node.motion.powered, "stopped by its own heartbeat consumer"
        machine.ask(lambda node=node: node.motion.write_controlword(0x80))
    looked = machine.run(
        "measure", machine.profile, "--yes", "--out", machine.folder / f"next-{command}"
    )
    assert looked.code == 3
    assert "a measurement was cut off" in looked.text
    restored = machine.run("restore", session)
    assert restored.code == 0, restored.text
    assert "The measurement that began at" in restored.text
    after = machine.working()
    for node in machine.nodes:
        for key in ((0x2010, 4), (0x6007, 0), (0x1016, 1), (0x1029, 1), (0x60C2, 1)):
            assert after[node.node_id][key] == before[node.node_id][key], key


ONLY_NEW = (
    "from fieldtool.workflow.verifying import Verification as v; v.before = lambda _: None;"
    "from fieldtool.cli.main import main; main()"
)
"""The tool without its trial of the old parameters, which takes its time."""
PDOS = range(0x1400, 0x1C00)
"""What PDOs hold and when they are sent: in working memory alone, and set anew before every motion."""
OLD = {"position_p": 12.0, "velocity_p": 3.0, "velocity_i": 20.0}
NEW = {"position_p": 15.0, "velocity_p": 3.5, "velocity_i": 25.0}


def test_a_tool_that_is_killed_in_the_trial_leaves_drives_that_stop_and_can_be_restored(machine):
    machine.set_up(OLD, store=True)
    before = machine.working()
    seen = {"written": 0, "syncs": 0, "powered": 0}

    def kill_in_trial(message):
        if is_download(message) and object_of(message) == 0x2010:
            seen["written"] += 1
        if message.arbitration_id == 0x80 and seen["written"] and not tool.killed:
            seen["syncs"] += 1
            axes = machine.machine.axes
            speeds = axes.state[axes.plant.size + axes.plant.motors]
            if seen["syncs"] > 50 and np.max(np.abs(speeds)) > MOVING:
                seen["powered"] = sum(node.motion.powered for node in machine.nodes)
                tool.kill()

    machine.bus.on_frame = kill_in_trial
    session = machine.session("tried", NEW)
    tool = machine.start("write", session, "--yes", tool=ONLY_NEW)
    ended = tool.wait()
    assert ended.code == -9, ended.text
    machine.bus.on_frame = lambda _: None
    assert seen["powered"] == AXES, "an axis moved, under power"
    assert machine.working()[11][0x2010, 1] == 15000, "the new ones were on trial"
    machine.ask(lambda: machine.machine.advance_to(machine.machine.time + 1_000_000_000))
    for node in machine.nodes:
        assert not node.motion.powered, "stopped by its own heartbeat consumer"
    restored = machine.run("restore", session)
    assert restored.code == 0, restored.text
    after = machine.working()
    for node in machine.nodes:
        now, then = after[node.node_id], before[node.node_id]
        assert {k for k in now if now[k] != then[k]} <= {k for k in now if k[0] in PDOS}
    assert machine.stored() == before


@pytest.mark.parametrize("moment", ["connecting", "moving"])
def test_a_second_tool_on_the_same_bus_is_refused(machine, moment):
    """At any time, also where nothing is to be heard on the bus; before it sends anything."""
    frames = []

    def hold(message):
        frames.append(message.arbitration_id)
        if (moment == "connecting" or frames.count(0x80) == 200) and not held:
            held.append(len(frames))
            os.kill(first.pid, signal.SIGSTOP)  # in real time it would not bear a busy computer

    held = []
    machine.bus.on_frame = hold
    first = machine.start("measure", machine.profile, "--yes", "--out", machine.folder / "first")
    deadline = time.monotonic() + 60
    while not held:
        assert time.monotonic() < deadline
        time.sleep(0.01)
    time.sleep(0.1)
    sent = len(frames)
    commands = {
        "connecting": (("scan", machine.profile), ("check", machine.profile, "--yes")),
        "moving": (
            ("measure", machine.profile, "--yes", "--out", machine.folder / "second"),
            ("restore", machine.folder / "first"),
        ),
    }
    for words in commands[moment]:
        second = machine.run(*words)
        said = " ".join(second.text.split())
        assert second.code == 3, said
        assert said.count("fieldtool: ") == 1, said
        assert "another fieldtool is at work on" in said
    assert len(frames) == sent, "nothing was sent"
    first.kill()
    first.wait()
    machine.bus.on_frame = lambda _: None
    if moment == "moving":
        machine.ask(lambda: machine.machine.advance_to(machine.machine.time + 1_000_000_000))
        restored = machine.run("restore", machine.folder / "first")
        assert restored.code == 0, restored.text
