"""Complex amplitudes of sinusoids in measured signals, with the covariance of their errors.

A signal y(t) = Re(A exp(j w t)) has the complex amplitude ("phasor") A; its modulus is the peak
value.  Phasors of one stretch of time share one origin of phase, so ratios of them are responses.

Errors are taken as circular: real and imaginary part have the same variance, half of E|e|^2.
"""

from dataclasses import dataclass
from itertools import pairwise
from math import ceil, floor

import numpy as np
from numpy.typing import NDArray

from fieldtool.errors import NotEnoughDataError

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

HARMONICS = 5
_MAX_BLOCKS = 16
_MIN_BLOCK_ROWS = 8
_RESIDUAL_FREEDOM = 2
"""Weight of the residual's noise level beside the scatter between blocks, in degrees of freedom."""


@dataclass(frozen=True, eq=False)
class Phasors:
    """Phasors of all axes' positions and torques in one experiment, at F frequencies."""

    experiment: str
    axes: tuple[str, ...]
    """All M axes."""
    driven: tuple[str, ...]
    free: tuple[str, ...]
    """Axes with torque zero; those neither driven nor free held their position."""
    frequencies: FloatArray
    """(F,), Hz; not necessarily rising, one may be there twice."""
    position: ComplexArray
    """(F, M), rad or m."""
    torque: ComplexArray
    """(F, M), N m, N or A."""
    covariance: ComplexArray
    """(F, 2M, 2M): E[e e^H] of the errors of positions, then torques; Hermitian."""

    def __post_init__(self) -> None:
        F, M = self.frequencies.size, len(self.axes)
        shapes = {
            "frequencies": (self.frequencies, (F,)),
            "position": (self.position, (F, M)),
            "torque": (self.torque, (F, M)),
            "covariance": (self.covariance, (F, 2 * M, 2 * M)),
        }
        for name, (values, shape) in shapes.items():
            if values.shape != shape:
                raise ValueError(f"phasors: {name} must have shape {shape}, got {values.shape}")
            if not np.all(np.isfinite(values)):
                raise ValueError(f"phasors of {self.experiment}: {name} must be finite")

    @property
    def position_std(self) -> FloatArray:
        """Standard error of real and of imaginary part of the positions, (F, M)."""
        return self._std()[:, : len(self.axes)]

    @property
    def torque_std(self) -> FloatArray:
        """Standard error of real and of imaginary part of the torques, (F, M)."""
        return self._std()[:, len(self.axes) :]

    def _std(self) -> FloatArray:
        return np.sqrt(np.diagonal(self.covariance, axis1=1, axis2=2).real / 2)


@dataclass(frozen=True, eq=False)
class SineFit:
    """Sinusoid and harmonics fitted to S signals over one stretch of time."""

    frequency: float
    """Hz."""
    amplitude: ComplexArray
    """(S,), phase counted from time 0 of the time column."""
    covariance: ComplexArray
    """(S, S): E[e e^H] of the error of ``amplitude``."""
    harmonics: ComplexArray
    """(H, S): amplitudes at 2, 3, ... H + 1 times the frequency."""
    residual: FloatArray
    """(S,): RMS of what the fit leaves."""

    @property
    def std(self) -> FloatArray:
        """Standard error of real and of imaginary part of ``amplitude``, (S,)."""
        return np.sqrt(np.diagonal(self.covariance).real / 2)


