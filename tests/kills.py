"""Kill the tool with SIGKILL while it writes, perhaps cut the drives' supply too, and restore.

One moment is a value, made from a seed; :func:`tried` tries it on a machine in this process with real
processes of the tool, and says what the drives' working and non-volatile memory held in the end.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import can
import numpy as np

from drives.parameters import Phase, load_backup, load_journal
from tests.apart import WRITABLE, Ended, MachineApart, ToolProcess, Values, is_download, object_of

STORE_INDEX = 0x1010
BEFORE = 65
"""Frames that the host sends to each drive before it writes, about."""
Supply = Literal["stays", "of one drive fails", "of all drives fails"]
Kind = Literal["before the first write", "after a frame", "while storing", "at the end"]


@dataclass(frozen=True)
class Blow:
    """When a process is killed, and what happens to the drives at the same moment."""

    kind: Kind
    frames: int
    """Frames of the host: from the start, or from the first object that is written."""
    seconds: float
    """From the first drive's storing, for ``while storing``; from the last frame, ``at the end``."""
    supply: Supply
    which: int
    """Number of the drive whose supply fails."""
    banks: tuple[str, ...]
    """For each drive what its memory holds if its supply fails while it stores."""


@dataclass(frozen=True)
class Moment:
    """One trial."""

    store: bool
    old: Mapping[str, float]
    new: Mapping[str, float]
    blow: Blow
    again: Blow | None
    """The restore is killed too, and repeated."""
    look_in: bool
    """Whether another session is tried before the restore; it has to be refused."""


@dataclass(frozen=True)
class Trial:
    """What came of a moment."""

    when: str
    """How far the write had come by its journal."""
    supply: Supply
    killed_again: bool
    working: str
    """What the drives' working memory held in the end: old, new, or mixed."""
    stored: str
    """And their non-volatile memory."""
    backup_whole: bool
    fault: str
    """What was not as it must be; empty where all was."""


def random_moment(rng: np.random.Generator, axes: int, store_time: float) -> Moment:
    """Make a moment: values, kind of blow, supply."""
    store = bool(rng.random() < 0.8)
    old = {name: _value(rng, name) for name in WRITABLE}
    new = {name: old[name] * rng.uniform(1.1, 1.6) for name in WRITABLE}
    again = _blow(rng, axes, store_time, store) if rng.random() < 0.3 else None
    blow = _blow(rng, axes, store_time, store)
    return Moment(store, old, new, blow, again, bool(rng.random() < 0.15))


def _value(rng: np.random.Generator, name: str) -> float:
    typical = {"position_p": 12.0, "velocity_p": 3.0, "velocity_i": 20.0}
    return float(typical.get(name, 0.3 if "damping" in name else 150.0) * rng.uniform(0.8, 1.2))


def _blow(rng: np.random.Generator, axes: int, store_time: float, store: bool) -> Blow:
    kinds: tuple[Kind, ...] = (
        "before the first write",
        "after a frame",
        "while storing",
        "at the end",
    )
    kind = kinds[rng.choice(4, p=(0.1, 0.45, 0.3, 0.15) if store else (0.1, 0.75, 0.0, 0.15))]
    last = (4 * len(WRITABLE) + 1 if store else 2 * len(WRITABLE)) * axes
    frames = {"before the first write": int(rng.integers(1, BEFORE * axes)), "at the end": last}
    longest = 0.05 if kind == "at the end" else 1.1 * axes * store_time
    supplies: tuple[Supply, ...] = ("stays", "of one drive fails", "of all drives fails")
    ended = kind == "at the end" and not store  # what was not stored may be gone then, as was said
    return Blow(
        kind,
        frames.get(kind, int(rng.integers(1, last))),
        float(rng.uniform(0.0, longest)),
        supplies[0 if ended else rng.choice(3, p=(0.5, 0.25, 0.25))],
        int(rng.integers(axes)),
        tuple(str(b) for b in rng.choice(("old", "new", "corrupted"), axes)),
    )


class _Killer:
    """Waits for the moment, in the thread that serves the drives."""

    def __init__(self, machine: MachineApart, blow: Blow) -> None:
        self._machine, self._blow = machine, blow
        self._tool: ToolProcess | None = None
        self._frames = 0
        self._writing = False
        self._due: int | None = None
        self._store_began: int | None = None

    def aim(self, start: Callable[[], ToolProcess]) -> Ended:
        """Start the tool, and wait for its end."""
        self._machine.bus.on_frame = self._frame
        self._machine.looks.append(self._look)
        self._tool = start()
        try:
            return self._tool.wait()
        finally:
            self._machine.looks.remove(self._look)
            self._machine.bus.on_frame = lambda _: None

    def _frame(self, message: can.Message) -> None:
        if is_download(message):
            self._writing = True
            if object_of(message) == STORE_INDEX and self._store_began is None:
                self._store_began = self._machine.machine.time
        if self._blow.kind == "before the first write" or self._writing:
            self._frames += 1
            if self._frames == self._blow.frames and self._blow.kind == "at the end":
                self._due = self._machine.machine.time
            elif self._frames == self._blow.frames and self._blow.kind != "while storing":
                self._strike()

    def _look(self) -> None:
        due = self._store_began if self._blow.kind == "while storing" else self._due
        if due is not None and (self._machine.machine.time - due) / 1e9 >= self._blow.seconds:
            self._strike()

    def _strike(self) -> None:
        tool, blow = self._tool, self._blow
        if tool is None or tool.killed:
            return
        try:
            tool.kill()
        except ProcessLookupError:
            return
        nodes: Any = self._machine.nodes
        if blow.supply == "of one drive fails":
            nodes = nodes[blow.which : blow.which + 1]
        if blow.supply != "stays":
            for node in nodes:
                node.power_cycle(blow.banks[self._machine.nodes.index(node)])


