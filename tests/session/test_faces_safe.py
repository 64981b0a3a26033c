"""Makers' drives: what stops them when the host dies, and what `fieldtool check --move` finds."""

import json
import math
from pathlib import Path

import numpy as np
import pytest

from drives.canopen_drive import connect
from drives.canopen_drive.setup import HOST_HEARTBEAT, HOST_LOST_AFTER
from drives.errors import DriveFaultError, SafetyStopError
from drives.sim.drive_faults import TorqueScaleWrong
from drives.sim.emergency import HEARTBEAT_LOST, ErrorRegister
from drives.sim.faults import MotorReversed
from drives.sim.host_faults import HostKilled
from drives.sim.running import RunningMachine
from drives.sim.state_machine import State
from fieldtool.cli.main import main
from fieldtool.workflow.fast_measuring import plan
from tests.faces import machine_of, simulated

TABLE = 11
CYCLE = 0.002
ROWS, DEAD_AFTER = 50, 500
"""Of a block; and cycles in motion after which the host is killed."""
LOOK = 0.001
"""Virtual seconds between two looks at the drives."""
SETTLED, LEFT = 6.0, 0.05
"""Virtual seconds after which friction has left so much of an axis' speed at most whose power is off."""
PAIRS = {
    "epos4": ("epos4", "epos4-dual-loop"),
    "novanta": ("novanta*", "epos4"),
    "copley": ("copley*", "novanta*"),
}
"""A star: the packaged profile with its unknown facts filled in."""
STOPS_AS = {
    "epos4": ["OPERATION_ENABLED", "FAULT_REACTION_ACTIVE", "FAULT"],
    "novanta": ["OPERATION_ENABLED", "QUICK_STOP_ACTIVE", "SWITCH_ON_DISABLED"],
}
"""The states that a drive goes through by itself; an EPOS4's lost heartbeat is a fault."""


class Watched:
    """What the drives really do from the moment on at which their host is gone."""

    def __init__(self, running: RunningMachine) -> None:
        self.running, self.killed = running, running.now
        self.states: dict[int, list[tuple[float, str]]] = {n.node_id: [] for n in running.nodes}
        self.speed_then = self.speeds()
        self._look()

    def speeds(self) -> list[float]:
        """Of the motors, rad/s."""
        axes = self.running.axes
        return [float(axes.state[axes.plant.size + m]) for m in axes.plant.motors]

    def _look(self) -> None:
        for node in self.running.nodes:
            seen, state = self.states[node.node_id], node.motion.state.name
            if not seen or seen[-1][1] != state:
                seen.append((self.running.scheduler.now / 1e9 - self.killed, state))
        self.running.scheduler.add(LOOK, self._look)


def killed_in_motion(machine, running: RunningMachine, before=lambda: None) -> Watched:
    """Let both axes swing, and nothing of the host reach the bus from the middle of it on."""
    watched: list[Watched] = []
    rows = 0

    def source(_):
        nonlocal rows
        if rows == DEAD_AFTER:
            before()
            running.inject(HostKilled())
            watched.append(Watched(running))
        t = CYCLE * (rows + np.arange(ROWS))
        rows += ROWS
        return start + 0.05 * np.sin(6 * t)[:, None]

    with (
        connect(machine) as group,
        pytest.raises(SafetyStopError, match="sent no PDO"),
        group.motion(CYCLE) as motion,
    ):
        start = motion.position
        motion.stream(source)
    running.advance_to(running.time + round(SETTLED * 1e9))
    return watched[0]


@pytest.mark.parametrize("pair", PAIRS)
def test_a_killed_host_stops_makers_drives_by_their_own_heartbeat_consumer(pair, tmp_path):
    machine = machine_of(PAIRS[pair], tmp_path)
    with simulated(machine) as running:
        watched = killed_in_motion(machine, running)
        assert all(abs(speed) > 0.05 for speed in watched.speed_then), "it was in motion"
        for node, face in zip(running.nodes, PAIRS[pair], strict=True):
            seen = watched.states[node.node_id]
            kind = "epos4" if face.startswith("epos4") else "novanta"
            assert [state for _, state in seen] == STOPS_AS[kind], face
            # the last heartbeat came before the kill, by one period at most
            assert seen[1][0] >= HOST_LOST_AFTER - HOST_HEARTBEAT - CYCLE, face
            assert seen[1][0] <= HOST_LOST_AFTER + 2 * LOOK, face
            assert node.emergency.active == (HEARTBEAT_LOST,), face
            assert not node.motion.powered, face
        for speed, then in zip(watched.speeds(), watched.speed_then, strict=True):
            assert abs(speed) < LEFT * abs(then)


