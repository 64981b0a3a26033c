"""Find the common poles of many frequency responses without knowing where to look.

Vector fitting (Gustavsen & Semlyen 1999; relaxed form, Gustavsen 2006; one QR a response,
Deschrijver et al. 2008): every response is multiplied by one common function sigma so that the
products share given poles; the zeros of sigma are better poles, and so on.  All arithmetic is
real, poles come in conjugate pairs, and poles that turn unstable are mirrored.

Valid for lightly damped modes and good data; it gives a start for a fit, not a result: noise
biases it.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]


@dataclass(frozen=True, eq=False)
class Responses:
    """Columns of values over one list of frequencies; what is missing has weight 0."""

    omega: FloatArray
    """Shape (F,), rad/s."""
    values: ComplexArray
    """Shape (F, C)."""
    weights: FloatArray
    """Inverse standard errors, shape (F, C)."""


@dataclass(frozen=True, eq=False)
class Poles:
    """Where a common denominator is zero."""

    pairs: ComplexArray
    """Upper half plane, shape (n,), rad/s, by rising imaginary part."""
    real: FloatArray
    """Shape (k,), rad/s, negative."""


def start_poles(omega: FloatArray, pairs: int, real: int = 0, damping: float = 0.01) -> Poles:
    """Spread lightly damped poles evenly over the logarithm of the measured band."""
    low, high = omega.min(), omega.max()
    imaginary = np.geomspace(low, high, pairs + 2)[1:-1]
    slow = -low * np.geomspace(0.03, 0.3, real) if real else np.zeros(0)
    return Poles(imaginary * (-damping + 1j), slow)


def find_poles(data: Responses, start: Poles, iterations: int = 25) -> Poles:
    """Move poles until they stay, or `iterations` times."""
    poles = start
    for _ in range(iterations):
        moved = _relocate(data, poles)
        change = _largest_change(poles, moved)
        poles = moved
        if change < 1e-6:
            break
    return poles


def partial_fractions(omega: FloatArray, poles: Poles) -> ComplexArray:
    """Real-coefficient basis, shape (F, k + 2n): 1/(s-p); 1/(s-p) + c.c. and j/(s-p) + c.c."""
    s = (1j * omega[:, None]).astype(np.complex128)
    one: ComplexArray = 1.0 / (s - poles.pairs)
    other: ComplexArray = 1.0 / (s - poles.pairs.conj())
    both = np.stack([one + other, 1j * (one - other)], axis=2).reshape(omega.size, -1)
    return np.hstack([1.0 / (s - poles.real), both])


def _relocate(data: Responses, poles: Poles) -> Poles:
    basis = partial_fractions(data.omega, poles)
    scale = np.linalg.norm(basis, axis=0)  # keeps columns comparable
    basis = basis / scale
    with_constant = np.hstack([basis, np.ones((data.omega.size, 1))])
    rows, sides = [], []
    width = with_constant.shape[1]
    for c in range(data.values.shape[1]):
        weighted = data.weights[:, c, None] * np.hstack(
            [with_constant, -data.values[:, c, None] * with_constant]
        )
        used = data.weights[:, c] > 0.0
        stacked = np.vstack([weighted[used].real, weighted[used].imag])
        rows.append(np.linalg.qr(stacked)[1][width:, width:])
        sides.append(np.zeros(rows[-1].shape[0]))
    size = float(np.linalg.norm(data.weights * np.abs(data.values))) / data.omega.size
    rows.append(size * with_constant.real.sum(axis=0, keepdims=True))  # sigma is not zero
    sides.append(np.array([size * data.omega.size]))
    solved = np.linalg.lstsq(np.vstack(rows), np.concatenate(sides), rcond=None)[0]
    residues, constant = solved[:-1] / scale, solved[-1]
    if abs(constant) < 1e-8:
        constant = float(np.copysign(1e-8, constant))
    return _zeros_of_sigma(poles, residues / constant)


def _zeros_of_sigma(poles: Poles, residues: FloatArray) -> Poles:
    """Eigenvalues of A - b c' in real form."""
    k, n = poles.real.size, poles.pairs.size
    matrix, b = np.zeros((k + 2 * n, k + 2 * n)), np.zeros(k + 2 * n)
    matrix[range(k), range(k)] = poles.real
    b[:k] = 1.0
    for r, p in enumerate(poles.pairs):
        at = k + 2 * r
        matrix[at : at + 2, at : at + 2] = [[p.real, p.imag], [-p.imag, p.real]]
        b[at] = 2.0
    zeros = np.linalg.eigvals(matrix - np.outer(b, residues)).astype(np.complex128)
    zeros = np.where(zeros.real > 0.0, -zeros.conj(), zeros)
    return _sorted_poles(zeros, n, k)


def _sorted_poles(zeros: ComplexArray, pairs: int, real: int) -> Poles:
    """Keep the numbers of pairs and real poles: two real ones too many become a pair, and back."""
    upper = zeros[zeros.imag > 0.0]
    flat = np.sort(zeros[zeros.imag == 0.0].real)
    while upper.size < pairs and flat.size >= real + 2:
        size = float(np.sqrt(flat[0] * flat[1]))
        upper = np.append(upper, size * (-0.3 + 0.954j))
        flat = flat[2:]
    while upper.size > pairs:
        slowest = int(np.argmin(np.abs(upper)))
        flat = np.append(flat, -np.abs(upper[slowest]) * np.array([0.9, 1.1]))
        upper = np.delete(upper, slowest)
    return Poles(upper[np.argsort(upper.imag)], np.sort(flat)[::-1])


def _largest_change(before: Poles, after: Poles) -> float:
    if before.pairs.size != after.pairs.size:
        return np.inf
    if before.pairs.size == 0:
        return 0.0
    return float(np.max(np.abs(after.pairs - before.pairs) / np.abs(before.pairs)))
