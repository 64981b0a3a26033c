"""Is the controller in a drive the one that was written?  Told by its torque, within some cycles.

The torque that a drive tells has to be that which its parameters make of target and position
(:mod:`fieldtool.experiment.verification.controller`), whatever the machine does.  Of both the part is
compared that is quicker than SETTLES, so nothing needs to be known of gravity, of friction, or of what
the integrator holds.  A wrong gain, sign or filter shows in the first quick motion of the target, at
some counts of the encoder and long before anything swings.

What may differ is stated: noise, SHARE of what is expected, and the torque's change within the time by
which the drive may be earlier or later than its profile says.  How noisy a drive's torque is, and how
well it follows from its parameters at all, is learned while its old parameters are tried: a drive whose
torque does not follow from its old ones is not judged by the new ones.

It can not see a plant that is not as its model, nor a motor that pushes against what its drive asks for.
"""

from collections.abc import Sequence
from math import exp

import numpy as np

from fieldtool.experiment.verification.controller import (
    BY_VELOCITY,
    FROM_POSITION,
    FROM_REFERENCE,
    LATE,
    PARTS,
    POSITIONS,
    REFERENCES,
    DriveLoop,
    ExpectedTorque,
)
from fieldtool.experiment.verification.gains import NAMES, GainEstimate
from fieldtool.experiment.verification.learned import LEARNED, LEAST_LEARNED, Learned
from fieldtool.records.model import FloatArray

SETTLES = 0.05
"""Time constant, s: slower torques are not compared."""
SETTLED = 2 * SETTLES
SHARE = 0.2
"""Of the torque that is expected by which it may differ."""
REMEMBERED = 0.015
"""s, time constant with which what was expected is forgotten."""
SEEN, OF = 3, 8
"""Differences above what is allowed, of so many cycles, that are enough."""
LASTS, LASTING, ONE = 32, 0.45, 1.5
"""Cycles over which the RMS of differences, over what is allowed, may be LASTING: what is small but goes
on, or comes again and again for a sample or two.  One of them counts as ONE times what is allowed at
most: an encoder's step between samples makes such a one too."""
TINY = 1e-300
EXPLAINS, SURE = 0.06, 3.0
"""Share of the differences' squares that being late has to explain to be believed; or it is so many
standard deviations from nothing, where differences count as new after SETTLES: torques that are noisy
leave it little to explain, however long they were seen."""
BLIND, BLIND_AGAIN = 0.015, 0.1
"""s from the beginning of a motion, and from a sample that did not come, in which nothing is said."""
QUANTA, ENCODER, COUNT, STILL = 3.0, 4.0, 1.5, 2.5
"""Steps of the torque, times the RMS of what encoders' steps make or times what one of them makes (when
it came within a cycle nobody knows), and times what was seen while all axes stood still, by which
torques may differ at any time."""


