"""How many common modes measured responses hold, without a prior.

Vector fitting with more pole pairs than any machine in question has modes puts the spare ones
into noise; the pairs that rise highest above it start a fit by maximum likelihood.  Then modes are
added where the residuals tell of one, and taken away where nothing is lost, until one more brings
no gain beyond the price of its parameters (Schwarz' criterion, with the covariance known).
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fieldtool.errors import NotEnoughDataError
from fieldtool.identify.likelihood.response_data import ResponseMatrix
from fieldtool.identify.modes import fit as modal_fit
from fieldtool.identify.modes.model import ModalModel, ModalParts, modal_response
from fieldtool.identify.modes.poles import Poles, find_poles, start_poles
from fieldtool.identify.modes.scan import noise_limit, scan_grid, scan_modes
from fieldtool.records.model import MachineModel

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
STAGES = (0.03, 1e-3, 0.0)
"""Relative errors added to the noise, stage after stage of a fit from poles that are near."""
NEAR_STAGES = (1e-3, 0.0)
"""The same where all modes but one are known."""
SPARE = 4
"""Pole pairs more than the largest machine in question has modes."""
RELOCATIONS = 12
"""Of the spare search: poles in noise never come to rest."""
EQUAL = 0.1
"""Second over first eigenvalue of a pole's residues above which it is taken for two modes."""
CLEAR = 30.0
"""Height over the noise below which a pole of the spare search is not worth a start."""
FAINT = 5.0
"""Standard errors below which modes are left out several at a time, and looked for again."""
DOUBTFUL = 0.01
"""Chance of noise alone below which a place in the band is told as a hint of a mode."""
CUTS = 4
"""How many numbers of modes a search may begin with."""
HOPELESS = 300.0
"""Misfit over noise of a start from which other searches are tried first."""
TRIED_SIZES = (1.0, 0.3, 0.1, 0.03, 0.01, 1e-3)
"""Of a new mode's shape, over what the scan estimates."""


@dataclass(frozen=True, eq=False)
class ModeSearch:
    """The fitted modes, and what may be one more."""

    modal: ModalModel
    hint: float | None
    """rad/s, where the residuals tell most of a further mode; None where they tell of none."""
    hint_chi2: float
    """By how much a mode there would lower chi2."""

    @property
    def criterion(self) -> float:
        """Schwarz' criterion of the modal model."""
        return criterion(self.modal)


def criterion(modal: ModalModel) -> float:
    """Chi2 plus the price of the parameters: the lower, the better."""
    count = modal.degrees_of_freedom + modal.parts.count
    return modal.chi2 + modal.parts.count * float(np.log(count))


def find_modes(data: ResponseMatrix, most: int, *, prior: MachineModel | None = None) -> ModeSearch:
    """Fit as many modes as the data hold, with friction anywhere, and delays where they show.

    Parameters
    ----------
    data : ResponseMatrix
        All pairs of axes measured.
    most : int
        Modes of the largest machine in question.
    prior : MachineModel, optional
        Its poles are one more start.

    Raises
    ------
    NotEnoughDataError
        If a pair of axes was not measured, or there are fewer numbers than a rigid body needs.
    """
    if not data.pairs.all():
        i, j = np.argwhere(~data.pairs)[0]
        raise NotEnoughDataError(
            f"axes {data.names[i]} and {data.names[j]}: no response between them was measured, so "
            "the number of masses can not be told; measure every axis with every motor"
        )
    best = reserve = None
    for parts, poles in _searches(data, most, prior):
        start = _start(data, parts, poles, most)
        if start is None:
            continue
        if start.excess > HOPELESS:
            reserve = _better(start, reserve)
            continue
        best = _better(_refined_count(data, start, most), best)
        if best.excess < modal_fit.GOOD_ENOUGH:
            break
    if best is None and reserve is not None:
        best = _refined_count(data, reserve, most)
    if best is None:
        raise NotEnoughDataError(
            f"{data.count} measured numbers are too few for the modes of {len(data.names)} axes; "
            "measure more frequencies"
        )
    best = _with_delays(data, best)
    hint, gain = _strongest_hint(data, best)
    return ModeSearch(best, hint, gain)


def without_mode(data: ResponseMatrix, modal: ModalModel) -> ModalModel | None:
    """Fit again without the faintest mode; None where there is none."""
    if modal.omega.size == 0:
        return None
    return _refit(
        data, modal, np.delete(np.arange(modal.omega.size), np.argmin(standing_out(modal)))
    )


