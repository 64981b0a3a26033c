"""One fault at one moment: the whole tool on a simulated machine, judged by the simulator's own truth.

The moments are found by what happens on the bus and in the drives, never by wall time.  Nothing of
the tool is replaced but the trial of written parameters, which would move axes for half a minute before
the write: a case is a command as a user gives it.
"""

import contextlib
import io
import os
import re
import struct
import sys
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from enum import Enum
from itertools import count
from pathlib import Path
from typing import Any
from unittest.mock import patch

import yaml

from drives.profile import load_machine
from drives.sim.dictionary import Key
from drives.sim.faults import Fault
from drives.sim.lockstep_bus import register, unregister
from drives.sim.machine import simulated_machine
from drives.sim.node import DriveNode
from drives.sim.running import RunningMachine
from drives.sim.state_machine import State
from fieldtool.cli.main import main
from fieldtool.errors import FieldtoolError
from fieldtool.records.recording import load
from tests.faults.clairvoyant import Received, Verdict, verdict
from tests.session.conftest import PROCESS_VALUES, two_axes
from tests.untried import Stood

TABLE, ARM = 11, 12
NAMES = {TABLE: "table", ARM: "arm"}
BITRATE = 500_000
"""Slow, so that the cycle is long and a case short."""
TUNING = {"velocity_p": 2.0, "velocity_i": 16.0, "position_p": 20.0}
"""What is written, to any drive."""
COEFFICIENT = {"epos4-dual-loop": {"main_filter_a": 1.5}}
"""And, by kind, what such a drive works with only once its latch was set."""
LATCHES = {"epos4-dual-loop": ((0x30AE, 0x40), (0x30AE, 0x10))}
"""By kind: latch and coefficient."""
GAINS: dict[str, dict[Key, int]] = {
    "reference": {(0x2010, 1): 20_000, (0x2010, 2): 2000, (0x2010, 3): 16_000},
    "epos4": {(0x30A1, 1): 560_000_000, (0x30A1, 2): 3_200_000_000, (0x30A1, 3): 20_000_000},
    "epos4-dual-loop": {
        (0x30AE, 0x10): 1500,
        (0x30AE, 0x01): 20_000,
        (0x30AE, 0x02): 20_000,
        (0x30AE, 0x20): 20_000_000,
        (0x30AE, 0x21): 160_000_000,
    },
}
"""What it comes to in drives of each kind, raw.  An EPOS4's PID is P = 2 * 20 + 16 N m/rad,
I = 20 * 16 N m/(rad s), D = 2 N m s/rad, in uA of a motor of 0.1 N m/A; with two loops both position
gains are written."""
REQUESTS, STILL_SYNCS, MOVING_SYNCS, WRITES = 3, 40, 60, 2
"""Requests of a node while connecting, SYNCs under power, changes of targets in the pilot, and gains
written to a node, until the fault comes."""
PATIENCE = 2.0
"""Virtual seconds after the command's end within which everything must be off."""
LONGEST = 120.0
"""Virtual seconds that a command may take: more is a hang."""
MOST_FRAMES = 400_000
"""Frames that the host may send in a command."""
POLL = 0.001
"""Virtual seconds between two looks at the drives."""


class Moment(Enum):
    """When the fault comes."""

    CONNECTING = "connecting"
    STILL = "enabled and still"
    SWEEP = "mid-sweep"
    WRITE = "mid-write"


class HangError(AssertionError):
    """The tool does not end."""


@dataclass
class Watch:
    """What the drives really did since the fault."""

    fault_time: float | None = None
    powered_then: frozenset[int] = frozenset()
    positions_then: dict[int, float] = field(default_factory=dict)
    reacted: dict[int, float] = field(default_factory=dict)
    """By node: seconds after the fault at which it had left operation enabled."""
    off: dict[int, float] = field(default_factory=dict)
    """By node: seconds after the fault at which its power stage was off."""
    unseen: dict[int, float] = field(default_factory=dict)
    """By node: how far its motor was from where it was when it had left operation enabled, rad."""
    farthest: dict[int, float] = field(default_factory=dict)
    """By node: how far the motor went from where it was, rad."""


