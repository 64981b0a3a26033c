"""Fit common modes to a matrix of frequency responses.

Poles are found without prior knowledge (:mod:`fieldtool.identify.modes.poles`), or taken from a
prior model; then frequencies, damping, mode shapes and rigid body are fitted together by maximum
likelihood.  A mode that one motor can not see is found through the others.
"""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eig

from fieldtool.errors import NotEnoughDataError
from fieldtool.identify.likelihood.least_squares import Fit, damped_fit
from fieldtool.identify.likelihood.response_data import ResponseMatrix
from fieldtool.identify.modes.model import (
    ModalModel,
    ModalParts,
    modal_derivatives,
    modal_response,
    take_apart,
)
from fieldtool.identify.modes.poles import Poles, Responses, find_poles, start_poles
from fieldtool.identify.modes.sum_rule import sum_rule, sum_rule_jacobian
from fieldtool.records.model import MachineModel

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
COARSE = (0.03, 3e-3)
"""Relative errors added to the noise while starts are compared, one stage after another."""
FINE = (3e-4, 3e-5, 0.0)
"""And then, down to the noise itself."""
GOOD_ENOUGH = 1.5
"""Misfit over noise at which no further start is tried."""
FULL_FITS = 2
"""How many of the best starts are fitted to the end."""
SPREAD = ((0, 0.01), (0, 0.001), (1, 0.01), (2, 0.01), (4, 0.01), (0, 0.05), (8, 0.01))
"""Starts of the pole search: pairs more than asked for, damping ratio."""


def fit_modes(
    data: ResponseMatrix,
    modes: int,
    *,
    general: bool = True,
    fit_friction: bool = False,
    fit_delay: bool = False,
    fit_load_friction: bool = False,
    prior: MachineModel | None = None,
) -> ModalModel:
    """Fit `modes` common vibration modes and a rigid body.

    Parameters
    ----------
    data : ResponseMatrix
        Any part of the matrix may be missing.
    modes : int
        n, the sum of N - 1 over the chains.
    general : bool, optional
        Let modes be out of phase, as dampers that are not proportional to the springs make them.
        Without it such dampers show as misfit and shift the masses by the square of their effect.
    fit_friction : bool
        Fit viscous friction of the rigid body; needs every pair of axes measured.
    fit_delay : bool
        Fit a delay per axis.
    fit_load_friction : bool
        With `fit_friction` and `general`: friction may act at loads too.
    prior : MachineModel, optional
        Its poles are tried first.

    Raises
    ------
    NotEnoughDataError
        If there are fewer numbers than parameters, or a pair is missing that friction needs.
    """
    if modes < 0:
        raise ValueError(f"the number of modes can not be negative, got {modes}")
    if fit_friction and not data.pairs.all():
        i, j = np.argwhere(~data.pairs)[0]
        raise NotEnoughDataError(
            f"friction needs every pair of axes, {data.names[i]} - {data.names[j]} was not "
            "measured; measure it, or fit without friction"
        )
    loads = fit_load_friction and fit_friction and general
    parts = ModalParts(modes, data.pairs, general, fit_friction, fit_delay, loads)
    if data.count < parts.count:
        raise NotEnoughDataError(
            f"{data.count} measured numbers can not give {modes} modes "
            f"({parts.count} parameters); measure more frequencies"
        )
    delays = first_delays(data) if fit_delay else np.zeros(len(data.names))
    best: Fit | None = None
    for start in _tried_starts(data, parts, delays, prior):
        found = fit_from(data, parts, start, FINE, 60)
        if best is None or found.chi2 < best.chi2:
            best = found
        if best.excess < GOOD_ENOUGH:
            break
    if best is None:
        raise NotEnoughDataError("no start for the fit could be found; measure more frequencies")
    return sorted_model(data, parts, best)


def _tried_starts(
    data: ResponseMatrix, parts: ModalParts, delays: FloatArray, prior: MachineModel | None
) -> list[FloatArray]:
    """Parameter vectors after a coarse fit, best first; the first that is good ends the search."""
    tried: list[tuple[float, FloatArray]] = []
    for poles in _starts(data, parts.modes, delays, parts.friction, prior):
        coarse = fit_from(data, parts, first_guess(data, parts, poles, delays), COARSE, 15)
        tried.append((coarse.chi2, coarse.x))
        if coarse.excess < GOOD_ENOUGH:
            break
    return [x for _, x in sorted(tried, key=lambda pair: pair[0])[:FULL_FITS]]


