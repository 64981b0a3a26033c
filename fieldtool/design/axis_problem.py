"""One axis' part of the design: what a choice of its parameters costs, all other loops being closed.

With the others closed the axis is one loop with a plant p (motor) and l (last mass)::

    S = 1 / (1 + C p)        motor = p H r S        last mass = l H r S

and the sensitivity of another axis i, whose loop stays as it is, follows from a change of this one::

    S_i = 1 - C_i ( T_ii - T_ik C T_ki S )

T being the compliance with this loop open; what the others' moves do follows in the same way, and is
part of the cost: a stiff motor leaves the machine's vibrations to its neighbours.

All models that the design has to hold for are evaluated at once, as are all frequencies.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import isfinite
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fieldtool.design.machine import Machine, respond
from fieldtool.design.margins import BANDWIDTH_LEVEL
from fieldtool.design.moves import TestMove
from fieldtool.design.servo import OFF, Servo, Timing
from fieldtool.design.waves import HalfWave
from fieldtool.records.closed_loop import AxisLoop
from fieldtool.records.model import FloatArray

ComplexArray = NDArray[np.complexfloating[Any, Any]]
PER_MODE = 9
BESIDE = np.linspace(-1, 1, PER_MODE)
GRID = 150
DISTURBANCE = 0.2
"""Of the torque that the move takes on a rigid axis: a step of it is to be held down."""
STEEP = 30.0
"""Cost of a bound that is missed, in durations of the move per relative excess."""
UNSTABLE = 1e3
STIFFNESS = 0.05
"""Cost of the logarithm of what a disturbance leaves, in durations of the move."""
INNER_BAND = 0.6
"""Of the band: where the search wants an axis to be, so that it is in the band for sure."""
MOVED = 2.0
"""Weight of the axis' own move beside those of the others."""
DURING = 0.05
"""Weight of the following error before the move has ended, for the feed-forward."""
MOST_FED = np.array([1.0, 1.3])
"""Velocity feed-forward, and inertia feed-forward over the axis' own inertia, at most."""
FAR_GAIN = 0.5
"""Largest gain of the closed loop beyond the frequencies that were measured: there the machine may
be three times what the model says without making the loop unstable."""
WITHIN = 0.998
"""Of a bandwidth that is to be kept: up to it the sensitivity stays below its level."""
SOFT = 0.01
"""Weight of a compliance that is missed beside a margin: it is a wish."""
FED_NOISE = 3.0
"""RMS of the torque that rounded targets make by inertia feed-forward, over that allowed of the
encoder's steps."""


@dataclass(frozen=True)
class Bounds:
    """What one axis' parameters have to keep."""

    sensitivity: float
    """Peak of every axis' sensitivity."""
    noise: float
    """RMS of the torque from the encoder's steps, N m or N; infinite: not looked at."""
    torque: float
    """Largest torque of the move, N m or N."""
    resolution: float
    """Of the encoder, rad or m; NaN: not known."""
    top: float
    """rad/s: highest frequency that the model was measured at."""
    compliance: float = np.inf
    """Largest motor position per torque at the motor, rad/(N m) or m/N."""
    far: float = FAR_GAIN
    """Largest gain of the closed loop beyond ``top``."""
    bandwidths: tuple[float, ...] = ()
    """rad/s, one an axis: least ones, of the first machine; none where there are none."""


@dataclass(frozen=True, eq=False)
class Grids:
    """Frequencies of J machines, and their responses, shared by all axes of a design."""

    machines: tuple[Machine, ...]
    omega: FloatArray
    """(J, F) rad/s."""
    motors: ComplexArray
    """(J, F, M, M)."""
    wave: HalfWave
    slow: ComplexArray
    """(W, M, M): motors of the first machine at the wave's frequencies."""
    loads: ComplexArray
    """(W, M, M)."""


