"""Frequency responses from records without a period: the local polynomial method.

In a narrow band around a frequency w0 the response and the transient are smooth; over the lines k of
the spectra of whole records there::

    a_e(k) = (sum_r H_r d**r) u_e(k) + sum_r t_er d**r + noise          d = (w_k - w0) / width

Here a is the spectrum of the position times (1 - 1/z)**2, which turns the transient of a body that
drifts, and that of springs and dampers, into smooth functions; u that of the torque.  H belongs to all
experiments, the transient t to each alone.  G(w0) = H_0 / (1 - 1/z)**2.

In closed loop noise runs round the loop into the torque, and then a direct ratio is wrong, while
coherence looks fine.  So where references were recorded, they are the inputs u of the band, the
responses of positions and of torques to them are found together, and G is their ratio.

A line is kept where the torque stands out of what is not its excitation, in every independent
direction: with references, the part that they explain out of its own standard error, 30 times in power;
without, the torque out of the lowest level of its own spectrum (or 30 dB below its highest, if that is
less), 10 times in power.  A band with less is widened, up to a quarter of its frequency.

Valid for linear machines with at least as many independent torques as axes within every band; modes
much narrower than a band are flattened.  The bands do not overlap, so the estimates are independent.
Source: Pintelon, Schoukens, Vandersteen, Barbe, "Estimation of nonparametric noise and FRF models for
multivariable systems", Mechanical Systems and Signal Processing 24, 2010.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fieldtool.errors import NotEnoughDataError
from fieldtool.frf.response import FrequencyResponse
from fieldtool.records.recorded import Experiment, Recording

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
LOCAL = "local polynomial"
"""Condition of the responses: solved from records in which all axes may have moved."""
ORDER = 2
"""Of the polynomials in a band."""
SPARE = 8
"""Lines in a band beyond those that the unknowns use up, for each axis, at least."""
WIDEST = 0.25
"""Of its centre frequency: largest half width of a band."""
PER_DECADE = 60
"""Bands in a decade, at most."""
STANDS_OUT = 10.0
"""Power ratio that the torque must reach over what is no excitation."""
EXPLAINED = 30.0
"""Power ratio that the part of the torque that references explain must reach over its error."""
HIGHEST_FLOOR = 1e-3
"""Of the strongest band's power: what is no excitation is not taken as more than this."""
TOP = 0.4
"""Of the sample rate: highest frequency."""
QUIET = 0.05
"""Share of the bands of a spectrum that shows its lowest level."""


@dataclass(frozen=True, eq=False)
class _Record:
    """Spectra of one experiment at lines 1 to K."""

    frequencies: FloatArray
    """(K,), Hz."""
    inputs: ComplexArray
    """(K, R)."""
    outputs: ComplexArray
    """(K, S): accelerations of the M axes, with references followed by their torques."""


@dataclass(frozen=True, eq=False)
class _Band:
    """What one band gives."""

    response: ComplexArray
    """H_0 of the axes, (M, M)."""
    covariance: ComplexArray
    """(M*M, M*M), row after row."""
    excitation: ComplexArray
    """(M, M): power of the torques, what no other input or transient explains; with references over
    the error of what they explain, else in square units of torque."""


def local_response(
    recording: Recording, experiments: Sequence[Experiment] | None = None
) -> FrequencyResponse:
    """Estimate the response matrix from whole records of any excitation.

    Parameters
    ----------
    recording
    experiments
        Of the recording; all where not given.  They may have different lengths.

    Returns
    -------
    FrequencyResponse
        At the centres of bands that do not overlap, with the covariance of the elements; lines
        without enough excitation are left out.

    Raises
    ------
    NotEnoughDataError
        If the records are too short, or nowhere have as many independent torques as axes.
    """
    chosen = recording.experiments if experiments is None else tuple(experiments)
    if not chosen:
        raise NotEnoughDataError("there is no experiment to compute a response from.")
    found: list[tuple[FloatArray, list[_Band], FloatArray]] = []
    for reference in _references(recording, chosen):
        records = [_spectra(e, recording.sample_period, reference) for e in chosen]
        limits = _limits(records, len(recording.axes), reference is not None)
        centres, bands = _sweep(records, limits, reference is not None)
        if bands:
            excitation = np.array([_alone_and_weakest(band, limits) for band in bands])
            found.append((centres, bands, excitation))
    if not found:
        raise NotEnoughDataError(_too_short(recording, chosen))
    centres, bands, excitation = max(
        found, key=lambda one: int(np.count_nonzero(one[2][:, -1] > 1.0))
    )
    kept = np.flatnonzero(excitation[:, -1] > 1.0)
    if kept.size == 0:
        raise NotEnoughDataError(_dependent(recording, excitation))
    return _response(recording, centres[kept], [bands[k] for k in kept])


