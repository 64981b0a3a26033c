"""Does a motor push the way its drive asks for?  Told by the work that it does, within some counts.

A machine that stands can not give work: what all motors together have done since then,

    W = sum over axes of integral( (torque - torque at rest) d(position) ),

is at least zero, whatever its masses, springs, couplings and frictions are (it is passive).  A motor
that pushes against what its drive asks for, or an encoder that counts the other way, makes the told
work of its axis negative from the first count on, and it grows with the square of the motion.

What may be missing: positions are whole counts, which by summation by parts is half a count times all
that the torque goes up and down; and for the torque at rest, which is known from a trial before, UNSURE
of the torque limit times the way.  Dry friction may have held any
part of itself in the torque at rest: work stays above zero all the same.  Valid while gravity is as it
was at rest: for small motions.
"""

from collections.abc import Sequence

import numpy as np

from fieldtool.experiment.verification.oscillation import TORQUE_UNITS
from fieldtool.records.model import FloatArray

UNSURE = 0.005
"""Share of the torque limit by which a torque at rest may have changed."""


class WorkWatch:
    """Reckons the work of all axes since they stood.

    Parameters
    ----------
    rest
        Torques at rest where the axes stand, shape (M,), N m or N.
    counts
        One count of each encoder, shape (M,), rad or m.
    limits
        Of the torques, shape (M,), N m or N.
    units
        Of positions, one an axis, for messages.
    """

    def __init__(
        self,
        rest: FloatArray,
        counts: FloatArray,
        limits: FloatArray,
        units: Sequence[str] = (),
    ) -> None:
        self._rest, self._counts = rest, counts
        self._units = [(one, TORQUE_UNITS.get(one, "")) for one in units or [""] * rest.size]
        self._unsure = UNSURE * limits
        self.begin()

    def begin(self) -> None:
        """All axes stand; what they did before is forgotten."""
        m = self._rest.size
        self._start: FloatArray | None = None
        self._work, self._rounding = np.zeros(m), np.zeros(m)

    def take(
        self, position: Sequence[float], torque: Sequence[float], *, fresh: bool
    ) -> list[tuple[int, str]]:
        """Take one SYNC of all axes; return the one whose work is most negative, where there is such."""
        if not fresh:
            self.begin()
            return []
        at, beside = np.array(position), np.array(torque) - self._rest
        if self._start is None:
            self._start = self._at = at
            self._torque, self._mean = beside, beside
            return []
        mean = (beside + self._torque) / 2
        self._work += mean * (at - self._at)
        self._rounding += self._counts / 2 * np.abs(mean - self._mean)
        self._at, self._torque, self._mean = at, beside, mean
        work, allowed = self._work, self._rounding
        way = np.maximum(np.abs(at - self._start), self._counts)
        if work.sum() >= -(allowed + self._unsure * way).sum():
            return []
        k = int(np.argmin(work))
        unit, torque_unit = self._units[k]
        text = (
            f"moved by {float(at[k] - self._start[k]):.3g} {unit} against its own torque of "
            f"{float(mean[k]):.3g} {torque_unit} beside that at rest: its motor pushes against what its "
            "drive asks for, or its encoder counts the other way"
        )
        return [(k, text)]
