"""The dry friction that periodic data hold beside a linear model, and data freed of it.

Friction of a motor that turns to and fro is Fc sign(velocity).  Its share at the excited lines looks
like viscous friction and a little inertia; between the lines it is what no linear machine makes.
Over all lines of the band, excited or not, the torque that a model can not explain is compared with
the lines of sign(velocity), which the measured position gives::

    T(k) - G(jw_k)**-1 Theta(k) = Fc_i S_i(k) + c_i V_i(k)

V, the velocity, takes back what the fit of a linear model has put down to viscous friction.  Where a
motor may stand there is no sign; what friction holds it is found from the model in hand.
Valid for: friction at the motors, motion that reverses; a motor that never reverses shows a constant.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fieldtool.frf.phasors import Phasors
from fieldtool.identify.likelihood.refine import machine_response
from fieldtool.identify.multisine.sliding import Sliding
from fieldtool.records.model import Estimate, MachineModel
from fieldtool.records.recording import Experiment

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
LEFT_AT_TURNS = 0.05
"""Standard error of friction while a motor stands, that goes with its acceleration, over Fc."""
SEEN = 5.0
"""Standard errors from which dry friction is taken off before a fit."""


@dataclass(frozen=True, eq=False)
class DryFriction:
    """Dry friction at each motor, from all experiments together."""

    axes: tuple[str, ...]
    torque: tuple[Estimate, ...]
    """Fc of each axis, N m or N."""
    share: FloatArray
    """Fc over the root mean square of the torque, shape (M,)."""

    def sizes(self, standard_errors: float) -> FloatArray:
        """Return Fc of the axes whose friction stands out of its error by so much, else 0; (M,)."""
        sizes = np.zeros(len(self.axes))
        for k in self.seen(standard_errors):
            sizes[k] = self.torque[k].value
        return sizes

    def seen(self, standard_errors: float) -> tuple[int, ...]:
        """Return the axes whose friction stands out of its error by so much."""
        return tuple(
            k
            for k, one in enumerate(self.torque)
            if one.std > 0 and one.value > standard_errors * one.std
        )


@dataclass(frozen=True, eq=False)
class SlidingLines:
    """One experiment at all lines of its band: peak phasors."""

    omega: FloatArray
    """(K,), rad/s."""
    position: ComplexArray
    """(K, M)."""
    torque: ComplexArray
    sign: ComplexArray
    """Of the velocities, 0 where a motor may stand, (K, M)."""
    inside: NDArray[np.bool_]
    """Which of the period's lines these are."""
    sliding: Sliding


def dry_friction(
    experiments: Sequence[Experiment],
    sample_period: float,
    band: tuple[float, float],
    model: MachineModel,
    delays: FloatArray,
    before: FloatArray | None = None,
) -> DryFriction:
    """Estimate Fc of every axis from periodic experiments.

    Parameters
    ----------
    experiments
        Of kind multisine, with a period; their last whole periods count.
    sample_period
        s.
    band
        Lowest and highest excited frequency, Hz.
    model, delays
        Linear model of the machine, and its delays (M,), s.
    before
        Fc as known before, (M,): it bounds what friction a motor that stands can have.
    """
    known = np.zeros(len(model.axes)) if before is None else before
    lines = [sliding_lines(e, sample_period, band, delays) for e in experiments]
    estimates, shares = [], []
    left = [_left(one, model, delays, known) for one in lines]
    for k in range(len(model.axes)):
        rows = [
            np.column_stack([one.sign[:, k], 1j * one.omega * one.position[:, k]]) for one in lines
        ]
        sides = [value[:, k] for value in left]
        estimates.append(_regression(np.vstack(rows), np.concatenate(sides)))
        power = float(np.mean([np.sum(np.abs(one.torque[:, k]) ** 2) / 2 for one in lines]))
        shares.append(abs(estimates[-1].value) / max(np.sqrt(power), 1e-300))
    return DryFriction(model.names, tuple(estimates), np.array(shares))


