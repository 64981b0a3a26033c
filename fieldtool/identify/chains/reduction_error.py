"""How far masses and springs move with what they are computed from.

Two uses: standard errors, from those of frequencies and gains; and a bound on what rounding does.
Rounding enters four times: in the given numbers, in the weights of equation (13), in the Lanczos
vectors, and in the differences K_k = B_kk m_k - K_k-1 and m_N = 1 / A_L - sum.  Each is followed
to the result by first derivatives; the bound adds all absolute values.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fieldtool.identify.chains.lanczos import row_sensitivity
from fieldtool.identify.chains.spectrum import Spectrum, weight_factors

FloatArray = NDArray[np.float64]
EPS = float(np.finfo(float).eps)
SAFETY = 4.0
"""Factor on the sum of all first-order effects of rounding."""


@dataclass(frozen=True, eq=False)
class ChainSensitivity:
    """First derivatives of (masses, springs) and what rounding does to them."""

    jacobian: FloatArray
    """By (resonances[1:], antiresonances, A_L, A_H or motor mass), shape (2N - 1, 2n)."""
    relative_bounds: FloatArray
    """Bounds of the relative errors by rounding, shape (2N - 1,); infinite if 0.5 or more."""


def chain_sensitivity(
    spectrum: Spectrum,
    diagonal: FloatArray,
    off: FloatArray,
    masses: FloatArray,
    springs: FloatArray,
    *,
    uses_motor_mass: bool,
) -> ChainSensitivity:
    """Differentiate one chain's masses and springs.

    Parameters
    ----------
    spectrum : Spectrum
        With n resonances.
    diagonal, off : array
        Rows of B, shapes (N - 1,) and (N - 2,), rad2/s2.
    masses, springs : array
        Results, shapes (N,) and (N - 1,).
    uses_motor_mass : bool
        Whether m_1 was given itself, not as 1 / A_H.
    """
    lam, weights = spectrum.resonances, spectrum.weights
    rows = _rows_to_results(diagonal, off, masses, springs)
    by_lam, by_weight = np.zeros((2, 2 * masses.size - 1, lam.size))
    if diagonal.size:
        moved = row_sensitivity(lam, weights, diagonal, off)
        by_lam = (
            rows.by_diagonal @ moved.diagonal_by_resonance
            + rows.by_log_off @ moved.log_off_by_resonance
        )
        by_weight = (
            rows.by_diagonal @ moved.diagonal_by_weight + rows.by_log_off @ moved.log_off_by_weight
        )
    weight_by_lam, weight_by_lam0 = _weight_derivatives(spectrum)
    low_gain = 1.0 / masses.sum()
    by_low_gain = -rows.by_total / low_gain**2
    by_first = rows.by_first if uses_motor_mass else -rows.by_first * masses[0] ** 2
    jacobian = np.column_stack(
        [
            (by_lam + by_weight @ weight_by_lam)[:, 1:],
            by_weight @ weight_by_lam0,
            by_low_gain,
            by_first,
        ]
    )
    given = np.concatenate(
        [
            lam[1:],
            spectrum.antiresonances,
            [low_gain, masses[0] if uses_motor_mass else 1.0 / masses[0]],
        ]
    )
    moved_by_rounding = (
        np.abs(jacobian) @ given
        + np.abs(by_weight) @ (weights * 3.0 * lam.size + _vector_rounding(lam, weights))
        + np.abs(by_lam).sum(axis=1) * lam[-1]
        + np.abs(rows.by_diagonal) @ diagonal * 3.0
        + np.abs(rows.by_log_off).sum(axis=1) * 3.0
        + rows.subtraction
    )
    relative = SAFETY * EPS * moved_by_rounding / np.concatenate([masses, springs])
    bounds = np.where(relative < 0.25, relative / (1.0 - 2.0 * np.minimum(relative, 0.25)), np.inf)
    return ChainSensitivity(jacobian, bounds)


@dataclass(frozen=True, eq=False)
class _RowsToResults:
    """Derivatives of (masses, springs), first axis of each array."""

    by_diagonal: FloatArray
    """By B_kk, shape (2N - 1, N - 1)."""
    by_log_off: FloatArray
    """By ln B_k,k+1**2, shape (2N - 1, N - 2)."""
    by_first: FloatArray
    """By m_1, shape (2N - 1,)."""
    by_total: FloatArray
    """By 1 / A_L, shape (2N - 1,)."""
    subtraction: FloatArray
    """Sizes of what is subtracted in (22), in units of each result, shape (2N - 1,)."""


def _rows_to_results(
    diagonal: FloatArray, off: FloatArray, masses: FloatArray, springs: FloatArray
) -> _RowsToResults:
    """Follow K_k = B_kk m_k - K_k-1 and m_k+1 = K_k**2 / (m_k B_k,k+1**2) with derivatives."""
    count, rows, offs = masses.size, diagonal.size, off.size
    inputs = rows + offs + 2  # B_kk, ln B_k,k+1**2, m_1, 1 / A_L
    d_mass, d_spring = np.zeros((count, inputs)), np.zeros((rows, inputs))
    unit = np.eye(inputs)
    if rows:
        d_mass[0] = unit[rows + offs]
    for k in range(rows):
        d_spring[k] = diagonal[k] * d_mass[k] + masses[k] * unit[k]
        if k:
            d_spring[k] -= d_spring[k - 1]
        if k < offs:
            d_mass[k + 1] = masses[k + 1] * (
                2.0 * d_spring[k] / springs[k] - d_mass[k] / masses[k] - unit[rows + k]
            )
    d_mass[-1] = unit[-1] - d_mass[:-1].sum(axis=0)
    both = np.vstack([d_mass, d_spring])
    subtraction = np.zeros(2 * count - 1)
    subtraction[count - 1] = 2.0 * masses.sum()
    return _RowsToResults(
        by_diagonal=both[:, :rows],
        by_log_off=both[:, rows : rows + offs],
        by_first=both[:, rows + offs],
        by_total=both[:, -1],
        subtraction=subtraction,
    )


def _weight_derivatives(spectrum: Spectrum) -> tuple[FloatArray, FloatArray]:
    """Derivatives of the weights by lam, shape (n, n), and by lam0, shape (n, n - 1).

    Products that leave one factor out stand for weight / (lam0 - lam), so a pair that cancels
    exactly does no harm.
    """
    lam = spectrum.resonances
    n = lam.size
    factors = weight_factors(spectrum)
    by_lam, by_lam0 = np.zeros((n, n)), np.zeros((n, n - 1))
    for i in range(n):
        other = np.flatnonzero(np.arange(n) != i)
        gap = lam[other] - lam[i]
        left_out = np.array([np.prod(np.delete(factors[i], j)) for j in other])
        by_lam0[i] = left_out / gap
        by_lam[i, other] = -left_out * factors[i, other] / gap
        by_lam[i, i] = -by_lam0[i].sum() - by_lam[i, other].sum()
    return by_lam, by_lam0


def _vector_rounding(lam: FloatArray, weights: FloatArray) -> FloatArray:
    """How far weights move, in units of EPS, when D is disturbed by EPS max(lam) in every entry.

    That is the backward error of Lanczos steps that keep their vectors orthogonal.  Eigenvector
    components move by sums over the distances to all other modes.
    """
    u = np.sqrt(weights)
    gaps = lam[:, None] - lam[None, :]
    np.fill_diagonal(gaps, np.inf)
    turned = np.sqrt(((u[None, :] / gaps) ** 2).sum(axis=1)) * lam[-1]
    moved: FloatArray = 2.0 * u * (1.0 + turned)
    return moved
