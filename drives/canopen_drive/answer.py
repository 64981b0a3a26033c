"""A motor that turns against its torque: told in motion, from how its axis has answered so far.

With elastic loads the sign of torque and acceleration proves nothing by itself: between antiresonance
and resonance a sound motor accelerates against its torque.  So the axis' answer is learned while it
moves: the change of its speed from those before and from the torques (an autoregressive model with an
input), and the scatter about it.  In every cycle the change is told for a sound motor, and for one whose
torque acts with the other sign; the logarithms of the ratio of both likelihoods are summed, anew
whenever the sound one is more likely: Page's test (CUSUM; Page 1954, Biometrika 41, 100).

What changes otherwise than both say is not called reversed: the model with the other sign has to leave
far less than the sound one.  Torques that do little prove nothing, nor does an axis that friction can
hold, unless it slides.  Coarse encoders show a change of speed over several cycles only: those are one
step, and one ends in each cycle.  All in position units, torque units and cycles.
"""

from collections import deque
from dataclasses import dataclass, field
from itertools import pairwise
from math import ceil, hypot, sqrt

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

BEFORE, TORQUES = 4, 4
"""Changes of speed before, and torques, that a change of speed is told from: a load on a spring."""
PLAIN = 3
"""What it is told from besides: speed, direction, and a constant torque (weight)."""
SIZE, PUSHES = BEFORE + PLAIN + TORQUES, BEFORE + PLAIN
"""Of a row of what a change is told from, and where its torques begin."""
LIMIT_UNITS, LONGEST = 60.0, 16
"""Position units that the torque limit changes a step by at least, or steps are longer; and the most
cycles of a step."""
BLOCK = 24
"""Steps that are learned from at a time: after they were told, so that nothing tells itself."""
MOVED_UNITS = 0.2
"""Position units (RMS) by which the torques of a block have to change speeds, or it teaches nothing."""
BLOCKS, SURE, LEFT = 2, 5.0, 0.9
"""Blocks until the answer is known; standard errors that the torques' part has to be above 0, and the
share of the changes of speed that may be left."""
FADES = 0.98
"""Weight of what was learned, a block later."""
LEAST_SCATTER = 0.5
"""Position units of scatter in any case, from rounding."""
ROUGH = 0.05
"""Share of what speeds tell of a change of speed that counts as scatter too."""
GUESSED_SCATTER = 0.7
"""The same of the first blocks: a change of speed is made of four roundings."""
STICKS, SLIDES, SLOWEST = 0.7, 3, 3
"""Position units from which what friction does in a step counts; speeds in a row of one sign of an axis
that slides, and the slowest: below, it creeps."""
CLEAR = 2.0
"""Times the scatter that a torque has to change the speed by, and that the speed has to change against
it, to be any proof against a motor: an axis that is held proves nothing."""
LIKE = 20.0
"""Steps with a torque like the one that begins a suspicion from which the answer has to be learned: an
axis that was slow so far, and whose load now swings, answers otherwise than it did."""
UNCLEAR = 0.2
"""Logarithm that a cycle that proves nothing takes away: what is suspected needs more proof soon."""
MOST = 7.0
"""Logarithm of a likelihoods' ratio that one cycle may count: three of them decide nothing."""
DECIDES = 28.0
"""Logarithm from which the motor is reversed: 1e-12, for 1e-6 in a motion of a million
cycles."""
TOLD = 0.15
"""Share of what the sound model leaves (squares) that the reversed one may leave."""
SUSPECT = 3.0
"""Logarithm from which nothing is learned any more."""


@dataclass
class Answer:
    """How an axis has answered its torques so far, from motion to motion."""

    cycle_time: float = 0.0
    """s, of the motions it was learned in: of others nothing is known."""
    weights: FloatArray | None = None
    """Of what a change of speed is told from, shape (11,); None until known."""
    unsure: FloatArray = field(default_factory=lambda: np.zeros((SIZE, SIZE)))
    """Covariance of the weights, over the square of the scatter."""
    scatter: float = 0.0
    """RMS of what was not told, position units."""
    learned: float = 0.0
    """Sum of the squares by which the torques of all steps it was learned from have changed speeds."""
    _guess: FloatArray = field(default_factory=lambda: np.zeros(SIZE))
    _spread: FloatArray = field(default_factory=lambda: np.ones(SIZE))
    _blocks: int = 0
    _normal: FloatArray = field(default_factory=lambda: np.zeros((SIZE, SIZE)))
    _right: FloatArray = field(default_factory=lambda: np.zeros(SIZE))
    _square: float = 0.0
    _count: float = 0.0

    def begin(self, cycle_time: float, push: float, torque: float) -> None:
        """Begin a motion; forget what was learned with another cycle.

        The first guess, which some steps outweigh, is a rigid axis of the prior inertia: ``push``
        position units a step that one torque unit changes its speed by, up to a limit ``torque``.
        """
        if self.cycle_time == cycle_time:
            return
        fresh = Answer(cycle_time)
        fresh._guess[PUSHES : PUSHES + 2] = push / 2
        constant = 0.1 * push * torque
        fresh._spread[:] = [0.5] * BEFORE + [0.1, constant, constant] + [push / 2] * TORQUES
        self.__dict__.update(fresh.__dict__)

    def learn(self, rows: FloatArray, steps: FloatArray, weight: float) -> None:
        """Learn from a block of steps: what they are told from, shape (N, 11), and the steps.

        Where steps overlap, ``weight`` is the share of one that is its own.
        """
        if self.weights is not None:
            left = steps - rows @ self.weights
            self.scatter = max(FADES * self.scatter, sqrt(float(left @ left) / steps.size))
        self._normal = FADES * self._normal + weight * rows.T @ rows
        self._right = FADES * self._right + weight * rows.T @ steps
        self._square = FADES * self._square + weight * float(steps @ steps)
        self._count = FADES * self._count + weight * steps.size
        self._blocks += 1
        if self._blocks >= BLOCKS:
            self._solve()

    def _solve(self) -> None:
        noise = max(self.scatter, GUESSED_SCATTER) ** 2
        guessed = noise / self._spread**2
        normal = self._normal + np.diag(guessed)
        size = np.sqrt(np.diag(normal))
        inverse = np.linalg.inv(normal / np.outer(size, size)) / np.outer(size, size)
        weights = inverse @ (self._right + guessed * self._guess)
        explained = 2 * self._right @ weights - weights @ self._normal @ weights
        left = max(self._square - float(explained), 1e-12)
        error = sqrt(float(inverse[PUSHES:, PUSHES:].sum()) * left / self._count)
        sure = float(weights[PUSHES:].sum()) > SURE * error and left < LEFT * self._square
        if sure and self.weights is None:
            self.scatter = max(self.scatter, sqrt(left / self._count))
        self.weights, self.unsure = (weights if sure else None), inverse
        torques = weights[PUSHES:]
        self.learned = float(torques @ self._normal[PUSHES:, PUSHES:] @ torques)


