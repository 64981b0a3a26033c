"""An axis' own move, and those of the others, under a choice of its parameters: part of the cost.

With all other loops closed and T the compliance with this loop open, motor and last mass follow from one
loop; so do the moves of the others.  All signals are half-waves (:mod:`fieldtool.design.waves`).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import isfinite

import numpy as np
from numpy.typing import NDArray

from fieldtool.design.grids import Bounds, ComplexArray, Grids, closed_compliance, without
from fieldtool.design.machine import standing
from fieldtool.design.moves import TestMove
from fieldtool.design.servo import Sampled, Servo
from fieldtool.records.model import FloatArray

DISTURBANCE = 0.2
"""Of the torque that the move takes on a rigid axis: a step of it is to be held down."""
STIFFNESS = 0.05
"""Cost of the logarithm of what a disturbance leaves, in durations of the move."""
INNER_BAND = 0.6
"""Of the band: where the search wants an axis to be, so that it is in the band for sure."""
MOVED = 2.0
"""Weight of the axis' own move beside those of the others."""
DURING = 0.05
"""Weight of the following error before the move has ended, for the feed-forward."""
MOST_FED = 1.3
"""Feed-forward of inertia and of friction, over what the axis has, at most."""
ROOM = 1.15
"""Times the torque of a rigid axis with its friction, where that is above the limit whatever the gains:
no gains are given up for less."""
FED_NOISE = 3.0
"""RMS of the torque that rounded targets make by inertia feed-forward, over that allowed of the
encoder's steps."""


@dataclass(frozen=True)
class Fed:
    """What feed-forward of an axis may be chosen, and what there is to feed forward."""

    velocity: bool
    inertia: bool
    friction: bool
    """As torque per velocity of the reference."""
    mass: float
    """Of the axis, kg m2 or kg."""
    viscous: float
    """Viscous friction of the axis, N m s/rad or N s/m."""

    @property
    def free(self) -> NDArray[np.bool_]:
        """Velocity, inertia, friction."""
        return np.array([self.velocity, self.inertia, self.friction])


