"""Torques without what drives do where a SYNC comes late: their reference is at rest by then.

A drive goes straight from target to target and has arrived after a cycle.  Where the next SYNC is so
late that it comes after the drive's next step, what it feeds forward for its reference's velocity and
acceleration is gone, and that is the torque that it samples at that SYNC.  Next to nothing moves for it;
but from sample to sample it looks like a swing.
"""

from collections.abc import Sequence

import numpy as np

from fieldtool.records.model import FloatArray

MORE = 1.3
"""Times what is fed forward that a torque may fall for it: loops answer too, and the move goes on."""
LATE = 5e-6
"""Seconds by which a SYNC is late: nobody knows when a drive's next step is."""


class Brakes:
    """Holds each axis' torque at late SYNCs where it falls by no more than what is fed forward.

    What falls farther or the other way is shown as it is, and so is all where SYNCs are in time or
    targets stand: nothing is fed forward then.

    Parameters
    ----------
    fed
        Torque per velocity and per acceleration of the reference, shape (2, M), SI.
    step
        Cycle time, s.
    """

    def __init__(self, fed: FloatArray, step: float) -> None:
        self._per_velocity, self._per_acceleration = fed[0] / step, fed[1] / step**2
        self.begin()

    def begin(self) -> None:
        """Another motion begins."""
        self._targets: list[FloatArray] = []
        self._shown: FloatArray | None = None

    def take(self, torque: Sequence[float], target: Sequence[float], late: float) -> list[float]:
        """Take one SYNC of all axes and the targets sent before it; return the torques to look at.

        It came so many seconds later than a cycle after the one before.
        """
        told = np.array(torque)
        falls = self._fed() if self._shown is not None else np.zeros_like(told)
        self._targets = [*self._targets[-2:], np.array(target)]
        shown = told if self._shown is None else self._shown
        way = (shown - told) * np.sign(falls)
        brakes = (way > 0) & (way <= MORE * np.abs(falls)) & (late > LATE)
        self._shown = np.where(brakes, shown, told)
        return [float(one) for one in self._shown]

    def _fed(self) -> FloatArray:
        """Return what was fed forward in the cycle that the next sample ends, shape (M,)."""
        if len(self._targets) < 3:
            return np.zeros_like(self._per_velocity)
        before, first, last = self._targets
        way = last - first
        fed: FloatArray = self._per_velocity * way + self._per_acceleration * (way - first + before)
        return fed
