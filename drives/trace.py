"""Every frame of a session in a file that CAN tools read: what was sent, what came, and when.

The wrapped bus is the seam: real and simulated buses are traced by the same lines, and without a trace
there is no wrapper and no cost.  Frames stand in the file in the order in which the host sent and
received them; each is on its way to the disk before the next one is handled, so that nothing of a
text format is lost when the program is killed.
"""

import os
import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, cast

import can

from drives.errors import BusError

FORMATS = (".asc", ".blf", ".log")
"""Suffixes of files that a trace can be written to (python-can's writers)."""
LARGEST_TRACE = 4_000_000_000
"""Bytes after which a trace ends: some three hours of three axes at a cycle of 1 ms."""
FREE_SPACE = 256_000_000
"""Bytes of the disk that a trace leaves free: recordings are kept before traces."""
LOOKED_AT_EVERY = 4096
"""Frames between two looks at the file's size and at the disk."""
SAME_CLOCK = 60.0
"""Seconds by which an adapter's time stamps may differ from this computer's clock; stamps that are
farther off count from some other start, and are moved to this computer's clock."""
SYNC_ID = 0x080
_BLF_CONTAINER = 8192
"""Bytes that a BLF file holds back at most: its compressed containers are written when full."""


class Trace:
    """A file that takes frames; one that fails or is full takes no more, and says so.

    Parameters
    ----------
    path
        File, with one of the suffixes ``FORMATS``; made anew.
    channel
        Name of the bus in formats that show one.

    Raises
    ------
    BusError
        If the suffix is none of these, or the file can not be made.
    """

    def __init__(self, path: Path, channel: str = "can0") -> None:
        suffix = path.suffix.lower()
        options: dict[str, Any] = {
            ".asc": {"channel": 1},
            ".blf": {"channel": 1, "max_container_size": _BLF_CONTAINER},
            ".log": {"channel": "".join(channel.split()) or "can0"},
        }
        if suffix not in options:
            raise BusError(
                f"{path}: a trace is written as {', '.join(FORMATS)}; choose one of these suffixes"
            )
        self.path = path
        self.frames = 0
        """Frames in the file."""
        self.problem = ""
        """Why the trace ended early, in a sentence; empty if it did not."""
        self._first: float | None = None
        try:
            self._writer = cast(Any, can.Logger(path, **options[suffix]))
            self._writer.file.flush()
        except OSError as error:
            raise BusError(
                f"{path}: the trace can not be written ({error.strerror}). Choose another file, or "
                "leave --trace out. Nothing was moved."
            ) from error

    def note(self, message: can.Message) -> None:
        """Take a frame with its time stamp and direction; never raises for what the disk does."""
        if self.problem:
            return
        if self._first is None:
            self._first = message.timestamp
        elif message.timestamp < self._first:
            message.timestamp = self._first  # no format has times before its first
        try:
            self._writer.on_message_received(message)
            self._writer.file.flush()
            self.frames += 1
            if self.frames % LOOKED_AT_EVERY == 0:
                self._look_at_disk()
        except (OSError, ValueError) as error:
            self._end(getattr(error, "strerror", None) or str(error))

    def _look_at_disk(self) -> None:
        if os.fstat(self._writer.file.fileno()).st_size > LARGEST_TRACE:
            self._end(f"it is {LARGEST_TRACE / 1e9:g} GB long, as long as a trace may be")
        elif shutil.disk_usage(self.path.parent).free < FREE_SPACE:
            self._end(f"the disk has less than {FREE_SPACE / 1e6:g} MB left, which recordings need")

    def _end(self, why: str) -> None:
        self.problem = (
            f"{self.path}: the trace ended after {self.frames} frames: {why}. What it holds until then "
            "can be read; the session goes on without it."
        )
        self.close()

    def close(self) -> None:
        """End the file; a disk that does not take its end changes nothing that is in it."""
        try:
            self._writer.stop()
        except (OSError, ValueError) as error:
            if not self.problem:
                self.problem = f"{self.path}: the trace's end could not be written ({error})."
        finally:
            with suppress(OSError, ValueError):
                self._writer.file.close()


class TracedBus:
    """A bus whose frames, both ways, are noted in a trace; everything else is the bus' own.

    Time stamps are the bus' own where it brings a clock (virtual time), else those of the adapter
    for what came and this computer's for what was sent, both in seconds since 1970.
    """

    def __init__(self, bus: can.BusABC, trace: Trace) -> None:
        self.bus, self.trace = bus, trace
        clock = getattr(bus, "clock", None)
        self._now = time.time if clock is None else clock.now
        self._shift: float | None = None if clock is None else 0.0
        self._sent = can.Message(is_rx=False)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.bus, name)

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Send a frame, and note it with the time at which it was handed over.

        It is noted first: what it brings about comes after it.  A frame that the bus did not take
        is noted too, for it may be on the bus all the same.
        """
        out = self._sent
        out.timestamp = self._now()
        out.arbitration_id, out.data, out.dlc = msg.arbitration_id, msg.data, msg.dlc
        out.is_extended_id, out.is_remote_frame = msg.is_extended_id, msg.is_remote_frame
        self.trace.note(out)
        self.bus.send(msg, timeout)

    def recv(self, timeout: float | None = None) -> can.Message | None:
        """Return the next frame, noted; None if none comes in time."""
        message = self.bus.recv(timeout)
        if message is not None:
            if self._shift is None:
                away = self._now() - message.timestamp
                self._shift = 0.0 if abs(away) < SAME_CLOCK else away
            message.timestamp += self._shift
            # a local process' frame looks sent to the kernel; only a SYNC of it can be the host's own
            message.is_rx = message.is_rx or message.arbitration_id != SYNC_ID
            self.trace.note(message)
        return message


@contextmanager
def traced(bus: can.BusABC, path: Path | None) -> Iterator[can.BusABC]:
    """Give a bus whose frames are traced in a file; the bus itself where there is no path.

    Raises
    ------
    BusError
        If the file can not be made.
    """
    if path is None:
        yield bus
        return
    trace = Trace(path, str(getattr(bus, "channel", "") or "can0"))
    try:
        yield cast(can.BusABC, TracedBus(bus, trace))
    finally:
        trace.close()


def trace_problem(bus: can.BusABC) -> str:
    """Return why a bus' trace ended early, in a sentence; empty if it did not, or there is none."""
    return bus.trace.problem if isinstance(bus, TracedBus) else ""