def mass_left_unsure(
    experiments: Sequence[Experiment],
    sample_period: float,
    highest: float,
    friction: DryFriction,
    delays: FloatArray,
) -> FloatArray:
    """Return the standard error of each motor's mass that its friction at the turns makes, (M,).

    What friction is while a motor stands is known only in part; that part of it goes with the
    acceleration, in all lines alike, so no misfit shows it.  ``LEFT_AT_TURNS`` of Fc, for the share of
    rows in which a motor may stand, over the acceleration's root mean square.
    """
    sizes, M = friction.sizes(SEEN), len(friction.axes)
    if not np.any(sizes):
        return np.zeros(M)
    stands, square = [], []
    for one in experiments:
        sliding = Sliding.of(one, sample_period, highest, delays)
        stands.append(np.mean(sliding.direction == 0, axis=0))
        kept = sliding.frequencies <= highest
        rates = (2 * np.pi * sliding.frequencies[kept, None]) ** 2
        square.append(
            np.sum(np.abs(rates * sliding.lines(sliding.position)[kept]) ** 2, axis=0) / 2
        )
    moved = np.sqrt(np.mean(square, axis=0))
    out: FloatArray = LEFT_AT_TURNS * sizes * np.mean(stands, axis=0) / np.maximum(moved, 1e-300)
    return out


def without_dry_friction(
    phasors: Sequence[Phasors],
    experiments: Sequence[Experiment],
    sample_period: float,
    friction: FloatArray,
    model: MachineModel,
    delays: FloatArray,
) -> tuple[Phasors, ...]:
    """Return phasors whose torque lacks the friction's share.

    Parameters
    ----------
    phasors, experiments
        In the same order.
    sample_period
        s.
    friction
        Fc of each axis, (M,), N m or N.
    model, delays
        Tell what friction holds a motor that stands; delays (M,), s.
    """
    freed = []
    for one, experiment in zip(phasors, experiments, strict=True):
        sliding = Sliding.of(experiment, sample_period, float(one.frequencies.max()), delays)
        course = sliding.direction * friction + sliding.standing(model, delays, friction)
        places = np.round(one.frequencies * float(experiment.period or 0.0)).astype(np.intp) - 1
        freed.append(replace(one, torque=one.torque - sliding.lines(course)[places]))
    return tuple(freed)


def sliding_lines(
    experiment: Experiment, step: float, band: tuple[float, float], delays: FloatArray
) -> SlidingLines:
    """Return all lines of the band of one experiment's last whole periods, excited or not."""
    sliding = Sliding.of(experiment, step, band[1], delays)
    frequencies = sliding.frequencies
    inside = (frequencies >= band[0] * (1 - 1e-9)) & (frequencies <= band[1] * (1 + 1e-9))
    position, torque, sign = (
        sliding.lines(values)[inside]
        for values in (sliding.position, sliding.torque, sliding.direction)
    )
    return SlidingLines(2 * np.pi * frequencies[inside], position, torque, sign, inside, sliding)


def _left(
    lines: SlidingLines, model: MachineModel, delays: FloatArray, known: FloatArray
) -> ComplexArray:
    """Torque that neither the model nor motors that stand explain, shape (K, M)."""
    response = machine_response(model, lines.omega, delays)
    explained = np.linalg.solve(response, lines.position[:, :, None])[:, :, 0]
    standing = lines.sliding.standing(model, delays, known)
    left: ComplexArray = lines.torque - explained - lines.sliding.lines(standing)[lines.inside]
    return left


def _regression(matrix: ComplexArray, side: ComplexArray) -> Estimate:
    """First of the real coefficients, with the standard error that the scatter says."""
    real = np.vstack([matrix.real, matrix.imag])
    right = np.concatenate([side.real, side.imag])
    scale = np.linalg.norm(real, axis=0)
    scale[scale == 0] = 1.0
    inverse = np.linalg.pinv(real / scale, rcond=1e-9)
    solution = inverse @ right
    rest = right - (real / scale) @ solution
    freedom = max(1, right.size - solution.size)
    variance = float(rest @ rest) / freedom * float(inverse[0] @ inverse[0])
    return Estimate(float(solution[0] / scale[0]), float(np.sqrt(variance) / scale[0]))
