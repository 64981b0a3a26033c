"""When a fault could have been known, by somebody who knows everything but what the host is not told.

The clairvoyant knows the plant's matrices, its dry friction, noise and rounding, which fault it is and
when it came.  Of the machine's state it knows only what the drives' PDOs have told.  Two Kalman
filters follow the same PDOs, one of the sound machine and one of the machine with the fault; the
logarithm of the ratio of their probabilities is summed from the fault on, and decides at ln(N / 1e-6):
a false alarm in a million motions of N cycles (Wald 1945: a likelihood ratio exceeds 1 / a with a
probability of at most a).  No watch can be much sooner with as few false alarms; one that knows neither
plant nor fault is later.

Torques between two SYNCs are not told; they are taken for a line, and what that leaves for noise, as
large as it was before the fault.  Nothing of the tool's watches is used.
"""

import math
import struct
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm
from scipy.stats import norm

from drives.cia402 import ENABLED_MASK, ENABLED_VALUE
from drives.sim.running import RunningMachine

FALSE_ALARM = 1e-6
"""Probability of a false alarm in a motion."""
HELD = 0.0
"""Stands for a fault that lets encoder or motor stand: only that axis' own counts are asked."""
SUBSTEPS = 8
"""Parts of a cycle in which dry friction is taken as constant."""
LOUDER = (1.0, 3.0, 10.0, 30.0, 100.0, 300.0)
"""Tried for the scatter of a torque between two SYNCs, in standard deviations of its noise."""
LEARNED = 400
"""Cycles before the fault that the filters are begun and tuned with."""
SETTLED = 20
"""Cycles after which the filters know the state."""
LEAST = 1e-4
"""Probability of any outcome at least: a frame may be wrong for reasons that are in no model, so that
one alone decides nothing."""

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class Verdict:
    """What the clairvoyant found, in cycles after the fault; None for what never came."""

    visible: int | None
    """When both machines' outcomes are expected a count and a standard deviation apart, first; where it
    decides before, then."""
    decided: int | None
    """When the ratio of probabilities decides."""


