"""Figures of merit of a move, a step and a loop: the same for what is simulated and what is measured."""

from dataclasses import asdict, dataclass
from math import inf
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fieldtool.records.model import FloatArray

ComplexArray = NDArray[np.complexfloating[Any, Any]]
STEP_BAND = 0.02
"""Of a step's height: within it the step has settled."""
STRAYS = 1.2
"""Times a following error, and half the band about the target: one above is clearly larger."""
CREEPS = 24
ENOUGH = 2000
"""Samples from which a creep is chosen."""
FASTEST_CREEP, SLOWEST_CREEP = 0.01, 2.0
"""Time constants of the creep that is told from the oscillation, over the record's length."""


@dataclass(frozen=True)
class MoveFigures:
    """How well an axis followed a move; rad or m, s."""

    settling_time: float
    """From the end of the reference until the position stays in the band; 0 where it never left it,
    infinite where it is outside at the end of the record."""
    positioning_time: float
    """From the beginning of the reference until the position stays in the band."""
    overshoot: float
    """Largest way beyond the target, in the direction of the move."""
    following_error: float
    """Largest distance from the reference, from its beginning to the end of the record."""
    residual_peak: float
    """Largest deviation of the oscillating part after the reference has ended."""
    residual_rms: float
    """RMS of that part."""
    band: float
    """What settling was judged by."""

    def as_dict(self) -> dict[str, float]:
        """Plain values."""
        return asdict(self)


@dataclass(frozen=True)
class StepFigures:
    """How a position follows a step of its reference."""

    rise_time: float
    """From 10 % to 90 %, s."""
    overshoot: float
    """Share of the step."""
    settling_time: float
    """Until it stays within 2 %, s; infinite where it does not."""

    def as_dict(self) -> dict[str, float]:
        """Plain values."""
        return asdict(self)


def move_figures(
    time: FloatArray,
    reference: FloatArray,
    position: FloatArray,
    band: float,
    watched: float = inf,
) -> MoveFigures:
    """Return the figures of a move from rest to rest.

    Parameters
    ----------
    time
        s, shape (n,), ascending; the record should go on for several periods of the slowest
        oscillation after the reference has ended.
    reference, position
        Of the same axis at these times, shape (n,), rad or m; a delay of the measurement that is
        known should be taken out first.
    band
        Half its width, rad or m, above 0.
    watched
        s, from the end of the reference, over which the oscillating part is looked at; all that was
        recorded where it is less.  What is told from the oscillation as creep depends on it: records
        of different length compare over the same time only.

    Raises
    ------
    ValueError
        If the shapes differ, the band is not above 0, or the reference does not move.
    """
    if not time.shape == reference.shape == position.shape:
        raise ValueError(f"shapes {time.shape}, {reference.shape}, {position.shape} differ")
    if not band > 0:
        raise ValueError(f"the band must be above 0, got {band}")
    moves = np.flatnonzero(np.diff(reference))
    if moves.size == 0:
        raise ValueError("the reference does not move")
    begin, end = int(moves[0]), int(moves[-1]) + 1
    target, way = float(reference[-1]), float(reference[-1] - reference[0])
    beyond = (position - target) * np.sign(way if way else 1.0)
    arrived = last_outside(time, position - target, band)
    seen = slice(end, end + int(np.count_nonzero(time[end:] <= time[end] + watched)))
    swing = oscillation(time[seen], (position - target)[seen])
    return MoveFigures(
        settling_time=max(arrived - float(time[end]), 0.0),
        positioning_time=max(arrived - float(time[begin]), 0.0),
        overshoot=max(float(beyond[begin:].max()), 0.0),
        following_error=float(np.abs(reference - position)[begin:].max()),
        residual_peak=float(np.abs(swing).max()),
        residual_rms=float(np.sqrt(np.mean(swing**2))),
        band=band,
    )


def strays(new: float, was: float, band: float) -> bool:
    """Return whether a following error is clearly larger than another."""
    return new > STRAYS * was + band / 2


def step_figures(time: FloatArray, position: FloatArray, height: float) -> StepFigures:
    """Return the figures of a step of the reference at time 0 from 0 to ``height``.

    Parameters
    ----------
    time
        s, shape (n,), ascending from 0.
    position
        Shape (n,), rad or m.
    height
        Of the step, not 0.
    """
    share = position / height
    above = [np.flatnonzero(share >= level) for level in (0.1, 0.9)]
    rise = float(time[above[1][0]] - time[above[0][0]]) if above[1].size else float("inf")
    settled = last_outside(time, share - 1.0, STEP_BAND)
    return StepFigures(rise, max(float(share.max()) - 1.0, 0.0), settled - float(time[0]))


def last_outside(time: FloatArray, error: FloatArray, band: float) -> float:
    """Return when an error comes into a band for good, between samples; infinity where it does not."""
    outside = np.flatnonzero(np.abs(error) > band)
    if outside.size == 0:
        return float(time[0])
    k = int(outside[-1])
    if k == time.size - 1:
        return float("inf")
    above, below = abs(float(error[k])) - band, band - abs(float(error[k + 1]))
    share = above / (above + below) if above + below > 0 else 1.0
    return float(time[k] + share * (time[k + 1] - time[k]))


def oscillation(time: FloatArray, error: FloatArray) -> FloatArray:
    """Return what is left of an error without its creep: a constant and one decaying exponential.

    Parameters
    ----------
    time, error
        Shape (n,).  Fewer than 4 samples hold no oscillation.
    """
    if time.size < 4 or not np.any(error):
        return np.zeros_like(error)
    t = (time - time[0]) / (time[-1] - time[0])
    taus = np.geomspace(FASTEST_CREEP, SLOWEST_CREEP, CREEPS)
    few = slice(None, None, max(time.size // ENOUGH, 1))
    creeps = np.exp(-t[few, None] / taus)
    creeps -= creeps.mean(axis=0)
    middle = error[few] - error[few].mean()
    # what each creep takes off the sum of squares
    taken = (middle @ creeps) ** 2 / np.maximum((creeps**2).sum(axis=0), 1e-300)
    creep = np.exp(-t / taus[int(np.argmax(taken))])
    creep -= creep.mean()
    swing = error - error.mean()
    swing = swing - creep * float(swing @ creep) / float(creep @ creep)
    return np.asarray(swing, dtype=np.float64)


def sensitivity_peak(sensitivity: ComplexArray) -> float:
    """Return the largest gain of a sensitivity.

    Parameters
    ----------
    sensitivity
        Of one loop at a grid of frequencies, shape (F,), or of all loops together, shape (F, M, M):
        then the largest singular value, at the inputs of the plant.
    """
    if sensitivity.ndim == 1:
        return float(np.abs(sensitivity).max())
    return float(np.linalg.svd(sensitivity, compute_uv=False).max())
