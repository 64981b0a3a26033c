"""Does a motor push the way its drive asks for?  Told by the work that it does, within some counts.

A machine that stands can not give work: what all motors together have done since then,

    W = sum over axes of integral( (torque - torque at rest) d(position) ),

is at least zero, whatever its masses, springs, couplings and frictions are (it is passive).  A motor
that pushes against what its drive asks for, or an encoder that counts the other way, makes the told
work of its axis negative from the first count on, and it grows with the square of the motion.

What may be missing: positions are whole counts, which by summation by parts is half a count times what
the torque goes up and down.  Where the encoder counts, torque may answer to that very rounding, and
all of it is allowed; else it is noise, which adds up as squares do.  Besides, the torque at rest, which
is known from a trial before, may be off by some of its own steps and UNSURE of the torque limit; and
while targets move, positions may be a cycle older than torques, or motors a cycle late.  What moves
when it is first seen brings its motion along, twice what the model's masses make of it.  Dry
friction may have held any part of itself in the torque at rest: work stays above zero all the same.
Valid while gravity is as it was at rest: for small motions.  After a sample that is missing while
targets move nothing is said until all stand again: nobody knows what springs and masses have taken up.
"""

from collections.abc import Sequence

import numpy as np

from fieldtool.experiment.verification.oscillation import TORQUE_UNITS
from fieldtool.records.model import FloatArray

UNSURE, STEPS = 0.0002, 0.5
"""Share of the torque limit, and steps in which it is told, by which a torque at rest may be off."""
SIGMAS = 4.0
FIRST = 4
"""Cycles from which it is told how fast axes move already."""
ANSWERS = 3
"""Cycles in which a torque answers to a count."""
TINY = 1e-300
LEARNED = 2.0
"""Times the work that was missing with the old parameters, over what is usually allowed, that may be
missing with the new ones: something shakes the machine, or motors lag what their drives tell."""


class WorkRecord:
    """Keeps what axes did in small motions, for the torque at rest is known only afterwards."""

    def __init__(self) -> None:
        self._parts: list[tuple[bool, list[tuple[Sequence[float], Sequence[float]]]]] = []
        self._lost = False

    def begin(self, *, moves: bool = False) -> None:
        """All axes stand; what they did before is a part of its own."""
        self._parts.append((moves, []))
        self._lost = False

    def take(
        self, position: Sequence[float], torque: Sequence[float], *, fresh: bool
    ) -> list[tuple[int, str]]:
        """Take one SYNC of all axes; nothing is said of it."""
        if not fresh or not self._parts:
            moves = bool(self._parts) and self._parts[-1][0]
            self.begin(moves=moves)
            self._lost = moves
        if fresh and not self._lost:
            self._parts[-1][1].append((position, torque))
        return []

    def most(self, watch: "WorkWatch") -> float:
        """Return the largest share of what a watch allows that was missing."""
        worst = 0.0
        for moves, part in self._parts:
            watch.begin(moves=moves)
            for position, torque in part:
                watch.take(position, torque, fresh=True)
                worst = max(worst, watch.missing)
        return worst


class WorkWatch:
    """Reckons the work of all axes since they stood.

    Parameters
    ----------
    rest
        Torques at rest where the axes stand, shape (M,), N m or N.
    counts
        One count of each encoder, shape (M,), rad or m.
    limits, quanta
        Of the torques; steps in which they are told; shape (M,), N m or N.
    speeds
        Inertias over the cycle time squared, shape (M,): what makes energy of steps.
    units
        Of positions, one an axis, for messages.
    missing
        Largest share of what is usually allowed that was missing with the old parameters.
    unsure
        By how much torques at rest may be others besides: an axis that still crept, say; shape (M,).
    """

    def __init__(
        self,
        rest: FloatArray,
        counts: FloatArray,
        limits: FloatArray,
        quanta: FloatArray,
        speeds: FloatArray,
        units: Sequence[str] = (),
        missing: float = 0.0,
        unsure: FloatArray | float = 0.0,
    ) -> None:
        self._scale = max(1.0, LEARNED * missing)
        self._rest, self._counts = rest, counts
        self._units = [(one, TORQUE_UNITS.get(one, "")) for one in units or [""] * rest.size]
        self._speeds = speeds
        self._unsure = UNSURE * limits + STEPS * quanta + unsure
        self.begin()

    def begin(self, *, moves: bool = False) -> None:
        """All axes stand; what they did before is forgotten.

        ``moves`` says whether the targets move from now on.
        """
        self._moves, self._lost = moves, False
        m = self._rest.size
        self.missing = 0.0
        """Work that is missing, over what may be by rounding and by the torque at rest."""
        self._start: FloatArray | None = None
        self._work, self._allowed, self._noise = np.zeros(m), np.zeros(m), np.zeros(m)
        self._counted, self._seen = np.zeros(m), 0

    def take(
        self, position: Sequence[float], torque: Sequence[float], *, fresh: bool
    ) -> list[tuple[int, str]]:
        """Take one SYNC of all axes; return the one whose work is most negative, where there is such."""
        if not fresh:
            self.begin(moves=self._moves)
            self._lost = self._moves
        if not fresh or self._lost:
            return []
        at, beside = np.array(position), np.array(torque) - self._rest
        if self._start is None:
            self._start = self._at = at
            self._torque, self._mean, self._step = beside, beside, np.zeros_like(at)
            return []
        mean = (beside + self._torque) / 2
        step = at - self._at
        self._work += mean * step
        if self._moves:
            self._allowed += np.abs(mean * (step - self._step))
        self._step = step
        rounding = self._counts / 2 * np.abs(mean - self._mean)
        counted = np.where(at != self._at, ANSWERS, np.maximum(self._counted - 1, 0))
        self._counted = counted
        self._allowed += np.where(counted > 0, rounding, 0.0)
        self._noise += rounding**2
        self._at, self._torque, self._mean = at, beside, mean
        way = np.maximum(np.abs(at - self._start), self._counts)
        self._seen += 1
        if self._seen <= FIRST:
            step = (way + self._counts) / FIRST
            self._brought = self._speeds * step**2
            return []
        allowed = self._brought + self._allowed + SIGMAS * np.sqrt(self._noise) + self._unsure * way
        self.missing = -float(self._work.sum() / max(allowed.sum(), TINY))
        if self.missing <= self._scale:
            return []
        k = int(np.argmin(self._work))
        unit, torque_unit = self._units[k]
        text = (
            f"moved by {float(at[k] - self._start[k]):.3g} {unit} against its own torque of "
            f"{float(mean[k]):.3g} {torque_unit} beside that at rest: its motor pushes against what its "
            "drive asks for, or its encoder counts the other way"
        )
        return [(k, text)]
