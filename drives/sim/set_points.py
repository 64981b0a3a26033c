"""Set-points of profile position mode: the handshake of controlword bit 4 and statusword bit 12.

The host raises bit 4 (new set-point), the drive takes the target and raises bit 12 (acknowledge),
the host clears bit 4, the drive clears bit 12 when it has room for another.  One set-point can wait
while one is approached; with bit 5 (change immediately) the new one takes over at once.
"""

from collections.abc import Callable

from drives.sim.state_machine import Control


class SetPoints:
    """One set-point under way and at most one waiting, in encoder counts.

    Parameters
    ----------
    begin
        Called with the target that is to be approached from now on.
    """

    def __init__(self, begin: Callable[[int], None]) -> None:
        self._begin = begin
        self._waiting: int | None = None
        self._moving = False
        self._requested = False
        self._target = 0
        self.last = 0
        """Newest set-point; what a relative one is added to."""
        self.acknowledged = False
        """Statusword bit 12."""

    def reset(self, position: int) -> None:
        """Forget all set-points; relative ones count from this position."""
        self._waiting, self._moving = None, False
        self.last, self.acknowledged = position, False

    def on_controlword(self, word: int, before: int, target: int) -> None:
        """Follow bits 4 to 6 of a controlword; ``target`` is object 0x607A."""
        self._requested = bool(word & Control.NEW_SET_POINT)
        rising = self._requested and not before & Control.NEW_SET_POINT
        if rising and not self.acknowledged:
            self._take(word, target)
        self._release()

    def on_reached(self) -> None:
        """Go on to the set-point that waits, if any: the one under way has been reached."""
        self._moving = False
        if self._waiting is not None:
            waiting, self._waiting = self._waiting, None
            self._start(waiting)
            self._release()

    def resume(self) -> bool:
        """Approach the set-point under way again (after a halt); False if there is none."""
        if self._moving:
            self._begin(self._target)
        return self._moving

    def _take(self, word: int, target: int) -> None:
        wanted = self.last + target if word & Control.RELATIVE else target
        if self._moving and not word & Control.CHANGE_IMMEDIATELY:
            if self._waiting is not None:
                return
            self._waiting = wanted
        else:
            self._waiting = None
            self._start(wanted)
        self.last, self.acknowledged = wanted, True

    def _start(self, target: int) -> None:
        self._target, self._moving = target, True
        self._begin(target)

    def _release(self) -> None:
        if not self._requested and self._waiting is None:
            self.acknowledged = False
