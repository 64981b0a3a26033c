"""How good a stepped-sine segment is: noise, distortion, and whether it really had settled."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fieldtool.frf.phasors import FloatArray, SineFit, fit_block, settled

SETTLED_TOLERANCE = 0.01
"""Largest change of an amplitude between the two halves of a segment that noise need not explain."""


@dataclass(frozen=True)
class SegmentQuality:
    """Judgement of one segment by the position and torque of the driven axes (the worst counts)."""

    experiment: str
    frequency: float
    """Hz."""
    signal_to_noise: float
    """Amplitude over its standard error."""
    distortion: float
    """Root of the sum of squares of the harmonics, as a share of the fundamental."""
    steady: bool
    """Whether both halves show the same amplitude within 1 % or noise."""


def judge(
    experiment: str, fit: SineFit, time: FloatArray, signals: FloatArray, driven: Sequence[int]
) -> SegmentQuality:
    """Judge a segment of signals (n, 2M), positions then torques, from its fit.

    ``driven`` are the places of the driven axes among the M.
    """
    M = signals.shape[1] // 2
    chosen = [*driven, *(M + axis for axis in driven)]
    size = np.abs(fit.amplitude[chosen])
    std = fit.std[chosen]
    return SegmentQuality(
        experiment=experiment,
        frequency=fit.frequency,
        signal_to_noise=_smallest(size, std),
        distortion=float(np.max(distortion_share(fit)[chosen], initial=0.0)),
        steady=_steady(time, signals[:, chosen], fit.frequency),
    )


def distortion_share(fit: SineFit) -> FloatArray:
    """Return the total harmonic distortion of each signal, (S,): 0 is a pure sinusoid.

    NaN for a signal without a fundamental.
    """
    overtones = np.sqrt(np.sum(np.abs(fit.harmonics) ** 2, axis=0))
    fundamental = np.abs(fit.amplitude)
    share = np.full(fundamental.shape, np.nan)
    np.divide(overtones, fundamental, out=share, where=fundamental > 0)
    return share


def _steady(time: FloatArray, signals: FloatArray, frequency: float) -> bool:
    """Compare the halves of a segment; one too short to be halved counts as steady."""
    half = time.size // 2
    if half < 8 or time[half] * frequency < 0.9:
        return True
    first = fit_block(time[:half], signals[:half], frequency)
    second = fit_block(time[half:], signals[half:], frequency)
    return settled(first, second, tolerance=SETTLED_TOLERANCE)


def _smallest(size: FloatArray, std: FloatArray) -> float:
    with np.errstate(divide="ignore", invalid="ignore"):
        ratios = np.where(std > 0, size / std, np.inf)
    return float(np.min(ratios, initial=np.inf))
