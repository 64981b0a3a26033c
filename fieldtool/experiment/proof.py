"""See that every encoder counts, by pulses of torque so short that little can go unseen.

A stuck encoder shows only when its motor must have moved.  So each axis at rest gets pulses, each one
period of a sine, that grow until its encoder shows motion, and turn by turn go one way and the other.
They leave no speed behind: a motor without friction whose encoder is stuck has gone by ``X D^2 / (2 pi
J)`` at most, X torque, D duration, J inertia.
"""

from collections.abc import Callable
from math import ceil, pi, sqrt

import numpy as np

from drives.api import Capture, FloatArray, Targets
from drives.errors import SafetyStopError
from fieldtool.experiment.axes import Axes

PROOF_REST = 0.1
"""Seconds in which the axes stand before: what the encoder shows then is its noise."""
PROOF_WAIT = 2.0
"""Seconds to wait at most, before until nothing sags, and afterwards until nothing swings."""
PROOF_QUIET = 0.05
"""Share of what an axis may go astray within which it stands."""
PROOF_PAUSE = 0.006
"""Seconds between two pulses, for torque and encoder to answer."""
PROOF_SHARES = (0.02, 0.04, 0.07, 0.11, 0.17, 0.26, 0.4)
"""Shares of the torque limit that the pulses have, one after the other."""
PROOF_ENOUGH = 0.25
"""Share that has to be reached to say that it does not move: less may be dry friction, and loops can
be too soft for more."""
PROOF_ROWS, PROOF_LONGEST = 8, 0.3
"""Cycles that a pulse takes at least, and seconds at most."""
PROOF_SHOWN, PROOF_NET = 6, 0.1
"""Counts of the encoder by which a tenth of the torque limit has to move the axis of the prior model
in a pulse: coarse encoders and heavy axes get longer ones."""
PROOF_ERROR = 0.25
"""Share of the following error limit by which targets may leave where the axis stands."""
PROOF_SLICE = 2
"""Cycles after which what the axis did is looked at."""
SHOWN_COUNTS, NOISE_SHARE = 2.5, 0.5
"""Counts, or that share of the range at rest, beyond the range at rest that are motion."""


def pulses(
    axes: Axes, k: int, stands: float, step: float, by_offset: bool
) -> tuple[tuple[float, int], ...]:
    """Return size and number of rows of each pulse of an axis, growing; none if nothing is known of it.

    Sizes are torques (N m or N) with ``by_offset``, else distances of the target (rad or m).
    """
    if axes.inertia is None or axes.stiffness is None:
        return ()
    limits, stiffness = axes.limits[k], float(axes.stiffness[k])
    shown = PROOF_SHOWN * float(axes.counts[k])
    net = PROOF_NET * limits.torque
    duration = min(sqrt(2 * pi * float(axes.inertia[k]) * shown / net), PROOF_LONGEST)
    rows = max(PROOF_ROWS, ceil(duration / step))
    torques = [share * limits.torque for share in PROOF_SHARES]
    room = min(stands - limits.travel[0], limits.travel[1] - stands)
    if by_offset:
        far = (rows * step) ** 2 / (2 * pi * float(axes.inertia[k]))  # for 1 N m or N
        return tuple((torque, rows) for torque in torques if 2 * torque * far <= room)
    widest = min(PROOF_ERROR * limits.following_error, room)
    found: list[tuple[float, int]] = []
    for torque in torques:
        size = torque / stiffness if stiffness > 0 else widest
        needed = max(rows, ceil(2 * pi * size / (limits.velocity * step)))
        if size > widest or needed * step > PROOF_LONGEST:
            break
        if size >= axes.counts[k]:
            found.append((size, needed))
    return tuple(found)