class AxisMotion:
    """One axis' move, the loops of all others being given; arguments as those of the problem."""

    def __init__(
        self,
        grids: Grids,
        servos: Sequence[Servo],
        axis: int,
        moves: Sequence[TestMove],
        bounds: Bounds,
        fed: Fed,
    ) -> None:
        self.bounds, self.move, self.fed, self.mass = bounds, moves[axis], fed, fed.mass
        self._free, self._most_inertia = fed.free, self._most_inertia_of(servos[axis])
        others = [i for i in range(len(servos)) if i != axis]
        wave, s = grids.wave, 1j * grids.wave.omega
        self._wave, self._tick = wave, wave.duration / wave.samples
        at = self._slow = Sampled.of(s, servos[axis].timing)
        gains = without(np.stack([servo.gain(s) for servo in servos], axis=-1), axis)
        closed = closed_compliance(grids.slow, gains)
        loads = grids.loads - np.einsum("wij,wj,wjk->wik", grids.loads, gains, closed)
        self._motor = closed[:, axis, axis]
        self._plants = np.stack([self._motor, loads[:, axis, axis]])
        target = wave.spectrum(wave.move(self.move))
        self._targets = target * np.stack([np.ones_like(s), s, at.acceleration * self.mass, s])
        """Of the move: position, velocity, what inertia feed-forward gives, velocity again."""
        self._step = wave.spectrum(wave.step(DISTURBANCE * self.mass * self.move.acceleration))
        self._wanted = wave.move(self.move)
        slow = self._friction(grids, axis) + self._pulled(grids, axis)
        self._drag = self._dragged(slow, (axis, closed, loads))
        _, _, acceleration = self.move.at(wave.time)
        least = float(np.abs(self.mass * acceleration + slow).max())
        self.most_torque = bounds.torque if least <= bounds.torque else ROOM * least
        """Of the move, N m or N."""
        after = [wave.time >= move.duration for move in moves]
        self._weight = np.where(after[axis], 1.0, DURING)
        self._per_band = after[axis] / (INNER_BAND * self.move.settling_band)
        # position = there - back C S, for motor and last mass of every other axis on its own move
        there, back, to, per_band = [], [], [], []
        for i in others:
            wanted = wave.move(moves[i])
            drive = servos[i].reference_gain(s) * wave.spectrum(wanted)
            for what in (closed, loads):
                there.append(what[:, i, i] * drive)
                back.append(what[:, i, axis] * closed[:, axis, i] * drive)
                to.append(wanted)
                per_band.append(after[i] / (INNER_BAND * moves[i].settling_band))
        shape = (len(there), wave.omega.size)
        self._others = np.array([to, per_band]).reshape(2, len(to), wave.samples)
        """Where the others are to be, and one over their band once they should be there; (2, K, N)."""
        self._there = np.array(there, dtype=np.complex128).reshape(shape)
        self._back = np.array(back, dtype=np.complex128).reshape(shape)

    def _friction(self, grids: Grids, axis: int) -> FloatArray:
        """Return the axis' dry friction on the reference, N m or N, in the direction of its velocity."""
        machine, wave = grids.machines[0], grids.wave
        torque = sum(
            0.5 * (dry.forward + dry.backward)
            for dry in machine.dry
            if dry.place in (machine.motors[axis], machine.loads[axis])
        )
        moving = np.sign(np.round(self.move.at(wave.time)[1] / self.move.velocity, 9))
        return np.asarray(torque * moving)

    def _pulled(self, grids: Grids, axis: int) -> FloatArray:
        """Return what goes with the position on the reference, about its mean of the ends, N m or N."""
        machine = standing(grids.machines[0], [self.move.start] * len(grids.machines[0].names))
        way = self.move.at(grids.wave.time)[0]
        torque = np.zeros_like(way)
        for pull in machine.pulls:
            if machine.axis_of(pull.place) == axis:
                ends = pull.at(np.array([0.0, self.move.distance]))
                torque += pull.at(way) - ends.mean()
        return torque

    def _dragged(
        self, torque: FloatArray, inner: tuple[int, ComplexArray, ComplexArray]
    ) -> ComplexArray | None:
        """Return what slow torques do to motor and last mass before the axis' loop is closed.

        Those of dry friction, against the direction of the reference's velocity: what an integrator has
        to learn when the move begins, and to forget when it ends; and those that go with the position,
        which it learns for good.  None where there are none.
        """
        axis, closed, loads = inner
        if not torque.any():
            return None
        force = self._wave.spectrum(-torque)
        return np.stack([closed[:, axis, axis] * force, loads[:, axis, axis] * force])

    def fed_forward(self, servo: Servo) -> Servo:
        """Return a controller with the feed-forward that fits its feedback best."""
        gain, torque, pi = self._slow.gain(servo)
        shares, _, _ = self._feed_forward(servo, 1 / (1 + gain * self._motor), torque, pi)
        velocity, inertia, *friction = shares.tolist()
        loop = replace(
            servo.loop,
            velocity_ff=velocity,
            viscous_ff=sum(friction) * servo.loop.velocity_p,
            inertia_ff=inertia * self.mass,
        )
        return replace(servo, loop=loop)

    def _feed_forward(
        self, servo: Servo, sensitivity: ComplexArray, torque: ComplexArray, pi: ComplexArray
    ) -> tuple[FloatArray, FloatArray, ComplexArray]:
        """Return the shares, errors of motor and last mass on the move (2, N), and the torque's phasors.

        Shares are those of least squares over the time after the move, and a little before it: of
        velocity, inertia, and where there is such a feed-forward, friction over the velocity's P.
        """
        loop = servo.loop
        gains = [pi * loop.position_p, pi, torque]
        known = [loop.velocity_ff, loop.inertia_ff / self.mass]
        if self.fed.friction or loop.viscous_ff:
            gains.append(torque * loop.velocity_p)
            known.append(loop.viscous_ff / loop.velocity_p)
        parts = self._targets[: len(gains)] * gains * sensitivity
        spectra = self._plants[:, None, :] * parts
        if self._drag is not None:
            spectra[:, 0] += self._drag * sensitivity
        signals = self._wave.signal(spectra)
        signals[:, 0] -= self._wanted
        seen = signals * self._weight
        most = np.array([1.0, self._most_inertia, MOST_FED * self.fed.viscous / loop.velocity_p])
        count = len(known)
        best = _least_squares(seen, np.array(known), self._free[:count], most[:count])
        shares = np.array([1.0, *best])
        return best, shares @ signals, shares @ parts

    def _most_inertia_of(self, servo: Servo) -> float:
        """Return the largest share of inertia: targets are rounded to encoder steps."""
        alone = replace(servo.loop, velocity_ff=0.0, viscous_ff=0.0, inertia_ff=self.mass)
        noise = replace(servo, loop=alone).target_noise(self.bounds.resolution)
        if not (isfinite(noise) and isfinite(self.bounds.noise) and noise > 0):
            return MOST_FED
        return min(MOST_FED, FED_NOISE * self.bounds.noise / noise)

    def figures(self, servo: Servo) -> tuple[float, float]:
        """Return a smooth measure of the time outside of the band, s, and the move's largest torque."""
        gain, torque, pi = self._slow.gain(servo)
        wave, sensitivity = self._wave, 1 / (1 + gain * self._motor)
        _, errors, phasors = self._feed_forward(servo, sensitivity, torque, pi)
        band = INNER_BAND * self.move.settling_band
        total = MOVED * _outside(errors * self._per_band)
        follow = gain * sensitivity
        spectra = np.concatenate(
            [self._plants * (self._step * sensitivity), self._there - self._back * follow]
        )
        moved = wave.signal(spectra)
        energies = (moved[:2] ** 2).sum(axis=1) * self._tick / band**2
        total += STIFFNESS * self.move.duration / self._tick * float(np.log(energies + 1e-12).sum())
        wanted, per_band = self._others
        total += _outside((moved[2:] - wanted) * per_band)
        if self._drag is not None:  # the loop works against these too
            phasors = phasors - self._drag[0] * follow
        return 0.5 * self._tick * total, float(np.abs(wave.signal(phasors)).max())