@dataclass
class Received:
    """What all drives told, SYNC by SYNC."""

    machine: RunningMachine
    counts: list[FloatArray] = field(default_factory=list)
    torques: list[FloatArray] = field(default_factory=list)
    """N m."""
    on: list[bool] = field(default_factory=list)
    """Whether all drives were enabled."""
    times: list[float] = field(default_factory=list)
    _now: dict[int, tuple[int, int, bool]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._nodes = [n.node_id for n in self.machine.nodes]
        self.machine.listen(self._heard)

    def _heard(self, now: int, cob_id: int, data: bytes) -> None:
        node = cob_id - 0x180
        if node not in self._nodes or len(data) != 8:
            return
        statusword, position, torque = struct.unpack("<Hih", data)
        self._now[node] = (position, torque, statusword & ENABLED_MASK == ENABLED_VALUE)
        if len(self._now) == len(self._nodes):
            rated = np.array([d.hardware.rated_torque for d in self.machine.description.drives])
            told = np.array([self._now[n] for n in self._nodes], dtype=np.float64)
            self.counts.append(told[:, 0])
            self.torques.append(told[:, 1] * rated / 1000)
            self.on.append(bool(told[:, 2].all()))
            self.times.append(now / 1e9)
            self._now.clear()


class _Follower:
    """A Kalman filter of the machine, with dry friction, and a factor on one motor's torque."""

    def __init__(self, machine: RunningMachine, period: float, noise: FloatArray) -> None:
        plant, drives = machine.axes.plant, machine.description.drives
        n = self.size = plant.size
        self.motors = plant.motors
        mass, damping, stiffness = plant.mass_matrix, plant.damping_matrix, plant.stiffness_matrix
        inverse = np.linalg.inv(mass)
        rates = np.block(
            [[np.zeros((n, n)), np.eye(n)], [-inverse @ stiffness, -inverse @ damping]]
        )
        self.mobility = inverse
        self.friction = plant.breakaway
        step = period / SUBSTEPS
        block = np.zeros((3 * n, 3 * n))
        block[: 2 * n, : 2 * n], block[n : 2 * n, 2 * n :] = rates * step, inverse * step
        whole = np.asarray(expm(block))
        self.free, self.forced, self.step = whole[: 2 * n, : 2 * n], whole[: 2 * n, 2 * n :], step
        self.scale = np.array([d.hardware.counts_per_unit for d in drives])
        self.shown = np.zeros((self.motors.size, 2 * n))
        self.shown[np.arange(self.motors.size), self.motors] = self.scale
        pushed = (
            expm(rates * period) @ np.vstack([np.zeros((n, n)), inverse])[:, self.motors] * period
        )
        arrived = np.vstack([0.5 * period * inverse, np.zeros((n, n))])[:, self.motors] * period
        way = pushed - arrived
        self.process = way @ np.diag(noise**2) @ way.T
        self.cycle = expm(rates * period)
        self.state = np.zeros(2 * n)
        self.spread = np.zeros((2 * n, 2 * n))

    def begin(self, counts: FloatArray) -> None:
        """Begin at rest, where the encoders stand, with all that is not told unknown."""
        n = self.size
        self.state[:] = 0.0
        chains = np.searchsorted(self.motors, np.arange(n), side="right") - 1
        self.state[:n] = ((counts + 0.5) / self.scale)[chains]
        self.spread = np.diag([1e-6] * n + [1e-4] * n)

    def copy(self) -> "_Follower":
        other = object.__new__(_Follower)
        other.__dict__ = dict(self.__dict__)
        other.state, other.spread = self.state.copy(), self.spread.copy()
        return other

    def predict(self, before: FloatArray, now: FloatArray) -> None:
        """Go on by a cycle, in which the torques go from one value to the next."""
        n = self.size
        stuck = np.zeros(n, dtype=bool)
        for part in range(SUBSTEPS):
            force = np.zeros(n)
            force[self.motors] = before + (now - before) * (part + 0.5) / SUBSTEPS
            state = self.free @ self.state + self.forced @ force
            for mass in np.flatnonzero(self.friction):
                # the impulse that would stop it, or all that friction gives (Moreau's stepping)
                most = self.friction[mass] * self.step
                impulse = float(np.clip(-state[n + mass] / self.mobility[mass, mass], -most, most))
                state[n:] += self.mobility[:, mass] * impulse
                state[:n] += self.mobility[:, mass] * impulse * self.step / 2
                stuck[mass] = abs(impulse) < most
            self.state = state
        self.spread = self.cycle @ self.spread @ self.cycle.T + self.process
        for mass in np.flatnonzero(stuck):  # it stands, whatever its speed was thought to be
            self.spread[n + mass], self.spread[:, n + mass] = 0.0, 0.0

    @property
    def expected(self) -> tuple[FloatArray, FloatArray]:
        """Motors' positions in counts before rounding, and their standard deviations."""
        covariance = self.shown @ self.spread @ self.shown.T
        return self.shown @ self.state, np.sqrt(np.maximum(np.diag(covariance), 1e-18))

    def chances(self, counts: FloatArray) -> FloatArray:
        """Logarithm of each motor's probability of such counts."""
        mean, spread = self.expected
        outcome = norm.cdf((counts + 1 - mean) / spread) - norm.cdf((counts - mean) / spread)
        return np.asarray(np.log(np.maximum(outcome, LEAST)))

    def correct(self, counts: FloatArray) -> None:
        """Take what was told."""
        shown = self.shown
        covariance = shown @ self.spread @ shown.T + np.eye(len(shown)) / 12
        gain = np.linalg.solve(covariance, shown @ self.spread).T
        self.state += gain @ (counts + 0.5 - shown @ self.state)
        kept = np.eye(self.state.size) - gain @ shown  # Joseph's form: it stays positive
        spread = kept @ self.spread @ kept.T + gain @ gain.T / 12
        self.spread = (spread + spread.T) / 2


def verdict(received: Received, fault_time: float, axis: int, factor: float) -> Verdict:
    """Return when the fault could have been seen, and decided.

    Parameters
    ----------
    received
        What the drives told.
    fault_time
        Virtual seconds.
    axis
        Number of the faulty axis.
    factor
        What the fault makes of the torque that its drive tells: -1 for a reversed motor, 0.1 for a
        scale that is ten times too large, ``HELD`` where the encoder or the motor stands.
    """
    times = np.array(received.times)
    period = float(np.median(np.diff(times[-50:])))
    first = int(np.searchsorted(times, fault_time - 1e-9))
    counts, torques = np.array(received.counts), np.array(received.torques)
    begin = max(0, first - LEARNED)
    while begin < first and np.any(np.abs(np.diff(times[begin : first + 1]) - period) > 1e-6):
        begin += 1
    drives = received.machine.description.drives
    told = np.array([max(d.hardware.torque_noise, d.hardware.rated_torque / 3464) for d in drives])
    tried = [
        _followed(
            received.machine, period, told * louder, counts[begin : first + 1], torques[begin:]
        )
        for louder in LOUDER
    ]
    sound = max(tried, key=lambda one: one[0])[1]
    faulty = sound.copy()
    threshold = math.log(max(first - begin, 1) / FALSE_ALARM)
    total, visible, decided = 0.0, None, None
    gain = np.ones(counts.shape[1])
    gain[axis] = factor
    for k in range(first + 1, times.size):
        if abs(times[k] - times[k - 1] - period) > 1e-6 or not received.on[k]:
            break
        sound.predict(torques[k - 1], torques[k])
        mean, spread = sound.expected
        if factor == HELD:
            other, other_spread = counts[first, axis] + 0.5, 0.0
            stands = counts[k, axis] == counts[first, axis]
            total += 0.0 if stands else math.log(LEAST)
            total -= float(sound.chances(counts[k])[axis])
            apart = abs(mean[axis] - other) - max(1.0, float(spread[axis]))
        else:
            faulty.predict(torques[k - 1] * gain, torques[k] * gain)
            other, other_spread = faulty.expected
            total += float(faulty.chances(counts[k]).sum() - sound.chances(counts[k]).sum())
            faulty.correct(counts[k])
            apart = np.max(np.abs(mean - other) - np.maximum(1.0, np.hypot(spread, other_spread)))
        sound.correct(counts[k])
        if visible is None and apart > 0:
            visible = k - first
        if total > threshold:
            decided = k - first
            visible = decided if visible is None else visible
            break
    return Verdict(visible, decided)


def _followed(
    machine: RunningMachine,
    period: float,
    noise: FloatArray,
    counts: FloatArray,
    torques: FloatArray,
) -> tuple[float, _Follower]:
    """Follow the sound machine from rest; return how probable that was, and the filter."""
    follower = _Follower(machine, period, noise)
    follower.begin(counts[0])
    total = 0.0
    for k in range(1, len(counts)):
        follower.predict(torques[k - 1], torques[k])
        if k > SETTLED:
            total += float(follower.chances(counts[k]).sum())
        follower.correct(counts[k])
    return total, follower
