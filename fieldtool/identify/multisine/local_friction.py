"""Dry friction before any machine is known: what no straight line between neighbours explains.

Whatever the machine and its loops are, torque is linear in the motors' accelerations A, with
coefficients that change little from one line of the period to the next::

    T_i(k) = sum over j of (a_ij + b_ij (w_k - w)) A_j(k) + Fc_i S_i(k)

S are the lines of the sign of the velocity, as measured.  In each short stretch of lines, excited or
not, a and b are projected out of both sides, and Fc is the one number that explains what is left of
all stretches; a stretch in which a resonance bends the line counts as little as it fits.

A position that is told late, or a torque that acts late, shows friction that turns before the motion
does: of some delays the one counts that leaves least.

Dry friction that is a large share of the torque hides modes, or makes others.  Taken off beforehand,
it leaves data in which they can be counted; the fit of the machine then finds it again, better.
Source: local polynomial method, Pintelon and Schoukens, System Identification, chapter 7, with one
input more.  Valid for: multisines of which lines were left out, with excited lines in every
stretch; friction at the motors.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from fieldtool.identify.multisine.dry_friction import (
    ComplexArray,
    DryFriction,
    FloatArray,
    SlidingLines,
    sliding_lines,
)
from fieldtool.identify.multisine.sliding import directions
from fieldtool.records.model import Estimate
from fieldtool.records.recording import Experiment, Recording

STRETCH = 10
"""Lines of the period in which the machine's dynamic stiffness is taken for straight."""
ROUNDS = 20
"""Of weighting stretches by what they leave."""
LEAST_SHARE = 0.03
"""Of the torque: what is bent within a stretch looks like friction of up to a fifth of that."""
DELAYS = np.arange(-2, 11) / 2
"""That are tried, sample periods: the fit of the machine finds what is between."""
DELAYED = 20.0
"""By so much the likelihood's logarithm, twice, has to be better with a delay than with none."""
LEAST_LEFT = 0.1
"""Of the median: what a stretch leaves is taken for no less, so that no single one decides."""


@dataclass(frozen=True, eq=False)
class _Stretch:
    """Lines of all experiments of one period in which the dynamic stiffness is taken for straight."""

    omega: FloatArray
    """(R,), rad/s, of each row."""
    basis: ComplexArray
    """(R, C): what accelerations explain, orthonormal."""
    torque: ComplexArray
    """(R, M), less what they explain."""
    sign: ComplexArray
    """(R, M), as measured."""

    @classmethod
    def of(cls, group: Sequence[SlidingLines], rows: slice) -> "_Stretch":
        """Cut it out of experiments of one period."""
        omega = group[0].omega[rows]
        x = (omega - omega.mean())[:, None]
        pushed = np.vstack([omega[:, None] ** 2 * one.position[rows] for one in group])
        known = np.hstack([pushed, np.tile(x, (len(group), 1)) * pushed])
        sizes = np.linalg.norm(known, axis=0)
        basis = np.linalg.qr(known / np.where(sizes > 0, sizes, 1.0))[0]
        torque = np.vstack([one.torque[rows] for one in group])
        sign = np.vstack([one.sign[rows] for one in group])
        return cls(np.tile(omega, len(group)), basis, _less(basis, torque), sign)

    @property
    def freedom(self) -> int:
        """Degrees of freedom of what is left."""
        rows, known = self.basis.shape
        return int(rows - known)

    def later(self, delay: float) -> ComplexArray:
        """Return what is left of the signs a delay, s, later: (R, M)."""
        return _less(self.basis, self.sign * np.exp(1j * self.omega * delay)[:, None])


