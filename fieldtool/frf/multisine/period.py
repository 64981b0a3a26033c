"""The period of periodic data that nobody wrote down, and which rows hold whole periods.

A reference is free of noise: it repeats exactly, but for a constant drift (an axis that moves on at
a constant velocity) and rounding.  Measured signals repeat within their noise.
"""

import numpy as np
from numpy.typing import NDArray

from fieldtool.errors import NotEnoughDataError
from fieldtool.frf.phasors import FloatArray
from fieldtool.records.recorded import Experiment

_EXACT = 1e-3
"""Share of a reference's RMS up to which two periods count as the same (rounding to counts)."""
_LIKE = 0.1
"""Share of a measured signal's power that may differ from period to period."""
_UNLIKE = 0.2
"""Typical change from period to period over a reference's size, from which the period is wrong."""
_SHORTEST = 16
"""Samples a period has at least."""


def samples_of_period(experiment: Experiment, sample_period: float) -> int:
    """Return the number of samples N in one period, found from the data where none is given.

    Raises
    ------
    NotEnoughDataError
        If the given period is no whole number of samples, or none is given and none is found.
    """
    if experiment.period is None:
        return round(find_period(experiment, sample_period) / sample_period)
    N = round(experiment.period / sample_period)
    if N < _SHORTEST or abs(N * sample_period - experiment.period) > 1e-6 * experiment.period:
        raise NotEnoughDataError(
            f"experiment {experiment.name}: the period of {experiment.period:.9g} s is "
            f"{experiment.period / sample_period:.6f} samples of {sample_period:.6g} s: it must be "
            f"a whole number of samples, at least {_SHORTEST}; correct the one that is wrong."
        )
    return N


def find_period(experiment: Experiment, sample_period: float) -> float:
    """Find the period, s: where all references repeat exactly, else where all torques do.

    The smallest shift at which the second half of the record repeats what was one shift earlier;
    for measured signals, with at most a tenth of the power left as a difference.  The shift must
    fit twice into the record.

    Raises
    ------
    NotEnoughDataError
        If nothing repeats.
    """
    references = reference_columns(experiment)
    if references is not None:
        N = _repetition(references, _EXACT**2)
    else:
        N = _repetition(experiment.torque, _LIKE)
    if N is None:
        what = "references" if references is not None else "torques"
        raise NotEnoughDataError(
            f"experiment {experiment.name} has no period given, and its {what} repeat at no shift "
            f"up to {experiment.samples // 2 * sample_period:.4g} s, half of the record: give the "
            "period in the description of the recording, or record at least two whole periods."
        )
    return N * sample_period


def reference_columns(experiment: Experiment) -> FloatArray | None:
    """Return all references that there are and that move, (n, R); None if there is none."""
    signals = (experiment.position_reference, experiment.torque_reference)
    columns = [
        values[:, axis]
        for values in signals
        if values is not None
        for axis in range(values.shape[1])
        if not np.any(np.isnan(values[:, axis])) and np.ptp(values[:, axis]) > 0
    ]
    return np.column_stack(columns) if columns else None


def whole_periods(experiment: Experiment, N: int) -> tuple[slice, int]:
    """Return the rows of the last P whole periods of N samples, and P.

    Rows at the ends where a reference does not repeat yet, or no more (fading in or out), are left
    out; so are the rows before the first whole period.

    Raises
    ------
    NotEnoughDataError
        If there are fewer than two, or the references do not repeat with this period.
    """
    start, stop = 0, experiment.samples
    references = reference_columns(experiment)
    if references is not None and stop > N:
        alike, like = _alike(references, N)
        first, last = _longest(alike) if np.any(alike) else (0, 0)
        if last - first >= N // 2:
            start, stop = first, last + N
        elif like > _UNLIKE:
            raise NotEnoughDataError(
                f"experiment {experiment.name}: its references do not repeat after {N} samples, the "
                "period that is given: correct the period, or leave it out to have it found."
            )
    P = (stop - start) // N
    if P < 2:
        step = float(np.mean(np.diff(experiment.time))) if experiment.samples > 1 else 0.0
        raise NotEnoughDataError(
            f"experiment {experiment.name}: {(stop - start) * step:.4g} s of steady excitation are "
            f"{(stop - start) / N:.2f} periods of {N * step:.4g} s, at least 2 whole ones are needed "
            "to tell noise and transients from the machine: measure longer, or with a shorter period."
        )
    return slice(stop - P * N, stop), P