def grids_of(machines: Sequence[Machine], low: float, high: float, wave: HalfWave) -> Grids:
    """Return frequencies from ``low`` to ``high``, rad/s, with more at every mode, and responses."""
    omegas = []
    for machine in machines:
        modes = np.concatenate([machine.modes, machine.held_modes])
        width = 0.03
        beside = (modes[:, None] * (1 + width * BESIDE)).ravel()
        omegas.append(np.sort(np.concatenate([np.geomspace(low, high, GRID), beside])))
    responses = [
        respond(machine, omega).motors for machine, omega in zip(machines, omegas, strict=True)
    ]
    slow = respond(machines[0], wave.omega)
    return Grids(
        tuple(machines), np.stack(omegas), np.stack(responses), wave, slow.motors, slow.loads
    )


@dataclass(frozen=True, eq=False)
class _Sampled:
    """A drive's controller at fixed frequencies, its delays computed once."""

    s: ComplexArray
    delay: ComplexArray
    velocity: ComplexArray
    """s times the velocity's delay."""
    acceleration: ComplexArray
    """s^2 times what holding the acceleration does."""

    @classmethod
    def of(cls, s: ComplexArray, timing: Timing) -> "_Sampled":
        bare = Servo(AxisLoop(1.0, 1.0, 0.0, 0.0, 1.0), OFF, timing)
        late = np.exp(-timing.lag * s)
        # inertia alone: reference_gain less position_p velocity_p
        held = bare.reference_gain(s) / late - 1.0
        return cls(s, late, s * np.exp(-0.5 * timing.period * s), held)

    def gain(self, servo: Servo) -> tuple[ComplexArray, ComplexArray, ComplexArray]:
        """Return torque per position error, its filters with the delay, and those with the PI."""
        loop, s = servo.loop, self.s
        torque = self.delay
        for biquad in loop.filters:
            torque = torque * biquad.response(s)
        pi = torque * (loop.velocity_p + loop.velocity_i / s)
        rate = self.velocity
        if servo.velocity_filter != OFF:
            rate = rate / (1 + s / (2 * np.pi * servo.velocity_filter))
        return pi * (loop.position_p + rate), torque, pi


