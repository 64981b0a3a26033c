"""When the motors of a periodic experiment slide and when they stand, and what friction is then.

A motor that slides has friction Fc against its motion.  One that stands, as it does at each turn
while its torque is below Fc, has whatever friction keeps it there: what is measured and not needed
for the motion of the others, no more than Fc.  So those rows neither speak for a model nor against it.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from fieldtool.frf.velocity_band import (
    STOPPED,
    UNSURE,
    position_noise,
    velocity_band,
    velocity_noise,
)
from fieldtool.identify.likelihood.refine import machine_response
from fieldtool.records.model import MachineModel
from fieldtool.records.recording import Experiment

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
HARMONICS = 3.0
"""Velocity is of the position's lines up to so many times the highest excited one at least."""
HELD = 8.0
"""What holds a motor that stands is told up to so many times the highest excited line."""


@dataclass(frozen=True, eq=False)
class Sliding:
    """One experiment's mean period of N samples; arrays (N, M)."""

    step: float
    """s."""
    highest: float
    """Highest excited frequency, Hz."""
    position: FloatArray
    """rad or m from where the experiment begins, a straight drift over the period taken off."""
    torque: FloatArray
    """N m or N."""
    direction: FloatArray
    """Sign of each motor's velocity a delay later; 0 where it may be standing."""

    @classmethod
    def of(
        cls, experiment: Experiment, step: float, highest: float, delays: FloatArray
    ) -> "Sliding":
        """Average the last whole periods.

        Parameters
        ----------
        experiment
            With a period.
        step, highest
            s, Hz.
        delays
            Torque acts, or the position is told, later by a delay; friction acts with the motion
            itself.  Shape (M,), s.
        """
        samples = round(float(experiment.period or 0.0) / step)
        position, drift = _mean(experiment.position - experiment.position[0], samples)
        velocity = _velocity(position, experiment, step, highest, delays) + drift / step
        direction = _direction(velocity, experiment, step, highest)
        return cls(step, highest, position, _mean(experiment.torque, samples)[0], direction)

    @cached_property
    def frequencies(self) -> FloatArray:
        """Lines 1 ... of the period below half the sampling rate, (K,), Hz."""
        count = self.position.shape[0]
        lines: FloatArray = np.arange(1, count // 2) / (count * self.step)
        return lines

    def lines(self, values: FloatArray) -> ComplexArray:
        """Return peak phasors of a course at these lines, (K, M): none of a constant."""
        count = values.shape[0]
        spectrum = np.fft.rfft(values - values.mean(axis=0), axis=0)
        out: ComplexArray = spectrum[1 : count // 2] * (2 / count)
        return out

    def standing(self, model: MachineModel, delays: FloatArray, sizes: FloatArray) -> FloatArray:
        """Return the friction of motors that stand, 0 where they slide.

        Parameters
        ----------
        model, delays
            Without dry friction; delays (M,), s.
        sizes
            Fc of each axis, N m or N.
        """
        if not np.any((self.direction == 0) & (sizes > 0)):
            return np.zeros_like(self.torque)
        count, kept = self.torque.shape[0], self.frequencies <= HELD * self.highest
        omega = 2 * np.pi * self.frequencies[kept]
        response = machine_response(model, omega, delays)
        moved = self.lines(self.position)[kept]
        left = self.lines(self.torque)[kept] - np.linalg.solve(response, moved[:, :, None])[:, :, 0]
        spectrum = np.zeros((count // 2 + 1, sizes.size), dtype=np.complex128)
        spectrum[1 : omega.size + 1] = left * (count / 2)
        course = np.fft.irfft(spectrum, count, axis=0)
        standing: FloatArray = np.where(self.direction == 0, np.clip(course, -sizes, sizes), 0.0)
        return standing


def directions(
    experiment: Experiment, step: float, highest: float, delays: FloatArray
) -> FloatArray:
    """Return the sign of each motor's velocity, a delay after each row of a whole record, (n, M).

    0 where the motor may be standing.  Beyond its ends the record goes on mirrored in its first and
    last point.
    """
    position = experiment.position - experiment.position[0]
    turned = 2.0 * position[-1] - position[-2::-1]
    there_and_back = np.concatenate([position, turned])[:-1]  # rises by twice the last value
    count = there_and_back.shape[0]
    rise = 2.0 * position[-1] / count
    level = there_and_back - np.outer(np.arange(count), rise)
    velocity = _velocity(level, experiment, step, highest, delays) + rise / step
    return _direction(velocity[: position.shape[0]], experiment, step, highest)


def _velocity(
    level: FloatArray, experiment: Experiment, step: float, highest: float, delays: FloatArray
) -> FloatArray:
    """Velocity of a course that repeats, a delay later, up to what its noise allows."""
    count = level.shape[0]
    spectrum = np.fft.rfft(level, axis=0)
    frequencies = np.fft.rfftfreq(count, step)[:, None]
    band = velocity_band(experiment.position, step, HARMONICS * highest)
    spectrum[frequencies > band] = 0.0
    rates = 2j * np.pi * frequencies
    out: FloatArray = np.fft.irfft(rates * np.exp(rates * delays) * spectrum, count, axis=0)
    return out


def _direction(
    velocity: FloatArray, experiment: Experiment, step: float, highest: float
) -> FloatArray:
    band = velocity_band(experiment.position, step, HARMONICS * highest)
    noise = velocity_noise(position_noise(experiment.position), band, step)
    fastest = np.quantile(np.abs(velocity), 0.99, axis=0)
    still = np.abs(velocity) < np.maximum(UNSURE * noise, STOPPED * fastest)
    return np.where(still, 0.0, np.sign(velocity))


def _mean(values: FloatArray, samples: int) -> tuple[FloatArray, FloatArray]:
    """Mean of the last whole periods less its straight drift (N, M), and the drift a row, (M,)."""
    whole = values.shape[0] // samples
    cut = values[values.shape[0] - whole * samples :].reshape(whole, samples, -1)
    if whole < 2:
        return np.asarray(cut[0], dtype=np.float64), np.zeros(cut.shape[2])
    index = np.arange(whole) - (whole - 1) / 2
    slope = np.tensordot(index, cut.mean(axis=1), axes=1) / (index @ index)
    ramp = (np.arange(samples) - (samples - 1) / 2) / samples
    mean: FloatArray = cut.mean(axis=0) - np.outer(ramp, slope)
    return mean, np.asarray(slope / samples, dtype=np.float64)
