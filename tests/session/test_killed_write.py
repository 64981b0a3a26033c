"""A few random moments of kill -9, with real processes; ``bench_kill.py`` tries 200 of them."""

import signal

import numpy as np
import pytest

from tests.apart import MachineApart
from tests.kills import random_moment, tried

pytestmark = pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="no SIGKILL on Windows")
AXES, MOMENTS = 2, 5
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


def test_a_killed_measurement_leaves_a_note_and_is_taken_back(machine):
    """Feed-forward is off while it runs: no later backup may take that for the machine's own."""
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
    tool = machine.start("measure", machine.profile, "--yes", "--out", session)
    assert tool.wait().code == -9
    machine.bus.on_frame = lambda _: None
    assert machine.working()[11][0x2010, 4] == 0
    assert (session / "parameters-before.yaml").is_file()
    machine.ask(lambda: machine.machine.advance_to(machine.machine.time + 1_000_000_000))
    for node in machine.nodes:
        assert not node.motion.powered, "stopped by its own heartbeat consumer"
        machine.ask(lambda node=node: node.motion.write_controlword(0x80))
    looked = machine.run("measure", machine.profile, "--yes", "--out", machine.folder / "next")
    assert looked.code == 3
    assert "a measurement was cut off" in looked.text
    restored = machine.run("restore", session)
    assert restored.code == 0, restored.text
    assert "The measurement that began at" in restored.text
    after = machine.working()
    for node in machine.nodes:
        for key in ((0x2010, 4), (0x6007, 0), (0x1016, 1), (0x1029, 1), (0x60C2, 1)):
            assert after[node.node_id][key] == before[node.node_id][key], key
