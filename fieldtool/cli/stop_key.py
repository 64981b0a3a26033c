"""Ctrl-C as a request to stop, and the question before anything moves."""

import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from time import monotonic
from types import FrameType

from drives.canopen_drive.interrupts import SIGNALS
from drives.errors import STOPPED_AT_REST, UserStopError
from fieldtool.cli.output import confirmed
from fieldtool.errors import PlanRefusedError

ASKED_WITHIN = 0.5
"""Seconds: a motion asks for a stop so often, at least."""


class StopKey:
    """Ctrl-C asks for a stop.

    While axes move, the motion asks for it in every cycle and ends in a stop of all axes; at any
    other time the work in hand is broken off at once, and what it had changed is put back.
    """

    def __init__(self, answer: str = "Stopping all axes ...") -> None:
        self.pressed = False
        self._answer = answer
        self._asked = -ASKED_WITHIN

    def __call__(self) -> bool:
        """Return whether it was pressed; a motion asks in every cycle."""
        self._asked = monotonic()
        return self.pressed

    def on_signal(self, _number: int, _frame: FrameType | None) -> None:
        """Note the key; with no motion to end, end what is being done now."""
        if self.pressed:
            return
        self.pressed = True
        if monotonic() - self._asked <= ASKED_WITHIN:
            with suppress(OSError):  # the terminal may be gone
                sys.stderr.write(f"\n{self._answer}\n")
            return
        raise UserStopError(STOPPED_AT_REST)

    def check(self) -> None:
        """Raise UserStopError if it was pressed; between two stages, with all axes disabled."""
        if self.pressed:
            raise UserStopError(STOPPED_AT_REST)


@contextmanager
def stop_key(answer: str = "Stopping all axes ...") -> Iterator[StopKey]:
    """Make Ctrl-C, the request to end, and a closed terminal a request to stop, while this lasts.

    Who started the tool with ``nohup`` wants it to outlive the terminal: that is left so.
    """
    key = StopKey(answer)
    heard = [
        number
        for number in SIGNALS
        if number in (signal.SIGINT, signal.SIGTERM) or signal.getsignal(number) != signal.SIG_IGN
    ]
    before = {number: signal.signal(number, key.on_signal) for number in heard}
    try:
        yield key
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def may_move(yes: bool) -> Callable[[str], bool] | None:
    """Return how to ask a person before the machine moves; None where nobody has to be asked.

    Where there is nobody to ask, nothing moves without ``--yes``.
    """
    if yes:
        return None

    def ask(sentence: str) -> bool:
        if not somebody_there():
            raise PlanRefusedError(
                "there is nobody to ask before the machine moves. Use --yes to move it without asking. "
                "Nothing was moved."
            )
        return confirmed(f"{sentence}\nMove the machine now?")

    return ask


def somebody_there() -> bool:
    """Whether a person can answer a question."""
    return sys.stdin is not None and sys.stdin.isatty()
