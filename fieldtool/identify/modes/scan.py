"""Where residuals of a modal fit tell of one more mode.

A score test: at each of a grid of poles a small symmetric residue matrix is projected on the
whitened residuals, across all that the fit can follow.  What chi2 would fall by is chi2-distributed
with M (M + 1) / 2 degrees of freedom where there is nothing but noise.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2 as chi2_distribution

from fieldtool.identify.likelihood.response_data import ResponseMatrix
from fieldtool.identify.modes.model import ModalModel, modal_derivatives, modal_response

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
SURE = 1e-3
"""Chance that noise alone looks like one more mode anywhere in the band."""
SCAN_DAMPINGS = (0.003, 0.02)
"""Damping ratios of the grid."""
STEPS_PER_LINE = 3
"""Of the grid, between two lines."""


@dataclass(frozen=True, eq=False)
class Scan:
    """What a small mode at each of a list of poles would gain, the others following."""

    omega: FloatArray
    zeta: FloatArray
    gain: FloatArray
    """By which chi2 falls, in units of the misfit."""
    residues: FloatArray
    """Upper triangles, shape (candidates, M (M + 1) / 2)."""


def scan_modes(
    data: ResponseMatrix, modal: ModalModel, omega: FloatArray, zeta: FloatArray
) -> Scan:
    """Score test: project residuals on a residue matrix at each pole, across all that is fitted."""
    parts, lines, axes = modal.parts, data.omega.size, modal.parts.axes
    x = modal.parameters
    residual = data.residuals(modal_response(parts, x, data.omega))
    q = np.linalg.qr(data.jacobian(modal_derivatives(parts, x, data.omega)))[0]
    i, j = np.triu_indices(axes)
    unit = np.zeros((lines, axes, axes, i.size), complex)
    for k, (a, b) in enumerate(zip(i, j, strict=True)):
        unit[:, a, b, k] = unit[:, b, a, k] = 1.0
    s = 1j * data.omega
    unit *= np.exp(-s[:, None] * modal.delays)[:, None, :, None]
    white, row_lines = _whitened_units(data, unit)
    half = residual.size // 2
    left = residual - q @ (q.T @ residual)
    complex_left = left[:half] + 1j * left[half:]
    complex_q = q[:half] + 1j * q[half:]

    def by_line(product: ComplexArray) -> ComplexArray:
        total = np.zeros((lines, *product.shape[1:]), complex)
        np.add.at(total, row_lines, product)
        return total

    seen = by_line(complex_left.conj()[:, None] * white)
    squares = by_line(white.conj()[:, :, None] * white[:, None, :])
    along = np.stack([by_line(complex_q[:, [c]].conj() * white) for c in range(q.shape[1])], axis=1)
    curve = 1.0 / (s**2 + 2.0 * (zeta * omega)[:, None] * s + (omega**2)[:, None])
    size = np.linalg.norm(curve, axis=1, keepdims=True)
    curve = curve / size
    side = (curve @ seen).real
    gram = np.tensordot(np.abs(curve) ** 2, squares.real, 1)
    parallel = np.tensordot(curve, along, 1).real
    own = np.einsum("ckk->ck", gram)
    gram = gram - parallel.transpose(0, 2, 1) @ parallel
    scale = np.sqrt(np.maximum(own, 1e-300))
    gram = gram / (scale[:, :, None] * scale[:, None, :]) + 1e-9 * np.eye(i.size)
    solved = np.linalg.solve(gram, (side / scale)[..., None])[..., 0]
    gain = np.sum(solved * side / scale, axis=1) / max(modal.excess, 1.0)
    return Scan(omega, zeta, gain, -solved / scale / size)


def _whitened_units(
    data: ResponseMatrix, unit: ComplexArray
) -> tuple[ComplexArray, NDArray[np.intp]]:
    """Whitened complex rows, shape (R, K), and the line of each row."""
    stacked = data.jacobian(unit)
    half = stacked.shape[0] // 2
    rows = np.nonzero(data.measured)[0]
    white: ComplexArray = stacked[:half] + 1j * stacked[half:]
    return white, rows.astype(np.intp)


def scan_grid(data: ResponseMatrix) -> tuple[FloatArray, FloatArray]:
    """Frequencies between and on the lines, with each damping ratio."""
    lines = np.sort(data.omega)
    steps = np.linspace(0.0, lines.size - 1.0, STEPS_PER_LINE * (lines.size - 1) + 1)
    omega = np.interp(steps, np.arange(lines.size), lines)
    return np.tile(omega, len(SCAN_DAMPINGS)), np.repeat(SCAN_DAMPINGS, omega.size)


def noise_limit(lines: int, axes: int, chance: float = SURE) -> float:
    """Gain that noise reaches anywhere in a band of so many lines with a given chance."""
    return float(chi2_distribution.isf(chance / (2.0 * lines), axes * (axes + 1) // 2))
