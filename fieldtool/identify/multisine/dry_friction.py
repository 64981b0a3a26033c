"""The dry friction that periodic data hold beside a linear model, and data freed of it.

Friction of a motor that turns to and fro is Fc sign(velocity).  Its share at the excited lines looks
like viscous friction and a little inertia; between the lines it is what no linear machine makes.
Over all lines of the band, excited or not, the torque that a model can not explain is compared with
the lines of sign(velocity), which the measured position gives::

    T(k) - G(jw_k)**-1 Theta(k) = Fc_i S_i(k) + c_i V_i(k)

V, the velocity, takes back what the fit of a linear model has put down to viscous friction.  Torque
acts, or the position is told, later by a delay; friction acts with the motion itself.  So the sign
is that of the velocity one delay after the torque it is compared with.
Valid for: friction at the motors, motion that reverses; a motor that never reverses shows a constant.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fieldtool.frf.phasors import Phasors
from fieldtool.frf.velocity_band import velocity_band
from fieldtool.identify.likelihood.refine import machine_response
from fieldtool.records.model import Estimate, MachineModel
from fieldtool.records.recording import Experiment

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
VELOCITY_BAND = 3.0
"""Velocity is of the position's lines up to so many times the highest excited one at least."""
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

    def seen(self, standard_errors: float) -> tuple[int, ...]:
        """Return the axes whose friction stands out of its error by so much."""
        return tuple(
            k
            for k, one in enumerate(self.torque)
            if one.std > 0 and one.value > standard_errors * one.std
        )


@dataclass(frozen=True, eq=False)
class SignLines:
    """One experiment at all lines of its band: peak phasors."""

    omega: FloatArray
    """(K,), rad/s."""
    position: ComplexArray
    """(K, M)."""
    torque: ComplexArray
    sign: ComplexArray
    """Of the velocities, shape (K, M)."""


