"""Lanczos steps on the diagonal matrix of resonances, and how they move with their inputs.

Paper, equations (14) to (16): started at the first eigenvector u1, the algorithm rebuilds row
after row of B = L**-1 K L**-T, the motor's mass first::

    B11 = u1' D u1,   d2 = B11 u1 - D u1,   B12 = |d2|,   u2 = d2 / B12,   B22 = u2' D u2

Every new vector is orthogonalised twice against all earlier ones.  Done so, the rows are those
of a matrix within rounding of D; by way of polynomials and their roots they are not.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class LanczosStep:
    """What the paper prints for each branch: the step that removes two masses.

    With off-diagonal entries taken negative, as in a chain: B u = ... - B12 u2.
    """

    u1: FloatArray
    """Start vector, shape (n,), length 1; n is the number of modes."""
    b11: float
    """(K_before + K_1) / m_1, rad2/s2; K_before is 0 at the motor (equation 17)."""
    d2: FloatArray
    """Shape (n,), rad2/s2 (equation 14)."""
    b12: float
    """K_1 / sqrt(m_1 m_2), rad2/s2 (equations 15 and 19)."""
    u2: FloatArray
    """Shape (n,), length 1 (equation 16)."""
    b22: float
    """(K_1 + K_2) / m_2, rad2/s2 (equation 18)."""


def lanczos_step(
    resonances: FloatArray, start: FloatArray, before: FloatArray | None = None
) -> LanczosStep:
    """One step with two rows of B.

    Parameters
    ----------
    resonances : array, shape (n,)
        lam, rad2/s2.
    start : array, shape (n,)
        u1, or any multiple of it.
    before : array, shape (n, k), optional
        Vectors of the masses that are already removed.

    Raises
    ------
    ZeroDivisionError
        If d2 is nothing but rounding: the modes hold one mass here, not two.
    """
    done = np.zeros((resonances.size, 0)) if before is None else before
    u1 = start / np.linalg.norm(start)
    b11 = float(u1 @ (resonances * u1))
    d2, u2 = next_vector(resonances, np.column_stack([done, u1]), b11)
    return LanczosStep(u1, b11, d2, float(np.linalg.norm(d2)), u2, float(u2 @ (resonances * u2)))


def next_vector(
    resonances: FloatArray, vectors: FloatArray, diagonal: float
) -> tuple[FloatArray, FloatArray]:
    """Return d = B_kk u_k - D u_k, orthogonal to all `vectors`, and d / |d|.

    Parameters
    ----------
    resonances : array, shape (n,)
        lam, rad2/s2.
    vectors : array, shape (n, k)
        u_1 ... u_k.
    diagonal : float
        B_kk, rad2/s2.

    Raises
    ------
    ZeroDivisionError
        If d is nothing but rounding.
    """
    last = vectors[:, -1]
    d = diagonal * last - resonances * last
    for _ in range(2):  # twice is enough
        d = d - vectors @ (vectors.T @ d)
    length = float(np.linalg.norm(d))
    if length <= 16.0 * np.finfo(float).eps * resonances.max(initial=0.0):
        raise ZeroDivisionError(f"no mass left after {vectors.shape[1]}")
    u = d / length
    u = u - vectors @ (vectors.T @ u)
    return d, u / np.linalg.norm(u)


@dataclass(frozen=True, eq=False)
class RowSensitivity:
    """First derivatives of the rows of B by resonances and weights (w = u1**2)."""

    diagonal_by_resonance: FloatArray
    """d B_kk / d lam_r at fixed weights, shape (N - 1, n)."""
    diagonal_by_weight: FloatArray
    """d B_kk / d w_r, shape (N - 1, n)."""
    log_off_by_resonance: FloatArray
    """d ln B_k,k+1**2 / d lam_r, shape (N - 2, n)."""
    log_off_by_weight: FloatArray
    """d ln B_k,k+1**2 / d w_r, shape (N - 2, n)."""


def row_sensitivity(
    resonances: FloatArray, weights: FloatArray, diagonal: FloatArray, off: FloatArray
) -> RowSensitivity:
    """Differentiate the rows of B.

    The weights are masses of a measure at the resonances and the Lanczos vectors its orthonormal
    polynomials p_k.  A change dmu moves their squared lengths by S_k = int p_k**2 dmu and their
    second coefficients by C_k = B_k,k+1 int p_k p_k-1 dmu; the rows move by differences of these.

    Parameters
    ----------
    resonances, weights : array, shape (n,)
    diagonal : array, shape (N - 1,)
        B_kk.
    off : array, shape (N - 2,)
        B_k,k+1, positive.

    Notes
    -----
    C of the row after the last needs B_N-1,N p_N-1, which the recurrence gives without B_N-1,N.
    """
    rows = diagonal.size
    p, slope = np.zeros((2, rows + 1, resonances.size))
    p[0] = 1.0
    for k in range(rows):  # the last one stays unscaled: B_N-1,N p_N-1
        scale = off[k] if k < rows - 1 else 1.0
        before = off[k - 1] if k else 0.0
        p[k + 1] = ((resonances - diagonal[k]) * p[k] - before * p[k - 1] * (k > 0)) / scale
        slope[k + 1] = (
            p[k] + (resonances - diagonal[k]) * slope[k] - before * slope[k - 1] * (k > 0)
        ) / scale
    lengths_w = p[:-1] ** 2
    lengths_l = 2.0 * weights * p[:-1] * slope[:-1]
    scales = np.append(off, 1.0)[:rows, None]
    moments_w = np.vstack([np.zeros_like(weights), scales * p[1:] * p[:-1]])
    moments_l = np.vstack(
        [np.zeros_like(weights), scales * weights * (slope[1:] * p[:-1] + p[1:] * slope[:-1])]
    )
    return RowSensitivity(
        diagonal_by_resonance=np.diff(moments_l, axis=0),
        diagonal_by_weight=np.diff(moments_w, axis=0),
        log_off_by_resonance=np.diff(lengths_l, axis=0),
        log_off_by_weight=np.diff(lengths_w, axis=0),
    )