class AxisProblem:
    """What parameters of one axis cost, the loops of all others being given."""

    def __init__(
        self,
        grids: Grids,
        servos: Sequence[Servo],
        axis: int,
        moves: Sequence[TestMove],
        bounds: Bounds,
        free: tuple[bool, bool],
        mass: float,
    ) -> None:
        """Prepare.

        Parameters
        ----------
        grids
            Of all machines.
        servos
            All axes' controllers; together they are stable on every machine.
        axis
            The one that is varied.
        moves
            One an axis.
        bounds
            To be kept.
        free
            Whether velocity and inertia feed-forward may be chosen.
        mass
            Of the axis, kg m2 or kg.
        """
        self.bounds, self.move, self.free, self.mass = bounds, moves[axis], free, mass
        s = 1j * grids.omega
        gains = np.stack([servo.gain(s) for servo in servos], axis=-1)
        inner = _compliance(grids.motors, _without(gains, axis))
        self._at = _Sampled.of(s, servos[axis].timing)
        self._plant = inner[..., axis, axis]
        others = [i for i in range(len(servos)) if i != axis]
        self._own = [1 - gains[..., i] * inner[..., i, i] for i in others]
        self._cross = [gains[..., i] * inner[..., i, axis] * inner[..., axis, i] for i in others]
        self._reference = 1 + gains[..., axis] * self._plant
        self._far = grids.omega > bounds.top
        widths = bounds.bandwidths or (0.0,) * len(servos)
        held = [grids.omega[0] < WITHIN * widths[i] for i in (axis, *others)]
        self._held = [below if below.any() else None for below in held]
        self._prepare_motion(grids, servos, axis, moves, others)

    def _prepare_motion(
        self,
        grids: Grids,
        servos: Sequence[Servo],
        axis: int,
        moves: Sequence[TestMove],
        others: list[int],
    ) -> None:
        wave, s = grids.wave, 1j * grids.wave.omega
        self._wave, self._tick = wave, wave.duration / wave.samples
        self._slow = _Sampled.of(s, servos[axis].timing)
        gains = _without(np.stack([servo.gain(s) for servo in servos], axis=-1), axis)
        closed = _compliance(grids.slow, gains)
        loads = grids.loads - np.einsum("wij,wj,wjk->wik", grids.loads, gains, closed)
        self._motor, self._load = closed[:, axis, axis], loads[:, axis, axis]
        self._target = wave.spectrum(wave.move(self.move))
        self._step = wave.spectrum(wave.step(DISTURBANCE * self.mass * self.move.acceleration))
        self._wanted = wave.move(self.move)
        self._begin = int(np.searchsorted(wave.time, self.move.duration))
        self._weight = np.where(wave.time >= self.move.duration, 1.0, DURING)
        # position = there - back C S, for motor and last mass of every other axis on its own move
        self._others = []
        for i in others:
            wanted = wave.move(moves[i])
            drive = servos[i].reference_gain(s) * wave.spectrum(wanted)
            begin = int(np.searchsorted(wave.time, moves[i].duration))
            band = INNER_BAND * moves[i].settling_band
            for what in (closed, loads):
                there, back = what[:, i, i] * drive, what[:, i, axis] * closed[:, axis, i] * drive
                self._others.append((there, back, wanted[begin:], begin, band))

    def cost(self, servo: Servo) -> float:
        """Return the cost of a controller, s; above UNSTABLE where the loop is not stable."""
        return self.figures(servo)[0]

    def figures(self, servo: Servo) -> tuple[float, float]:
        """Return cost, s, and the largest relative excess of a bound (negative: all are kept)."""
        gain, _, _ = self._at.gain(servo)
        opened = 1 + gain * self._plant
        ratio = opened / self._reference
        turned = np.angle(ratio[:, 1:] * np.conj(ratio[:, :-1])).sum(axis=1)
        inverse = 1 / opened
        peak = float(np.abs(inverse).max())
        if np.abs(turned).max() > 1.0 or not isfinite(peak):
            return UNSTABLE * (1 + min(peak, 1e3)), np.inf
        follow = gain * inverse
        sizes = [np.abs(inverse)]
        sizes += [np.abs(a + b * follow) for a, b in zip(self._own, self._cross, strict=True)]
        excess = max(float(size.max()) for size in sizes) / self.bounds.sensitivity - 1
        for size, below in zip(sizes, self._held, strict=True):
            if below is not None:
                excess = max(excess, float(size[0][below].max()) / BANDWIDTH_LEVEL - 1)
        if isfinite(self.bounds.compliance):
            soft = float(np.abs(self._plant * inverse).max())
            excess = max(excess, SOFT * (soft / self.bounds.compliance - 1))
        if self._far.any():
            far = np.abs(1 - inverse[self._far])
            excess = max(excess, float(far.max()) / self.bounds.far - 1)
        if isfinite(self.bounds.noise) and isfinite(self.bounds.resolution):
            noise = servo.torque_noise(self.bounds.resolution)
            excess = max(excess, noise / self.bounds.noise - 1)
        settled, torque = self._motion(servo)
        excess = max(excess, torque / self.bounds.torque - 1)
        return settled + STEEP * self.move.duration * max(excess, 0.0), excess

    def fed_forward(self, servo: Servo) -> Servo:
        """Return a controller with the feed-forward that fits its feedback best."""
        gain, torque, pi = self._slow.gain(servo)
        share, inertia = self._feed_forward(servo, 1 / (1 + gain * self._motor), torque, pi)[0]
        loop = replace(servo.loop, velocity_ff=share, inertia_ff=inertia)
        return replace(servo, loop=loop)

    def _feed_forward(
        self, servo: Servo, sensitivity: ComplexArray, torque: ComplexArray, pi: ComplexArray
    ) -> tuple[tuple[float, float], tuple[FloatArray, FloatArray], ComplexArray]:
        """Return the shares, errors of motor and last mass on the move, and the torque's phasors.

        Shares are those of least squares over the time after the move, and a little before it.
        """
        wave, drive = self._wave, self._target * sensitivity
        parts = [pi * servo.loop.position_p * drive]
        parts.append(pi * self._slow.s * drive)
        parts.append(torque * self._slow.acceleration * drive * self.mass)
        signals = [[wave.signal(plant * part) for part in parts] for plant in self._plants]
        known = np.array([servo.loop.velocity_ff, servo.loop.inertia_ff / self.mass])
        base = np.concatenate([(one[0] - self._wanted) * self._weight for one in signals])
        columns = np.column_stack(
            [np.concatenate([one[k] * self._weight for one in signals]) for k in (1, 2)]
        )
        best = _least_squares(columns, base, known, np.array(self.free), self._most_fed(servo))
        errors = tuple(
            one[0] - self._wanted + best[0] * one[1] + best[1] * one[2] for one in signals
        )
        phasors = parts[0] + best[0] * parts[1] + best[1] * parts[2]
        return (float(best[0]), float(best[1]) * self.mass), (errors[0], errors[1]), phasors

    def _most_fed(self, servo: Servo) -> FloatArray:
        """Return the largest shares of velocity and inertia: targets are rounded to encoder steps."""
        alone = replace(servo.loop, velocity_ff=0.0, inertia_ff=self.mass)
        noise = replace(servo, loop=alone).target_noise(self.bounds.resolution)
        if not (isfinite(noise) and isfinite(self.bounds.noise) and noise > 0):
            return MOST_FED
        return np.asarray(np.minimum(MOST_FED, [1.0, FED_NOISE * self.bounds.noise / noise]))

    @property
    def _plants(self) -> tuple[ComplexArray, ComplexArray]:
        return self._motor, self._load

    def _motion(self, servo: Servo) -> tuple[float, float]:
        """Return a smooth measure of the time outside of the band, s, and the move's largest torque."""
        gain, torque, pi = self._slow.gain(servo)
        wave, sensitivity = self._wave, 1 / (1 + gain * self._motor)
        _, errors, phasors = self._feed_forward(servo, sensitivity, torque, pi)
        band = INNER_BAND * self.move.settling_band
        disturbed = self._step * sensitivity
        total = 0.0
        for plant, error in zip(self._plants, errors, strict=True):
            pushed = wave.signal(plant * disturbed)
            total += MOVED * _outside(error[self._begin :], band)
            energy = float(pushed @ pushed) * self._tick / band**2
            total += STIFFNESS * self.move.duration / self._tick * float(np.log(energy + 1e-12))
        follow = gain * sensitivity
        for there, back, wanted, begin, other_band in self._others:
            moved = wave.signal(there - back * follow)[begin:]
            total += _outside(moved - wanted, other_band)
        return 0.5 * self._tick * total, float(np.abs(wave.signal(phasors)).max())


