"""A python-can bus that answers from a trace: the session is shown again, with no drive there.

``can.Bus(interface="fieldreplay", channel="session/trace.asc")``.  What the host sends must be what it
sent when the trace was made, frame by frame; at the first difference the bus says which frame differs
and carries no more.  The host's own heartbeat is not compared: it goes by the clock.

Time is that of the trace.  It passes as frames are sent and received, and while the host waits.
"""

from collections import deque
from pathlib import Path

import can
from can.typechecking import CanFilters, Channel

from drives.errors import ProfileError
from drives.replay.reading import read_trace

INTERFACE = "fieldreplay"
HOST_TIME = 0.002
"""Seconds that the host may have needed to think between two frames."""
ENDED = "the replay has ended"


class ReplayBus(can.BusABC):
    """A trace as a bus.

    Parameters
    ----------
    channel
        Trace file.
    can_filters
        As everywhere in python-can; frames that do not match are passed over.
    bitrate
        Taken and not used.

    Raises
    ------
    can.CanInitializationError
        If there is no such trace.
    TypeError
        If an option is not known.
    """

    of_this_process = True
    """No other process can have to do with it."""

    def __init__(
        self,
        channel: Channel | None = None,
        can_filters: CanFilters | None = None,
        bitrate: int = 1_000_000,  # noqa: ARG002
        **unknown: object,
    ) -> None:
        if unknown:
            raise TypeError(f"{INTERFACE} has no option {', '.join(sorted(unknown))}")
        self.path = Path(str(channel or ""))
        self._frames = read_trace(self.path)
        self._ahead: deque[can.Message] = deque()
        self._number = 0
        """Of the last frame that was played, from 1."""
        self.difference = ""
        """Where the host left the trace, in a sentence; empty as long as it did not."""
        try:
            first = self._peek()
        except ProfileError as error:
            self._frames.close()
            raise can.CanInitializationError(str(error)) from error
        self._now = first.timestamp if first is not None else 0.0
        self._can_protocol = can.CanProtocol.CAN_20
        self.channel_info = f"{INTERFACE} {self.path}"
        self.clock = self
        self.not_imitated = (f"everything: frames of {self.path.name} are shown again",)
        super().__init__(channel=str(channel), can_filters=can_filters)

    # --- the trace's time --------------------------------------------------------------------------

    def now(self) -> float:
        """Seconds, as in the trace; with the host about to send, when it did so, if that is soon."""
        sent = self._peek()
        if sent is not None and not sent.is_rx and sent.timestamp - self._now <= HOST_TIME:
            self._now = max(self._now, sent.timestamp)
        return self._now

    def wait_until(self, moment: float) -> None:
        """Let time pass; not less than passed until the host sent its next frame."""
        sent = self._next_sent()
        self._now = max(self._now, moment, sent.timestamp if sent is not None else moment)

    # --- frames ------------------------------------------------------------------------------------

    @property
    def finished(self) -> bool:
        """Whether everything that the host sent in the trace was sent again."""
        return not self.difference and self._next_sent() is None

    @property
    def remaining(self) -> int:
        """Number of the last frame that was played."""
        return self._number

    def send(self, msg: can.Message, timeout: float | None = None) -> None:  # noqa: ARG002
        """Compare a frame with the one that was sent when the trace was made.

        Raises
        ------
        can.CanOperationError
            If it is another one, or nothing more was sent then; naming both.
        """
        if self._is_shutdown:
            raise can.CanOperationError(f"{self.channel_info}: the bus is shut down")
        if self.difference:
            raise can.CanOperationError(ENDED)
        if _is_beat(msg):
            return
        recorded = self._next_sent()
        if recorded is None:
            self._differs(f"there nothing more was sent, now {_shown(msg)}")
        elif not _same(recorded, msg):
            number = self._number + self._distance(recorded)
            self._differs(
                f"frame {number} at {recorded.timestamp:.6f} s was {_shown(recorded)}, now "
                f"{_shown(msg)}"
            )
        else:
            self._ahead.remove(recorded)
            self._number += 1
            self._now = max(self._now, recorded.timestamp)

    def _differs(self, how: str) -> None:
        self.difference = (
            f"the replay of {self.path} ends, because something else was sent than when it was made: "
            f"{how}."
        )
        raise can.CanOperationError(self.difference)

    def recv(self, timeout: float | None = None) -> can.Message | None:
        """Return the next frame, if it came before the host sent its next one.

        Raises
        ------
        can.CanOperationError
            If the bus is shut down.
        can.CanTimeoutError
            If ``timeout`` is None and nothing comes any more.
        """
        if self._is_shutdown:
            raise can.CanOperationError(f"{self.channel_info}: the bus is shut down")
        while (frame := self._peek()) is not None and (frame.is_rx or _is_beat(frame)):
            self._ahead.popleft()
            self._number += 1
            if not frame.is_rx:
                continue
            self._now = max(self._now, frame.timestamp)
            if self._matches_filters(frame):
                return frame
        if timeout is None:
            raise can.CanTimeoutError(f"{self.channel_info}: no frame comes before one is sent")
        if timeout > 0:  # whoever waits in vain does so until it is time to send
            self._now += timeout
            if frame is not None:
                self._now = max(self._now, frame.timestamp)
        return None

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        return self.recv(timeout), True

    def _peek(self) -> can.Message | None:
        """Return the next frame of the trace, and leave it there."""
        if not self._ahead:
            frame = next(self._frames, None)
            if frame is None:
                return None
            self._ahead.append(frame)
        return self._ahead[0]

    def _next_sent(self) -> can.Message | None:
        """Return the next frame that the host sent, its heartbeats left out, and leave it there."""
        for frame in self._ahead:
            if not frame.is_rx and not _is_beat(frame):
                return frame
        while (frame := next(self._frames, None)) is not None:  # type: ignore[assignment]
            self._ahead.append(frame)
            if not frame.is_rx and not _is_beat(frame):
                return frame
        return None

    def _distance(self, frame: can.Message) -> int:
        return next(k for k, one in enumerate(self._ahead, 1) if one is frame)

    def shutdown(self) -> None:
        """Close the trace."""
        self._frames.close()
        super().shutdown()

    @property
    def state(self) -> can.BusState:
        """Always active."""
        return can.BusState.ACTIVE

    @state.setter
    def state(self, new_state: can.BusState) -> None:
        if new_state is not can.BusState.ACTIVE:
            raise NotImplementedError(f"{INTERFACE} is always active, it can not be {new_state}")


def _is_beat(frame: can.Message) -> bool:
    return 0x700 < frame.arbitration_id < 0x780 and not frame.is_extended_id


def _same(a: can.Message, b: can.Message) -> bool:
    return (
        a.arbitration_id == b.arbitration_id
        and a.is_extended_id == b.is_extended_id
        and a.is_remote_frame == b.is_remote_frame
        and bytes(a.data) == bytes(b.data)
    )


def _shown(frame: can.Message) -> str:
    data = bytes(frame.data).hex(" ").upper() or "no data"
    return f"{frame.arbitration_id:03X} [{data}]"