def _starts(
    data: ResponseMatrix,
    modes: int,
    delays: FloatArray,
    friction: bool,
    prior: MachineModel | None,
) -> Iterator[ComplexArray]:
    """Poles to begin with, best guess first, shape (n,) each."""
    if modes == 0:
        yield np.zeros(0, complex)
        return
    if prior is not None:
        yield prior_poles(prior, modes)
    responses = accelerations(data, delays)
    for more, damping in SPREAD:
        if 2 * (modes + more) + 1 > data.omega.size:
            continue
        for real in (0, len(data.names)) if friction else (0,):
            start = start_poles(data.omega, modes + more, real, damping)
            found = find_poles(responses, start)
            yield _most_visible(data, found, modes, delays)


def accelerations(data: ResponseMatrix, delays: FloatArray) -> Responses:
    """-w**2 G without its delays: constant plus proper fractions."""
    square = data.omega[:, None, None] ** 2
    undelayed = np.exp(1j * data.omega[:, None] * delays)[:, None, :]
    values = np.where(data.measured, -square * data.response * undelayed, 0.0)
    weights = np.where(data.measured, 1.0 / np.where(data.measured, square * data.std, 1.0), 0.0)
    count = data.omega.size
    flat = weights.reshape(count, -1)
    used = flat.any(axis=0)
    return Responses(data.omega, values.reshape(count, -1)[:, used], flat[:, used])


def prior_poles(prior: MachineModel, modes: int) -> ComplexArray:
    """Poles of a prior model; 1 % damping where it has none."""
    n = prior.mass_matrix.shape[0]
    zero, unit = np.zeros((n, n)), np.eye(n)
    a = np.block([[zero, unit], [-prior.stiffness_matrix, -prior.damping_matrix]])
    b = np.block([[unit, zero], [zero, prior.mass_matrix]])
    values = eig(a, b, right=False)
    upper = values[values.imag > 0.0]
    upper = upper[np.argsort(-np.abs(upper))][:modes]
    damping = np.maximum(-upper.real / np.abs(upper), 1e-4)
    if not np.any(prior.damping_matrix):
        damping = np.full(upper.size, 0.01)
    poles: ComplexArray = np.sort_complex(np.abs(upper) * (-damping + 1j))[: upper.size]
    return poles[np.argsort(poles.imag)]


def _most_visible(
    data: ResponseMatrix, found: Poles, modes: int, delays: FloatArray
) -> ComplexArray:
    """Of more poles than asked for, those that rise highest above the noise."""
    if found.pairs.size == modes:
        return found.pairs
    height = visibility(data, found, delays)
    kept: ComplexArray = found.pairs[np.sort(np.argsort(-height)[:modes])]
    return kept


def visibility(data: ResponseMatrix, found: Poles, delays: FloatArray) -> FloatArray:
    """Height of each pole's resonance over the noise near it, shape (n,); 0 if strongly damped."""
    residues, _ = _residues(data, found.pairs, delays)
    size, damping = np.abs(found.pairs), -found.pairs.real / np.abs(found.pairs)
    noise = np.array([_nearest_noise(data, w) for w in size])
    height = np.max(np.abs(residues), axis=(0, 1)) / (2.0 * np.maximum(damping, 1e-4) * size**2)
    result: FloatArray = np.where(damping > 0.3, 0.0, height) / noise
    return result


def _nearest_noise(data: ResponseMatrix, omega: float) -> float:
    row = int(np.argmin(np.abs(data.omega - omega)))
    return float(np.min(data.std[row][data.measured[row]], initial=np.inf)) or 1.0


def pole_residues(data: ResponseMatrix, poles: ComplexArray, delays: FloatArray) -> FloatArray:
    """Real residue matrices of given poles by linear least squares, shape (M, M, n)."""
    return _residues(data, poles, delays)[0]


