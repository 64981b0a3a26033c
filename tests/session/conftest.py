"""A simulated machine on a bus of its own, the tool in front of it, and a second listener."""

import itertools
from collections.abc import Callable, Iterator
from copy import deepcopy
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import can
import numpy as np
import pytest
import yaml

from drives.canopen_drive import connect
from drives.profile import load_machine
from drives.sim.entries import ENTRIES
from drives.sim.faults import Fault
from drives.sim.lockstep_bus import register, unregister
from drives.sim.machine import simulated_machine
from drives.sim.running import RunningMachine
from fieldtool.cli.main import main
from fieldtool.records.recording import Recording, load
from tests.untried import Stood

GAINS = {
    "position_p": 15,
    "velocity_p": 1.2,
    "velocity_i": 8,
    "velocity_ff": 1,
    "velocity_filter": 150,
}
LIMITS = {
    "travel": ["-120 deg", "120 deg"],
    "velocity": "10 rad/s",
    "acceleration": "400 rad/s2",
    "torque": "6 N m",
    "following_error": "30 deg",
}
PROCESS_VALUES = {
    (0x1001, 0),
    *((0x1003, k) for k in range(9)),
    (0x603F, 0),
    (0x6040, 0),
    (0x6041, 0),
    (0x6064, 0),
    (0x606C, 0),
    (0x6071, 0),
    (0x6074, 0),
    (0x6077, 0),
    (0x607A, 0),
    (0x60F4, 0),
}
"""Objects that a motion changes by what it is: targets, actual values, error history."""

AFTER_CENTRING = 6000
"""SYNCs from the start of the sweeps into the first one: the axes are centred and at rest first."""

_numbers = itertools.count()


def axis(name: str, node_id: int, masses: list[float], springs: list[float]) -> dict[str, Any]:
    return {
        "name": name,
        "kind": "rotary",
        "node_id": node_id,
        "drive": "reference",
        "may_float": True,
        "limits": deepcopy(LIMITS),
        "prior": {
            "masses": list(masses),
            "springs": list(springs),
            "dampers": [0.02] * len(springs),
            "viscous_friction": 0.01,
        },
    }


def simulated(masses: list[float], springs: list[float]) -> dict[str, Any]:
    return {
        "masses": list(masses),
        "springs": list(springs),
        "dampers": [0.03] * len(springs),
        "viscous_friction": 0.02,
        "rated_torque": 4,
        "peak_torque": 12,
        "torque_noise": 0.004,
        "gains": dict(GAINS),
    }


def one_axis() -> dict[str, Any]:
    """An elastic table of two masses."""
    return {
        "format": "fieldtool-machine/1",
        "name": "bench",
        "bus": {"interface": "fieldsim", "channel": "?", "bitrate": 1_000_000},
        "axes": [axis("table", 11, [0.02, 0.025], [190])],
        "simulation": {"seed": 7, "axes": [simulated([0.02, 0.03], [190])]},
    }


def two_axes() -> dict[str, Any]:
    """The table, and a rigid arm coupled with it."""
    machine = one_axis()
    machine["axes"].append(axis("arm", 12, [0.04], []))
    machine["couplings"] = [{"axes": ["table", "arm"], "value": 0.006}]
    machine["simulation"]["axes"].append(simulated([0.04], []))
    machine["simulation"]["couplings"] = [{"axes": ["table", "arm"], "value": 0.009}]
    return machine


def _as_on_the_wire(value: Any) -> Any:
    return float(np.float32(value)) if isinstance(value, float) else value


@dataclass(frozen=True)
class Outcome:
    """What a command came to."""

    code: int
    out: str
    err: str


@dataclass(frozen=True)
class Frame:
    """A frame that the listener heard; ``sync`` counts the SYNCs before it."""

    sync: int
    cob_id: int
    data: bytes


