"""One CAN bus, one thread: frames are received when somebody waits for them.

python ``canopen`` usually receives in a thread of its own; a dead thread then looks like a quiet bus
while periodic frames go on.  Here whoever waits receives, so an error of the bus is raised where
it matters, and time is the bus' own.
"""

from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager, suppress
from math import inf

import can
import canopen

from drives.bus import Clock, bus_state, clock_of, is_data, trouble_of
from drives.canopen_drive.sdo import StrictSdoClient
from drives.errors import BusError

NMT_OPERATIONAL = 5
NMT_STATES = (0, 4, NMT_OPERATIONAL, 127)
"""That a heartbeat can show: boot-up, stopped, operational, pre-operational."""
NMT_ID, NMT_BYTES = 0x000, 2
EMERGENCY_IDS, EMERGENCY_BYTES, HEARTBEAT_ID = (0x81, 0xFF), 8, 0x700
SHORTEST_WAIT = 1e-4
"""Seconds; a difference of two times may be smaller than a clock can tell."""


class Line(canopen.Network):  # type: ignore[misc]
    """A CANopen network whose frames are received by those who wait for them."""

    def __init__(self, bus: can.BusABC) -> None:
        super().__init__(bus)
        self.can_bus = bus
        self.clock: Clock = clock_of(bus)
        self.frames = 0
        """Frames received."""
        self.troubles: dict[str, int] = {}
        """Error frames: what they said, and how often."""
        self._lost = 0
        self._beat: can.Message | None = None
        self._next_beat = self._beat_period = 0.0

    def begin_heartbeat(self, node_id: int, period: float) -> None:
        """Be a node that is operational, seen by its heartbeat every so many seconds, from now on.

        It is sent by :meth:`beat`, and while somebody waits for an answer; there is no thread that
        would go on when the program hangs.
        """
        self._beat = can.Message(
            arbitration_id=0x700 + node_id, data=bytes([NMT_OPERATIONAL]), is_extended_id=False
        )
        self._beat_period, self._next_beat = period, self.clock.now()

    def end_heartbeat(self) -> None:
        """Send no heartbeat any more."""
        self._beat = None

    def beat(self) -> float:
        """Send the heartbeat if it is due; return the seconds until the next one."""
        if self._beat is None:
            return inf
        now = self.clock.now()
        if now >= self._next_beat:
            self.send(self._beat)
            self._next_beat = now + self._beat_period
        return self._next_beat - now

    def send(self, message: can.Message) -> None:
        """Send a frame; raise BusError if the bus does not take it."""
        try:
            self.can_bus.send(message)
        except (can.CanError, OSError) as error:
            raise BusError(f"the bus does not take frames any more: {error}") from error

    def send_message(self, can_id: int, data: bytes, remote: bool = False) -> None:
        """Send a frame by its identifier, as ``canopen`` does it."""
        self.send(
            can.Message(
                arbitration_id=can_id, data=data, is_extended_id=False, is_remote_frame=remote
            )
        )

    def receive(self, timeout: float) -> can.Message | None:
        """Receive at most one frame, and return it.

        Raises
        ------
        BusError
            If the bus delivers none any more, or the adapter has switched itself off the bus.
        """
        try:
            message = self.can_bus.recv(timeout)
        except (can.CanError, OSError) as error:
            raise BusError(f"the bus does not deliver frames any more: {error}") from error
        if message is not None:
            self.frames += 1
            if message.is_error_frame:
                self._take_trouble(message)
        return message

    def _take_trouble(self, message: can.Message) -> None:
        trouble = trouble_of(message, hasattr(self.can_bus, "overruns"))
        if trouble.matters:
            self.troubles[trouble.words] = self.troubles.get(trouble.words, 0) + 1
        self._lost += trouble.overrun
        if trouble.bus_off:
            raise BusError(
                f"the adapter went off the bus: {trouble.words}. Check cable, terminators and bit rate."
            )

    @property
    def overruns(self) -> int:
        """Received frames that were lost since the bus was opened, as far as the adapter tells."""
        return int(getattr(self.can_bus, "overruns", 0)) + self._lost

    @contextmanager
    def only(self, identifiers: Collection[int]) -> Iterator[None]:
        """Receive frames of these identifiers only, where the bus can leave the others out.

        A bus that is traced takes every frame.
        """
        focus = getattr(type(self.can_bus), "focus", None)
        if focus is None:
            yield
            return
        focus(self.can_bus, identifiers)
        try:
            yield
        finally:
            with suppress(can.CanError, OSError):
                focus(self.can_bus, None)

    def diagnosis(self) -> str:
        """Return in a sentence what the bus shows, where a node is silent; empty if it is quiet."""
        state = bus_state(self.can_bus)
        if self.troubles:
            said = ", ".join(f"{text} ({count} times)" for text, count in self.troubles.items())
            return f"There were error frames: {said}. The bit rate is most likely another one."
        if state:
            return (
                f"The adapter is {state}: nobody acknowledges its frames, or the bit rate is wrong."
            )
        if not self.frames:
            return "Nothing at all was heard on this bus."
        return ""

    def pump(self, timeout: float) -> can.Message | None:
        """Receive at most one frame, hand it on to those who subscribed, and return it."""
        message = self.receive(timeout)
        if message is not None and is_data(message):
            self.notify(message.arbitration_id, message.data, message.timestamp)
        return message

    def listen(self, seconds: float) -> frozenset[int]:
        """Receive for so long, and return the identifiers that were heard."""
        heard: set[int] = set()
        deadline = self.clock.now() + seconds
        while (left := deadline - self.clock.now()) > 0:
            message = self.pump(max(SHORTEST_WAIT, left))
            if message is not None and is_data(message):
                heard.add(message.arbitration_id)
        return frozenset(heard)

    def notify(self, can_id: int, data: bytearray, timestamp: float) -> None:
        """Hand a frame on to those who subscribed; one that is too short can not harm them."""
        if EMERGENCY_IDS[0] <= can_id <= EMERGENCY_IDS[1] and len(data) < EMERGENCY_BYTES:
            data = bytearray(data) + bytes(EMERGENCY_BYTES - len(data))
        if can_id > HEARTBEAT_ID and (not data or data[0] & 0x7F not in NMT_STATES):
            return  # no heartbeat of any node; `canopen` would stumble over it
        if can_id == NMT_ID and len(data) < NMT_BYTES:
            return  # no command, likewise
        super().notify(can_id, data, timestamp)

    def wait(self, seconds: float, until: Callable[[], bool] = lambda: False) -> bool:
        """Receive for so long, or until a condition holds; return whether it does."""
        deadline = self.clock.now() + seconds
        while not until():
            left = deadline - self.clock.now()
            if left <= 0:
                return until()
            self.pump(max(SHORTEST_WAIT, min(left, self.beat())))
        return True


class Node(canopen.RemoteNode):  # type: ignore[misc]
    """``canopen``'s remote node with the SDO client above."""

    def add_sdo(self, rx_cobid: int, tx_cobid: int) -> StrictSdoClient:
        """Add an SDO channel."""
        client = StrictSdoClient(rx_cobid, tx_cobid, self.object_dictionary)
        self.sdo_channels.append(client)
        return client
