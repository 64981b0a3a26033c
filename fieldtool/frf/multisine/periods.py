"""Periodic data: cut into periods, drop the transient, average line by line.

Line k of a period p is the frequency k / p.  Its amplitudes are peak values.  The scatter from
period to period is noise; what repeats in every period is the machine, straight or not.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fieldtool.errors import NotEnoughDataError
from fieldtool.frf.phasors import ComplexArray, FloatArray

_UNLIKE = 1.5


@dataclass(frozen=True, eq=False)
class PeriodAverage:
    """Mean spectrum of S signals over the settled periods, lines 1 to K below half the rate."""

    period: float
    """s."""
    skipped: int
    """Leading periods that were left out as transient."""
    periods: int
    """Periods P that were averaged."""
    mean: ComplexArray
    """(K, S): amplitude at lines 1 to K."""
    covariance: ComplexArray
    """(K, S, S): E[e e^H] of the error of ``mean``, from P - 1 degrees of freedom."""

    @property
    def frequencies(self) -> FloatArray:
        """Of lines 1 to K, Hz, (K,)."""
        return np.arange(1, self.mean.shape[0] + 1) / self.period

    @property
    def std(self) -> FloatArray:
        """Standard error of real and of imaginary part of ``mean``, (K, S)."""
        return np.sqrt(np.diagonal(self.covariance, axis1=1, axis2=2).real / 2)


def average_periods(
    signals: FloatArray, period: float, sample_period: float, skip: int | None = None
) -> PeriodAverage:
    """Average signals (n, S) over their periods.

    Parameters
    ----------
    signals
        (n, S), sampled without gaps from the start of a period.
    period, sample_period
        s; a period must be a whole number of samples.
    skip
        Leading periods to leave out; None leaves out those that differ from the mean of the last
        half by 1.5 times more than any of that half does, in power at the lines that stand out;
        at least one.

    Raises
    ------
    NotEnoughDataError
        If the period is no whole number of samples, or fewer than two periods remain.
    """
    N = round(period / sample_period)
    if N < 2 or abs(N * sample_period - period) > 1e-6 * period:
        raise NotEnoughDataError(
            f"the period of {period:.9g} s is {period / sample_period:.6f} samples of "
            f"{sample_period:.6g} s: it must be a whole number of samples."
        )
    whole = signals.shape[0] // N
    cut = signals[: whole * N].reshape(whole, N, -1)
    if skip is None:
        skip = _transient_periods(cut)
    if skip < 0 or whole - skip < 2:
        raise NotEnoughDataError(
            f"{whole} whole periods of {period:.6g} s, {skip} of them left out, are too few: at "
            "least two settled periods are needed to tell noise from signal; measure longer."
        )
    kept = _without_drift(cut[skip:])
    spectra = np.fft.rfft(kept, axis=1)[:, 1 : (N + 1) // 2] * (2 / N)
    mean = spectra.mean(axis=0)
    deviation = spectra - mean
    P = spectra.shape[0]
    covariance = np.einsum("pki,pkj->kij", deviation, deviation.conj()) / (P * (P - 1))
    return PeriodAverage(period, skip, P, mean, covariance)


def _transient_periods(cut: FloatArray) -> int:
    """Count the leading periods unlike the last half, by the lines that stand out of its noise.

    At least 1, at most half of the P periods of cut (P, N, S).  A stray period later on is noise.
    """
    P, N, _ = cut.shape
    if P < 4:
        return 1 if P else 0
    spectra = np.fft.rfft(cut, axis=1)[:, 1 : (N + 1) // 2]
    late = spectra[P // 2 :]
    mean, variance = late.mean(axis=0), late.var(axis=0, ddof=1)  # (K, S)
    strong = (np.abs(mean) ** 2 > 25 * variance) & (variance > 0)
    distance = np.sum(np.abs(spectra - mean) ** 2 / np.where(strong, variance, np.inf), axis=1)
    usual = np.maximum(distance[P // 2 :].max(axis=0), strong.sum(axis=0))  # (S,)
    unlike = np.any(distance[: P // 2] > _UNLIKE * usual, axis=1)
    leading = P // 2 if np.all(unlike) else int(np.argmin(unlike))
    return max(1, leading)


def _without_drift(cut: FloatArray) -> FloatArray:
    """Take out the straight line through the means of the periods, cut (P, N, S)."""
    P, N, _ = cut.shape
    index = np.arange(P) - (P - 1) / 2
    slope = index @ cut.mean(axis=1) / (index @ index)  # a period
    ramp = (np.arange(P * N) / N).reshape(P, N, 1)
    flat: FloatArray = cut - cut.mean(axis=(0, 1)) - (ramp - ramp.mean()) * slope
    return flat


def excited_lines(
    average: PeriodAverage, reference: int, kind: str, torque: int
) -> NDArray[np.intp]:
    """Find the lines that were excited; return their places in ``average``, (L,).

    Parameters
    ----------
    average
        With the reference and the torque among its signals.
    reference
        Which signal says what was asked for.
    kind
        ``torque_reference``, ``position_reference`` (weighted by the square of frequency), or
        ``torque`` where there is no reference and the measured torque has to say it.
    torque
        Which signal is the measured torque of the same axis.

    Notes
    -----
    A line counts as excited where its amplitude is above a share of the strongest one within an
    octave either side (-40 dB; -20 dB for a measured torque, which has content of its own between
    the lines), above -60 dB (-30 dB) of the strongest of all, and both it and the measured torque
    stand out of the noise by a factor of 5.

    Raises
    ------
    NotEnoughDataError
        If there is none.
    """
    weight = average.frequencies**2 if kind == "position_reference" else 1.0
    size = np.abs(average.mean[:, reference]) * weight
    near, far = (0.1, 0.03) if kind == "torque" else (0.01, 0.001)
    lines = np.arange(1, size.size + 1)
    first, last = (lines + 1) // 2 - 1, np.minimum(2 * lines, size.size)
    strongest = np.array([size[a:b].max() for a, b in zip(first, last, strict=True)])
    clear = np.abs(average.mean) > 5 * average.std
    found = (size > near * strongest) & (size > far * size.max())
    excited = np.flatnonzero(found & clear[:, reference] & clear[:, torque])
    if excited.size == 0:
        raise NotEnoughDataError(
            f"no line of the {kind.replace('_', ' ')} stands out of the noise: check that the "
            f"period of {average.period:.6g} s is right and that the axis was excited."
        )
    return excited
