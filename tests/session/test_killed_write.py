"""A few random moments of kill -9, with real processes; ``bench_kill.py`` tries 200 of them."""

import numpy as np
import pytest

from tests.apart import MachineApart
from tests.kills import random_moment, tried

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