class Reversed:
    """Watches one axis for a motor that turns against its torque.

    Parameters
    ----------
    answer
        What is known of the axis; goes on to be learned.
    push
        Position units per cycle and cycle by which one torque unit accelerates the whole axis.
    torque
        Torque limit, torque units.
    cycle_time
        s.
    """

    def __init__(self, answer: Answer, push: float, torque: float, cycle_time: float) -> None:
        self._step = min(LONGEST, max(1, ceil(sqrt(LIMIT_UNITS / (push * torque)))))
        self._push = push * self._step**2
        self._answer = answer
        answer.begin(cycle_time, self._push, torque)
        length = max(BEFORE + 2, TORQUES) * self._step + 1
        self._positions: deque[int] = deque(maxlen=length)
        self._torques: deque[int] = deque(maxlen=length)
        self._rows: list[list[float]] = []
        self._steps: list[float] = []
        self._block = BLOCK * max(1, self._step // 2)
        self.total = self._of_sound = self._of_reversed = 0.0
        self.alarm = False
        """Whether its motor is reversed."""

    def restart(self) -> None:
        """Begin anew: time has passed unseen, or nothing pushes the axis."""
        self._positions.clear()
        self._torques.clear()
        self._forget()

    def _forget(self) -> None:
        self.total = self._of_sound = self._of_reversed = 0.0

    def take(self, position: int, torque: int, cycles: float = 1.0, friction: float = 0.0) -> None:
        """Take the next sample, so many cycles after the one before; friction in torque units."""
        if cycles != 1.0:
            self.restart()
        self._positions.append(position)
        self._torques.append(torque)
        if len(self._positions) < (self._positions.maxlen or 0):
            return
        positions = list(self._positions)
        speeds = [now - before for now, before in pairwise(positions[:: -self._step])]
        if friction * self._push > STICKS and not _slides(speeds[:SLIDES]):
            return
        changes = [now - before for now, before in pairwise(speeds)]
        speed = speeds[1]
        plain = (speed, (speed > 0) - (speed < 0), 1)
        row = [*changes[1 : BEFORE + 1], *plain, *self._pushes()]
        self._judge(row, changes[0])
        self._rows.append(row)
        self._steps.append(changes[0])
        if len(self._steps) >= self._block:
            self._learn()

    def _pushes(self) -> list[float]:
        """Return the mean torques of the last steps, the last one first."""
        torques, m = list(self._torques), self._step
        last = len(torques)
        return [sum(torques[last - (k + 1) * m : last - k * m]) / m for k in range(TORQUES)]

    def _judge(self, row: list[float], step: float) -> None:
        answer = self._answer
        if answer.weights is None:
            return
        told_from = np.array(row)
        torque = float(told_from[PUSHES:] @ answer.weights[PUSHES:])
        plain = float(told_from[:PUSHES] @ answer.weights[:PUSHES])
        scatter = hypot(max(answer.scatter, LEAST_SCATTER), ROUGH * plain)
        rest = step - plain
        of_sound, of_reversed = (rest - torque) ** 2, (rest + torque) ** 2
        ratio = (of_sound - of_reversed) / (2 * scatter**2 * self._step)
        if ratio > 0:
            ratio /= 1 + float(told_from @ answer.unsure @ told_from)
            clear = CLEAR * scatter
            held = abs(torque) < clear or abs(step) < clear or step * torque > 0
            unlike = self.total <= 0 and answer.learned < LIKE * torque**2
            if held or unlike:
                ratio = -UNCLEAR
        self.total += max(-MOST, min(MOST, ratio))
        if self.total <= 0:
            self._forget()
            return
        self._of_sound += of_sound
        self._of_reversed += of_reversed
        if self.total > DECIDES and self._of_reversed < TOLD * self._of_sound:
            self.alarm = True

    def _learn(self) -> None:
        rows, steps = (
            np.array(self._rows, dtype=np.float64),
            np.array(self._steps, dtype=np.float64),
        )
        self._rows, self._steps = [], []
        moved = self._push * float(np.std(rows[:, PUSHES:]))
        if self.total <= SUSPECT and moved >= MOVED_UNITS:
            self._answer.learn(rows, steps, 1.0 / self._step)


def _slides(speeds: list[int]) -> bool:
    return all(s >= SLOWEST for s in speeds) or all(s <= -SLOWEST for s in speeds)