def _residues(
    data: ResponseMatrix, poles: ComplexArray, delays: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Real residue matrices, shape (M, M, n), and R0, shape (M, M), for given poles."""
    axes = len(data.names)
    s = 1j * data.omega[:, None]
    modes = 1.0 / (s**2 - 2.0 * poles.real * s + np.abs(poles) ** 2)
    basis = np.hstack([1.0 / s**2, modes])
    residues, rigid = np.zeros((axes, axes, poles.size)), np.zeros((axes, axes))
    measured, errors = data.measured, data.errors(0.003)
    for i in range(axes):
        for j in range(i, axes):
            rows, sides = [], []
            for a, b in {(i, j), (j, i)}:
                used = measured[:, a, b]
                weight = 1.0 / errors[used, a, b]
                delay = np.exp(-s[used, 0] * delays[b])
                rows.append((weight * delay)[:, None] * basis[used])
                sides.append(weight * data.response[used, a, b])
            matrix, side = np.vstack(rows), np.concatenate(sides)
            if matrix.shape[0] == 0:
                continue
            scale = np.linalg.norm(matrix, axis=0)
            solved = np.linalg.lstsq(
                np.vstack([matrix.real, matrix.imag]) / scale,
                np.concatenate([side.real, side.imag]),
                rcond=None,
            )[0]
            rigid[i, j] = rigid[j, i] = solved[0] / scale[0]
            residues[i, j] = residues[j, i] = solved[1:] / scale[1:]
    return residues, rigid


def first_guess(
    data: ResponseMatrix, parts: ModalParts, poles: ComplexArray, delays: FloatArray
) -> FloatArray:
    """Parameter vector for given poles, by linear least squares."""
    residues, rigid = _residues(data, poles, delays)
    phi = np.array([rank_one(residues[:, :, r], parts.pairs) for r in range(poles.size)])
    x = np.zeros(parts.count)
    at = parts.slices
    x[at["omega"]] = np.abs(poles)
    x[at["zeta"]] = np.clip(-poles.real / np.maximum(np.abs(poles), 1e-300), 1e-4, 0.3)
    x[at["phi"]] = phi.T.ravel()
    x[at["rigid"]] = rigid[parts.upper]
    x[at["delay"]] = delays[: at["delay"].stop - at["delay"].start]
    return x


def fit_from(
    data: ResponseMatrix,
    parts: ModalParts,
    start: FloatArray,
    floors: tuple[float, ...],
    evaluations: int,
) -> Fit:
    """Fit from a parameter vector, stage after stage of relative errors added to the noise."""

    def residuals(x: FloatArray, floor: float) -> FloatArray:
        response = modal_response(parts, x, data.omega)
        return np.concatenate([data.residuals(response, floor), sum_rule(parts, x)])

    def jacobian(x: FloatArray, floor: float) -> FloatArray:
        derivatives = modal_derivatives(parts, x, data.omega)
        return np.vstack([data.jacobian(derivatives, floor), sum_rule_jacobian(parts, x)])

    return damped_fit(residuals, jacobian, start, floors, evaluations)


def rank_one(residue: FloatArray, pairs: NDArray[np.bool_]) -> FloatArray:
    """Mode shape whose products come near a residue matrix, shape (M,), any sign."""
    shape: FloatArray
    values, vectors = np.linalg.eigh(residue)
    diagonal = np.diag(residue)
    pivot = int(np.argmax(diagonal))
    if pairs.all() and values[-1] > 0.0:
        shape = vectors[:, -1] * np.sqrt(values[-1])
    elif diagonal[pivot] > 0.0:
        shape = residue[pivot] / np.sqrt(diagonal[pivot])
    else:
        shape = np.sqrt(np.abs(residue).max(axis=1))
    return shape


def first_delays(data: ResponseMatrix) -> FloatArray:
    """From the slope of the drive points' phase, which without delay is 0 or pi, shape (M,)."""
    delays = np.zeros(len(data.names))
    for j in range(delays.size):
        used = data.measured[:, j, j]
        if used.any():
            omega = data.omega[used]
            folded = np.angle(data.response[used, j, j] ** 2) / 2.0
            upper = omega >= np.median(omega)
            delays[j] = max(0.0, float(np.median(-folded[upper] / omega[upper])))
    return delays


def sorted_model(data: ResponseMatrix, parts: ModalParts, found: Fit) -> ModalModel:
    """Sort modes by frequency and take the parameter vector apart."""
    order = np.argsort(found.x[parts.slices["omega"]])
    at = parts.slices
    index = np.arange(parts.count)
    for name in ("omega", "zeta"):
        index[at[name]] = at[name].start + order
    for name in ("phi", "chi") if parts.general else ("phi",):
        for a in range(parts.axes):
            start = at[name].start + a * parts.modes
            index[start : start + parts.modes] = start + order
    v = take_apart(parts, found.x[index])
    return ModalModel(
        names=data.names,
        parts=parts,
        omega=v.omega,
        zeta=v.zeta,
        phi=v.phi,
        chi=v.chi,
        rigid=v.rigid,
        friction=v.friction,
        delays=v.delays,
        covariance=found.covariance()[np.ix_(index, index)],
        chi2=found.chi2,
        degrees_of_freedom=found.degrees_of_freedom,
    )
