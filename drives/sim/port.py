"""How simulated nodes are joined to whatever carries their frames."""

from collections.abc import Callable

from durand.network import NetworkABC

Callback = Callable[[int, bytes | bytearray], None]
"""Gets identifier and data of a frame."""


class Switchboard:
    """Which callbacks hear frames of which identifier; one for all nodes of a machine."""

    def __init__(self) -> None:
        self._callbacks: dict[int, tuple[Callback, ...]] = {}

    def deliver(self, cob_id: int, data: bytes | bytearray) -> None:
        """Hand a frame to everyone who listens."""
        for callback in self._callbacks.get(cob_id, ()):
            callback(cob_id, data)

    def add(self, cob_id: int, callback: Callback) -> None:
        """Begin to listen."""
        self._callbacks[cob_id] = (*self._callbacks.get(cob_id, ()), callback)

    def remove(self, cob_id: int, callback: Callback) -> None:
        """End it; nothing happens if nobody listened."""
        rest = tuple(c for c in self._callbacks.get(cob_id, ()) if c != callback)
        self._callbacks[cob_id] = rest


class BusPort(NetworkABC):  # type: ignore[misc]  # durand is not typed
    """A node's connection to the bus; it can be pulled.

    Parameters
    ----------
    switchboard
        Where frames come from.
    transmit
        Where frames go to.
    """

    def __init__(self, switchboard: Switchboard, transmit: Callable[[int, bytes], None]) -> None:
        self._switchboard, self._transmit = switchboard, transmit
        self._subscriptions: dict[int, Callback] = {}
        self.connected = True

    def add_subscription(self, cob_id: int, callback: Callback) -> None:
        """Listen to frames of this identifier; one callback an identifier."""
        self.remove_subscription(cob_id)
        self._subscriptions[cob_id] = callback
        if self.connected:
            self._switchboard.add(cob_id, callback)

    def remove_subscription(self, cob_id: int) -> None:
        """Listen no more; nothing happens if nobody listened."""
        callback = self._subscriptions.pop(cob_id, None)
        if callback is not None and self.connected:
            self._switchboard.remove(cob_id, callback)

    def send(self, cob_id: int, msg: bytes) -> None:
        """Send a frame; of a port that is not connected nothing is heard."""
        if self.connected:
            self._transmit(cob_id, msg)

    def connect(self, connected: bool) -> None:
        """Plug in or pull out."""
        if connected == self.connected:
            return
        self.connected = connected
        for cob_id, callback in self._subscriptions.items():
            if connected:
                self._switchboard.add(cob_id, callback)
            else:
                self._switchboard.remove(cob_id, callback)