def dry_friction(
    experiments: Sequence[Experiment],
    sample_period: float,
    band: tuple[float, float],
    model: MachineModel,
    delays: FloatArray,
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
    """
    lines = [lines_of_signs(e, sample_period, band, delays) for e in experiments]
    estimates, shares = [], []
    left = [_left(one, model, delays) for one in lines]
    for k in range(len(model.axes)):
        rows = [
            np.column_stack([one.sign[:, k], 1j * one.omega * one.position[:, k]]) for one in lines
        ]
        sides = [value[:, k] for value in left]
        estimates.append(_regression(np.vstack(rows), np.concatenate(sides)))
        power = float(np.mean([np.sum(np.abs(one.torque[:, k]) ** 2) / 2 for one in lines]))
        shares.append(abs(estimates[-1].value) / max(np.sqrt(power), 1e-300))
    return DryFriction(model.names, tuple(estimates), np.array(shares))


def without_dry_friction(
    phasors: Sequence[Phasors],
    experiments: Sequence[Experiment],
    sample_period: float,
    friction: Sequence[float],
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
        Fc of each axis, N m or N.
    delays
        Of each axis, shape (M,), s.
    """
    freed = []
    for one, experiment in zip(phasors, experiments, strict=True):
        band = (float(one.frequencies.min()), float(one.frequencies.max()))
        sign = _sign_lines(experiment, sample_period, band, delays)
        period = float(experiment.period or 0.0)
        places = np.round(one.frequencies * period).astype(np.intp) - 1
        torque = one.torque - sign[places] * np.asarray(friction)
        freed.append(replace(one, torque=torque))
    return tuple(freed)


def lines_of_signs(
    experiment: Experiment, step: float, band: tuple[float, float], delays: FloatArray
) -> SignLines:
    """Return all lines of the band of one experiment's last whole periods, excited or not."""
    period = float(experiment.period or 0.0)
    position, torque = (
        _period_mean(values, period, step) for values in (experiment.position, experiment.torque)
    )
    count = position.shape[0]
    spectra = [np.fft.rfft(v, axis=0)[1 : count // 2] * (2 / count) for v in (position, torque)]
    frequencies = np.arange(1, count // 2) / period
    inside = (frequencies >= band[0] * (1 - 1e-9)) & (frequencies <= band[1] * (1 + 1e-9))
    sign = _sign_lines(experiment, step, band, delays)
    return SignLines(
        2 * np.pi * frequencies[inside],
        spectra[0][inside],
        spectra[1][inside],
        sign[: inside.size][inside],
    )


def _period_mean(values: FloatArray, period: float, step: float) -> FloatArray:
    """Mean of the last whole periods, the straight drift over them taken off, shape (N, M)."""
    samples = round(period / step)
    whole = values.shape[0] // samples
    cut = values[values.shape[0] - whole * samples :].reshape(whole, samples, -1)
    if whole > 1:
        index = np.arange(whole) - (whole - 1) / 2
        slope = np.tensordot(index, cut.mean(axis=1), axes=1) / (index @ index)
        ramp = (np.arange(samples) - (samples - 1) / 2) / samples
        mean: FloatArray = cut.mean(axis=0) - np.outer(ramp, slope)
        return mean
    return np.asarray(cut[0], dtype=np.float64)


def _sign_lines(
    experiment: Experiment, step: float, band: tuple[float, float], delays: FloatArray
) -> ComplexArray:
    """Lines 1 ... of the sign of each motor's velocity a delay later, peak phasors, shape (K, M)."""
    period = float(experiment.period or 0.0)
    position = _period_mean(experiment.position, period, step)
    count = position.shape[0]
    spectrum = np.fft.rfft(position, axis=0)
    frequencies = np.arange(spectrum.shape[0]) / period
    spectrum[frequencies[:, None] > _band(experiment, step, band[1])] = 0.0
    velocity = np.fft.irfft(_derived(spectrum, frequencies, delays), count, axis=0)
    velocity += _drift(experiment, step)
    lines: ComplexArray = np.fft.rfft(np.sign(velocity), axis=0)[1 : count // 2] * (2 / count)
    return lines


def signs_of_velocity(
    experiment: Experiment, step: float, highest: float, delays: FloatArray
) -> FloatArray:
    """Return the sign of each motor's velocity, a delay after each row, shape (n, M).

    The velocity is that of frequencies up to ``VELOCITY_BAND`` times `highest`, Hz, or as many more
    as its noise allows; beyond its ends the record goes on mirrored in its first and last point.
    """
    position = experiment.position - experiment.position[0]
    turned = 2.0 * position[-1] - position[-2::-1]
    there_and_back = np.concatenate([position, turned])[:-1]  # rises by twice the last value
    count = there_and_back.shape[0]
    rise = 2.0 * position[-1] / count
    spectrum = np.fft.rfft(there_and_back - np.outer(np.arange(count), rise), axis=0)
    frequencies = np.arange(spectrum.shape[0]) / (count * step)
    spectrum[frequencies[:, None] > _band(experiment, step, highest)] = 0.0
    velocity = np.fft.irfft(_derived(spectrum, frequencies, delays), count, axis=0)
    signs: FloatArray = np.sign(velocity + rise / step)[: position.shape[0]]
    return signs


def _derived(spectrum: ComplexArray, frequencies: FloatArray, delays: FloatArray) -> ComplexArray:
    """Spectra of velocities, each a delay later."""
    rates = 2j * np.pi * frequencies[:, None]
    out: ComplexArray = rates * np.exp(rates * delays) * spectrum
    return out


def _band(experiment: Experiment, step: float, highest: float) -> FloatArray:
    """Highest frequency that each motor's velocity keeps, Hz, shape (M,)."""
    return velocity_band(experiment.position, step, VELOCITY_BAND * highest)


def _drift(experiment: Experiment, step: float) -> FloatArray:
    """Mean velocity over the last whole periods, shape (M,): a bias velocity."""
    samples = round(float(experiment.period or 0.0) / step)
    whole = experiment.samples // samples
    if whole < 2:
        return np.zeros(experiment.position.shape[1])
    rows = experiment.position[-whole * samples :].reshape(whole, samples, -1).mean(axis=1)
    drift: FloatArray = (rows[-1] - rows[0]) / ((whole - 1) * samples * step)
    return drift


def _left(lines: SignLines, model: MachineModel, delays: FloatArray) -> ComplexArray:
    """Torque that the model does not explain, shape (K, M)."""
    response = machine_response(model, lines.omega, delays)
    explained = np.linalg.solve(response, lines.position[:, :, None])[:, :, 0]
    left: ComplexArray = lines.torque - explained
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