@dataclass(frozen=True)
class Result:
    """What a case came to."""

    code: int
    said: str
    """Everything on standard error, in one line."""
    period: float
    """Cycle time, s."""
    watch: Watch
    rows: tuple[int, ...]
    """Rows of each recorded experiment, in order."""
    complete: tuple[bool, ...]
    changed: Mapping[int, Mapping[str, tuple[Any, Any]]]
    """By node and object: what is not as it was before, as (was, is), but for the gains."""
    gains: Mapping[int, str]
    """By node: old, new or mixed."""
    stored: Mapping[int, str]
    """By node: what a power cycle would bring: old, new or mixed."""
    still_on: tuple[int, ...]
    """Nodes whose power stage was on at the end."""
    enabled_again: bool
    """Whether a drive was enabled again after all had reacted."""
    restored: str
    """What was wrong with `fieldtool restore`, where something was left to be put back; else empty."""
    not_acting: Mapping[int, tuple[Any, Any]] = field(default_factory=dict)
    """By node: a coefficient that the drive holds and does not work with, as (works with, holds)."""
    best: Verdict | None = None
    """When somebody who knows all of the machine could have known; None where it was not asked."""

    def cycles(self, *without: int) -> float:
        """Cycles until every drive that was on had left operation enabled."""
        times = [t for node, t in self.watch.reacted.items() if node not in without]
        return max(times, default=0.0) / self.period