class IdentityWatch:
    """Compares the torques of one trial with those that its parameters should make.

    Parameters
    ----------
    loops
        What should be in their drives.
    step
        Cycle time, s.
    quanta
        Steps in which torques are told, (M,), N m or N.
    learned
        From the trial of the old parameters; None: this is that trial, nothing is said, only learned.
    units
        Of torques, one an axis, for messages.
    """

    def __init__(
        self,
        loops: Sequence[DriveLoop],
        step: float,
        quanta: FloatArray,
        learned: Learned | None = None,
        units: Sequence[str] = (),
    ) -> None:
        self._step, self._learned = step, learned
        m = len(loops)
        self._units = tuple(units) or ("",) * m
        self._quanta = quanta
        self._still, self._share = np.zeros(m), np.zeros(m)
        self._lateness, self._moved = np.zeros((3, m)), 0
        self._passed = SETTLES / (SETTLES + step)
        self._kept = exp(-step / REMEMBERED)
        self._standing = True
        self._off = np.zeros((len(NAMES), m))
        self._taken = self._compared = 0
        self._gains: GainEstimate | None = None
        self.use(loops)

    def use(self, loops: Sequence[DriveLoop]) -> None:
        """Go on with other controllers: what is switched off for an excitation, say."""
        self._off = self._off_so_far
        self._expected = ExpectedTorque(loops, self._step)
        learned = self._learned
        refused = ("",) * len(loops) if learned is None else learned.why_not()
        self.why_not = tuple(loop.why_not or why for loop, why in zip(loops, refused, strict=True))
        """For each axis why nothing is said of it; empty where it is judged."""
        self._judged = [not why for why in self.why_not]
        late = np.array([loop.unsure for loop in loops])
        if learned is not None:
            late = late + LEARNED * learned.late
        velocity = np.array([loop.unsure_velocity for loop in loops])
        self._late = np.array([late + [loop.unsure_targets for loop in loops], late, velocity])
        # where a period is not known, so much is late or early all the time
        self._lasts = np.where(velocity > 0, 1 / LASTING - 1, 0.0)
        encoder = np.array([loop.noise for loop in loops])
        counts = COUNT * np.array([loop.count for loop in loops])
        self._floor = QUANTA * self._quanta + np.maximum(ENCODER * encoder, counts)
        self._scale = np.ones(len(loops))
        self._gains = GainEstimate(
            self._quanta,
            encoder,
            np.array([loop.loop.position_p * self._step for loop in loops]),
            self._late[1],
            velocity,
            self._step,
            self._passed,
            None if learned is None else learned.gains,
        )
        if learned is not None:
            self._floor = self._floor + STILL * learned.still
            self._scale = np.maximum(LEAST_LEARNED, LEARNED * learned.share)
        self.begin()

    def begin(self) -> None:
        """Another motion begins."""
        self._rows: list[tuple[FloatArray, FloatArray, FloatArray, FloatArray]] = []
        self._origin: FloatArray | None = None
        self._count = 0
        self._blind = round(BLIND / self._step)

    def stand(self, *, still: bool) -> None:
        """Say whether all axes are told to stand still from now on."""
        self._standing = still

    @property
    def cleaned(self) -> tuple[list[float], list[float]] | None:
        """Positions and torques one SYNC before the last, M values each; None where there are none yet.

        Of axes that are judged what is quick in the torque is what is expected, so only slow noise is
        left in it; but for the first SETTLED of a motion, when nobody knows yet what is slow.
        """
        if self._count == 0:
            return None
        position, torque = self._rows[-LATE][:2]
        if self._count * self._step < SETTLED:
            return position.tolist(), torque.tolist()
        expected = torque - self._quick[-1] + self._quick[:-1].sum(axis=0)
        return position.tolist(), np.where(self._judged, expected, torque).tolist()

    @property
    def unbroken(self) -> int:
        """Cycles up to the last one that were compared without a gap."""
        return max(0, self._count - self._blind)

    @property
    def seen(self) -> float:
        """Share of all cycles so far that were compared: late ones, and some after them, are not."""
        return self._compared / max(self._taken, 1)

    def learned(self) -> Learned:
        """Return what was seen so far."""
        along, square, whole = self._lateness
        share = min(EXPLAINS, SURE**2 * SETTLES / (self._step * max(self._moved, 1)))
        explains = along**2 > share * square * whole
        late = np.where(explains, np.abs(along) / np.maximum(square, TINY), 0.0)
        return Learned(self._still.copy(), self._share.copy(), late, self.seen, self._off_so_far)

    @property
    def _off_so_far(self) -> FloatArray:
        return np.maximum(self._off, 0.0 if self._gains is None else self._gains.off)

    def take(
        self,
        position: Sequence[float],
        torque: Sequence[float],
        target: Sequence[float],
        offset: Sequence[float],
        *,
        fresh: bool,
    ) -> list[tuple[int, str]]:
        """Take one SYNC of all axes; return those whose torque is not theirs, with a sentence each."""
        self._taken += 1
        if not fresh:
            self.begin()
            self._blind = round(BLIND_AGAIN / self._step)
            return []
        row = tuple(np.array(one, dtype=np.float64) for one in (position, torque, target, offset))
        if self._origin is None:
            self._start(row[0], row[1])
        self._rows.append((row[0], row[1], row[2], row[3]))
        if len(self._rows) <= REFERENCES + LATE - 1:
            return []
        del self._rows[: -REFERENCES - LATE]
        return self._compare()

    def _start(self, position: FloatArray, torque: FloatArray) -> None:
        m = position.size
        self._origin = position
        self._expected.restart()
        self._before = np.zeros((PARTS + 1, m))
        self._before[-1] = torque
        self._quick = np.zeros((PARTS + 1, m))
        self._last = np.zeros((2, m))
        if self._gains is not None:
            self._gains.begin()
        self._peak, self._slope = np.zeros(m), np.zeros((3, m))
        self._over: list[FloatArray] = []
        self._squares: list[FloatArray] = []
        self._far: list[FloatArray] = []
        self._count = 0

    def _compare(self) -> list[tuple[int, str]]:
        rows, origin = self._rows, self._rows[0][0] if self._origin is None else self._origin
        targets = np.stack(
            [*(one[2] - origin for one in rows[:REFERENCES]), rows[REFERENCES - 1][3]]
        )
        positions = np.stack([one[0] - origin for one in rows[-POSITIONS:]])
        now = np.empty_like(self._before)
        now[:-1] = self._expected.advance(targets.T, positions.T)
        now[-1] = rows[-LATE][1]
        quick = self._passed * (self._quick + now - self._before)
        velocity = quick[BY_VELOCITY] - self._quick[BY_VELOCITY]
        both = np.stack([quick[FROM_REFERENCE].sum(axis=0), quick[FROM_POSITION].sum(axis=0)])
        changed, self._last = both - self._last, both
        turns, slope = changed[1] / self._step, np.abs([*changed, velocity]) / self._step
        self._before, self._quick = now, quick
        expected = both[0] + both[1]
        off = quick[-1] - expected
        difference = np.abs(off)
        if self._learned is None and not self._standing:
            self._lateness += (turns * off, turns**2, difference**2)
            self._moved += 1
        self._peak = np.maximum(np.abs(expected), self._kept * self._peak)
        self._slope = np.maximum(slope, self._kept * self._slope)
        lateness = (self._late * self._slope).sum(axis=0)
        allowed = self._floor + SHARE * self._peak + lateness
        if self._learned is None:
            allowed = allowed + STILL * self._still  # noise is no share of anything
        self._count += 1
        if self._count <= self._blind:
            # what enabling did to the torque, as at the first sample, is not theirs to explain
            self._quick[-1] = expected
            return []
        gained = [quick[0] + quick[3], quick[1] + quick[4], quick[2]]
        parts = np.stack([*gained, changed.sum(axis=0), changed[1], velocity])
        gains = [] if self._gains is None else self._gains.take(parts, off)
        self._compared += 1
        self._over = [*self._over[1 - OF :], difference / allowed]
        lasting = allowed + self._lasts * lateness
        capped = np.minimum(difference / (self._scale * lasting), ONE)
        self._squares = [*self._squares[1 - LASTS :], capped**2]
        self._far = [*self._far[1 - OF :], difference]
        if len(self._over) < SEEN:
            return []
        wrong = [(k, _gain_sentence(name, by)) for k, name, by in gains if self._judged[k]]
        return [*self._found(allowed), *wrong]

    def _found(self, allowed: FloatArray) -> list[tuple[int, str]]:
        lasting = self._scale / LASTING * np.sqrt(np.sum(self._squares, axis=0) / LASTS)
        over = np.maximum(np.sort(np.array(self._over), axis=0)[-SEEN], lasting)
        if self._learned is None:
            self._learn(over, np.sort(np.array(self._far), axis=0)[-SEEN])
            return []
        return [
            (k, self._sentence(k, float(self._scale[k] * allowed[k])))
            for k in np.flatnonzero(over > self._scale).tolist()
            if self._judged[k]
        ]

    def _learn(self, over: FloatArray, far: FloatArray) -> None:
        if self._standing:
            self._still = np.maximum(self._still, far)
        else:
            self._share = np.maximum(self._share, over)

    def _sentence(self, k: int, allowed: float) -> str:
        expected, told = float(self._quick[:-1, k].sum()), float(self._quick[-1, k])
        unit = self._units[k]
        return (
            f"its torque is {told:.3g} {unit} where its parameters make {expected:.3g} {unit} of its "
            f"target and position (slow torques left out; {allowed:.2g} {unit} off is taken): what acts "
            "in the drive is not what was written"
        )


def _gain_sentence(name: str, factor: float) -> str:
    return (
        f"its {name} is {factor:.2g} times what was written, by the torque that it makes of target and "
        "position: what acts in the drive is not what was written"
    )