def _references(recording: Recording, experiments: Sequence[Experiment]) -> list[str | None]:
    """Return the signals that may serve as inputs of the band; None stands for the torques.

    Raises
    ------
    NotEnoughDataError
        If references were recorded, and an axis has none that ever changes.
    """
    moving: dict[str, NDArray[np.bool_]] = {}
    for name in ("position_reference", "torque_reference"):
        signals = [getattr(e, name) for e in experiments]
        if all(one is not None for one in signals):
            changes = [np.ptp(np.nan_to_num(one), axis=0) > 0.0 for one in signals]
            moving[name] = np.array(np.any(changes, axis=0))
    full = [
        name
        for name, axes in moving.items()
        if axes.all() and all(np.all(np.isfinite(getattr(e, name))) for e in experiments)
    ]
    if moving and not np.any(list(moving.values()), axis=0).all():
        still = recording.names[int(np.argmin(np.any(list(moving.values()), axis=0)))]
        raise NotEnoughDataError(
            f"the reference of axis {still} never changes, so its torque only answers the other axes: "
            "the response to it can not be known. Record an experiment in which this axis is moved."
        )
    return [*full] or [None]


def _spectra(experiment: Experiment, step: float, reference: str | None) -> _Record:
    rows = experiment.samples
    lines = np.arange(1, int(TOP * rows) + 1)
    difference = (1.0 - np.exp(-2j * np.pi * lines / rows)) ** 2

    def spectrum(signal: FloatArray) -> ComplexArray:
        values: ComplexArray = np.fft.rfft(signal, axis=0)[lines] / np.sqrt(rows)
        return values

    moved = spectrum(experiment.position) * difference[:, None]
    torque = spectrum(experiment.torque)
    frequencies: FloatArray = lines / (rows * step)
    if reference is None:
        return _Record(frequencies, torque, moved)
    inputs = spectrum(getattr(experiment, reference))
    if reference == "position_reference":
        inputs = inputs * difference[:, None]
    return _Record(frequencies, inputs, np.hstack([moved, torque]))


def _unknowns(records: Sequence[_Record]) -> int:
    return int((ORDER + 1) * (records[0].inputs.shape[1] + len(records)))


