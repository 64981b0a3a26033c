"""Moments that nothing from the keyboard may cut short: stopping axes, putting drives back."""

import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from types import FrameType

_HANG_UP = (signal.SIGHUP,) if hasattr(signal, "SIGHUP") else ()
SIGNALS = (signal.SIGINT, signal.SIGTERM, *_HANG_UP)
"""Ctrl-C, the request to end, and the terminal that was closed (not on Windows)."""


@contextmanager
def uninterrupted() -> Iterator[None]:
    """Hold Ctrl-C and the request to end back until the block is done.

    What came meanwhile acts afterwards.  Where an error is on its way, that error goes on, for it says
    more; the program's own handler is told all the same, so that nothing begins anew.

    In other threads than the main one signals never act, and nothing is done.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    came: list[int] = []

    def note(number: int, _frame: FrameType | None) -> None:
        came.append(number)

    before = {number: signal.signal(number, note) for number in SIGNALS}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, signal.SIG_DFL if handler is None else handler)
        acting = [number for number in came if before[number] is not signal.SIG_IGN]
        if acting and sys.exc_info()[0] is None:
            signal.raise_signal(acting[0])
        elif acting and callable(handler := before[acting[0]]):
            with suppress(BaseException):
                handler(acting[0], None)
