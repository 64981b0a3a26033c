"""Whole periods of closed-loop motion, freed of the transient that still decays in them.

A linear machine under its loops moves, after any start, as its steady periodic motion plus

    sum over the closed loop's poles of  c l^t,   l = exp(p T)

with the same poles in every signal and every experiment.  Over P periods of N samples the DFT of
such a term is c (1 - l^(P N)) / (1 - l exp(-j w)), at every bin, while the steady motion is only at
the bins that are multiples of P, the lines.  So the poles and the c are found from what the lines do
not touch, and what they say at the lines is taken off:

1. The first period minus the mean of the later ones holds no steady motion: it is a free decay.
   Its Hankel matrix (all signals of all experiments together) gives the poles: the eigensystem
   realisation algorithm.  The number of poles is the one with the least corrected information
   criterion of the fit at the bins between the lines.
2. The c follow from the bins between the lines by linear least squares.  A straight drift is the
   pole l = 1 and is always among them, so a constant velocity is taken out exactly.
3. What the fit leaves between the lines is noise, in these bins as in the lines.

Valid for: loops that are linear enough for their decay to be a sum of exponentials, at least two
periods, and a sample rate some 8 times the highest line (poles above 4 times the highest line are
not looked for).  A rational model of each line's neighbourhood alone does not do: with two periods
its 10 to 20 bins are as wide as the gaps between the poles.
Sensitivity: on the three-axis machine of the paper's case study (two periods of 4 s, slowest pole
1/s, 1 s after the start) the response's error of 4 % (rms; 12 % at worst) falls to 2e-10 (1e-9)
without noise.  With noise the scatter of the response grows by some 10 % for two periods, 2 % for
four; what stays of the transient is below the noise and counts as noise, which can raise the
estimated noise of a very quiet signal by half.

Source: Juang and Pappa, An eigensystem realization algorithm, 1985; Pintelon and Schoukens, System
Identification: A Frequency Domain Approach, chapter 7 (transients between the lines).
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from fieldtool.frf.phasors import ComplexArray, FloatArray

BoolArray = NDArray[np.bool_]
MAX_POLES = 30
_CHANNELS = 8
"""Principal signals that the Hankel matrix is made of."""
_BLOCK_ROWS = 30
_EXACT = 1e-10
"""Of the largest singular value: below it is rounding."""


@dataclass(frozen=True, eq=False)
class SteadySpectra:
    """Steady amplitudes of S signals at lines 1 to L, and what the bins between them show."""

    periods: int
    """P."""
    mean: ComplexArray
    """(L, S): amplitudes (peak) at lines 1 to L, the transient taken out."""
    transient: ComplexArray
    """(L, S): what was taken out."""
    poles: ComplexArray
    """(n,): of the transient, 1/s; of a pair the one above the real axis."""
    residual: ComplexArray
    """(B, S): what is left at the bins between the lines, in the scale of ``mean``."""
    place: FloatArray
    """(B,): where these bins are, in lines."""
    freedom: FloatArray
    """(B,): share of each bin that the fit did not use up, 0 to 1."""
    inflation: FloatArray
    """(L,): variance of ``mean`` over that of the plain mean, 1 or above."""


def steady_spectra(signals: FloatArray, periods: int, lines: int, step: float) -> SteadySpectra:
    """Return the steady amplitudes of S signals over whole periods.

    Parameters
    ----------
    signals
        (P * N, S), P >= 2 whole periods; all S with the same poles: the positions and torques of one
        experiment, or of several with the same period beside each other.
    periods
        P.
    lines
        L, number of the highest line wanted, below N / 2.
    step
        Sample period, s.

    Raises
    ------
    ValueError
        If the rows are no P >= 2 periods, or L is out of range.
    """
    n = signals.shape[0]
    N = n // max(periods, 1)
    if periods < 2 or n != periods * N or not 1 <= lines <= (N - 1) // 2:
        raise ValueError(
            f"{n} rows, {periods} periods and {lines} lines do not fit: at least two whole periods "
            "and at most half a period's samples as lines are needed"
        )
    centred = signals - signals.mean(axis=0)
    last = min((N - 1) // 2, lines + max(10, lines // 3))
    bins = np.arange(1, periods * last + 1)
    spectrum = np.fft.rfft(centred, axis=0)[bins] * (2 / n)
    between = bins % periods != 0
    chosen = _best_fit(_decays(centred, periods, lines), spectrum, bins, between, n)
    at_lines = np.arange(1, lines + 1) * periods - 1
    transient = chosen.basis[at_lines] @ chosen.coefficients
    return SteadySpectra(
        periods=periods,
        mean=spectrum[at_lines] - transient,
        transient=transient,
        poles=np.asarray(np.log(chosen.factors) / step, dtype=np.complex128),
        residual=(spectrum - chosen.basis @ chosen.coefficients)[between],
        place=bins[between] / periods,
        freedom=1 - chosen.leverage[between],
        inflation=1 + chosen.leverage[at_lines],
    )


def noise_covariance(
    spectra: SteadySpectra, columns: list[NDArray[np.intp]], wanted: float
) -> tuple[ComplexArray, FloatArray]:
    """Return the covariance of the noise of the mean at every line, and its degrees of freedom.

    Parameters
    ----------
    spectra
        Of S signals.
    columns
        One list of s columns for each experiment whose noise is taken as alike (E of them).
    wanted
        Degrees of freedom (complex) to average over: the window around a line is widened until it
        holds as many, or everything.

    Returns
    -------
    covariance, freedom
        (L, s, s), E[e e^H], and (L,).
    """
    there = np.array([spectra.residual[:, group] for group in columns])  # (E, B, s)
    products = np.einsum("ebi,ebj->bij", there, there.conj())
    products = np.concatenate([np.zeros((1, *products.shape[1:])), np.cumsum(products, axis=0)])
    counts = np.concatenate([[0.0], np.cumsum(spectra.freedom)]) * len(columns)
    lines = np.arange(1, spectra.mean.shape[0] + 1)
    low, high = windows(spectra.place, counts, lines, wanted)
    freedom = counts[high] - counts[low]
    mean = (products[high] - products[low]) / freedom[:, None, None]
    return mean * spectra.inflation[:, None, None], freedom


def windows(
    place: FloatArray, counts: FloatArray, lines: NDArray[np.intp] | FloatArray, wanted: float
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return for each line the bins from, to (not included) of the narrowest window that will do.

    Parameters
    ----------
    place
        (B,): where bins are, rising.
    counts
        (B + 1,): sums of the degrees of freedom of all bins before.
    lines
        (L,): where the windows are centred, in the unit of ``place``.
    wanted
        Degrees of freedom; a window that would need more bins than there are holds all of them.
    """
    low, high = np.empty(len(lines), np.intp), np.empty(len(lines), np.intp)
    for at, line in enumerate(lines):
        distance = np.unique(np.abs(place - line))
        a, b = 0, distance.size - 1
        while a < b:  # narrowest half width with enough freedom, by bisection
            middle = (a + b) // 2
            ends = np.searchsorted(place, [line - distance[middle], line + distance[middle] + 1e-9])
            if counts[ends[1]] - counts[ends[0]] >= wanted:
                b = middle
            else:
                a = middle + 1
        reach = distance[a] + 1e-9
        low[at], high[at] = np.searchsorted(place, [line - reach, line + reach])
    return low, high


