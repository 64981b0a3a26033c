"""What axes do, on the disk while they move: for the case that nothing is left of this program.

A recording gets whole experiments, written when the axes stand: a disk may be slow, and a cycle is
not.  Until then every block of rows also goes through a pipe to a small process of its own, which
copies it into a file.  The pipe is never waited for, and what it holds is copied even where this
program is killed.  When all is in the recording, the file is removed; one that is found holds what the
recording lacks (:func:`cut_off_rows`).

The file is a sequence of frames: four letters, the payload's bytes as uint32, the payload.  ``HEAD``:
JSON of the axes and the sample period of the motion that begins; ``ROWS``: rows of float64, each the
SYNC's count, then positions, references, torques and statuswords of all axes; ``KEPT``: an experiment
was written to the recording.  Numbers are little-endian; a frame that is cut off is the end.
"""

import contextlib
import json
import os
import struct
import subprocess
import sys
from collections import deque
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from drives.api import Capture
from fieldtool.errors import FileFormatError
from fieldtool.records.files import check_size
from fieldtool.records.recorded import Experiment, FloatArray, Recording

_FRAME = struct.Struct("<4sI")
_COPY = """
import os, signal, sys
signal.signal(signal.SIGINT, signal.SIG_IGN)
with open(sys.argv[1], "wb", buffering=0) as file:
    while block := os.read(0, 1 << 20):
        file.write(block)
"""
MAX_BYTES = 4 * 1024**3
MOST_WAITING = 64 * 1024**2
"""Bytes that are held while the pipe is full; what is more is left out, and said in no file."""
END_PATIENCE = 10.0
"""Seconds that the copying process may take to end."""
SHORTEST = 2
"""Rows that are worth keeping."""
NOTE = "cut off: the program ended while the axes moved, and these rows were saved beside it"


class RawRows:
    """Takes every block of a session's motions; a context manager.

    Parameters
    ----------
    path
        Of the file; replaced if it is there.
    axes
        Names, in the order of the captures.

    Notes
    -----
    Nothing here ever raises while axes move: rows that can not be saved twice are in memory still.
    """

    def __init__(self, path: Path, axes: Sequence[str]) -> None:
        self.path, self._axes = path, list(axes)
        self._waiting: deque[bytes] = deque()
        self._held = 0
        self._process: subprocess.Popen[bytes] | None = None
        with contextlib.suppress(OSError):
            self._process = subprocess.Popen(
                [sys.executable, "-I", "-S", "-c", _COPY, str(path)],
                stdin=subprocess.PIPE,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                bufsize=0,
                start_new_session=True,
            )
        if self._process is not None and self._process.stdin is not None:
            self._pipe = self._process.stdin.fileno()
            with contextlib.suppress(OSError, AttributeError):  # Windows, before Python 3.12
                os.set_blocking(self._pipe, False)

    def begin(self, cycle_time: float) -> None:
        """A motion begins; what was before it is in the recording, or never will be."""
        head = {"axes": self._axes, "sample_period": cycle_time}
        self._put(b"HEAD", json.dumps(head).encode())

    def take(self, capture: Capture) -> None:
        """A block of the motion."""
        count = capture.first_sync + np.arange(capture.rows, dtype="<f8")
        parts = (
            count[:, None],
            capture.position,
            capture.position_reference,
            capture.torque,
            capture.statusword,
        )
        self._put(b"ROWS", np.concatenate(parts, axis=1, dtype="<f8").tobytes())

    def kept(self) -> None:
        """An experiment of the last motion is in the recording."""
        self._put(b"KEPT", b"")

    def close(self, *, all_kept: bool) -> None:
        """End the copying; remove the file if all is in the recording."""
        process = self._process
        if process is None or process.stdin is None:
            return
        self._process = None
        with contextlib.suppress(OSError, AttributeError):
            os.set_blocking(self._pipe, True)
        with contextlib.suppress(OSError):
            while self._waiting and not all_kept:
                rest = self._waiting.popleft()
                while rest:
                    rest = rest[os.write(self._pipe, rest) :]
        with contextlib.suppress(OSError):
            process.stdin.close()
        try:
            process.wait(END_PATIENCE)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
        if all_kept:
            with contextlib.suppress(OSError):
                self.path.unlink(missing_ok=True)

    def _put(self, kind: bytes, payload: bytes) -> None:
        if self._process is None:
            return
        frame = _FRAME.pack(kind, len(payload)) + payload
        if self._held + len(frame) <= MOST_WAITING:
            self._waiting.append(frame)
            self._held += len(frame)
        try:
            while self._waiting:
                first = self._waiting[0]
                sent = os.write(self._pipe, first)
                self._held -= sent
                if sent == len(first):
                    self._waiting.popleft()
                else:
                    self._waiting[0] = first[sent:]
        except BlockingIOError:
            return  # with the next block
        except OSError:  # the copying process is gone: the disk is full, or somebody ended it
            self._waiting.clear()
            self._held = MOST_WAITING