class Proof:
    """One axis' pulses; a source of targets (``drives.api.Source``).

    Torque is added to what the loops ask for where the drive takes that (0x60B2); elsewhere targets ask
    for it, as far as the loop's stiffness, the limits of speed and following error, and the travel let
    them.

    Parameters
    ----------
    axes
        Names, limits, encoders' counts, prior inertias, stiffness of loops, torque offsets.
    k
        Which axis.
    stands
        Where all axes stand, shape (M,).
    step
        Seconds from SYNC to SYNC.
    quiet
        Within how much an axis stands, shape (M,).
    judge
        Is given where all axes are, shape (M,), every few cycles, and how far the pulses so far may have
        taken this one, by its prior inertia; raises if one goes astray.
    """

    def __init__(
        self,
        axes: Axes,
        k: int,
        stands: FloatArray,
        step: float,
        quiet: FloatArray,
        judge: Callable[[FloatArray, float], None],
    ) -> None:
        self._axes, self._k, self._stands, self._judge = axes, k, stands, judge
        self._by_offset = bool(axes.torque_offsets) and axes.torque_offsets[k]
        sizes = pulses(axes, k, float(stands[k]), step, self._by_offset)
        self._rest, pause = max(5, ceil(PROOF_REST / step)), max(2, ceil(PROOF_PAUSE / step))
        self._waits = self._settles = ceil(PROOF_WAIT / PROOF_REST)
        self._quiet = quiet
        self._held: list[FloatArray] = []
        parts, ends, sign = [np.zeros(self._rest)], [self._rest], 1.0
        for size, rows in sizes:
            wave = sign * size * np.sin(2 * pi * np.arange(rows) / rows)
            parts += [wave, np.zeros(pause)]
            ends.append(ends[-1] + rows + pause)
            sign = -sign
        self._path, self._ends = np.concatenate(parts), ends
        self._longest = sizes[-1][1] * step if sizes else 0.0
        self._ways = [0.0, *(self._way(size, rows * step) for size, rows in sizes)]
        stiffness = 1.0 if self._by_offset or axes.stiffness is None else float(axes.stiffness[k])
        self._torques = [stiffness * size for size, _ in sizes]
        self._done, self._torque = 0, 0.0
        self._resting: list[float] = []
        self._reached: list[float] = []
        self._pulls: list[float] = []
        self.asks = bool(sizes)
        """Whether there is a way to ask."""
        self.answered = False
        """Whether its encoder has shown motion."""

    def __call__(self, before: Capture | None) -> FloatArray | Targets | None:
        """Return the next targets; None when the pulse in which it answered has ended."""
        if before is not None:
            self._look(before)
        if self.answered and self._done in self._ends:
            return self._come_to_rest()
        if self._done >= self._path.size or self._too_much():
            self._refuse()
            return None
        if self._done == self._rest and self._still_sags():
            self._done, self._resting, self._pulls = 0, [], []
        until = min(self._done + PROOF_SLICE, next(end for end in self._ends if end > self._done))
        part, self._done = self._path[self._done : until], until
        return self._targets(part)

    def _still_sags(self) -> bool:
        """Whether to wait on before the first pulse: a weight sinks until its loop has taken it over."""
        self._settles -= 1
        sags = np.ptp(self._resting) > SHOWN_COUNTS * float(self._axes.counts[self._k])
        return bool(sags) and self._settles >= 0

    def _too_much(self) -> bool:
        """Whether the next pulse, on top of what the axis holds already, is beyond its torque limit."""
        if self._done not in self._ends:
            return False
        holds = abs(float(np.mean(self._pulls)))
        return (
            holds + self._torques[self._ends.index(self._done)] > self._axes.limits[self._k].torque
        )

    def _targets(self, part: FloatArray) -> FloatArray | Targets:
        targets = np.tile(self._stands, (part.size, 1))
        if not self._by_offset:
            targets[:, self._k] += part
        if not any(self._axes.torque_offsets):
            return targets
        torque = np.zeros_like(targets)
        if self._by_offset:
            torque[:, self._k] = part
        return Targets(targets, torque)

    def _come_to_rest(self) -> FloatArray | Targets | None:
        """Hold it until nothing swings from these pulses, or time is up."""
        rows = len(self._held)
        if rows >= self._rest:
            quiet = bool(np.all(np.ptp(self._held, axis=0) <= self._quiet))
            self._waits -= 1
            self._held = []
            if quiet or self._waits == 0:
                return None
        return self._targets(np.zeros(PROOF_SLICE))

    def _look(self, capture: Capture) -> None:
        begun = sum(end < self._done for end in self._ends)
        self._judge(capture.position[-1], self._ways[begun])
        if self.answered and self._done in self._ends:
            self._held += list(capture.position)
        position, torque = capture.position[:, self._k], capture.torque[:, self._k]
        if self._done <= self._rest:
            self._resting += position.tolist()
            self._pulls += torque.tolist()
            return
        noise = self._noise
        beyond = max(SHOWN_COUNTS * float(self._axes.counts[self._k]), NOISE_SHARE * noise)
        # friction may let go of it on either side of where it stood: what counts is from end to end
        self._reached = [*self._reached, *position.tolist()]
        self._reached = [min(self._reached), max(self._reached)]
        if self._reached[1] - self._reached[0] > noise + beyond:
            self.answered = True
        else:
            most = float(np.abs(torque - np.mean(self._pulls)).max())
            self._torque = max(self._torque, most)

    @property
    def _noise(self) -> float:
        """By how much its position changed at rest, rad or m."""
        return max(self._resting) - min(self._resting)

    def _refuse(self) -> None:
        """Raise SafetyStopError if torque enough was given, and nothing moved; power has to be cut."""
        axes, k = self._axes, self._k
        limit = axes.limits[k].torque
        if self.answered or self._torque < PROOF_ENOUGH * limit:
            return
        name, unit, counts = axes.names[k], axes.unit(k), float(axes.counts[k])
        shaken = self._noise > SHOWN_COUNTS * counts
        changed = (
            f"by {np.ptp(self._reached):.2g} {unit}, and at rest it did by {self._noise:.2g} {unit}"
            if shaken
            else f"by less than {ceil(SHOWN_COUNTS)} counts"
        )
        hides = "something shakes it by more than these pulses do, " if shaken else ""
        raise SafetyStopError(
            f"{name}: does not move by its encoder: short pulses of torque up to {self._torque:.3g} "
            f"{'N m' if unit == 'rad' else 'N'} ({100 * self._torque / limit:.0f} % of its limit) "
            f"changed its position {changed}; its power was cut and all axes were stopped. Without "
            f"friction it has moved by at most {self._unseen():.2g} {unit}. Either its encoder does "
            f"not count (cable, supply), or {hides}it is blocked, its brake is closed, or friction "
            "holds it. All look the same from here: turn it by hand with the power off, and see "
            "whether its position changes.",
            axis=name,
            runaway=True,
        )

    def _way(self, size: float, duration: float) -> float:
        """Return how far a pulse takes an axis without friction, by the prior inertia, rad or m."""
        inertia, stiffness = self._axes.inertia, self._axes.stiffness
        if inertia is None or stiffness is None:
            return 0.0
        torque = size if self._by_offset else size * float(stiffness[self._k])
        return torque * duration**2 / (2 * pi * float(inertia[self._k]))

    def _unseen(self) -> float:
        """Return how far a motor without friction was away, by the torque that was measured."""
        inertia = self._axes.inertia
        return (
            0.0
            if inertia is None
            else self._torque * self._longest**2 / (2 * pi * inertia[self._k])
        )
