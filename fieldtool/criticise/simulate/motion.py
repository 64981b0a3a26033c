"""The measured motion of one experiment, with velocity and acceleration, as a model is driven by it.

Velocity and acceleration are central differences of eighth order.  Their relative errors at w Ts = 0.6
are below 1e-4; they are not smoothed, because what follows is compared in a band, measured
and modelled torque filtered alike.  Laws that bend at standstill (friction) take the smooth motion.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.signal import butter, sosfiltfilt

from fieldtool.frf.held_targets import folds
from fieldtool.frf.velocity_band import STOPPED, UNSURE, velocity_noise, white_noise
from fieldtool.records.recording import Experiment, Recording

FloatArray = NDArray[np.float64]
FIRST = np.array([1 / 280, -4 / 105, 1 / 5, -4 / 5, 0.0, 4 / 5, -1 / 5, 4 / 105, -1 / 280])
"""Weights of rows k - 4 to k + 4 for the first derivative times the step."""
SECOND = np.array(
    [-1 / 560, 8 / 315, -1 / 5, 8 / 5, -205 / 72, 8 / 5, -1 / 5, 8 / 315, -1 / 560]
)  # fmt: skip
"""The same for the second derivative times the step squared."""
REACH = 4
"""Rows to either side that a difference needs."""
SMOOTH = 2.5
"""Corner of the smooth motion over the highest frequency that is compared."""
FEWEST_ROWS = 200
"""In an experiment worth simulating."""


@dataclass(frozen=True, eq=False)
class Motion:
    """One experiment as a model is driven by it; arrays (n, M), axes in the recording's order."""

    experiment: str
    step: float
    """s."""
    clock: FloatArray
    """(n,), s since the recording's first sample; rising from experiment to experiment."""
    position: FloatArray
    """rad or m."""
    velocity: FloatArray
    acceleration: FloatArray
    torque: FloatArray
    """As measured, less what a drive's targets bend it by: N m, N or A."""
    smooth_position: FloatArray
    """Without phase shift, low-passed above the band."""
    smooth_velocity: FloatArray
    counted: FloatArray
    """1 where the axis moves for sure, 0 where it may stand still or a difference lacks rows."""

    @cached_property
    def inputs(self) -> FloatArray:
        """q, q', q'' of the motors side by side, (n, 3 M)."""
        return np.hstack([self.position, self.velocity, self.acceleration])

    @cached_property
    def driven(self) -> FloatArray:
        """The same for straight lines between samples, which are weaker by (w Ts)**2 / 12."""
        u = self.inputs
        out = u.copy()
        out[1:-1] -= (u[2:] - 2.0 * u[1:-1] + u[:-2]) / 12.0
        return out

    @property
    def rows(self) -> int:
        """Number of samples n."""
        return int(self.position.shape[0])


def differentiate(values: FloatArray, weights: FloatArray, scale: float) -> FloatArray:
    """Central difference along the rows; the first and last four repeat their neighbour."""
    inner = np.zeros((values.shape[0] - 2 * REACH, *values.shape[1:]))
    for shift, weight in enumerate(weights):
        inner += weight * values[shift : shift + inner.shape[0]]
    ends = [(REACH, REACH)] + [(0, 0)] * (values.ndim - 1)
    return np.asarray(np.pad(inner / scale, ends, mode="edge"), dtype=np.float64)


def motions_of(
    recording: Recording, experiments: Sequence[Experiment], top: float
) -> tuple[Motion, ...]:
    """Return what a model is driven by, for each experiment that is long enough.

    Parameters
    ----------
    recording, experiments
    top : float
        Highest frequency that will be compared, Hz.
    """
    step, clock, motions = recording.sample_period, 0.0, []
    for experiment in experiments:
        if experiment.samples < FEWEST_ROWS:
            continue
        clock = max(clock, float(experiment.time[0]))
        motions.append(_motion(experiment, _acting(recording, experiment), step, clock, top))
        clock += experiment.samples * step
    return tuple(motions)


def _acting(recording: Recording, experiment: Experiment) -> FloatArray:
    """Return the measured torque, less what a drive's targets bend it by where it is sampled."""
    torque, reference = experiment.torque.copy(), experiment.position_reference
    if reference is None:
        return torque
    for fold in folds(recording):
        sent = reference[:, fold.axis]
        if np.all(np.isfinite(sent)):
            torque[:, fold.axis] -= fold.course(sent, fold.size)
    return torque


def _motion(
    experiment: Experiment, torque: FloatArray, step: float, begin: float, top: float
) -> Motion:
    position = experiment.position
    velocity = differentiate(position, FIRST, step)
    acceleration = differentiate(position, SECOND, step**2)
    corner = min(SMOOTH * top * step * 2, 0.8)
    sections = butter(2, corner, output="sos")
    smooth = np.asarray(sosfiltfilt(sections, position, axis=0), dtype=np.float64)
    smooth_velocity = differentiate(smooth, FIRST, step)
    return Motion(
        experiment.name,
        step,
        np.asarray(begin + step * np.arange(experiment.samples), dtype=np.float64),
        position,
        velocity,
        acceleration,
        torque,
        smooth,
        smooth_velocity,
        _counted(smooth_velocity, white_noise(position), corner / (2 * step), step),
    )


def _counted(velocity: FloatArray, noise: FloatArray, corner: float, step: float) -> FloatArray:
    """Find the rows in which each axis moves for sure, (n, M)."""
    spread = velocity_noise(noise, np.full_like(noise, corner), step)
    fastest = np.quantile(np.abs(velocity), 0.99, axis=0)
    slow = np.abs(velocity) <= np.maximum(UNSURE * spread, STOPPED * fastest)
    slow[1:] |= slow[:-1].copy()
    slow[:-1] |= slow[1:].copy()
    # A passage through zero between two rows is slow as well.
    turned = np.signbit(velocity[1:]) != np.signbit(velocity[:-1])
    slow[1:] |= turned
    slow[:-1] |= turned
    counted = np.where(slow, 0.0, 1.0)
    counted[:REACH], counted[-REACH:] = 0.0, 0.0
    return counted