@pytest.mark.parametrize("face", ["epos4", "novanta*", "copley*"])
def test_nothing_else_would_stop_them(face, tmp_path):
    """The other test has something to find: with its consumer taken away, a drive stays enabled."""
    machine = machine_of((face, "reference"), tmp_path)
    with simulated(machine) as running:
        table, arm = running.nodes
        watched = killed_in_motion(machine, running, lambda: table.dictionary.write(0x1016, 1, 0))
        assert [state for _, state in watched.states[TABLE]] == ["OPERATION_ENABLED"]
        assert table.motion.powered
        assert not arm.motion.powered


# --- fieldtool check --move -----------------------------------------------------------------------


def checked(profile: Path, capsys) -> tuple[int, dict[tuple[str | None, str], dict]]:
    """Return the exit code of a check with motion, and what it found by axis and check."""
    capsys.readouterr()
    with pytest.raises(SystemExit) as ended:
        main(["check", str(profile), "--move", "--json"])
    found = json.loads(capsys.readouterr().out)["findings"]
    return int(ended.value.code or 0), {(f["axis"], f["check"]): f for f in found}


def objects(running: RunningMachine) -> list[dict[tuple[int, int], object]]:
    """What every drive holds: all that it would keep."""
    return [dict(node.dictionary.parameters()) for node in running.nodes]


@pytest.mark.parametrize("pair", [("epos4", "novanta*"), ("copley*", "epos4-dual-loop")])
def test_a_check_passes_on_makers_drives_and_leaves_them_as_they_were(pair, tmp_path, capsys):
    machine = machine_of(pair, tmp_path)
    with simulated(machine) as running:
        before = objects(running)
        code, found = checked(machine.path, capsys)
        assert code == 0
        assert {key: f["found"] for key, f in found.items() if f["status"] != "pass"} == {}
        assert {("table", "direction"), ("arm", "direction")} <= found.keys()
        assert running.sync_count > 1000
        assert objects(running) == before
        assert not any(n.motion.powered for n in running.nodes)


@pytest.mark.parametrize(
    ("fault", "words", "farthest"),
    [
        (MotorReversed, "while it was told to stand still; its power was cut", math.radians(2)),
        (
            lambda node: TorqueScaleWrong(node, -1.0),
            "the torque that starts a positive move is negative",
            math.radians(5),
        ),
    ],
    ids=["motor reversed", "torque's sign"],
)
@pytest.mark.parametrize("face", ["epos4", "novanta*", "copley*"])
def test_a_wrong_sign_is_found_on_makers_drives(face, fault, words, farthest, tmp_path, capsys):
    machine = machine_of((face, "reference"), tmp_path)
    with simulated(machine) as running:
        before = objects(running)
        axes = running.axes
        motor, most = axes.plant.motors[0], 0.0

        def look() -> None:
            nonlocal most
            most = max(most, abs(float(axes.state[motor])))
            running.scheduler.add(LOOK, look)

        look()
        running.inject(fault(TABLE))
        code, found = checked(machine.path, capsys)
        assert code == 4
        assert found["table", "direction"]["status"] == "fail"
        assert words in found["table", "direction"]["found"]
        assert found["arm", "direction"]["status"] != "fail"
        assert most < farthest
        assert objects(running) == before
        assert not any(n.motion.powered for n in running.nodes)


# --- faults that a lost host left behind ----------------------------------------------------------


def test_a_reset_fault_is_told_where_a_later_axis_is_refused(tmp_path):
    machine = machine_of(("reference", "reference"), tmp_path)
    with simulated(machine) as running:
        lost, hot = running.nodes
        lost.motion.fault(HEARTBEAT_LOST, ErrorRegister.COMMUNICATION)
        hot.motion.fault(0x4310, ErrorRegister.TEMPERATURE)
        with pytest.raises(DriveFaultError, match="0x4310") as refused, connect(machine):
            pass
        assert [note for note in refused.value.__notes__ if "The fault was reset" in note]


def test_a_plan_resets_no_fault(tmp_path):
    machine = machine_of(("reference", "reference"), tmp_path)
    with simulated(machine) as running:
        lost, other = running.nodes
        lost.motion.fault(HEARTBEAT_LOST, ErrorRegister.COMMUNICATION)
        assert plan(machine).duration > 0
        assert lost.motion.state is State.FAULT
        other.motion.fault(0x4310, ErrorRegister.TEMPERATURE)
        with pytest.raises(DriveFaultError, match="0x4310"):
            plan(machine)
