"""Heartbeat producer (0x1017) and consumers (0x1016) of the simulated drive."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

from drives.sim.abort_codes import Abort
from drives.sim.dictionary import DriveDictionary
from drives.sim.entries import HEARTBEAT_CONSUMERS
from drives.sim.scheduler import Timer, VirtualScheduler


class HeartbeatProducer:
    """Sends the NMT state every 0x1017 milliseconds; the first frame goes out at once."""

    def __init__(
        self,
        dictionary: DriveDictionary,
        scheduler: VirtualScheduler,
        send_state: Callable[[], None],
    ) -> None:
        self._scheduler, self._send_state = scheduler, send_state
        self._timer: Timer | None = None
        dictionary.effects[0x1017, 0] = self.start

    def start(self, milliseconds: int) -> None:
        """Begin with this period; 0 ends it."""
        if self._timer is not None:
            self._scheduler.cancel(self._timer)
            self._timer = None
        if milliseconds:
            self._beat(milliseconds)

    def _beat(self, milliseconds: int) -> None:
        self._timer = self._scheduler.add(milliseconds / 1000, self._beat, (milliseconds,))
        self._send_state()


@dataclass(frozen=True)
class _Watch:
    """Whose heartbeat is watched, and how long it may stay away, ms."""

    node_id: int
    milliseconds: int


class HeartbeatConsumers:
    """Watches other nodes' heartbeats (the host's above all).

    An entry is node id << 16 | milliseconds.  Watching starts with the first heartbeat received
    after the entry was written, and again with the first one after a loss.
    """

    def __init__(
        self,
        dictionary: DriveDictionary,
        scheduler: VirtualScheduler,
        on_lost: Callable[[int], None],
        on_back: Callable[[int], None],
    ) -> None:
        self._dictionary, self._scheduler = dictionary, scheduler
        self._on_lost, self._on_back = on_lost, on_back
        self._watches: dict[int, _Watch] = {}
        self._timers: dict[int, Timer] = {}
        self._lost: set[int] = set()
        for k in range(1, HEARTBEAT_CONSUMERS + 1):
            dictionary.guards[0x1016, k] = partial(self._refuse, k)

    @property
    def watched(self) -> tuple[int, ...]:
        """Node ids whose heartbeats are to be listened to."""
        return tuple(self._watches)

    def configure(self) -> None:
        """Take 0x1016 as it stands; every watch waits for its first heartbeat again."""
        self.stop()
        self._watches = {}
        for k in range(1, HEARTBEAT_CONSUMERS + 1):
            watch = _parse(int(self._dictionary.read(0x1016, k)))
            if watch is not None:
                self._watches[watch.node_id] = watch

    def stop(self) -> None:
        """Watch nothing until the next heartbeats."""
        for timer in self._timers.values():
            self._scheduler.cancel(timer)
        self._timers.clear()
        self._lost.clear()

    def heard(self, node_id: int) -> None:
        """Take note of a heartbeat; ones that nobody asked for are passed over."""
        watch = self._watches.get(node_id)
        if watch is None:
            return
        timer = self._timers.get(node_id)
        if timer is not None:
            self._scheduler.cancel(timer)
        delay = watch.milliseconds / 1000
        self._timers[node_id] = self._scheduler.add(delay, self._expired, (node_id,))
        if node_id in self._lost:
            self._lost.discard(node_id)
            self._on_back(node_id)

    def _expired(self, node_id: int) -> None:
        del self._timers[node_id]
        self._lost.add(node_id)
        self._on_lost(node_id)

    def _refuse(self, k: int, value: int) -> int | None:
        if value >> 24 or (value >> 16) > 127:
            return Abort.INVALID_VALUE
        watch = _parse(value)
        if watch is None:
            return None
        others = (
            _parse(int(self._dictionary.read(0x1016, j)))
            for j in range(1, HEARTBEAT_CONSUMERS + 1)
            if j != k
        )
        if any(other is not None and other.node_id == watch.node_id for other in others):
            return Abort.INCOMPATIBLE
        return None


def _parse(value: int) -> _Watch | None:
    node_id, milliseconds = (value >> 16) & 0x7F, value & 0xFFFF
    return _Watch(node_id, milliseconds) if node_id and milliseconds else None