def tried(machine: MachineApart, moment: Moment, name: str) -> Trial:
    """Write, kill, restore, and look."""
    machine.set_up(moment.old, store=True)
    old = machine.working()
    assert old == machine.stored()
    session = machine.session(name, moment.new)
    options = ("--store",) if moment.store else ()
    faults: list[str] = []
    ended = _Killer(machine, moment.blow).aim(
        lambda: machine.start("write", session, "--yes", *options)
    )
    when = _how_far(session, ended, faults)
    backup = session / "parameters-before.yaml"
    killed_again = False
    if when == "ended":
        wanted = "new"
    else:
        wanted = "old"
        if when not in ("before the backup", "before the journal"):
            if moment.look_in:
                _look_in(machine, moment, name, faults)
            if moment.again is not None:
                second = _Killer(machine, moment.again).aim(
                    lambda: machine.start("restore", session)
                )
                killed_again = second.code < 0
        if when != "before the backup":
            last = machine.run("restore", session)
            if last.code != 0:
                faults.append(f"restore ended with {last.code}: {last.text.strip()}")
    new = _new_values(machine, moment, old)
    working, stored = machine.working(), machine.stored()
    held = _which(working, old, new), _which(stored, old, new)
    expected = wanted, wanted if moment.store or wanted == "old" else "old"
    if held != expected:
        faults.append(f"working memory {held[0]}, non-volatile {held[1]}, expected {expected}")
    whole = when == "before the backup" or _is_whole(backup, old)
    if not whole:
        faults.append("the backup is lost")
    if _notes(machine) and when == "ended":  # killed before they were removed: the next one does it
        other = machine.session(f"{name}-next", moment.new)
        following = machine.run("write", other, "--yes")
        if following.code != 0:
            faults.append(f"the next session ended with {following.code}: {following.text.strip()}")
    if _notes(machine):
        faults.append(f"notes are left: {_notes(machine)}")
    return Trial(when, moment.blow.supply, killed_again, held[0], held[1], whole, "; ".join(faults))


def _notes(machine: MachineApart) -> list[str]:
    return [path.name for path in (machine.folder / "notes").glob("*.yaml")]


def _how_far(session: Path, ended: Ended, faults: list[str]) -> str:
    """Say by the journal how far the write had come."""
    path = session / "write-journal.yaml"
    if ended.code >= 0 and ended.code != 0:
        faults.append(f"write ended with {ended.code}: {ended.text.strip()}")
    if not (session / "parameters-before.yaml").exists():
        return "before the backup"
    if not path.exists():
        return "before the journal"
    journal = load_journal(path)  # whole at every instant
    if not journal.is_open:
        return "ended"
    phases = {record.phase for record in journal.drives}
    for phase, word in (
        (Phase.STORING, "storing"),
        (Phase.STORED, "storing"),
        (Phase.WRITING, "writing"),
        (Phase.VERIFIED, "checking"),
    ):
        if phase in phases:
            return word
    return "checking" if Phase.WRITTEN in phases and Phase.PLANNED not in phases else "writing"


def _look_in(machine: MachineApart, moment: Moment, name: str, faults: list[str]) -> None:
    """Try another session: it has to be refused, with what to do."""
    other = machine.session(f"{name}-other", moment.new)
    before = machine.working()
    looked = machine.run("write", other, "--yes")
    if looked.code != 3 or "fieldtool restore" not in looked.text:
        faults.append(f"another session was not refused: {looked.code} {looked.text.strip()}")
    if machine.working() != before:
        faults.append("another session wrote")


def _new_values(machine: MachineApart, moment: Moment, old: Values) -> Values:
    new: dict[int, dict[tuple[int, int], Any]] = {n: dict(v) for n, v in old.items()}
    for values in new.values():
        for name, value in moment.new.items():
            key, scale = WRITABLE[name]
            values[key] = round(value / scale) if scale != 1.0 else value
    return new


def _which(held: Values, old: Values, new: Values) -> str:
    """Say whether all drives hold the old values, or all the new ones."""
    return next((w for w, values in (("old", old), ("new", new)) if _same(held, values)), "mixed")


def _same(one: Values, other: Values) -> bool:
    return all(
        np.float32(one[node][key]) == np.float32(value)
        if isinstance(value, float)
        else one[node][key] == value
        for node, values in other.items()
        for key, value in values.items()
    )


def _is_whole(path: Path, old: Values) -> bool:
    """Whether the backup can be read and holds what the drives held before the write."""
    for part in load_backup(path).drives:
        for held in part.held:
            key = (held.info.address.index, held.info.address.subindex)
            if key in old[part.node_id]:
                value = old[part.node_id][key]
                if np.float32(held.value) != np.float32(value):
                    return False
    return True