class Bench:
    """A machine of two coupled axes, the command line in front of it, and one fault to come."""

    def __init__(
        self,
        folder: Path,
        moment: Moment,
        faults: Callable[[int], tuple[Fault, ...]],
        node: int = ARM,
        profile: dict[str, Any] | None = None,
        objects: Mapping[int, Mapping[tuple[int, int], Any]] | None = None,
        factor: float | None = None,
        moving: int = MOVING_SYNCS,
        writing: Key | None = None,
    ) -> None:
        self.folder, self.moment, self.node = folder, moment, node
        self._moving_syncs = moving
        self._writing = writing
        self._faults = faults(node)
        self.channel = f"fault-{next(_numbers)}"
        profile = profile or two_axes()
        profile["bus"] |= {"channel": self.channel, "bitrate": BITRATE}
        self.profile = folder / "bench.yaml"
        self.profile.write_text(yaml.safe_dump(profile, sort_keys=False), encoding="utf-8")
        described = simulated_machine(load_machine(self.profile))
        drives = tuple(
            replace(d, objects=dict((objects or {}).get(d.node_id, {}))) for d in described.drives
        )
        self.machine: RunningMachine = register(self.channel, replace(described, drives=drives))
        self._gains = {n.node_id: GAINS[n.face.name] for n in self.machine.nodes}
        self.before = {n.node_id: self._objects(n) for n in self.machine.nodes}
        self._acting: dict[int, Any] = {}
        for one in self.machine.nodes:
            self._watch_filter(one)
        self._factor = factor
        self._received = Received(self.machine) if factor is not None else None
        self.watch = Watch()
        self._frames = self._requests = self._still = self._moving = self._writes = 0
        self._motions, self._on = 0, False
        self._targets: dict[int, bytes] = {}
        self._period = 0.002
        self._receive = self.machine.receive
        self._enabled_again = False
        self.machine.receive = self._seen  # type: ignore[method-assign]

    def __enter__(self) -> "Bench":
        notes = str(self.folder / "notes")
        self._apart = patch.dict(os.environ, {"FIELDTOOL_STATE_DIR": notes})
        self._apart.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._apart.stop()
        unregister(self.channel)

    @property
    def out(self) -> Path:
        return self.folder / "session"

    def _watch_filter(self, node: DriveNode) -> None:
        """See which coefficient a drive works with: the one at its latch, or at its start."""
        if node.face.name not in LATCHES:
            return
        latch, coefficient = LATCHES[node.face.name]
        effects, power_up = node.dictionary.effects, node.motion.power_up
        set_latch = effects[latch]

        def take() -> None:
            self._acting[node.node_id] = node.dictionary.read(*coefficient)

        def latched(value: Any) -> None:
            take()
            set_latch(value)

        def started() -> None:
            take()
            power_up()

        take()
        effects[latch] = latched
        node.motion.power_up = started  # type: ignore[method-assign]

    def _not_acting(self) -> dict[int, tuple[Any, Any]]:
        held = {
            n.node_id: n.dictionary.read(*LATCHES[n.face.name][1])
            for n in self.machine.nodes
            if n.node_id in self._acting
        }
        return {k: (acts, held[k]) for k, acts in self._acting.items() if acts != held[k]}

    # -- moments ----------------------------------------------------------------------------------

    def _seen(self, cob_id: int, data: bytes | bytearray) -> bool:
        self._frames += 1
        if self._frames > MOST_FRAMES or self.machine.now > LONGEST:
            raise HangError(f"{self._frames} frames, {self.machine.now:.0f} s of virtual time")
        if self.watch.fault_time is None and self._is_moment(cob_id, bytes(data)):
            self._bring_about()
        return self._receive(cob_id, data)

    def _is_moment(self, cob_id: int, data: bytes) -> bool:
        if self.moment is Moment.CONNECTING:
            self._requests += cob_id == 0x600 + self.node
            return self._requests >= REQUESTS
        if self.moment is Moment.WRITE:
            if cob_id == 0x600 + self.node and data[0] >> 5 == 1:
                key = int.from_bytes(data[1:3], "little"), data[3]
                self._writes += key in self._gains[self.node]
                if self._writing is not None:
                    return key == self._writing
            return self._writing is None and self._writes >= WRITES
        if cob_id - self.node == 0x200:
            self._moving += self._targets.get(cob_id, data)[2:6] != data[2:6]
            self._targets[cob_id] = data
        if cob_id != 0x80:
            return False
        on = all(n.motion.state is State.OPERATION_ENABLED for n in self.machine.nodes)
        if on != self._on:
            self._on, self._still, self._moving = on, 0, 0
            self._motions += on
        self._still += on
        if self.moment is Moment.STILL:
            return self._still >= STILL_SYNCS
        return on and self._motions >= 2 and self._moving >= self._moving_syncs

    def _bring_about(self) -> None:
        watch = self.watch
        watch.fault_time = self.machine.now
        if self.moment in (Moment.STILL, Moment.SWEEP):  # drives have no common cycle before
            self._period = self.machine.period / 1e9
        watch.powered_then = frozenset(n.node_id for n in self.machine.nodes if n.motion.powered)
        watch.positions_then = {n.node_id: self._position(n) for n in self.machine.nodes}
        for fault in self._faults:
            self.machine.inject(fault)
        self._look()

    def _position(self, node: DriveNode) -> float:
        axes = self.machine.axes
        return float(axes.state[axes.plant.motors[node.axis]])

    def _look(self) -> None:
        watch, after = self.watch, self.machine.scheduler.now / 1e9 - (self.watch.fault_time or 0)
        reacted_before = len(watch.reacted)
        for node in self.machine.nodes:
            one, state = node.node_id, node.motion.state
            way = abs(self._position(node) - watch.positions_then[one])
            if one in watch.powered_then and after > 0:
                if state is not State.OPERATION_ENABLED:
                    watch.reacted.setdefault(one, after)
                    watch.unseen.setdefault(one, way)
                elif reacted_before == len(watch.powered_then):
                    self._enabled_again = True
                if not node.motion.powered:
                    watch.off.setdefault(one, after)
            watch.farthest[one] = max(watch.farthest.get(one, 0.0), way)
        self.machine.scheduler.add(POLL, self._look)

    # -- the command ------------------------------------------------------------------------------

    def run(self) -> Result:
        """Run the command that the moment belongs to, let time pass, and see what there is."""
        if self.moment is Moment.WRITE:
            self.prepare_write()
            code, said = command("write", self.out, "--yes", "--store")
        else:
            code, said = command("measure", self.profile, "--yes", "--out", self.out)
        if self.watch.fault_time is None:
            raise AssertionError(f"the moment never came; exit code {code}: {said}")
        ended = self.machine.time
        self.machine.advance_to(ended + round(PATIENCE * 1e9))
        return self._result(code, said)

    def prepare_write(self) -> None:
        """Make a session folder with a tuning for both axes."""
        self.out.mkdir()
        (self.out / "machine.yaml").write_text(self.profile.read_text(), encoding="utf-8")
        axes = [
            {
                "axis": NAMES[node.node_id],
                "parameters": TUNING | COEFFICIENT.get(node.face.name, {}),
                "sensitivity_peak": 1.4,
                "reason": "bench",
            }
            for node in self.machine.nodes
        ]
        tuning = {"format": "fieldtool-tuning/1", "axes": axes}
        (self.out / "tuning.yaml").write_text(yaml.safe_dump(tuning), encoding="utf-8")

    def _result(self, code: int, said: str) -> Result:
        rows, complete = self._recorded()
        nodes = self.machine.nodes
        best = self._best()
        changed, not_acting = self._all_changed(), self._not_acting()
        gains = {n.node_id: self._kind(n, n.dictionary.read) for n in nodes}
        stored = {n.node_id: self._kind(n, self._after_power_cycle(n)) for n in nodes}
        still_on = tuple(n.node_id for n in nodes if n.motion.powered)
        return Result(
            code,
            said,
            self._period,
            self.watch,
            rows,
            complete,
            changed,
            gains,
            stored,
            still_on,
            self._enabled_again,
            self._restored() if self._is_left(code, changed) else "",
            not_acting,
            best,
        )

    def _best(self) -> Verdict | None:
        if self._received is None or self._factor is None or self.watch.fault_time is None:
            return None
        if self.moment not in (Moment.STILL, Moment.SWEEP):
            return None
        axis = self.machine.node(self.node).axis
        return verdict(self._received, self.watch.fault_time, axis, self._factor)

    def _is_left(self, code: int, changed: Mapping[int, Mapping[str, Any]]) -> bool:
        if self.moment is Moment.WRITE:
            return code in (4, 6, 7)
        return self.moment is not Moment.CONNECTING and any(changed.values())

    def _restored(self) -> str:
        """Mend everything, and let the tool restore: all old, whatever it was."""
        for fault in self._faults:
            self.machine.lift(fault)
        code, said = command("restore", self.out)
        gains = {self._kind(n, n.dictionary.read) for n in self.machine.nodes}
        left = {} if self.moment is Moment.WRITE else self._all_changed()
        left = left or self._not_acting()
        if code == 0 and gains == {"old"} and not left:
            return ""
        return f"restore: {code}, {gains}, {left}: {said}"

    def _all_changed(self) -> dict[int, dict[str, tuple[Any, Any]]]:
        """Return what is not as it was before, by node; nodes where all is are left out."""
        changed = {n.node_id: self._changed(n) for n in self.machine.nodes}
        return {node: what for node, what in changed.items() if what}

    def _recorded(self) -> tuple[tuple[int, ...], tuple[bool, ...]]:
        try:
            experiments = load(self.out / "recording.h5").experiments
        except FieldtoolError:
            return (), ()
        return tuple(e.samples for e in experiments), tuple(e.complete for e in experiments)

    # -- what drives hold -------------------------------------------------------------------------

    @staticmethod
    def _objects(node: DriveNode) -> dict[Key, Any]:
        dictionary = node.dictionary
        return {
            key: _as_on_the_wire(dictionary.read(*key))
            for key, entry in dictionary.entries.items()
            if entry.access != "wo" and key not in PROCESS_VALUES | dictionary.hidden
        }

    def _changed(self, node: DriveNode) -> dict[str, tuple[Any, Any]]:
        was, now = self.before[node.node_id], self._objects(node)
        return {
            f"0x{key[0]:04X}:{key[1]:02X}": (was[key], now[key])
            for key in was
            if was[key] != now[key] and key not in self._gains[node.node_id]
        }

    def _kind(self, node: DriveNode, read: Callable[[int, int], Any]) -> str:
        new = self._gains[node.node_id]
        held = {key: read(*key) for key in new}
        if held == {key: self.before[node.node_id][key] for key in new}:
            return "old"
        return "new" if held == new else "mixed"

    @staticmethod
    def _after_power_cycle(node: DriveNode) -> Callable[[int, int], Any]:
        stored = node.memory.stored

        def read(index: int, subindex: int) -> Any:
            factory = node.dictionary.factory_value(node.dictionary.entries[index, subindex])
            return stored.get((index, subindex), factory)

        return read


def _as_on_the_wire(value: Any) -> Any:
    return struct.unpack("<f", struct.pack("<f", value))[0] if isinstance(value, float) else value


_numbers = count()


def command(*arguments: object) -> tuple[int, str]:
    """Run a command in this process; return its exit code and what it said on standard error."""
    out, err = io.StringIO(), io.StringIO()
    code: Any = 0
    untried = patch("fieldtool.workflow.writing.Verification", Stood)
    with untried, contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            main([str(a) for a in arguments])
        except SystemExit as ended:
            code = ended.code
    said = re.sub(r"\s+", " ", f"{err.getvalue()} {out.getvalue()}")
    return code if isinstance(code, int) else 0, re.sub(r"SIMULATED.*ageing of drives\. ", "", said)


def try_case(
    moment: Moment,
    faults: Callable[[int], tuple[Fault, ...]],
    node: int = ARM,
    **options: Any,
) -> Result:
    """Run one case in a folder of its own."""
    with (
        tempfile.TemporaryDirectory(prefix="fault-bench-") as folder,
        Bench(Path(folder), moment, faults, node, **options) as bench,
    ):
        return bench.run()


if __name__ == "__main__":
    sys.exit("run `python -m tests.benchmarks faults`")
