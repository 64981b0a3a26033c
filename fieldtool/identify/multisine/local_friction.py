"""Dry friction before any machine is known: what no straight line between neighbours explains.

Whatever the machine and its loops are, torque is linear in the motors' accelerations A, with
coefficients that change little from one line of the period to the next::

    T_i(k) = sum over j of (a_ij + b_ij (w_k - w)) A_j(k) + Fc_i S_i(k)

S are the lines of the sign of the velocity, as measured.  In each short stretch of lines, excited or
not, a and b are projected out of both sides, and Fc is the one number that explains what is left of
all stretches; a stretch in which a resonance bends the line counts as little as it fits.

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
LEAST_LEFT = 0.1
"""Of the median: what a stretch leaves is taken for no less, so that no single one decides."""


@dataclass(frozen=True, eq=False)
class _Stretch:
    """What is left of the torque and of the sign of one axis, and their degrees of freedom."""

    torque: ComplexArray
    sign: ComplexArray
    freedom: int


def local_friction(
    axes: Sequence[str],
    experiments: Sequence[Experiment],
    sample_period: float,
    band: tuple[float, float],
) -> DryFriction:
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
    found = []
    for axis in range(len(axes)):
        stretches = []
        for group in lines:
            omega = group[0].omega
            edges = np.linspace(0, omega.size, max(1, omega.size // STRETCH) + 1).astype(int)
            for first, last in pairwise(edges):
                rows = slice(first, last)
                x = (omega[rows] - omega[rows].mean())[:, None]
                known = [
                    np.hstack([pushed, x * pushed])
                    for one in group
                    for pushed in [omega[rows, None] ** 2 * one.position[rows]]
                ]
                torque = np.concatenate([one.torque[rows, axis] for one in group])
                sign = np.concatenate([one.sign[rows, axis] for one in group])
                stretches.append(_less(np.vstack(known), torque, sign))
        found.append(_explaining([s for s in stretches if s.freedom > 0]))
    shares = np.abs([one.value for one in found]) / np.maximum(np.sqrt(power), 1e-300)
    worth = (
        one if share > LEAST_SHARE else Estimate(0.0)
        for one, share in zip(found, shares.tolist(), strict=True)
    )
    return DryFriction(tuple(axes), tuple(worth), shares)


def without_local_friction(recording: Recording, sizes: FloatArray, highest: float) -> Recording:
    """Return the recording with friction of these sizes, (M,), taken off all multisines' torques.

    `highest`: highest excited frequency, Hz.  Where a motor may stand, nothing is taken off.
    """

    def freed(one: Experiment) -> Experiment:
        if one.kind != "multisine" or not one.complete:
            return one
        signs = directions(one, recording.sample_period, highest, np.zeros(sizes.size))
        return replace(one, torque=one.torque - signs * sizes)

    return replace(recording, experiments=tuple(freed(one) for one in recording.experiments))


def _less(known: ComplexArray, torque: ComplexArray, sign: ComplexArray) -> _Stretch:
    """Project out of torque and sign what the columns of `known` span."""
    sizes = np.linalg.norm(known, axis=0)
    basis = np.linalg.qr(known / np.where(sizes > 0, sizes, 1.0))[0]
    left = [value - basis @ (basis.conj().T @ value) for value in (torque, sign)]
    return _Stretch(left[0], left[1], known.shape[0] - known.shape[1])


def _explaining(stretches: Sequence[_Stretch]) -> Estimate:
    """One number times what is left of the sign, that explains what is left of the torque."""
    if not stretches:
        return Estimate(0.0, np.inf)
    both = np.array([float((s.sign.conj() @ s.torque).real) for s in stretches])
    own = np.array([float((s.sign.conj() @ s.sign).real) for s in stretches])
    weights, value = np.ones(len(stretches)), 0.0
    variance: FloatArray = weights
    for _ in range(ROUNDS):
        value = float(weights @ both / max(weights @ own, 1e-300))
        variance = np.array(
            [np.sum(np.abs(s.torque - value * s.sign) ** 2) / s.freedom for s in stretches]
        )
        weights = 1.0 / np.maximum(variance + LEAST_LEFT * np.median(variance), 1e-300)
    spread = float(weights**2 @ (variance * own)) / 2
    return Estimate(value, float(np.sqrt(spread) / max(weights @ own, 1e-300)))
