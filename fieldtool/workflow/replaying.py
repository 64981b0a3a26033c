"""A trace as text and numbers, compared with the session's recording."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from drives.canopen_drive.group import profile_of
from drives.objects import ObjectAddress
from drives.profile import MachineProfile, load_machine
from drives.replay import Decoded, Decoder, read_trace
from drives.replay.decoding import knowledge
from drives.replay.process_data import Rebuilding, find
from drives.replay.statistics import Counting, Statistics
from drives.trace import FORMATS
from fieldtool.errors import FileFormatError
from fieldtool.records.recording import Recording, load
from fieldtool.records.session_folder import SessionFolder

USUAL_BITRATE = 1_000_000


@dataclass(frozen=True)
class Source:
    """Where a trace is, and what is known of its machine."""

    trace: Path
    machine: MachineProfile | None
    recording: Path | None
    """The session's raw data, if they are there."""


@dataclass(frozen=True)
class Wanted:
    """Which frames are shown; what is empty leaves all."""

    kinds: frozenset[str] = frozenset()
    nodes: frozenset[int] = frozenset()
    objects: frozenset[ObjectAddress] = frozenset()
    """Of SDO transfers, and of PDOs that carry them; sub-index 0 alone stands for all of an index."""
    begin: float | None = None
    """Seconds since the first frame."""
    end: float | None = None

    def __contains__(self, frame: object) -> bool:
        if not isinstance(frame, Decoded):
            return False
        return (
            (not self.kinds or frame.kind.lower() in self.kinds)
            and (not self.nodes or frame.node in self.nodes)
            and (not self.objects or self._has_object(frame))
        )

    def _has_object(self, frame: Decoded) -> bool:
        there = [value.address for value in frame.values]
        if frame.address is not None:
            there.append(frame.address)
        return any(
            address == wanted or (wanted.subindex == 0 and address.index == wanted.index)
            for address in there
            for wanted in self.objects
        )

    def at(self, seconds: float) -> bool:
        """Whether a time since the first frame is wanted."""
        return (self.begin is None or seconds >= self.begin) and (
            self.end is None or seconds <= self.end
        )


@dataclass(frozen=True)
class Found:
    """An experiment of the recording, looked for in the trace's PDOs."""

    experiment: str
    rows: int
    rows_found: int
    """Rows whose positions and torques are all in the trace, in order."""
    pieces: int

    @property
    def whole(self) -> bool:
        """Whether every row was found."""
        return self.rows_found == self.rows


@dataclass(frozen=True)
class Replayed:
    """What a trace amounts to, and how it compares with the recording."""

    source: Source
    begin: float
    """Time stamp of the first frame, s."""
    statistics: Statistics
    experiments: tuple[Found, ...] = ()

    def as_dict(self) -> dict[str, Any]:
        """Plain values, as ``--json`` prints them."""
        s = self.statistics
        pace = None
        if s.pace is not None:
            pace = {field.name: getattr(s.pace, field.name) for field in fields(s.pace)}
        return {
            "trace": str(self.source.trace),
            "machine": self.source.machine.name if self.source.machine else None,
            "frames": s.frames,
            "seconds": s.seconds,
            "kinds": s.kinds,
            "sync": pace,
            "pdos": [
                {
                    "node": p.node,
                    "received": p.received,
                    "missing": p.missing,
                    "doubled": p.doubled,
                }
                for p in s.pdos
            ],
            "bus_load": {"mean": s.mean_load, "peak": s.peak_load},
            "sdo_aborts": list(s.aborts),
            "sdo_unanswered": s.unanswered,
            "emergencies": list(s.emergencies),
            "boot_ups": list(s.boots),
            "recording": [
                {
                    "experiment": f.experiment,
                    "rows": f.rows,
                    "rows_found": f.rows_found,
                    "pieces": f.pieces,
                }
                for f in self.experiments
            ],
        }


def find_source(path: Path, machine: str | None = None) -> Source:
    """Return the trace of a session folder, or the file itself, with its machine's profile.

    Raises
    ------
    FileFormatError
        If the path does not exist, there is no trace, or more than one.
    ProfileError
        If the machine profile is wrong.
    """
    if not path.exists():
        raise FileFormatError(
            path, "does not exist. Give a session folder with a trace, or a trace."
        )
    folder = SessionFolder(path if path.is_dir() else path.parent)
    if path.is_dir():
        traces = sorted(p for p in path.iterdir() if p.suffix.lower() in FORMATS)
        if not traces:
            raise FileFormatError(
                path, "has no trace; measure with --trace to have one, or name the file"
            )
        preferred = [p for p in traces if p.stem == "trace"]
        if len(preferred or traces) > 1:
            names = ", ".join(p.name for p in traces)
            raise FileFormatError(path, f"has several traces ({names}); name the one to be shown")
        path = (preferred or traces)[0]
    profile = None
    if machine is not None:
        profile = load_machine(machine)
    elif folder.machine.is_file():
        profile = load_machine(folder.machine)
    recording = folder.recording if folder.recording.is_file() else None
    return Source(path, profile, recording)


def replay(
    source: Source,
    wanted: Wanted | None = None,
    show: Callable[[Decoded, float], None] = lambda _frame, _seconds: None,
    bitrate: int | None = None,
) -> Replayed:
    """Decode and count a trace, show the frames that are wanted, and compare with the recording.

    Parameters
    ----------
    source
        Trace and machine.
    wanted
        Which frames are shown; none where it is None.
    show
        Gets each of them, with the seconds since the first frame.
    bitrate
        Of the bus, bit/s; the profile's otherwise.

    Raises
    ------
    ProfileError
        If the file is no trace.
    FileFormatError
        If the recording is none.
    """
    machine = source.machine
    axes = machine.axes if machine is not None else ()
    known = {} if machine is None else knowledge((axis, profile_of(axis, machine)) for axis in axes)
    decoder = Decoder(known)
    counting = Counting(bitrate or (machine.bus.bitrate if machine else USUAL_BITRATE))
    rebuilding = Rebuilding([axis.node_id for axis in axes])
    begin: float | None = None
    for message in read_trace(source.trace):
        frame = decoder.decode(message)
        begin = frame.time if begin is None else begin
        counting.add(frame)
        rebuilding.add(frame)
        seconds = frame.time - begin
        if wanted is not None and frame in wanted and wanted.at(seconds):
            show(frame, seconds)
    experiments: tuple[Found, ...] = ()
    if source.recording is not None and axes:
        experiments = tuple(_compared(load(source.recording), rebuilding))
    return Replayed(source, begin or 0.0, counting.result(), experiments)


def _compared(recording: Recording, rebuilding: Rebuilding) -> Iterator[Found]:
    data, start = rebuilding.result(), 0
    if not data.time.size:  # nothing moved while it was traced: a write, or a restore
        return
    for one in recording.experiments:
        position, torque = np.asarray(one.position), np.asarray(one.torque)
        pieces = find(data, position, torque, start)
        rows = sum(piece.rows for piece in pieces)
        yield Found(one.name, position.shape[0], rows, len(pieces))
        if pieces:
            start = pieces[-1].sync + pieces[-1].rows
