"""The forward problem: what a known machine shows its motors, without damping.

Resonances and antiresonances are singular values of S = diag(sqrt(k)) D L**-T, with D the
differences across the springs and M = L L**T: then K x = lam M x has lam = sigma**2.  Unlike
eigenvalues of K, these carry full relative accuracy down to slow modes, and the rigid bodies
never appear.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cholesky, solve_triangular

from fieldtool.identify.chains.spectrum import Spectrum
from fieldtool.records.model import MachineModel

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Gains:
    """Accelerations per torque at the ends of the frequency range (paper, sections 3.1, 3.2)."""

    low: FloatArray
    """A_L, shape (M,), 1/kg or 1/(kg m2): slow push, all other axes held (equation 2)."""
    high: FloatArray
    """A_H, shape (M,), 1/kg or 1/(kg m2): fast push; 1/m1 where N >= 2 (equation 3)."""
    cross: FloatArray
    """A_C with its sign, shape (M, M): theta''_i over tau_j, slow push, all axes but i and j
    held; NaN on the diagonal."""


def gains(model: MachineModel) -> Gains:
    """Low, high and cross gains of a machine."""
    total = np.diag([axis.total_mass for axis in model.axes])
    for coupling in model.couplings:
        i, j = (model.names.index(name) for name in coupling.axes)
        total[i, j] += coupling.value
        total[j, i] += coupling.value
    sums = np.diag(total)
    off = -total / (np.outer(sums, sums) - total**2 + np.diag(np.full(len(sums), np.nan)))
    high = np.diag(np.linalg.inv(model.mass_matrix))[model.first_masses]
    return Gains(low=1.0 / sums, high=high.copy(), cross=off)


def spectra(model: MachineModel) -> tuple[Spectrum, ...]:
    """Spectrum of each axis, all other motors free of torque.

    Modes that an axis can not see at all are left out: those of axes without any inertia
    coupling to it, and one of each pair that symmetry makes equal.

    Raises
    ------
    ValueError
        If the mass matrix is not positive definite or a spring is not positive.
    """
    parts = {name: part for part in _coupled_parts(model) for name in part.names}
    return tuple(_spectrum(parts[axis.name], axis.name) for axis in model.axes)


def _coupled_parts(model: MachineModel) -> list[MachineModel]:
    """Split the machine into sets of axes that inertia couplings join."""
    groups = [{name} for name in model.names]
    for coupling in model.couplings:
        if coupling.value != 0.0:
            joined = [g for g in groups if not g.isdisjoint(coupling.axes)]
            groups = [g for g in groups if g not in joined] + [set().union(*joined)]
    return [
        replace(
            model,
            axes=tuple(a for a in model.axes if a.name in group),
            couplings=tuple(c for c in model.couplings if c.axes[0] in group and c.value != 0.0),
        )
        for group in groups
    ]


def _spectrum(part: MachineModel, name: str) -> Spectrum:
    springs = np.array([k.value for axis in part.axes for k in axis.springs])
    if np.any(springs <= 0.0):
        raise ValueError(f"springs must be positive, got {springs.min():.6g}")
    mass = part.mass_matrix
    motor = part.first_masses[part.names.index(name)]
    stretch = np.sqrt(springs)[:, None] * _differences(part)
    free = np.arange(mass.shape[0]) != motor
    lam = _squared_singular_values(stretch, mass)
    lam0 = _squared_singular_values(stretch[:, free], mass[np.ix_(free, free)])
    lam, lam0 = _without_equal(np.append(0.0, lam), lam0)
    return Spectrum(name, lam, np.clip(lam0, lam[:-1], lam[1:]))


def _differences(part: MachineModel) -> FloatArray:
    """Displacements to stretches of the springs, shape (springs, masses)."""
    rows = []
    for first, axis in zip(part.first_masses, part.axes, strict=True):
        for k in range(len(axis.springs)):
            row = np.zeros(part.last_masses[-1] + 1)
            row[first + k], row[first + k + 1] = -1.0, 1.0
            rows.append(row)
    return np.array(rows).reshape(len(rows), part.last_masses[-1] + 1)


def _squared_singular_values(stretch: FloatArray, mass: FloatArray) -> FloatArray:
    if stretch.shape[0] == 0:
        return np.zeros(0)
    try:
        lower = cholesky(mass, lower=True)
    except np.linalg.LinAlgError as error:
        raise ValueError(
            "the mass matrix is not positive definite: a coupling is larger than its masses allow"
        ) from error
    scaled = solve_triangular(lower, stretch.T, lower=True)
    values: FloatArray = np.sort(np.linalg.svd(scaled, compute_uv=False)) ** 2
    return values


def _without_equal(lam: FloatArray, lam0: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Of resonances that are equal by symmetry, one motor sees only one."""
    distinct = np.diff(lam) > 32.0 * np.finfo(float).eps * lam[-1]
    return np.append(0.0, lam[1:][distinct]), lam0[distinct]