def with_strongest_hint(data: ResponseMatrix, modal: ModalModel) -> ModalModel | None:
    """Fit again with one mode more where residuals tell most of one, noise or not."""
    if data.count <= modal.parts.count + 2 * modal.parts.axes + 2:
        return None
    scan = scan_modes(data, modal, *scan_grid(data))
    best = int(np.argmax(scan.gain))
    place = float(scan.omega[best]), float(scan.zeta[best])
    return _refit(data, modal, np.arange(modal.omega.size), place)


def standing_out(modal: ModalModel) -> FloatArray:
    """How far each mode stands out of the noise in standard errors, 0 if not known, shape (n,).

    The length of its shape in the metric of its covariance: for a single motor the shape over its
    standard error; not less than that of the largest component otherwise.  Of modes of equal
    frequency, whose shapes can turn into each other, it stays large where components do not.
    """
    result = np.zeros(modal.omega.size)
    start, (axes, modes) = modal.parts.slices["phi"].start, modal.phi.shape
    for r in range(modes):
        columns = start + np.arange(axes) * modes + r
        covariance = modal.covariance[np.ix_(columns, columns)]
        known = np.isfinite(np.diag(covariance)) & (np.diag(covariance) > 0.0)
        covariance, shape = covariance[np.ix_(known, known)], modal.phi[known, r]
        std = np.sqrt(np.diag(covariance))
        if not known.any() or not np.isfinite(covariance).all() or not np.isfinite(shape).all():
            continue
        scaled = covariance / np.outer(std, std)
        result[r] = np.sqrt(
            max(float((shape / std) @ np.linalg.pinv(scaled, hermitian=True) @ (shape / std)), 0.0)
        )
    return result


def with_modes(data: ResponseMatrix, parts: ModalParts, poles: ComplexArray) -> ModalModel:
    """Fit modes from poles that are near, shape (n,); `parts` says what else is fitted.

    A pole that is given k times becomes k modes of equal frequency.
    """
    delays = modal_fit.first_delays(data) if parts.delay else np.zeros(parts.axes)
    single, inverse, count = np.unique(poles, return_inverse=True, return_counts=True)
    parts = replace(parts, modes=single.size)
    start = modal_fit.first_guess(data, parts, single, delays)
    if poles.size > single.size:
        phi = start[parts.slices["phi"]].reshape(parts.axes, single.size)[:, inverse]
        residues = modal_fit.pole_residues(data, single, delays)
        for r in np.flatnonzero(count > 1):
            size, vectors = np.linalg.eigh(residues[:, :, r])
            shapes = (vectors * np.sqrt(np.maximum(size, 0.0)))[:, ::-1]
            phi[:, inverse == r] = shapes[:, : count[r]]
        start, parts = _repeated(start, parts, inverse, phi)
    found = modal_fit.fit_from(data, parts, start, STAGES, 60)
    return modal_fit.sorted_model(data, parts, found)


def _repeated(
    start: FloatArray, parts: ModalParts, columns: NDArray[np.intp], phi: FloatArray
) -> tuple[FloatArray, ModalParts]:
    """A parameter vector with modes repeated, and its layout."""
    more = replace(parts, modes=columns.size)
    at, to = parts.slices, more.slices
    x = np.zeros(more.count)
    for name in ("omega", "zeta"):
        x[to[name]] = start[at[name]][columns]
    x[to["phi"]] = phi.ravel()
    for name in ("rigid", "friction", "delay"):
        x[to[name]] = start[at[name]]
    return x, more


def poles_of(modal: ModalModel) -> ComplexArray:
    """Upper poles of the modes, shape (n,), rad/s."""
    damping = np.clip(modal.zeta, 1e-5, 0.9)
    poles: ComplexArray = modal.omega * (-damping + 1j * np.sqrt(1.0 - damping**2))
    return poles


