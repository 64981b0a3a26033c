"""Positions and torques of all axes at every SYNC, rebuilt from a trace's PDOs alone."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from drives import objects
from drives.api import FloatArray
from drives.objects import ObjectAddress
from drives.replay.decoding import Decoded


@dataclass(frozen=True, eq=False)
class ProcessData:
    """What a trace holds of the axes; n SYNCs, M axes; NaN where a PDO did not come."""

    nodes: tuple[int, ...]
    time: FloatArray
    """Of each SYNC, shape (n,), s."""
    position: FloatArray
    """Shape (n, M), rad or m."""
    torque: FloatArray
    """Shape (n, M), N m or N."""
    target: FloatArray
    """Target position that was sent before each SYNC, shape (n, M), rad or m."""


class Rebuilding:
    """Collects process data as decoded frames come.

    A PDO belongs to the SYNC before it; targets belong to the SYNC after them.

    Parameters
    ----------
    nodes
        Node ids of the axes, in order.
    """

    def __init__(self, nodes: Sequence[int]) -> None:
        self._column = {node: k for k, node in enumerate(nodes)}
        self._time: list[float] = []
        self._rows: list[list[float]] = []
        self._targets: list[list[float]] = []
        self._next_target = [np.nan] * len(nodes)

    def add(self, frame: Decoded) -> None:
        """Take one frame."""
        if frame.kind == "SYNC":
            self._time.append(frame.time)
            self._rows.append([np.nan] * (2 * len(self._column)))
            self._targets.append(list(self._next_target))
            return
        column = self._column.get(frame.node)
        if frame.kind != "PDO" or column is None:
            return
        for value in frame.values:
            physical = np.nan if value.physical is None else value.physical
            self._take(frame, value.address, physical, column)

    def _take(self, frame: Decoded, address: ObjectAddress, physical: float, column: int) -> None:
        if frame.sent:
            if address == objects.TARGET_POSITION.address:
                self._next_target[column] = physical
        elif self._rows:
            if address == objects.POSITION_ACTUAL.address:
                self._rows[-1][2 * column] = physical
            elif address == objects.TORQUE_ACTUAL.address:
                self._rows[-1][2 * column + 1] = physical

    def result(self) -> ProcessData:
        """Return what was collected so far."""
        m = len(self._column)
        rows = np.array(self._rows, dtype=np.float64).reshape(-1, 2 * m)
        return ProcessData(
            tuple(self._column),
            np.array(self._time, dtype=np.float64),
            rows[:, 0::2],
            rows[:, 1::2],
            np.array(self._targets, dtype=np.float64).reshape(-1, m),
        )


def rebuilt(frames: Iterable[Decoded], nodes: Sequence[int]) -> ProcessData:
    """Return the process data of a whole trace."""
    collecting = Rebuilding(nodes)
    for frame in frames:
        collecting.add(frame)
    return collecting.result()


@dataclass(frozen=True)
class Piece:
    """Rows of a recording that were found in a trace."""

    row: int
    """First one of the recording."""
    sync: int
    """SYNC of the trace, from 0, that it belongs to."""
    rows: int


def find(
    data: ProcessData, position: FloatArray, torque: FloatArray, start: int = 0
) -> tuple[Piece, ...]:
    """Return where the rows of a recording are in a trace, in as few pieces as there are.

    Measurements that were disturbed were made again, so a recording may have gaps in the trace.

    Parameters
    ----------
    data
        Of the trace.
    position, torque
        Of the recording, shape (n, M), in the order of the trace's nodes.
    start
        First SYNC to look at.

    Returns
    -------
    tuple of Piece
        In order; the pieces end before the first row that is nowhere.
    """
    pieces: list[Piece] = []
    row, rows = 0, position.shape[0]
    while row < rows:
        piece = _longest(data, position[row:], torque[row:], start)
        if piece is None:
            break
        pieces.append(Piece(row, piece[0], piece[1]))
        row += piece[1]
        start = piece[0] + piece[1]
    return tuple(pieces)


def _longest(
    data: ProcessData, position: FloatArray, torque: FloatArray, start: int
) -> tuple[int, int] | None:
    """Return SYNC and length of the longest piece that begins with the first row; the first of them."""
    at_start = np.all(_near(data.position[start:], position[0]), axis=1) & np.all(
        _near(data.torque[start:], torque[0]), axis=1
    )
    best: tuple[int, int] | None = None
    for k in (np.flatnonzero(at_start) + start).tolist():
        n = min(position.shape[0], data.time.size - k)
        if best is not None and n <= best[1]:
            break
        same = np.all(_near(data.position[k : k + n], position[:n]), axis=1) & np.all(
            _near(data.torque[k : k + n], torque[:n]), axis=1
        )
        length = n if same.all() else int(np.argmin(same))
        if best is None or length > best[1]:
            best = k, length
        if length == position.shape[0]:
            break
    return best


def _near(a: FloatArray, b: FloatArray) -> np.ndarray[tuple[int, ...], np.dtype[np.bool_]]:
    """Whether two numbers are the same but for rounding of the last digit."""
    return np.isclose(a, b, rtol=1e-9, atol=1e-15)