def _needed(records: Sequence[_Record], M: int) -> int:
    return _unknowns(records) + max(SPARE * M, _unknowns(records) // 3)


def _sweep(
    records: Sequence[_Record], limits: FloatArray, referenced: bool
) -> tuple[FloatArray, list[_Band]]:
    """Go up in frequency, band after band, each as narrow as unknowns and excitation allow."""
    M = limits.size
    density = sum(1.0 / float(record.frequencies[0]) for record in records)  # lines per Hz
    half = _needed(records, M) / density / 2.0
    top = max(float(record.frequencies[-1]) for record in records)
    centres: list[float] = []
    bands: list[_Band] = []
    low = half
    while low + 2.0 * half <= top:
        width = half
        found = _band(records, low + width, width, M, referenced)
        while not _enough(found, limits) and 2.0 * width <= WIDEST * (low + 2.0 * width):
            width *= 2.0
            found = _band(records, low + width, width, M, referenced)
        if not _enough(found, limits):
            width = half
            found = _band(records, low + width, width, M, referenced)
        if found is None:
            low += 2.0 * half
            continue
        centre = low + width
        centres.append(centre)
        bands.append(found)
        low = max(centre + width, centre * 10 ** (1.0 / PER_DECADE) - half)
    return np.array(centres), bands


def _enough(band: _Band | None, limits: FloatArray) -> bool:
    return band is not None and bool(_alone_and_weakest(band, limits)[-1] > 1.0)


def _band(
    records: Sequence[_Record], centre: float, half: float, M: int, referenced: bool
) -> _Band | None:
    """Fit the polynomials; None if the inputs of the band are not independent."""
    matrix, outputs = _equations(records, centre, half)
    rows, columns = matrix.shape
    if rows < columns + 2 * M:
        return None
    scale = np.linalg.norm(matrix, axis=0)
    if np.any(scale == 0.0):
        return None
    left, singular, right = np.linalg.svd(matrix / scale, full_matrices=False)
    if singular[-1] < 1e-7 * singular[0]:
        return None
    solution = (right.conj().T / singular) @ (left.conj().T @ outputs) / scale[:, None]
    residual = outputs - matrix @ solution
    noise = (residual.T @ residual.conj()) / (rows - columns)
    R = records[0].inputs.shape[1]
    inverse = right.conj().T / singular
    spread = (inverse @ inverse.conj().T / np.outer(scale, scale))[:R, :R]
    gains = solution[:R].T  # (S, R)
    if referenced:
        return _ratio(gains, noise, spread, M)
    return _Band(gains, np.kron(noise, spread), np.linalg.inv(spread).T / rows)


def _equations(
    records: Sequence[_Record], centre: float, half: float
) -> tuple[ComplexArray, ComplexArray]:
    blocks, outputs = [], []
    for number, record in enumerate(records):
        near = np.abs(record.frequencies - centre) <= half
        powers = ((record.frequencies[near] - centre) / half)[:, None] ** np.arange(ORDER + 1)
        inputs = powers[:, :, None] * record.inputs[near][:, None, :]
        transient = np.zeros((powers.shape[0], len(records), ORDER + 1))
        transient[:, number] = powers
        flat = inputs.reshape(powers.shape[0], -1)
        blocks.append(np.hstack([flat, transient.reshape(powers.shape[0], -1)]))
        outputs.append(record.outputs[near])
    return np.vstack(blocks), np.vstack(outputs)


def _ratio(gains: ComplexArray, noise: ComplexArray, spread: ComplexArray, M: int) -> _Band | None:
    """Responses to references become positions per torque, with errors to first order."""
    moved, torque = gains[:M], gains[M:]
    if np.linalg.matrix_rank(torque) < M:
        return None
    weight = np.linalg.inv(spread)
    response = moved @ np.linalg.inv(torque)
    mixing = np.hstack([np.eye(M), -response])
    error = mixing @ noise @ mixing.conj().T
    information = torque @ weight.T @ torque.conj().T
    scatter = noise[M:, M:]
    size = np.sqrt(np.maximum(np.diag(scatter).real, np.finfo(float).tiny))
    root = np.linalg.cholesky(scatter / np.outer(size, size) + 1e-9 * np.eye(M))
    back = np.linalg.inv(root) / size
    return _Band(
        response, np.kron(error, np.linalg.inv(information.T)), back @ information @ back.conj().T
    )


def _limits(records: Sequence[_Record], M: int, referenced: bool) -> FloatArray:
    """Return the excitation that counts as enough, square root of power, (M,)."""
    if referenced:
        return np.full(M, np.sqrt(EXPLAINED))
    lines = _needed(records, M)
    between, strong = [], []
    for record in records:
        power = np.abs(record.inputs) ** 2
        count = max(power.shape[0] // lines, 1)
        pieces = np.array_split(power, count)
        between += [np.median(piece, axis=0) for piece in pieces]
        strong += [np.mean(piece, axis=0) for piece in pieces]
    floor = np.minimum(np.quantile(between, QUIET, axis=0), HIGHEST_FLOOR * np.max(strong, axis=0))
    limits: FloatArray = np.sqrt(np.maximum(STANDS_OUT * floor, np.finfo(float).tiny))
    return limits


def _alone_and_weakest(band: _Band, limits: FloatArray) -> FloatArray:
    """Excitation over what is enough, (M + 1,): of each axis alone, then of the weakest direction."""
    power = band.excitation / np.outer(limits, limits)
    weakest = np.linalg.eigvalsh((power + power.conj().T) / 2.0)[:1]
    alone = 1.0 / np.maximum(np.diag(np.linalg.pinv(power)).real, np.finfo(float).tiny)
    return np.concatenate([alone, weakest])


def _too_short(recording: Recording, experiments: Sequence[Experiment]) -> str:
    seconds = max(e.samples for e in experiments) * recording.sample_period
    return (
        f"the longest record of {seconds:.3g} s is too short, or its torques are too alike, for a "
        f"response of {len(recording.axes)} axes: record longer, or move the axes at different times."
    )


def _dependent(recording: Recording, excitation: FloatArray) -> str:
    best = excitation[:, :-1].max(axis=0)
    name = recording.names[int(np.argmin(best))]
    if best.min() > 1.0:
        return (
            "the axes are nowhere all excited at the same frequencies by independent torques: record "
            "moves of all axes of the same kind, at different times or in separate experiments."
        )
    return (
        f"the torque of axis {name} is nowhere excited on its own, only together with the others or "
        "below the noise: record an experiment that moves this axis at other times than the others, "
        "and livelier."
    )


def _response(
    recording: Recording, centres: FloatArray, bands: Sequence[_Band]
) -> FrequencyResponse:
    M = len(recording.axes)
    turn = np.exp(-2j * np.pi * centres * recording.sample_period)
    factor = 1.0 / (1.0 - turn) ** 2
    response = np.array([band.response for band in bands]) * factor[:, None, None]
    covariance = np.array([band.covariance for band in bands])
    covariance = covariance * np.abs(factor[:, None, None]) ** 2
    covariance = (covariance + covariance.conj().transpose(0, 2, 1)) / 2.0
    variance = np.einsum("fkk->fk", covariance).real.reshape(-1, M, M)
    std = np.sqrt(variance / 2.0)
    return FrequencyResponse(recording.names, centres, response, std, LOCAL, covariance)