def _least_squares(
    columns: FloatArray,
    base: FloatArray,
    known: FloatArray,
    free: NDArray[np.bool_],
    most: FloatArray,
) -> FloatArray:
    """Return shares within their bounds that make base + columns shares smallest; fixed ones stay."""
    best = np.where(free, np.clip(known, 0.0, most), known)
    for k in (0, 1, 0, 1) if free.all() else (0, 1):
        if free[k]:
            column = columns[:, k]
            rest = base + columns @ best - column * best[k]
            size = float(column @ column)
            best[k] = float(np.clip(-(column @ rest) / max(size, 1e-300), 0.0, most[k]))
    if free.all():
        normal = columns.T @ columns
        normal += 1e-12 * np.trace(normal) * np.eye(2)
        pair = np.linalg.solve(normal, -(columns.T @ base))
        if np.all((pair >= 0) & (pair <= most)):
            return np.asarray(pair)
    return best


def _outside(error: FloatArray, band: float) -> float:
    """Return a smooth count of the samples outside of a band."""
    fourth = error / band
    fourth *= fourth
    fourth *= fourth
    return float((fourth / (fourth + 1)).sum())


def _without(gains: ComplexArray, axis: int) -> ComplexArray:
    out = gains.copy()
    out[..., axis] = 0.0
    return out


def _compliance(plant: ComplexArray, gains: ComplexArray) -> ComplexArray:
    """Return motor positions per added torque with loops closed, (..., M, M)."""
    eye = np.eye(plant.shape[-1])
    return np.linalg.solve(eye + plant * gains[..., None, :], plant)