def cut_off_rows(path: Path, recording: Recording) -> tuple[Experiment, ...]:
    """Return what a file of raw rows holds of its last motion and the recording does not.

    Raises
    ------
    FileFormatError
        If the file can not be read, or is of other axes than the recording.
    """
    period, rows, kept = _last_motion(path, recording)
    names = {one.name for one in recording.experiments}
    found: list[Experiment] = []
    for stretch in _stretches(rows):
        if kept:
            stretch = _beyond(stretch, recording)  # noqa: PLW2901 - the part that is not there yet
        if stretch.shape[0] < SHORTEST:
            continue
        name = next(n for n in _numbered("cut off") if n not in names)
        names.add(name)
        try:
            found.append(_experiment(name, stretch, period, recording.names))
        except ValueError as error:
            raise FileFormatError(path, f"is damaged: {error}.") from error
    return tuple(found)


def _last_motion(path: Path, recording: Recording) -> tuple[float, FloatArray, bool]:
    """Sample period and rows of the last motion, and whether any of it is in the recording."""
    check_size(path, MAX_BYTES)
    width = 1 + 4 * len(recording.axes)
    period, blocks, kept = recording.sample_period, list[FloatArray](), False
    for kind, payload in _frames(path):
        if kind == b"HEAD":
            period, blocks, kept = _head(path, payload, recording), [], False
        elif kind == b"KEPT":
            kept = True
        elif kind == b"ROWS" and len(payload) % (8 * width) == 0:
            blocks.append(np.frombuffer(payload, dtype="<f8").reshape(-1, width))
        else:
            raise FileFormatError(path, f"has a frame {kind!r} of {len(payload)} bytes: damaged.")
    rows = np.concatenate(blocks) if blocks else np.zeros((0, width))
    if not np.all(np.isfinite(rows)):
        raise FileFormatError(path, "holds numbers that are none: damaged.")
    return period, rows, kept


def _frames(path: Path) -> Iterator[tuple[bytes, bytes]]:
    try:
        content = path.read_bytes()
    except OSError as error:
        raise FileFormatError(path, f"can not be read ({error.strerror}).") from error
    at = 0
    while at + _FRAME.size <= len(content):
        kind, size = _FRAME.unpack_from(content, at)
        at += _FRAME.size + size
        if at > len(content):
            return
        yield kind, content[at - size : at]


def _head(path: Path, payload: bytes, recording: Recording) -> float:
    try:
        head = json.loads(payload)
        axes, period = tuple(head["axes"]), float(head["sample_period"])
    except (ValueError, TypeError, KeyError, OverflowError, RecursionError) as error:
        raise FileFormatError(path, f"has no head: damaged ({type(error).__name__}).") from None
    if axes != recording.names or period != recording.sample_period:
        raise FileFormatError(
            path,
            f"is of axes {', '.join(map(str, axes))} every {period:g} s; the recording beside it has "
            f"{', '.join(recording.names)} every {recording.sample_period:g} s.",
        )
    return period


def _stretches(rows: FloatArray) -> list[FloatArray]:
    """Part rows where SYNCs are between them that belong to no stream."""
    breaks = np.flatnonzero(np.diff(rows[:, 0]) != 1.0) + 1
    return np.split(rows, breaks) if rows.size else []


def _beyond(rows: FloatArray, recording: Recording) -> FloatArray:
    """Rows after the last one that is in the recording; all of them where none is found in it."""
    axes = len(recording.axes)
    end = 0
    for experiment in recording.experiments:
        n = experiment.samples
        first = np.all(rows[:, 1 : 1 + axes] == experiment.position[0], axis=1)
        for begin in np.flatnonzero(first).tolist():
            if np.array_equal(rows[begin : begin + n, 1 : 1 + axes], experiment.position):
                end = max(end, begin + n)
    return rows[end:]


def _numbered(name: str) -> Iterator[str]:
    yield name
    k = 2
    while True:
        yield f"{name} {k}"
        k += 1


def _experiment(name: str, rows: FloatArray, period: float, axes: tuple[str, ...]) -> Experiment:
    position, reference, torque, words = np.split(rows[:, 1:], 4, axis=1)
    return Experiment(
        name=name,
        kind="other",
        driven=axes,
        free=(),
        period=None,
        time=period * np.arange(rows.shape[0], dtype=np.float64),
        position=position,
        torque=torque,
        position_reference=reference,
        statusword=np.clip(words, 0, 0xFFFF).astype(np.uint16),
        complete=False,
        note=NOTE,
    )
