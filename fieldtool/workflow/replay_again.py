"""A session done again by the tool itself, with its trace in place of drives."""

import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, fields, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from drives.errors import DrivesError, UserStopError
from drives.replay.replay_bus import INTERFACE
from fieldtool.errors import FieldtoolError, FileFormatError
from fieldtool.records.recording import Experiment, load
from fieldtool.records.session_folder import SessionFolder
from fieldtool.workflow.replaying import Source
from fieldtool.workflow.session import Options, Screen
from fieldtool.workflow.stages import measure, run
from fieldtool.writeback.unfinished import STATE_VARIABLE


@dataclass(frozen=True)
class Again:
    """A session that was done again on its own trace."""

    folder: Path
    same_frames: bool
    """Whether the tool sent, frame by frame, what it sent then."""
    differences: tuple[str, ...]
    """In words; empty if frames and recording are the same."""
    rows: int
    """Rows of the recording that were compared."""


def again(source: Source, out: Path, screen: Screen | None = None) -> Again:
    """Do a session's command again, with its trace in place of drives, and compare the recordings.

    Raises
    ------
    FileFormatError
        If the trace is in no session folder, or the session was no ``run`` or ``measure``.
    UserStopError
        If the user stops it now.
    """
    folder, machine = source.trace.parent, source.machine
    if machine is None:
        raise FileFormatError(folder, "is no session folder: there is no machine.yaml in it")
    command, options = _session_of(source)
    bus = machine.bus.elsewhere(INTERFACE, str(source.trace))
    played = machine.model_copy(update={"bus": bus})
    problem = ""
    try:
        with _no_notes_about_drives():
            if command == "run":
                wrote = SessionFolder(folder).journal.is_file()
                run(played, out, options, screen=screen, confirm=lambda _: wrote)
            else:
                measure(played, out, options, screen=screen)
    except UserStopError:
        raise
    except (DrivesError, FieldtoolError) as error:
        problem = str(error)
    before = SessionFolder(folder).recording
    after = SessionFolder(out).recording
    rows, differences = _recordings_differ(before, after)
    models = SessionFolder(folder).model, SessionFolder(out).model
    if command == "run" and not problem and _text(models[0]) != _text(models[1]):
        differences = (*differences, f"{models[1]} is another model than {models[0]}")
    same = not problem or problem == _how_it_ended(folder)
    return Again(out, same, differences if same else (problem, *differences), rows)


@contextmanager
def _no_notes_about_drives() -> Iterator[None]:
    """Keep the notes about unfinished writes apart: the drives of a replay are not there.

    A write that was cut off on the real ones does not hinder the replay, and a replay that is cut off
    leaves nothing behind that would hinder them.
    """
    before = os.environ.get(STATE_VARIABLE)
    with TemporaryDirectory(prefix="fieldtool-replay-") as folder:
        os.environ[STATE_VARIABLE] = folder
        try:
            yield
        finally:
            if before is None:
                del os.environ[STATE_VARIABLE]
            else:
                os.environ[STATE_VARIABLE] = before


def _session_of(source: Source) -> tuple[str, Options]:
    """Return command and options of the session that made a trace."""
    events = SessionFolder(source.trace.parent).events
    found = None
    for line in _lines(events):
        options = line.get("options")
        if (
            line.get("event") == "session"
            and isinstance(options, dict)
            and options.get("trace") == source.trace.name
        ):
            found = line.get("command"), options
    if found is None or found[0] not in ("run", "measure"):
        raise FileFormatError(
            events,
            f"tells of no `run` or `measure` whose trace is {source.trace.name}; only these can be done "
            "again",
        )
    command, kept = str(found[0]), found[1]
    known = {field.name: kept[field.name] for field in fields(Options) if field.name in kept}
    try:
        return command, replace(Options(), **{**known, "trace": None})
    except (TypeError, ValueError) as error:
        raise FileFormatError(events, f"has options that are not known ({error})") from None


def _lines(events: Path) -> Iterator[dict[str, Any]]:
    try:
        text = events.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise FileFormatError(events, f"can not be read ({error})") from None
    for line in text.splitlines():
        try:
            value = json.loads(line)
        except ValueError:
            continue
        if isinstance(value, dict):
            yield value


def _text(path: Path) -> str:
    return path.read_text(encoding="utf-8") if path.is_file() else ""


def _how_it_ended(folder: Path) -> str:
    """Return the error that ended the session, if one did."""
    ended = [line for line in _lines(SessionFolder(folder).events) if line.get("event") == "ended"]
    return str(ended[-1].get("text", "")) if ended else ""


def _recordings_differ(before: Path, after: Path) -> tuple[int, tuple[str, ...]]:
    if not before.is_file() and not after.is_file():
        return 0, ()
    for path in (before, after):
        if not path.is_file():
            return 0, (f"there is no {path}",)
    old, new = load(before), load(after)
    names = [e.name for e in old.experiments], [e.name for e in new.experiments]
    if names[0] != names[1]:
        return 0, (f"the experiments are {names[1]}, they were {names[0]}",)
    differences: list[str] = []
    rows = 0
    for one, two in zip(old.experiments, new.experiments, strict=True):
        rows += one.samples
        differences += _experiments_differ(one, two)
    return rows, tuple(differences)


def _experiments_differ(one: Experiment, two: Experiment) -> list[str]:
    """Return the signals that are not the same, number by number."""
    old = {**one.signals(), **one.extra, "statusword": one.statusword}
    new = {**two.signals(), **two.extra, "statusword": two.statusword}
    return [
        f"{one.name}: {name} differs"
        for name in sorted({*old, *new})
        if not _equal(old.get(name), new.get(name))
    ]


def _equal(a: Any, b: Any) -> bool:
    """Whether two signals are the same in every number, or neither is there."""
    if a is None or b is None:
        return a is b
    return bool(np.array_equal(a, b, equal_nan=a.dtype.kind == "f"))