@dataclass(frozen=True, eq=False)
class _Fit:
    factors: ComplexArray
    basis: ComplexArray
    coefficients: ComplexArray
    leverage: FloatArray
    criterion: float


def _best_fit(
    candidates: list[ComplexArray],
    spectrum: ComplexArray,
    bins: NDArray[np.intp],
    between: BoolArray,
    n: int,
) -> _Fit:
    fits = [_fit(factors, spectrum, bins, between, n) for factors in candidates]
    return min(fits, key=lambda fit: fit.criterion)


def _fit(
    factors: ComplexArray,
    spectrum: ComplexArray,
    bins: NDArray[np.intp],
    between: BoolArray,
    n: int,
) -> _Fit:
    """Fit all signals with these exponentials and a drift, real coefficients, between the lines."""
    basis = _basis(factors, bins, n)
    stacked = np.concatenate([basis[between].real, basis[between].imag])
    U, s, Vt = np.linalg.svd(stacked, full_matrices=False)
    kept = s > 1e-12 * s[0]
    inverse = (Vt[kept].T / s[kept]) @ U[:, kept].T
    measured = spectrum[between]
    coefficients = inverse @ np.concatenate([measured.real, measured.imag])
    spread = basis @ (Vt[kept].T / s[kept])
    leverage = np.sum(np.abs(spread) ** 2, axis=1) / 2
    residual = measured - basis[between] @ coefficients
    criterion = _information(residual, np.abs(measured), int(np.count_nonzero(kept)))
    return _Fit(factors, basis, coefficients, np.minimum(leverage, 1e3), criterion)


