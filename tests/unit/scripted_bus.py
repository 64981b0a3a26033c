"""A bus in virtual time whose far end is a function: what comes after a frame was sent, or by itself."""

from collections.abc import Callable
from typing import Any

import can

Answer = Callable[[can.Message], list[can.Message]]


class ScriptedBus:
    """Enough of a bus for a line: ``send``, ``recv`` and a clock.

    Parameters
    ----------
    answer
        Gives the frames that come right after one that the host sent.
    unasked
        Frames that come by themselves, by their time stamps.
    refuses
        Raised by ``send``, if given.
    """

    def __init__(
        self,
        answer: Answer = lambda _: [],
        unasked: list[can.Message] | None = None,
        refuses: Exception | None = None,
    ) -> None:
        self._answer, self._unasked, self._refuses = answer, list(unasked or []), refuses
        self._queue: list[can.Message] = []
        self._time = 0.0
        self.sent: list[can.Message] = []
        self.clock: Any = self

    def now(self) -> float:
        return self._time

    def wait_until(self, moment: float) -> None:
        self._time = max(self._time, moment)

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        if self._refuses is not None:
            raise self._refuses
        self.sent.append(msg)
        self._queue += self._answer(msg)

    def recv(self, timeout: float | None = None) -> can.Message | None:
        if self._queue:
            return self._queue.pop(0)
        end = self._time + (timeout or 0.0)
        if self._unasked and self._unasked[0].timestamp <= end:
            message = self._unasked.pop(0)
            self._time = max(self._time, message.timestamp)
            return message
        self._time = end
        return None

    def shutdown(self) -> None:
        pass


def frame(identifier: int, data: bytes = b"", timestamp: float = 0.0, **more: Any) -> can.Message:
    more.setdefault("is_extended_id", False)
    return can.Message(arbitration_id=identifier, data=data, timestamp=timestamp, **more)
