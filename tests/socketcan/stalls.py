"""Whether this computer gave its programs their time while a test ran.

What is tested here happens in real time.  On a computer that stands still now and then (a busy one, or
a small guest on it) axes are rightly stopped and frames are rightly late: that says nothing about the
tool.  A process that does nothing but sleep sees such pauses independently of everything that is
tested; a test that fails while there was one is run again, a few times at most.
"""

import mmap
import os
import signal
import struct
import time
from collections.abc import Callable

import pytest
from _pytest.runner import runtestprotocol

NAP = 0.005
"""Seconds that the meter sleeps at a time."""
STALL = 0.03
"""Seconds without the processor that excuse a failure: three cycles of these tests."""
ATTEMPTS = 4
_WORST = struct.Struct("d")


class StallMeter:
    """A process that sleeps, and notes by how much it was woken too late."""

    def __init__(self) -> None:
        self._shared = mmap.mmap(-1, _WORST.size)
        self._parent = os.getpid()
        self._pid = os.fork()
        if self._pid == 0:
            signal.signal(signal.SIGINT, signal.SIG_IGN)
            self._measure()

    def _measure(self) -> None:
        while os.getppid() == self._parent:
            begin = time.monotonic()
            time.sleep(NAP)
            late = time.monotonic() - begin - NAP
            if late > self.worst:
                _WORST.pack_into(self._shared, 0, late)
        os._exit(0)

    @property
    def worst(self) -> float:
        """Seconds by which it was woken too late at most, since the last reset."""
        return float(_WORST.unpack_from(self._shared)[0])

    def reset(self) -> None:
        """Begin anew."""
        _WORST.pack_into(self._shared, 0, 0.0)

    def close(self) -> None:
        """End the process."""
        os.kill(self._pid, signal.SIGKILL)
        os.waitpid(self._pid, 0)


def run_again_if_stalled(
    item: pytest.Item,
    nextitem: pytest.Item | None,
    meter: StallMeter,
    say: Callable[[str], None],
) -> None:
    """Run a test; run it again if it fails and the computer stood still meanwhile."""
    item.ihook.pytest_runtest_logstart(nodeid=item.nodeid, location=item.location)
    for attempt in range(1, ATTEMPTS + 1):
        meter.reset()
        reports = runtestprotocol(item, nextitem=nextitem, log=False)
        worst = meter.worst
        failed = [report for report in reports if report.failed]
        if not failed or worst < STALL or attempt == ATTEMPTS:
            for report in reports:
                report.sections.append(("Stall meter", f"{1000 * worst:.1f} ms, attempt {attempt}"))
                item.ihook.pytest_runtest_logreport(report=report)
            break
        crash = getattr(failed[0].longrepr, "reprcrash", None)
        why = " ".join(crash.message.split())[-200:] if crash else failed[0].when
        say(
            f"{item.name}, attempt {attempt}: this computer stood still for {1000 * worst:.0f} ms "
            f"({why}); once more"
        )
    item.ihook.pytest_runtest_logfinish(nodeid=item.nodeid, location=item.location)