class Bench:
    """A profile as a file, its simulated machine, and the command line in front of it."""

    def __init__(
        self,
        folder: Path,
        profile: dict[str, Any],
        objects: dict[int, dict[tuple[int, int], Any]],
        capsys: pytest.CaptureFixture[str],
        monkeypatch: pytest.MonkeyPatch,
        **drive_changes: Any,
    ) -> None:
        self.folder, self._capsys = folder, capsys
        self.channel = f"bench-{next(_numbers)}"
        profile["bus"]["channel"] = self.channel
        self.profile = folder / f"{self.channel}.yaml"
        self.rewrite(profile)
        described = simulated_machine(load_machine(self.profile))
        drives = tuple(
            replace(d, objects=objects.get(d.node_id, {}), **drive_changes)
            for d in described.drives
        )
        self.machine: RunningMachine = register(self.channel, replace(described, drives=drives))
        self.before = self.objects()
        self._listener: can.BusABC | None = None
        self.in_sweep: list[tuple[Fault, int]] = []
        """Faults, and so many SYNCs after the middle of the first sweep they come."""
        self._sweeps_began: int | None = None
        self._watch_for_sweeps(monkeypatch)

    def _watch_for_sweeps(self, monkeypatch: pytest.MonkeyPatch) -> None:
        from fieldtool.workflow import measuring

        run_plan = measuring.run_plan

        def noting(*arguments: Any) -> float:
            if self._sweeps_began is None:
                self._sweeps_began = self.machine.sync_count
                for fault, after in self.in_sweep:
                    self.machine.inject(fault, at_sync=self.mid_sweep + after)
            return run_plan(*arguments)

        monkeypatch.setattr(measuring, "run_plan", noting)

    @property
    def mid_sweep(self) -> int:
        """Number of a SYNC in the middle of the first sweep, once the sweeps have begun."""
        assert self._sweeps_began is not None, "it did not come as far as the first sweep"
        return self._sweeps_began + AFTER_CENTRING

    @property
    def sweeps(self) -> bool:
        """Whether the middle of the first sweep has come."""
        return self._sweeps_began is not None and self.machine.sync_count >= self.mid_sweep

    def rewrite(self, profile: dict[str, Any]) -> None:
        self.data = profile
        self.profile.write_text(yaml.safe_dump(profile, sort_keys=False), encoding="utf-8")

    # -- the tool ---------------------------------------------------------------------------------

    @property
    def out(self) -> Path:
        return self.folder / "session"

    def command(self, *arguments: object) -> Outcome:
        """Run a command in this process; nobody is there to be asked, so motion is agreed to before."""
        self._capsys.readouterr()
        words = [str(a) for a in arguments]
        if words[0] in ("measure", "run") and not {"--yes", "--write"} & set(words):
            words.append("--yes")
        with pytest.raises(SystemExit) as ended:
            main(words)
        captured = self._capsys.readouterr()
        code = ended.value.code
        outcome = Outcome(code if isinstance(code, int) else 0, captured.out, captured.err)
        assert "Traceback" not in outcome.err + outcome.out, outcome.err
        assert "defect of fieldtool" not in outcome.err, outcome.err
        return outcome

    def measure(self, *options: str, plan: str = "classic") -> Outcome:
        return self.command("measure", self.profile, "--plan", plan, "--out", self.out, *options)

    def run(self, *options: str, plan: str = "classic") -> Outcome:
        return self.command("run", self.profile, "--plan", plan, "--out", self.out, *options)

    def connected(self, stop: Callable[[], bool] = lambda: False) -> Any:
        return connect(load_machine(self.profile), stop_requested=stop)

    def recording(self) -> Recording:
        return load(self.out / "recording.h5")

    # -- the machine ------------------------------------------------------------------------------

    def inject(self, fault: Fault, sync: int | None = None) -> None:
        self.machine.inject(fault, at_sync=sync)

    def powered(self) -> dict[int, str]:
        """Return the power state of every node whose power stage is on."""
        return {n.node_id: n.motion.state.name for n in self.machine.nodes if n.motion.powered}

    def objects(self) -> dict[int, dict[tuple[int, int], Any]]:
        """Return every object of every node, but for what a motion changes by what it is."""
        return {
            node.node_id: {
                key: _as_on_the_wire(node.dictionary.read(*key))
                for key, entry in ENTRIES.items()
                if entry.access != "wo" and key not in PROCESS_VALUES
            }
            for node in self.machine.nodes
        }

    def changed(self, *without: int) -> dict[int, dict[str, tuple[Any, Any]]]:
        """Return what is not as it was when the machine was made, by node, as (was, is)."""
        now = self.objects()
        return {
            node_id: different
            for node_id, was in self.before.items()
            if node_id not in without
            and (
                different := {
                    f"0x{key[0]:04X}:{key[1]:02X}": (was[key], now[node_id][key])
                    for key in was
                    if was[key] != now[node_id][key]
                }
            )
        }

    def stored(self) -> dict[int, dict[tuple[int, int], Any]]:
        return {n.node_id: n.memory.stored for n in self.machine.nodes}

    # -- the listener -----------------------------------------------------------------------------

    def listen(self) -> None:
        """Hear all frames from now on, as a second adapter on the bus would."""
        self._listener = can.Bus(interface="fieldsim", channel=self.channel)

    def heard(self) -> list[Frame]:
        """Return the frames heard so far, and stop listening."""
        assert self._listener is not None
        frames, syncs = [], 0
        while (message := self._listener.recv(0.0)) is not None:
            syncs += message.arbitration_id == 0x80
            frames.append(Frame(syncs, message.arbitration_id, bytes(message.data)))
        self.close()
        return frames

    def close(self) -> None:
        if self._listener is not None:
            self._listener.shutdown()
            self._listener = None


MakeBench = Callable[..., Bench]


@pytest.fixture
def make_bench(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> Iterator[MakeBench]:
    """Make a bench of a profile (plain values); ``objects``: factory values by node and key."""
    benches: list[Bench] = []

    def make(
        profile: dict[str, Any] | None = None,
        objects: dict[int, dict[tuple[int, int], Any]] | None = None,
        **drive_changes: Any,
    ) -> Bench:
        bench = Bench(
            tmp_path, profile or two_axes(), objects or {}, capsys, monkeypatch, **drive_changes
        )
        benches.append(bench)
        return bench

    yield make
    for bench in benches:
        bench.close()
        unregister(bench.channel)


@pytest.fixture
def bench(make_bench: MakeBench) -> Bench:
    """Two coupled axes."""
    return make_bench()


@pytest.fixture
def small_bench(make_bench: MakeBench) -> Bench:
    """One axis: quick."""
    return make_bench(one_axis())


@pytest.fixture
def profile_of_two() -> dict[str, Any]:
    return two_axes()


@pytest.fixture
def profile_of_one() -> dict[str, Any]:
    return one_axis()


@pytest.fixture
def untried(monkeypatch: pytest.MonkeyPatch) -> None:
    """Writes that are not tried on the machine: for tests of the write itself."""
    monkeypatch.setattr("fieldtool.workflow.writing.Verification", Stood)


@pytest.fixture
def quick_plan(monkeypatch: pytest.MonkeyPatch) -> None:
    """A coarser first pass: enough for one chain of two masses, in a third of the time."""
    monkeypatch.setattr("fieldtool.experiment.stepped.design.GRID_RATIO", 1.25)
    monkeypatch.setattr("fieldtool.experiment.stepped.design.HIGH_TONES", 4)
