"""From fitted modes to what order reduction starts from: spectra and gains, with their errors.

With unit vector u along (sqrt(R0_ii), phi_i) and D = diag(0, w_r**2), the antiresonances of axis i
are the eigenvalues of D on the space across u: the motor held still.  A_H is the squared length
of that vector.  inv(R0) holds the chain masses and, off its diagonal, the couplings, from which
A_L and A_C follow as they would be measured with the other axes held.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from fieldtool.errors import NotEnoughDataError
from fieldtool.identify.chains.order_reduction import (
    AxisModes,
    CrossGain,
    ReducedMachine,
    reduce_machine,
)
from fieldtool.identify.chains.spectrum import Spectrum
from fieldtool.identify.likelihood.least_squares import propagate, standard_errors
from fieldtool.identify.modes.model import ModalModel
from fieldtool.records.model import Estimate, Kind

FloatArray = NDArray[np.float64]
SEEN = 10.0
"""Standard errors that a mode's largest component must have to count as seen; modes that a fit invents
out of noise reach 7."""


@dataclass(frozen=True, eq=False)
class ReductionInputs:
    """Arguments of :func:`fieldtool.identify.chains.order_reduction.reduce_machine`."""

    axes: tuple[AxisModes, ...]
    cross_gains: tuple[CrossGain, ...]
    covariance: FloatArray
    """Of all of them, correlations included."""


def reduction_inputs(
    modal: ModalModel,
    masses: Mapping[str, int],
    kinds: Mapping[str, Kind] | None = None,
    motor_masses: Mapping[str, Estimate] | None = None,
) -> ReductionInputs:
    """Resonances, antiresonances and gains of each axis, with errors by linear propagation.

    Parameters
    ----------
    modal : ModalModel
        With all pairs of axes measured.
    masses : mapping of axis name to N
    kinds : mapping of axis name to rotary or linear, optional
        Rotary where not given.
    motor_masses : mapping of axis name to Estimate, optional
        Motor masses from data sheets; the high-frequency gain is not used there.

    Raises
    ------
    NotEnoughDataError
        If a pair of axes was not measured, so that its share of the rigid body is not known, or a
        mode does not rise out of the noise at any motor.
    """
    if not modal.parts.pairs.all():
        i, j = np.argwhere(~modal.parts.pairs)[0]
        raise NotEnoughDataError(
            f"axes {modal.names[i]} and {modal.names[j]}: no response between them was measured, "
            "so their coupling and masses are not known; measure one"
        )
    _check_modes_are_seen(modal)
    known = dict(motor_masses or {})
    axes, rows = [], []
    low, low_rows = _low_gains(modal)
    for i, name in enumerate(modal.names):
        spectrum, spectrum_rows = _spectrum(modal, i)
        high, high_row = _high_gain(modal, i)
        given = known.get(name)
        axes.append(
            AxisModes(
                spectrum,
                masses[name],
                Estimate(float(low[i]), _std(low_rows[i], modal.covariance)),
                Estimate(high, _std(high_row, modal.covariance)),
                given,
                (kinds or {}).get(name, "rotary"),
            )
        )
        rows += [spectrum_rows, low_rows[i], np.zeros_like(high_row) if given else high_row]
    gains, gain_rows = _cross_gains(modal)
    jacobian = np.vstack([*rows, gain_rows])
    covariance = propagate(jacobian, modal.covariance)
    at = 0
    for axis in axes:
        at += 2 * axis.spectrum.antiresonances.size + 2
        if axis.motor_mass is not None:
            covariance[at - 1, at - 1] = np.nan_to_num(axis.motor_mass.std) ** 2
    return ReductionInputs(tuple(axes), gains, covariance)


def reduce_modes(
    modal: ModalModel,
    masses: Mapping[str, int],
    kinds: Mapping[str, Kind] | None = None,
    motor_masses: Mapping[str, Estimate] | None = None,
) -> ReducedMachine:
    """Masses, springs and couplings from fitted modes; arguments as :func:`reduction_inputs`."""
    inputs = reduction_inputs(modal, masses, kinds, motor_masses)
    return reduce_machine(inputs.axes, inputs.cross_gains, inputs.covariance)


def _check_modes_are_seen(modal: ModalModel) -> None:
    faint = np.flatnonzero(modal.significance < SEEN)
    if faint.size:
        seen = modal.omega.size - faint.size
        where = ", ".join(f"{w / (2 * np.pi):.4g}" for w in modal.omega[faint])
        raise NotEnoughDataError(
            f"only {seen} of {modal.omega.size} modes rise out of the noise; those put at {where} "
            "Hz are not established. Excite more strongly or longer, over a wider band, or "
            "describe the axes with fewer masses"
        )


def _std(row: FloatArray, covariance: FloatArray) -> float:
    return float(standard_errors(propagate(row[None], covariance))[0])


def _spectrum(modal: ModalModel, axis: int) -> tuple[Spectrum, FloatArray]:
    """Spectrum of one axis and derivatives of (resonances[1:], antiresonances)."""
    at = modal.parts.slices
    lam = np.append(0.0, modal.omega**2)
    vector = np.append(np.sqrt(modal.rigid[axis, axis]), modal.phi[axis])
    length = np.linalg.norm(vector)
    u = vector / length
    across = np.linalg.qr(np.column_stack([u, np.eye(u.size)]))[0][:, 1 : u.size]
    lam0, turned = np.linalg.eigh(across.T @ (lam[:, None] * across))
    shapes = across @ turned  # columns: modes with the motor held
    by_lam = (shapes**2).T
    by_vector = -2.0 * shapes.T * (u @ (lam[:, None] * shapes))[:, None] / length
    rows = np.zeros((2 * modal.omega.size, modal.parts.count))
    n = modal.omega.size
    rows[np.arange(n), at["omega"].start + np.arange(n)] = 2.0 * modal.omega
    rows[n:, at["omega"]] = by_lam[:, 1:] * 2.0 * modal.omega
    start = at["phi"].start + axis * n
    rows[n:, start : start + n] = by_vector[:, 1:]
    rows[n:, _rigid_column(modal, axis, axis)] = by_vector[:, 0] / (2.0 * vector[0])
    spectrum = Spectrum(
        modal.names[axis],
        lam,
        np.clip(lam0, lam[:-1], lam[1:]),
        propagate(rows, modal.covariance),
    )
    return spectrum, rows


def _rigid_column(modal: ModalModel, i: int, j: int) -> int:
    rows, columns = modal.parts.upper
    where = np.flatnonzero((rows == min(i, j)) & (columns == max(i, j)))[0]
    return int(modal.parts.slices["rigid"].start) + int(where)


def _high_gain(modal: ModalModel, axis: int) -> tuple[float, FloatArray]:
    """A_H = R0_ii + sum of phi_i**2, and its derivatives."""
    row = np.zeros(modal.parts.count)
    start = modal.parts.slices["phi"].start + axis * modal.omega.size
    row[start : start + modal.omega.size] = 2.0 * modal.phi[axis]
    row[_rigid_column(modal, axis, axis)] = 1.0
    return float(modal.rigid[axis, axis] + (modal.phi[axis] ** 2).sum()), row


def _mass_derivatives(modal: ModalModel) -> tuple[FloatArray, FloatArray]:
    """inv(R0), shape (M, M), and its derivatives, shape (M, M, P)."""
    mass: FloatArray = np.asarray(np.linalg.inv(modal.rigid), dtype=np.float64)
    moved = np.zeros((*mass.shape, modal.parts.count))
    for i, j in zip(*modal.parts.upper, strict=True):
        change = np.outer(mass[:, i], mass[j])
        if i != j:
            change = change + change.T
        moved[:, :, _rigid_column(modal, i, j)] = -change
    return mass, moved


def _low_gains(modal: ModalModel) -> tuple[FloatArray, FloatArray]:
    """A_L, shape (M,), and derivatives, shape (M, P)."""
    mass, moved = _mass_derivatives(modal)
    axes = np.arange(mass.shape[0])
    low: FloatArray = 1.0 / np.diag(mass).astype(np.float64)
    rows: FloatArray = -moved[axes, axes] * low[:, None] ** 2
    return low, rows


def _cross_gains(modal: ModalModel) -> tuple[tuple[CrossGain, ...], FloatArray]:
    """A_C = -m_ij / (M_i M_j - m_ij**2) of every pair, and derivatives, shape (pairs, P)."""
    mass, moved = _mass_derivatives(modal)
    gains: list[CrossGain] = []
    rows: list[FloatArray] = []
    for i, j in combinations(range(mass.shape[0]), 2):
        m = mass[i, j]
        determinant = mass[i, i] * mass[j, j] - m**2
        row = (
            -(1.0 / determinant + 2.0 * m**2 / determinant**2) * moved[i, j]
            + m * (mass[j, j] * moved[i, i] + mass[i, i] * moved[j, j]) / determinant**2
        )
        rows.append(row)
        std = _std(row, modal.covariance)
        gains.append(CrossGain((modal.names[i], modal.names[j]), float(-m / determinant), std))
    return tuple(gains), _stacked(rows, modal.parts.count)


def _stacked(rows: Sequence[FloatArray], width: int) -> FloatArray:
    return np.array(rows).reshape(len(rows), width)