def local_friction(
    axes: Sequence[str],
    experiments: Sequence[Experiment],
    sample_period: float,
    band: tuple[float, float],
) -> tuple[DryFriction, FloatArray]:
    """Estimate Fc of every axis without a model of the machine.

    Parameters
    ----------
    axes
        Names, M of them.
    experiments
        Of kind multisine, with a period; their last whole periods count.
    sample_period
        s.
    band
        Lowest and highest excited frequency, Hz: where nothing is excited, the loops alone tie torque
        to motion, and friction can not be told.

    Returns
    -------
    DryFriction
        None of an axis where it is less than ``LEAST_SHARE`` of the torque or the lines are too few.
    FloatArray
        Delay after which the measured motion shows when friction turned, (M,), s; 0 unless it is seen.
    """
    still = np.zeros(len(axes))
    alike: dict[int, list[Experiment]] = {}
    for one in experiments:
        alike.setdefault(round(float(one.period or 0.0) / sample_period), []).append(one)
    lines = [
        [sliding_lines(one, sample_period, band, still) for one in members]
        for members in alike.values()
    ]
    power = np.mean([np.sum(np.abs(o.torque) ** 2, axis=0) / 2 for g in lines for o in g], axis=0)
    stretches = []
    for group in lines:
        count = group[0].omega.size
        edges = np.linspace(0, count, max(1, count // STRETCH) + 1).astype(int)
        stretches += [_Stretch.of(group, slice(*ends)) for ends in pairwise(edges)]
    found, delays = _explaining([s for s in stretches if s.freedom > 0], sample_period, len(axes))
    shares = np.abs([one.value for one in found]) / np.maximum(np.sqrt(power), 1e-300)
    worth = (
        one if share > LEAST_SHARE else Estimate(0.0)
        for one, share in zip(found, shares.tolist(), strict=True)
    )
    return DryFriction(tuple(axes), tuple(worth), shares), delays


def without_local_friction(
    recording: Recording, sizes: FloatArray, highest: float, delays: FloatArray
) -> Recording:
    """Return the recording with friction of these sizes, (M,), taken off all multisines' torques.

    `highest`: highest excited frequency, Hz; `delays`: as found with it, (M,), s.  Where a motor may
    stand, nothing is taken off.
    """

    def freed(one: Experiment) -> Experiment:
        if one.kind != "multisine" or not one.complete:
            return one
        signs = directions(one, recording.sample_period, highest, delays)
        return replace(one, torque=one.torque - signs * sizes)

    return replace(recording, experiments=tuple(freed(one) for one in recording.experiments))


def _less(basis: ComplexArray, values: ComplexArray) -> ComplexArray:
    """Take off what an orthonormal basis explains."""
    left: ComplexArray = values - basis @ (basis.conj().T @ values)
    return left


def _explaining(
    stretches: Sequence[_Stretch], step: float, axes: int
) -> tuple[list[Estimate], FloatArray]:
    """Friction of each axis and its delay, s, that explain what is left of the torques."""
    if not stretches:
        return [Estimate(0.0, np.inf)] * axes, np.zeros(axes)
    every = {d: [s.later(d * step) for s in stretches] for d in DELAYS.tolist()}
    found, delays = [], np.zeros(axes)
    for axis in range(axes):
        tried = {
            delay: _one_number(stretches, axis, [sign[:, axis] for sign in signs])
            for delay, signs in every.items()
        }
        best = min(tried, key=lambda delay: tried[delay][1])
        if tried[0.0][1] - tried[best][1] > DELAYED:
            delays[axis] = best * step
        else:
            best = 0.0
        found.append(tried[best][0])
    return found, delays


def _one_number(
    stretches: Sequence[_Stretch], axis: int, signs: Sequence[ComplexArray]
) -> tuple[Estimate, float]:
    """One number times the sign, that explains what is left; and -2 log likelihood."""
    torques, freedom = [s.torque[:, axis] for s in stretches], [s.freedom for s in stretches]
    both = np.array([float((s.conj() @ t).real) for s, t in zip(signs, torques, strict=True)])
    own = np.array([float((s.conj() @ s).real) for s in signs])
    power = np.array([float((t.conj() @ t).real) for t in torques])
    weights, value = np.ones(len(stretches)), 0.0
    variance, least = weights, 0.0
    for _ in range(ROUNDS):
        value = float(weights @ both / max(weights @ own, 1e-300))
        left = np.maximum(power - 2 * value * both + value**2 * own, 0.0)
        variance = left / freedom
        least = LEAST_LEFT * float(np.median(variance))
        weights = 1.0 / np.maximum(variance + least, 1e-300)
    spread = float(weights**2 @ (variance * own)) / 2
    unlikely = 2.0 * float(freedom @ np.log(np.maximum(variance + least, 1e-300)))
    return Estimate(value, float(np.sqrt(spread) / max(weights @ own, 1e-300))), unlikely
