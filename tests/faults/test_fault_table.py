"""The fault table through the bus: no traceback, drives safe, data kept, right code, right words.

A third of the table is tried in each run, chosen by a seed that is printed, and everything that went
wrong once.  ``python -m tests.benchmarks faults`` tries and prints the whole table.
"""

import os
import re

import numpy as np
import pytest

from drives.sim.emergency import HEARTBEAT_LOST, ErrorRegister
from drives.sim.faults import SdoRefused
from drives.sim.host_faults import BusOff
from drives.sim.state_machine import State
from tests.faults.bench import ARM, Bench, Moment, command, try_case
from tests.faults.clairvoyant import HELD
from tests.faults.table import EPOS4_CASES, ROWS, Row, problems, try_row, with_epos4
from tests.seeds import fresh_seed

WENT_WRONG_ONCE = {
    ("encoder stuck", Moment.STILL),
    ("motor reversed", Moment.SWEEP),
    ("mode changes, to profile position", Moment.SWEEP),
    ("mode changes, to cyclic torque", Moment.SWEEP),
    ("stranger: targets", Moment.SWEEP),
    ("stranger: the host's heartbeat", Moment.STILL),
    ("stranger: NMT reset", Moment.WRITE),
    ("SDO answers late, twice", Moment.STILL),
    ("SDO answer: other index", Moment.WRITE),
    ("PDO late for good", Moment.CONNECTING),
    ("statusword frozen", Moment.SWEEP),
    ("torque scale times ten", Moment.CONNECTING),
    ("torque scale by ten", Moment.SWEEP),
    ("node id twice", Moment.CONNECTING),
    ("node id twice", Moment.SWEEP),
}
"""What the tool did wrong when it was tried first."""
RESET = (
    "arm: was in fault 0x8130 because it lost its host: an earlier session ended without a word. The "
    "fault was reset (communication reset)."
)
SEED = int(os.environ.get("FAULT_SEED", fresh_seed()))
CASES = [(row, moment) for row in ROWS for moment in Moment]


def _chosen() -> list[tuple[Row, Moment]]:
    take = np.random.default_rng(SEED).random(len(CASES)) < 1 / 3
    return [
        (row, moment)
        for (row, moment), taken in zip(CASES, take, strict=True)
        if taken or (row.name, moment) in WENT_WRONG_ONCE
    ]


def test_the_table_is_whole():
    names = [row.name for row in ROWS]
    assert len(set(names)) == len(names) >= 30
    assert {name for name, _ in WENT_WRONG_ONCE} <= set(names)
    epos4 = [(row, moment) for row, moments in EPOS4_CASES for moment in moments]
    assert len({row.name for row, _ in epos4}) == len(EPOS4_CASES)
    for row, moment in CASES + epos4:
        expected = row.expected(moment)
        assert expected.says or expected.why, f"{row.name}, {moment.value}: why is it harmless?"


@pytest.mark.parametrize("part", range(6))
def test_faults_end_well_at_every_moment(part):
    print(f"FAULT_SEED={SEED}")
    wrong = []
    for row, moment in _chosen()[part::6]:
        result = try_row(row, moment)
        wrong += [
            f"{row.name}, {moment.value}: {problem}\n    {result.said[:600]}"
            for problem in problems(result, row.expected(moment), moment)
        ]
    assert not wrong, "\n".join(wrong)


@pytest.mark.parametrize("part", range(3))
def test_faults_of_an_epos4_end_well_too(part):
    """In its own objects and its own ways: as many cases as show them."""
    wrong = []
    for row, moments in EPOS4_CASES[part::3]:
        for moment in moments:
            result, expected = try_row(row, moment), row.expected(moment)
            wrong += [
                f"{row.name}, {moment.value}: {problem}\n    {result.said[:600]}"
                for problem in problems(result, expected, moment)
            ]
    assert not wrong, "\n".join(wrong)


def test_an_epos4_that_lost_its_host_moves_again_after_a_restore(tmp_path):
    """Its fault reset works only after an NMT reset, which the next motion sends by itself."""
    fault = BusOff()
    with Bench(tmp_path, Moment.STILL, lambda _: (fault,), profile=with_epos4()) as bench:
        assert command("measure", bench.profile, "--yes", "--out", bench.out)[0] == 4
        arm = bench.machine.node(ARM).motion
        bench.machine.advance_to(bench.machine.time + 10**9)
        assert (arm.state, arm.reset_blocked) == (State.FAULT, True)
        bench.machine.lift(fault)
        code, said = command("restore", bench.out)
        assert code == 0, said
        no_consumer = SdoRefused(ARM, 0x1016, 1)
        bench.machine.inject(no_consumer)
        code, said = command("measure", bench.profile, "--yes", "--out", tmp_path / "next")
        assert (code, RESET in said) == (3, True), said  # told, whatever comes after it
        assert arm.state is State.SWITCH_ON_DISABLED
        bench.machine.lift(no_consumer)
        arm.fault(HEARTBEAT_LOST, ErrorRegister.COMMUNICATION)
        arm.reset_blocked = True
        code, said = command("check", bench.profile, "--move")
        assert (code, RESET in said) == (0, True), said
        assert "fail" not in said
        assert bench._all_changed() == {}
        assert not any(n.motion.powered for n in bench.machine.nodes)


def test_a_motor_that_reverses_in_motion_is_stopped_whenever_it_does(fresh_rng):
    """Where it was fast, its torque limit may be sooner than what its energy proves."""
    row = next(row for row in ROWS if row.name == "motor reversed")
    for moving in fresh_rng.integers(60, 3000, 4):  # changes of targets: into the pilot, and beyond
        result = try_case(Moment.SWEEP, row.make, factor=row.factor, moving=int(moving))
        assert result.code == 4, (moving, result.said)
        assert result.cycles() <= 81, moving
        assert re.search("arm: .*(moves? the wrong way)", result.said), (moving, result.said)


def test_the_clairvoyant_is_sooner_than_the_tool_and_sees_nothing_where_nothing_is():
    row = next(row for row in ROWS if row.name == "motor reversed")
    result = try_row(row, Moment.SWEEP)
    assert result.best is not None
    assert result.best.visible is not None
    assert result.best.decided is not None
    assert 1 <= result.best.visible <= result.best.decided <= result.cycles()
    for factor in (-1.0, HELD):
        sound = try_case(Moment.SWEEP, lambda _: (), factor=factor)
        assert sound.code == 0
        assert sound.best is not None
        assert sound.best.decided is None, factor
