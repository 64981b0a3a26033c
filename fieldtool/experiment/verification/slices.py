"""Targets in slices, with something to be done before some of their rows."""

from collections.abc import Callable, Sequence

from drives.api import Capture, FloatArray

SLICE_TIME = 0.02
"""Seconds that are sent at a time."""
SENT_AHEAD = 2
"""Slices that are on their way when a row is asked for, at most."""

Turn = tuple[int, Callable[[], None]]
"""A row, and what is done before it is sent."""


def slices(targets: FloatArray, step: float, turns: Sequence[Turn] = ()) -> "Slices":
    """Return targets, shape (n, M), in slices of SLICE_TIME; turns come in the order of their rows."""
    return Slices(targets, max(2, round(SLICE_TIME / step)), turns)


class Slices:
    """Targets in slices; a ``drives.api.Source``."""

    def __init__(self, targets: FloatArray, rows: int, turns: Sequence[Turn] = ()) -> None:
        self._targets, self._rows, self._done, self._turns = targets, rows, 0, list(turns)

    def __call__(self, _before: Capture | None) -> FloatArray | None:
        """Return the next slice; None after the last one."""
        if self._done >= self._targets.shape[0]:
            return None
        end = self._done + self._rows
        if self._turns and self._done == self._turns[0][0]:
            self._turns.pop(0)[1]()
        if self._turns:
            end = min(end, self._turns[0][0])
        part = self._targets[self._done : end]
        self._done += part.shape[0]
        return part
