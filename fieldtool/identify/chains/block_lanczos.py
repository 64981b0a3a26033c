"""Lanczos on all chains at once: from motors' mode shapes to every mass, spring and coupling.

A row phi_ik holds what mass k of axis i shows of every mode, normalised to the mass matrix, rigid
modes (eigenvalue 0) first.  Then M**-1 = Phi Phi' and K = M Phi D Phi' M.  Rows of neighbours obey
the chain's equation of motion, so one row gives the next, level by level from the motors::

    phi_k D m_k = K_k-1 (phi_k - phi_k-1) + K_k (phi_k - phi_k+1),   m_k = 1 / |phi_k|**2

with K_k from phi_k across phi_k+1: K_k-1 + K_k = m_k**2 phi_k D phi_k'.  These are the paper's
Lanczos steps (equations 14 to 19) with vectors of physical length.  A chain ends after its own
number of steps; the rows of all ends together give the matrix of end masses and couplings,
inv(Phi_end Phi_end').  This holds for chains of any lengths, a motor that is its own end included.

Valid where only end masses are coupled: then all rows but those of two ends are across each other,
which the caller can test.  Every row is made orthogonal to the earlier ones of its chain twice.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class ChainRows:
    """Chains taken apart; B is any number of variants computed together."""

    lengths: tuple[int, ...]
    """N of each axis."""
    rows: FloatArray
    """Phi, chain after chain, motor side first, shape (B, sum of N, modes)."""
    masses: FloatArray
    """Of all masses, shape (B, sum of N); of an end the diagonal entry of the end matrix."""
    springs: FloatArray
    """Chain after chain, shape (B, sum of N - 1)."""
    ends: FloatArray
    """End masses with their couplings, shape (B, M, M)."""

    @property
    def places(self) -> tuple[tuple[int, int], ...]:
        """(axis, mass) of every row, mass 0 at the motor."""
        return tuple((i, k) for i, n in enumerate(self.lengths) for k in range(n))

    @property
    def end_rows(self) -> NDArray[np.intp]:
        """Number of each chain's last row, shape (M,)."""
        return np.cumsum(self.lengths).astype(np.intp) - 1

    @property
    def mass_matrix(self) -> FloatArray:
        """M, shape (B, sum of N, sum of N)."""
        matrix = np.zeros((*self.masses.shape, self.masses.shape[1]))
        each = np.arange(self.masses.shape[1])
        matrix[:, each, each] = self.masses
        matrix[:, self.end_rows[:, None], self.end_rows] = self.ends
        return matrix

    def stiffness_matrix(self, resonances: FloatArray) -> FloatArray:
        """K = M Phi D Phi' M, with entries where a machine of chains has none, (B, sum N, sum N)."""
        weighted = self.mass_matrix @ self.rows
        result: FloatArray = (weighted * resonances[:, None, :]) @ weighted.transpose(0, 2, 1)
        return result


def chain_rows(resonances: FloatArray, motors: FloatArray, lengths: Sequence[int]) -> ChainRows:
    """Take all chains apart.

    Parameters
    ----------
    resonances : array, shape (B, modes)
        D, rad2/s2, zeros of the rigid modes included.
    motors : array, shape (B, M, modes)
        P: rows of the motors.
    lengths : sequence of int
        N of each axis.  The modes must be at least the longest chain.

    Returns
    -------
    ChainRows
        Without any check of signs: a spring or mass that is not positive, not finite or huge says
        that the lengths are wrong.
    """
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        chains = [_chain(resonances, motors[:, i], n) for i, n in enumerate(lengths)]
        rows = np.concatenate([c[0] for c in chains], axis=1)
        springs = np.concatenate([c[1] for c in chains], axis=1)
        masses = 1.0 / (rows**2).sum(axis=2)
        last = np.cumsum(lengths) - 1
        ends = _inverse(rows[:, last] @ rows[:, last].transpose(0, 2, 1))
        masses[:, last] = np.diagonal(ends, axis1=1, axis2=2)
    return ChainRows(tuple(lengths), rows, masses, springs, ends)


def _chain(resonances: FloatArray, motor: FloatArray, length: int) -> tuple[FloatArray, FloatArray]:
    """Rows, shape (B, N, modes), and springs, shape (B, N - 1), of one chain."""
    rows, springs = [motor], []
    before = np.zeros(motor.shape[0])
    for k in range(length - 1):
        row = rows[-1]
        mass = 1.0 / (row**2).sum(axis=1)
        force = mass[:, None] * resonances * row
        spring = mass * (row * force).sum(axis=1) - before
        push = before[:, None] * (row - rows[-2]) if k else 0.0
        rows.append(_across(row + (push - force) / spring[:, None], rows))
        springs.append(spring)
        before = spring
    joints = np.array(springs).reshape(length - 1, motor.shape[0])
    return np.stack(rows, axis=1), np.asarray(joints.T, dtype=np.float64)


def _across(row: FloatArray, earlier: list[FloatArray]) -> FloatArray:
    """Take from a row its parts along earlier ones, which are across each other; twice is enough."""
    for _ in range(2):
        for other in earlier:
            part = (row * other).sum(axis=1) / (other**2).sum(axis=1)
            row = row - part[:, None] * other
    return row


def _inverse(matrices: FloatArray) -> FloatArray:
    """Inverses of symmetric matrices, NaN where there is none, scaled to a unit diagonal inside."""
    size = np.sqrt(np.diagonal(matrices, axis1=1, axis2=2))
    scale = size[:, :, None] * size[:, None, :]
    scaled = matrices / scale
    good = np.isfinite(scaled).all(axis=(1, 2))
    good[good] = np.linalg.cond(scaled[good]) < 1e14
    result = np.full_like(matrices, np.nan)
    result[good] = np.linalg.inv(scaled[good]) / scale[good]
    return result