def _least_squares(
    seen: FloatArray, known: FloatArray, free: NDArray[np.bool_], most: FloatArray
) -> FloatArray:
    """Return shares within their bounds that make base + columns shares smallest; fixed ones stay.

    Parameters
    ----------
    seen
        Base and n columns of two signals, shape (2, 1 + n, N).
    known
        Shares of the columns where nothing better is found, shape (n,).
    """
    products = np.matmul(seen, seen.swapaxes(1, 2)).sum(axis=0)
    normal, base = products[1:, 1:], products[1:, 0]
    chosen = free & (most > 0)
    best = np.where(free, np.clip(known, 0.0, most), known)
    right = -base - normal[:, ~chosen] @ best[~chosen]
    ridge = 1e-12 * max(float(np.trace(normal)), 1e-290) * np.eye(most.size)
    inner = (normal + ridge)[chosen][:, chosen]
    best[chosen] = _bounded(inner, right[chosen], most[chosen])
    return best


def _bounded(matrix: FloatArray, right: FloatArray, most: FloatArray) -> FloatArray:
    """Return the x between 0 and its bounds with the least x' A x / 2 - b' x.

    Where the least of all x breaks bounds, that within them lies on at least one of these.
    """
    x = np.asarray(np.linalg.solve(matrix, right), dtype=np.float64)
    nearest = np.clip(x, 0.0, most)
    broken = np.flatnonzero(x != nearest)
    if not broken.size:
        return x
    tried = []
    for k, end in zip(broken, nearest[broken], strict=True):
        rest = np.arange(x.size) != k
        one = np.full(x.size, end)
        moved = right[rest] - end * matrix[rest, k]
        one[rest] = _bounded(matrix[rest][:, rest], moved, most[rest])
        tried.append(one)
    return min(tried, key=lambda one: float(one @ (0.5 * matrix @ one - right)))


def _outside(bands: FloatArray) -> float:
    """Return a smooth count of the samples outside of a band, of errors over it."""
    fourth = bands * bands
    fourth *= fourth
    return float((fourth / (fourth + 1)).sum())