def fit_sine(
    time: FloatArray, signals: FloatArray, frequency: float, harmonics: int = HARMONICS
) -> SineFit:
    """Fit offset, drift, a sinusoid and its harmonics to signals (n, S) at times (n,).

    Least squares, so neither whole periods nor a whole number of samples a period is needed.
    Harmonics above 0.9 of half the sample rate, or more than the rows can carry, are left out.

    The covariance comes from two sources: the scatter between up to 16 blocks of whole periods,
    which sees noise of any colour and drifts of the amplitude, and the residual taken as white
    noise, weighted as 2 degrees of freedom so that few blocks do not give a wild answer.

    Raises
    ------
    NotEnoughDataError
        If the stretch is shorter than 0.9 periods or has fewer than 8 rows.
    """
    n = time.size
    step = (time[-1] - time[0]) / max(n - 1, 1)
    periods = n * step * frequency
    if n < 8 or periods < 0.9:
        raise NotEnoughDataError(
            f"{n} rows hold {periods:.2f} periods of {frequency:.6g} Hz: at least one period and 8 "
            "rows are needed; measure longer."
        )
    carried = min(floor(0.45 / (step * frequency)), (n // 4 - 2) // 2)
    basis = _basis(time, frequency, 1 + max(0, min(harmonics, carried - 1)))
    solution, *_ = np.linalg.lstsq(basis, signals, rcond=None)
    residual = signals - basis @ solution
    waves = solution[2::2] - 1j * solution[3::2]
    freedom = max(n - basis.shape[1], 1)
    white = (residual.T @ residual) * (4 / (n * freedom))
    return SineFit(
        frequency=frequency,
        amplitude=waves[0],
        covariance=_pooled(time, residual, frequency, white, floor(periods + 0.1)),
        harmonics=waves[1:],
        residual=np.sqrt(np.sum(residual**2, axis=0) / freedom),
    )


def fit_block(time: FloatArray, signals: FloatArray, frequency: float) -> SineFit:
    """Fit a sinusoid alone, fast: for use while measuring, block by block (see :func:`settled`).

    Unlike in :func:`fit_sine` the covariance is that of white noise whose level comes from second
    differences of the residual: a transient that has not died out does not count as noise.

    Raises
    ------
    NotEnoughDataError
        If the block has fewer than 8 rows.
    """
    n = time.size
    if n < 8:
        raise NotEnoughDataError(f"a block of {n} rows is too short: at least 8 are needed.")
    basis = _basis(time, frequency, 1)
    solution, *_ = np.linalg.lstsq(basis, signals, rcond=None)
    residual = signals - basis @ solution
    noise = np.sum(np.diff(residual, n=2, axis=0) ** 2, axis=0) / (6 * (n - 2))
    return SineFit(
        frequency=frequency,
        amplitude=solution[2] - 1j * solution[3],
        covariance=np.diag(4 * noise / n).astype(np.complex128),
        harmonics=np.empty((0, signals.shape[1]), dtype=np.complex128),
        residual=np.sqrt(np.mean(residual**2, axis=0)),
    )


def settled(
    previous: SineFit, current: SineFit, tolerance: float = 2e-3, sigmas: float = 3.0
) -> bool:
    """Tell whether two consecutive blocks agree in every signal: the transient has died out.

    They agree where the amplitudes differ by no more than ``tolerance`` of the larger one or by no
    more than noise explains (``sigmas`` standard errors; a difference of pure noise passes 3 with
    a chance of 1e-4).  Both blocks must be fitted on one time axis.

    Valid for: blocks of at least one period.  A slow beat between the sinusoid and a mode that
    dies out can agree by chance when the blocks are a whole number of beats apart: ask for two
    agreements in a row where modes are close and lightly damped.

    Raises
    ------
    ValueError
        If the blocks have different frequencies or signals.
    """
    if previous.frequency != current.frequency:
        raise ValueError(
            f"blocks of {previous.frequency} and {current.frequency} Hz do not compare"
        )
    if previous.amplitude.shape != current.amplitude.shape:
        raise ValueError("blocks of different signals do not compare")
    difference = np.abs(current.amplitude - previous.amplitude)
    size = np.maximum(np.abs(current.amplitude), np.abs(previous.amplitude))
    noise = np.sqrt(2 * (previous.std**2 + current.std**2))
    return bool(np.all(difference <= np.maximum(tolerance * size, sigmas * noise)))


def ratio_std(
    response: ComplexArray, denominator: ComplexArray, covariance: ComplexArray
) -> FloatArray:
    """Return the standard error of real and of imaginary part of numerator / denominator.

    Parameters
    ----------
    response
        The ratio, shape (...).
    denominator
        Shape (...).
    covariance
        Of [numerator, denominator], shape (..., 2, 2).

    Notes
    -----
    First order: the error of N/D is (eN - R eD)/D.  Valid while the error of the denominator is
    well below its modulus.
    """
    variance = (
        covariance[..., 0, 0].real
        + np.abs(response) ** 2 * covariance[..., 1, 1].real
        - 2 * np.real(np.conj(response) * covariance[..., 0, 1])
    )
    return np.sqrt(np.maximum(variance, 0.0) / 2) / np.abs(denominator)


def _basis(time: FloatArray, frequency: float, waves: int) -> FloatArray:
    span = time[-1] - time[0]
    columns = [np.ones_like(time), (time - time[0]) / span - 0.5]
    for order in range(1, waves + 1):
        angle = 2 * np.pi * frequency * order * time
        columns += [np.cos(angle), np.sin(angle)]
    return np.column_stack(columns)


def _pooled(
    time: FloatArray, residual: FloatArray, frequency: float, white: FloatArray, periods: int
) -> ComplexArray:
    """Covariance of the amplitudes: white residual and scatter between blocks, pooled."""
    n = time.size
    rows_per_period = (n - 1) / ((time[-1] - time[0]) * frequency)
    held = max(ceil(periods / _MAX_BLOCKS), ceil(_MIN_BLOCK_ROWS / rows_per_period))
    blocks = periods // held
    if blocks < 2:
        return white.astype(np.complex128)
    borders = np.arange(blocks + 1) * held * rows_per_period
    borders = np.minimum(borders + 0.5, n).astype(np.intp)
    turning = np.exp(-2j * np.pi * frequency * time)[:, None]
    deviations = np.empty((blocks, residual.shape[1]), dtype=np.complex128)
    for block, (start, stop) in enumerate(pairwise(borders)):
        piece = residual[start:stop] - residual[start:stop].mean(axis=0)
        deviations[block] = 2 * np.mean(piece * turning[start:stop], axis=0)
    deviations -= deviations.mean(axis=0)
    scatter = np.einsum("bi,bj->ij", deviations, deviations.conj()) / (blocks * (blocks - 1))
    scatter *= borders[-1] / n
    weight = blocks - 1
    pooled: ComplexArray = (weight * scatter + _RESIDUAL_FREEDOM * white) / (
        weight + _RESIDUAL_FREEDOM
    )
    return pooled


def equation_errors(response: ComplexArray, covariance: ComplexArray) -> ComplexArray:
    """Return E[e e^H] of e = Theta - G T, shape (..., M, M): what measured phasors leave of noise alone.

    Parameters
    ----------
    response
        G, shape (..., M, M).
    covariance
        Of positions, then torques, shape (..., 2M, 2M); leading axes as those of G, or broadcast.
    """
    unit = np.broadcast_to(np.eye(response.shape[-1]), response.shape)
    mixing = np.concatenate([unit, -response], axis=-1)
    errors: ComplexArray = mixing @ covariance @ mixing.conj().swapaxes(-1, -2)
    return errors