def _searches(
    data: ResponseMatrix, most: int, prior: MachineModel | None
) -> Iterator[tuple[ModalParts, ComplexArray]]:
    """What to fit and poles to begin with, most visible first."""
    axes = len(data.names)
    parts = ModalParts(0, data.pairs, True, True, False, True)
    for delay, spare, damping in (
        (False, SPARE, 0.01),
        (True, SPARE, 0.01),
        (False, 2 * SPARE, 0.003),
        (False, 1, 0.03),
    ):
        delays = modal_fit.first_delays(data) if delay else np.zeros(axes)
        if delay and not delays.any():
            continue
        pairs = min(most + spare, (data.omega.size - axes - 1) // 3)
        if pairs < 1:
            continue
        start = start_poles(data.omega, pairs, axes, damping)
        found = find_poles(modal_fit.accelerations(data, delays), start, RELOCATIONS)
        yield replace(parts, delay=delay), _by_visibility(data, found, delays)
    if prior is not None:
        yield parts, modal_fit.prior_poles(prior, prior.mass_matrix.shape[0] - axes)
    yield parts, np.zeros(0, complex)


def _by_visibility(data: ResponseMatrix, found: Poles, delays: FloatArray) -> ComplexArray:
    """Poles in the band that rise out of the noise, highest first; twice those of two modes."""
    height = modal_fit.visibility(data, found, delays)
    size = np.abs(found.pairs)
    inside = (size > 0.5 * data.omega.min()) & (size < 2.0 * data.omega.max())
    damping = -found.pairs.real / size
    good = inside & (damping < 0.3) & (height > 3.0)
    residues = modal_fit.pole_residues(data, found.pairs, delays)
    kept: list[tuple[float, complex]] = []
    for r in np.flatnonzero(good):
        values = np.linalg.eigvalsh(residues[:, :, r])[::-1]
        # Not divided by the first, which noise may make 0 or negative: such a pole is one mode.
        least = max(EQUAL, CLEAR / height[r]) * max(values[0], 0.0)
        count = max(int(np.count_nonzero(values > least)), 1)
        kept += [(float(height[r]), complex(found.pairs[r]))] * count
    kept.sort(key=lambda pair: -pair[0])
    return np.array([pole for _, pole in kept], dtype=np.complex128)


def _better(one: ModalModel, other: ModalModel | None) -> ModalModel:
    return one if other is None or criterion(one) < criterion(other) else other


def _start(
    data: ResponseMatrix, parts: ModalParts, poles: ComplexArray, most: int
) -> ModalModel | None:
    """Fit the poles that stand out; None with too few data."""
    best: ModalModel | None = None
    for count in _cuts(data, poles, parts):
        modal = _try(data, parts, poles[: min(count, most)])
        if modal is not None:
            best = _better(modal, best)
        if best is not None and best.excess < CLEAR:
            break
    return best


def _refined_count(data: ResponseMatrix, modal: ModalModel, most: int) -> ModalModel:
    """Add and take away modes until nothing is gained."""
    refused: list[float] = []
    for _ in range(2 * most + 4):
        fewer = _without_faintest(data, modal)
        if fewer is not None:
            if fewer.omega.size == modal.omega.size - 1:
                refused.append(float(modal.omega[np.argmin(standing_out(modal))]))
            modal = fewer
            continue
        more = _with_one_more(data, modal, refused) if modal.omega.size < most + 1 else None
        if more is None:
            break
        modal = more
    return modal


def _cuts(data: ResponseMatrix, poles: ComplexArray, parts: ModalParts) -> list[int]:
    """How many of the poles, highest first, to begin with: where their height drops most."""
    if poles.size == 0:
        return [0]
    delays = modal_fit.first_delays(data) if parts.delay else np.zeros(parts.axes)
    single, inverse = np.unique(poles, return_inverse=True)
    height = modal_fit.visibility(data, Poles(single, np.zeros(0)), delays)[inverse]
    height = np.minimum.accumulate(np.maximum(height, CLEAR))
    if height[0] <= CLEAR:
        return [0]
    drops = height / np.append(height[1:], CLEAR)
    return [int(k) + 1 for k in np.argsort(-drops)[:CUTS] if drops[k] > 1.0]


def _try(data: ResponseMatrix, parts: ModalParts, poles: ComplexArray) -> ModalModel | None:
    while data.count < replace(parts, modes=poles.size).count + 1:
        if poles.size == 0:
            return None
        poles = poles[:-1]
    return with_modes(data, parts, poles)


def _without_faintest(data: ResponseMatrix, modal: ModalModel) -> ModalModel | None:
    """The model without its faint modes, or with one mode less if that is better."""
    seen = standing_out(modal)
    if seen.min(initial=np.inf) > CLEAR:
        return None
    if np.count_nonzero(seen < FAINT) > 1:
        fewer = _refit(data, modal, np.flatnonzero(seen >= FAINT))
        if criterion(fewer) < criterion(modal):
            return fewer
    one_less = without_mode(data, modal)
    return one_less if one_less and criterion(one_less) < criterion(modal) else None


def _with_one_more(
    data: ResponseMatrix, modal: ModalModel, refused: list[float]
) -> ModalModel | None:
    """The model with one mode more where residuals tell of it, if better by the criterion."""
    added = 2 * modal.parts.axes + 2
    if data.count <= modal.parts.count + added:
        return None
    for omega, zeta in _hints(data, modal, refused):
        more = _refit(data, modal, np.arange(modal.omega.size), (omega, zeta))
        if criterion(more) < criterion(modal) and more.zeta.max() < 0.5:
            return more
        refused.append(omega)
    return None


def _refit(
    data: ResponseMatrix,
    modal: ModalModel,
    kept: NDArray[np.intp],
    added: tuple[float, float] | None = None,
) -> ModalModel:
    """Fit from the modes that are kept, with one more if given, where its shape starts from zero."""
    parts = replace(modal.parts, modes=kept.size + (added is not None))
    at, axes = parts.slices, parts.axes
    x = np.zeros(parts.count)
    pole = added or (0.0, 0.0)
    new = [] if added is None else [0.0]
    x[at["omega"]] = np.r_[modal.omega[kept], [pole[0]] if added else []]
    x[at["zeta"]] = np.r_[modal.zeta[kept], [pole[1]] if added else []]
    for name, values in (("phi", modal.phi), ("chi", modal.chi)):
        x[at[name]] = np.hstack([values[:, kept], np.tile(new, (axes, 1))]).ravel()
    x[at["rigid"]] = modal.rigid[parts.upper]
    x[at["friction"]] = modal.friction[: at["friction"].stop - at["friction"].start]
    x[at["delay"]] = modal.delays[: at["delay"].stop - at["delay"].start]
    if added is not None:
        column = at["phi"].start + np.arange(axes) * parts.modes + kept.size
        x = _best_size(data, parts, x, column, _shape_at(data, modal, *added))
    found = modal_fit.fit_from(data, parts, x, NEAR_STAGES, 60)
    return modal_fit.sorted_model(data, parts, found)


def _best_size(
    data: ResponseMatrix,
    parts: ModalParts,
    x: FloatArray,
    columns: NDArray[np.intp],
    shape: FloatArray,
) -> FloatArray:
    """The parameter vector with a new mode's shape in the size that fits best."""

    def tried(size: float) -> tuple[float, FloatArray]:
        vector = x.copy()
        vector[columns] = size * shape
        left = data.residuals(modal_response(parts, vector, data.omega))
        return float(left @ left), vector

    return min((tried(size) for size in TRIED_SIZES), key=lambda pair: pair[0])[1]


def _with_delays(data: ResponseMatrix, modal: ModalModel) -> ModalModel:
    """The model with delays, or without, whichever is better by the criterion."""
    parts = replace(modal.parts, delay=not modal.parts.delay)
    if data.count <= parts.count:
        return modal
    pieces = {
        "omega": modal.omega,
        "zeta": modal.zeta,
        "phi": modal.phi.ravel(),
        "chi": modal.chi.ravel(),
        "rigid": modal.rigid[parts.upper],
        "friction": modal.friction,
        "delay": np.zeros(parts.axes) if parts.delay else np.zeros(0),
    }
    start = np.concatenate(list(pieces.values()))
    found = modal_fit.fit_from(data, parts, start, NEAR_STAGES, 30)
    other = modal_fit.sorted_model(data, parts, found)
    return other if criterion(other) < criterion(modal) else modal


def _hints(
    data: ResponseMatrix, modal: ModalModel, refused: list[float]
) -> Iterator[tuple[float, float]]:
    """Up to three places where a mode would gain more than noise does, the best first."""
    scan = scan_modes(data, modal, *scan_grid(data))
    gain = scan.gain.copy()
    spacing = (data.omega.max() - data.omega.min()) / data.omega.size
    for omega in refused:
        gain[np.abs(scan.omega - omega) < 2.0 * spacing] = 0.0
    for _ in range(3):
        best = int(np.argmax(gain))
        if not gain[best] > noise_limit(data.omega.size, len(data.names)):
            return
        yield float(scan.omega[best]), float(scan.zeta[best])
        gain[np.abs(scan.omega - scan.omega[best]) < 2.0 * spacing] = 0.0


def _shape_at(data: ResponseMatrix, modal: ModalModel, omega: float, zeta: float) -> FloatArray:
    scan = scan_modes(data, modal, np.array([omega]), np.array([zeta]))
    axes = modal.parts.axes
    residue = np.zeros((axes, axes))
    i, j = np.triu_indices(axes)
    residue[i, j] = residue[j, i] = scan.residues[0]
    return modal_fit.rank_one(residue, modal.parts.pairs)


def _strongest_hint(data: ResponseMatrix, modal: ModalModel) -> tuple[float | None, float]:
    if data.count <= modal.parts.count + 2 * modal.parts.axes + 2:
        return None, 0.0
    scan = scan_modes(data, modal, *scan_grid(data))
    best = int(np.argmax(scan.gain))
    limit = noise_limit(data.omega.size, len(data.names), DOUBTFUL)
    found = bool(scan.gain[best] > limit)
    return (float(scan.omega[best]) if found else None), float(scan.gain[best])