def _alike(references: FloatArray, N: int) -> tuple[NDArray[np.bool_], float]:
    """Rows k, (n - N,), at which all references repeat after N rows, but for a constant drift.

    And the typical change from period to period over the signal's size, of the worst reference.
    """
    change = references[N:] - references[:-N]
    drift = np.median(change, axis=0)
    straight = np.arange(references.shape[0])[:, None] * drift / N
    size = np.std(references - straight, axis=0)
    limit = np.maximum(10 * _EXACT * size, 2.5 * np.array([quantum(one) for one in references.T]))
    same: NDArray[np.bool_] = np.all(np.abs(change - drift) <= limit, axis=1)
    moved = np.maximum(size, np.finfo(float).tiny)
    return same, float(np.max(np.median(np.abs(change - drift), axis=0) / moved))


def quantum(values: FloatArray) -> float:
    """Return the smallest step between different values, the resolution of a rounded signal."""
    steps = np.diff(np.unique(values))
    return float(steps.min()) if steps.size else 0.0


def _longest(mask: NDArray[np.bool_]) -> tuple[int, int]:
    """Return start and end of the longest stretch that is true."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], mask.astype(np.int8), [0]])))
    starts, ends = edges[::2], edges[1::2]
    longest = int(np.argmax(ends - starts))
    return int(starts[longest]), int(ends[longest])


def _repetition(signals: FloatArray, share: float) -> int | None:
    """Return the smallest shift at which all signals (n, S) repeat; None if there is none.

    Compared is the second half of the rows with what was one shift earlier; means (drifts) of the
    differences are left out.  Shifts are tried in order of the autocorrelation's peaks.
    """
    n = signals.shape[0]
    moving = signals[:, np.ptp(signals, axis=0) > 0]
    if moving.shape[1] == 0 or n < 4 * _SHORTEST:
        return None
    half = moving[n // 2 :]
    flat = half - half.mean(axis=0)
    power = np.mean(flat**2, axis=0)
    for N in _shifts(moving):
        change = half - moving[n // 2 - N : n - N]
        left = np.var(change, axis=0) / (2 * power)
        if np.all(left <= share) and np.all(power > 0):
            return N
    return None


def _shifts(signals: FloatArray) -> list[int]:
    """Shifts from 16 samples to half the rows that stand out as peaks of the likeness, rising.

    The difference's power at all shifts at once, by FFT: sum of squares less twice the correlation
    of the second half with all that went before.
    """
    n = signals.shape[0]
    scaled = (signals - signals.mean(axis=0)) / np.std(signals, axis=0)
    late = scaled[n // 2 :]
    size = 1 << int(np.ceil(np.log2(2 * n)))
    both = np.fft.rfft(scaled, size, axis=0) * np.fft.rfft(late, size, axis=0).conj()
    likeness = np.sum(np.fft.irfft(both, size, axis=0), axis=1)  # start of the compared rows
    squares = np.concatenate([[0.0], np.cumsum(np.sum(scaled**2, axis=1))])
    starts = n // 2 - np.arange(n // 2 + 1)
    rows = late.shape[0]
    difference = squares[starts + rows] - squares[starts] - 2 * likeness[starts]
    inner = np.arange(_SHORTEST, starts.size)
    before, after = difference[inner - 1], difference[np.minimum(inner + 1, starts.size - 1)]
    low = (difference[inner] <= before) & (difference[inner] <= after)
    return [int(N) for N in inner[low]]
