"""Virtual time: what is due when, and a clock that only moves when it is told to.

Times are whole nanoseconds, so that a control period of 125 microseconds never drifts.  One
scheduler belongs to one machine; durand's process-wide scheduler is not used.
"""

import heapq
import threading
from collections.abc import Callable, Mapping
from typing import Any

from durand.scheduler import AbstractScheduler

NANOSECONDS = 1_000_000_000


def nanoseconds(seconds: float) -> int:
    """Return a time in whole nanoseconds, nearest."""
    return round(seconds * NANOSECONDS)


class Timer:
    """A call that is due at a time; made by :class:`VirtualScheduler`."""

    __slots__ = ("args", "callback", "due", "kwargs", "pending")

    def __init__(
        self,
        due: int,
        callback: Callable[..., object],
        args: tuple[Any, ...],
        kwargs: Mapping[str, Any],
    ) -> None:
        self.due, self.callback, self.args, self.kwargs = due, callback, args, kwargs
        self.pending = True


class VirtualScheduler(AbstractScheduler):  # type: ignore[misc]  # durand is not typed
    """Calls in order of their time, and of their making where times are equal.

    A call may add and cancel others; one that it makes for a time already reached runs in the same
    :meth:`run_due`.
    """

    def __init__(self) -> None:
        self.now = 0
        """Present virtual time, ns."""
        self._heap: list[tuple[int, int, Timer]] = []
        self._made = 0
        self._lock = threading.RLock()

    @property
    def lock(self) -> threading.RLock:
        """Held by whoever lets the machine's time pass."""
        return self._lock

    @property
    def next_due(self) -> int | None:
        """Time of the next call, ns; None if nothing is due ever."""
        heap = self._heap
        while heap and not heap[0][2].pending:
            heapq.heappop(heap)
        return heap[0][0] if heap else None

    def add(
        self,
        delay: float,
        callback: Callable[..., object],
        args: tuple[Any, ...] = (),
        kwargs: Mapping[str, Any] | None = None,
    ) -> Timer:
        """Call back in so many seconds; return the timer, for :meth:`cancel`.

        Raises
        ------
        ValueError
            If the delay is negative.
        """
        if delay < 0:
            raise ValueError(f"a delay must not be negative, got {delay} s")
        return self.add_at(self.now + nanoseconds(delay), callback, args, kwargs)

    def add_at(
        self,
        due: int,
        callback: Callable[..., object],
        args: tuple[Any, ...] = (),
        kwargs: Mapping[str, Any] | None = None,
    ) -> Timer:
        """Call back at this time, ns; at once (in the next run) if it has passed."""
        timer = Timer(due, callback, args, kwargs or {})
        self._made += 1
        heapq.heappush(self._heap, (due, self._made, timer))
        return timer

    def cancel(self, entry: Timer) -> None:
        """Forget a call; nothing happens if it has been made or cancelled before."""
        entry.pending = False

    def run_due(self, now: int) -> None:
        """Set the clock to ``now`` (ns) and make every call that is due by then, each at its time.

        Raises
        ------
        ValueError
            If ``now`` is in the past.
        """
        if now < self.now:
            raise ValueError(f"virtual time can not go back from {self.now} ns to {now} ns")
        heap = self._heap
        while heap and heap[0][0] <= now:
            due, _, timer = heapq.heappop(heap)
            if not timer.pending:
                continue
            timer.pending = False
            self.now = max(self.now, due)
            timer.callback(*timer.args, **timer.kwargs)
        self.now = now