def _basis(factors: ComplexArray, bins: NDArray[np.intp], n: int) -> ComplexArray:
    """DFTs of a drift and of real exponentials, columns of norm 1, (K, parameters)."""
    turn = np.exp(-2j * np.pi * bins / n)
    columns = [1 / (1 - turn)]
    for factor in factors:
        one = (1 - factor**n) / (1 - factor * turn)
        other = (1 - np.conj(factor) ** n) / (1 - np.conj(factor) * turn)
        columns.append(one + other)
        if factor.imag > 0:
            columns.append((one - other) / 1j)
    basis = np.array(columns).T
    scaled: ComplexArray = basis / np.linalg.norm(basis, axis=0)
    return scaled


def _information(residual: ComplexArray, size: FloatArray, parameters: int) -> float:
    """Akaike's criterion, corrected for few data; the noise of each signal level over some bins."""
    B, S = residual.shape
    edges = np.linspace(0, B, max(1, B // 12) + 1).astype(np.intp)
    floor = (1e-13 * size.max(axis=0)) ** 2 + np.finfo(float).tiny
    fit = 0.0
    for a, b in pairwise(edges):
        power = np.mean(np.abs(residual[a:b]) ** 2, axis=0)
        fit += 2 * (b - a) * float(np.sum(np.log(power + floor)))
    reals = 2 * B
    if reals - parameters - 2 <= 0:
        return float("inf") if parameters > 1 else fit
    return fit + float(S * 2 * parameters * reals / (reals - parameters - 1))


def _decays(signals: FloatArray, periods: int, lines: int) -> list[ComplexArray]:
    """Candidate sets of factors l per sample, one set per number of poles, from none upwards."""
    N = signals.shape[0] // periods
    cut = signals.reshape(periods, N, -1)
    decay = cut[0] - cut[1:].mean(axis=0)
    together = max(1, N // (8 * lines))
    whole = N // together
    blocks = decay[: whole * together].reshape(whole, together, -1).mean(axis=1)
    none = np.empty(0, dtype=np.complex128)
    principal = _principal(blocks)
    if principal is None or whole < 12:
        return [none]
    rows = min(_BLOCK_ROWS, whole // 3)
    columns = whole - rows
    hankel = np.concatenate([principal[j : j + columns + 1].T for j in range(rows)])
    U, s, Vt = np.linalg.svd(hankel[:, :-1], full_matrices=False)
    reals = 2 * (periods - 1) * lines
    most = min(MAX_POLES, reals // 4, int(np.count_nonzero(s > _EXACT * s[0])))
    moved = (U[:, :most].T @ hankel[:, 1:] @ Vt[:most].T) / s[:most]
    sizes = [*range(1, min(most, 20) + 1), *range(22, most + 1, 2)]
    candidates = [none]
    for size in sizes:
        values = np.linalg.eigvals(moved[:size, :size]).astype(np.complex128)
        usable = (values.imag >= 0) & (np.abs(values) < 1 - 1e-9) & (np.abs(values) > 1e-3)
        candidates.append(values[usable] ** (1 / together))
    return candidates


def _principal(signals: FloatArray) -> FloatArray | None:
    """Main combinations of signals (n, S), each signal over its noise; None if all are zero."""
    size = np.sqrt(np.mean(signals**2, axis=0))
    if not np.any(size) or signals.shape[0] < 8:
        return None
    noise = np.sqrt(np.mean(np.diff(signals, n=3, axis=0) ** 2, axis=0) / 20)
    scale = np.maximum(noise, 1e-9 * size)
    scaled = signals[:, size > 0] / scale[size > 0]
    _, V = np.linalg.eigh(scaled.T @ scaled)
    main: FloatArray = scaled @ V[:, ::-1][:, :_CHANNELS]
    return main
