"""From recorded moves to spectra that a machine can be fitted to.

The spectra are those of whole records, without windows.  With them go: the noise of the positions
(white, from their fourth differences), the band in which the motion stands out of it, and what is
known of the course of friction: the sign of the velocity of each motor, and a constant.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.signal import savgol_filter

from fieldtool.errors import NotEnoughDataError
from fieldtool.identify.moves.record_spectra import Spectra, TorquePart
from fieldtool.identify.moves.spectra import TorqueResidual
from fieldtool.records.recording import Experiment, Recording

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
FEWEST_ROWS = 200
"""In a record worth using."""
TOP = 0.08
"""Of the sample rate: highest line used, so that what happens between samples matters little."""
MOST_LINES = 6000
"""Lines used of one record."""
STANDS_OUT = 10.0
"""Ratio in power of the motion to the noise of the position, up to which lines are used."""
MOVED = 20.0
"""Range of an axis' position over its noise from which it counts as moved."""
AT_LIMIT = 0.05
"""Share of rows with the torque at its limit that is too much."""
BAND_LINES = 16
"""Fewest lines in a band of the noise's spectrum."""
ROUNDING = 0.01
"""Share of the fastest velocity within which friction turns over, unless said otherwise."""
STOPPED = 1e-3
"""Share of the fastest velocity below which an axis may be standing still."""
STILL = 0.02
"""s: an axis without velocity for so long stands still."""


@dataclass(frozen=True, eq=False)
class Motion:
    """One record, and what follows from it."""

    experiment: Experiment
    noise: FloatArray
    """(M,), rad or m: standard error of one position."""
    moved: NDArray[np.bool_]
    """(M,)."""
    velocity: FloatArray
    """(n, M), unit of position per row, smoothed."""
    unsure: FloatArray
    """(M,): three standard errors of the velocity."""
    fastest: FloatArray
    """(M,): velocity that 1 % of the rows exceed."""
    moving: FloatArray
    """(n, M): 0 where the axis stands still, else 1."""


def usable_motions(recording: Recording, experiments: Sequence[Experiment]) -> tuple[Motion, ...]:
    """Return the records in which something moved, with noise and direction of motion.

    Raises
    ------
    NotEnoughDataError
        If all records are too short, an axis never moves, or a torque stays at its limit.
    """
    longest = max((e.samples for e in experiments), default=0)
    if longest < FEWEST_ROWS:
        raise NotEnoughDataError(
            f"the longest record has {longest} rows; at least {FEWEST_ROWS} are needed: record a move "
            "there and back."
        )
    motions = [_motion(e, recording.sample_period) for e in experiments if e.samples >= FEWEST_ROWS]
    ever = np.any([motion.moved for motion in motions], axis=0)
    if not ever.all():
        name = recording.names[int(np.argmin(ever))]
        raise NotEnoughDataError(
            f"axis {name} never moves by more than {MOVED:.0f} times the noise of its position: its "
            "masses can not be known. Record moves of this axis, or leave it out of the recording."
        )
    usable = tuple(motion for motion in motions if motion.moved.any())
    _check_saturation(recording, usable)
    return usable


def _motion(experiment: Experiment, step: float) -> Motion:
    noise = np.array([_white_noise(column) for column in experiment.position.T])
    spread = np.ptp(experiment.position, axis=0)
    moved = spread > np.maximum(MOVED * noise, 1e-12 * np.abs(experiment.position).max(axis=0))
    axes = range(experiment.position.shape[1])
    smooth = [_velocity(experiment.position[:, j], noise[j]) for j in axes]
    velocity = np.column_stack([one[0] for one in smooth])
    unsure = np.array([one[1] for one in smooth])
    fastest = np.quantile(np.abs(velocity), 0.99, axis=0)
    moving = np.ones(experiment.position.shape)
    for j in np.flatnonzero(moved):
        slow = np.abs(velocity[:, j]) < max(unsure[j], STOPPED * fastest[j])
        moving[:, j] = _without_rests(slow, int(STILL / step))
    return Motion(
        experiment, noise, np.array(moved, dtype=np.bool_), velocity, unsure, fastest, moving
    )


def _white_noise(position: FloatArray) -> float:
    """Standard error of white noise, by the median of fourth differences: the motion leaves few."""
    differences = np.diff(position, 4)
    return float(np.median(np.abs(differences)) / 0.6745 / np.sqrt(70.0))


def _velocity(position: FloatArray, noise: float) -> tuple[FloatArray, float]:
    """Velocity per row, smoothed over no more rows than the noise asks for, and its 3 sigma."""
    fastest = float(np.quantile(np.abs(savgol_filter(position, 11, 2, deriv=1)), 0.99))
    window = 5
    while noise * np.sqrt(12.0 / window**3) > 0.003 * fastest and window < position.size // 20:
        window += 2
    velocity: FloatArray = np.asarray(savgol_filter(position, window, 2, deriv=1), dtype=np.float64)
    return velocity, 3.0 * noise * float(np.sqrt(12.0 / window**3))


def _without_rests(slow: NDArray[np.bool_], rows: int) -> FloatArray:
    """0 in stretches of at least so many slow rows, else 1."""
    rows = max(rows, 5)
    full = np.convolve(slow, np.ones(rows), mode="valid") > rows - 0.5
    covered = np.convolve(full, np.ones(rows), mode="full") > 0.5
    return np.where(covered, 0.0, 1.0)


def _check_saturation(recording: Recording, motions: Sequence[Motion]) -> None:
    for j, axis in enumerate(recording.axes):
        torque = np.concatenate([m.experiment.torque[:, j] for m in motions])
        limit = axis.controller.torque_limit if axis.controller is not None else 0.0
        share = float(np.mean(np.abs(torque) >= 0.995 * limit)) if limit else _flat_share(torque)
        if share > AT_LIMIT:
            largest = limit or float(np.abs(torque).max())
            raise NotEnoughDataError(
                f"axis {axis.name}: the torque is at its limit of {largest:.4g} {axis.torque_unit} in "
                f"{100 * share:.0f} % of the rows, where it does not say what acts on the axis: record "
                "gentler moves, or raise the limit of the drive."
            )


def _flat_share(torque: FloatArray) -> float:
    """Share of rows at the very largest torque of either sign, one row after another, both signs."""
    shares = []
    for extreme in (torque.max(), torque.min()):
        at = torque == extreme
        shares.append(float(np.mean(at[1:] & at[:-1])))
    return sum(shares) if min(shares) > 0.0 and torque.max() > torque.min() else 0.0


def spectra_of(
    recording: Recording, motions: Sequence[Motion], *, gate: bool, rounding: float = ROUNDING
) -> tuple[Spectra, ...]:
    """Return the spectra of each record from the first line to the top of the band.

    The variance of the torque is a first guess: a noise of 3 % of the torque, spread over all lines.

    Parameters
    ----------
    recording, motions
    gate : bool
        Count the torque only while the axis moves: standing still, friction takes what there is, and
        the net torque is zero.  Right for a single rigid axis only.
    rounding : float
        Share of the fastest velocity within which Coulomb friction grows from nothing to all of it;
        real friction does not jump where the velocity changes its sign.

    Raises
    ------
    NotEnoughDataError
        If no record has enough lines in which the motion stands out of the noise.
    """
    found = [_spectra(recording, motion, gate, rounding) for motion in motions]
    kept = tuple(block for block in found if block.omega.size >= BAND_LINES)
    if not kept:
        longest = max(m.experiment.samples for m in motions) * recording.sample_period
        raise NotEnoughDataError(
            f"fewer than {BAND_LINES} lines of the spectrum stand out of the noise in the longest "
            f"record of {longest:.3g} s: record longer or livelier moves."
        )
    return kept


def _spectra(recording: Recording, motion: Motion, gate: bool, rounding: float) -> Spectra:
    experiment, step = motion.experiment, recording.sample_period
    rows = experiment.samples
    lines = np.arange(1, min(int(TOP * rows), MOST_LINES) + 1)
    lines = lines[: _last_line(experiment.position, motion.noise, lines)]
    moving = motion.moving if gate else np.ones_like(motion.moving)
    torque = experiment.torque * moving
    spectrum = np.fft.rfft(torque, axis=0) / rows
    size = np.abs(spectrum[lines]) ** 2
    guess = np.broadcast_to(1e-3 * size.mean(axis=0) + np.finfo(float).tiny ** 0.5, size.shape)
    position_variance = np.broadcast_to(motion.noise**2 / rows, (1, lines.size, motion.noise.size))
    return Spectra(
        names=recording.names,
        sample_period=step,
        rows=rows,
        omega=np.asarray(2 * np.pi * lines / (rows * step), dtype=np.float64),
        position=(np.fft.rfft(experiment.position, axis=0) / rows)[None, lines],
        torque=spectrum[None, lines],
        position_variance=position_variance,
        torque_variance=guess[None],
        mean_torque=spectrum[0].real[None],
        parts=_parts(recording, motion, moving, rounding, lines),
    )


def _parts(
    recording: Recording,
    motion: Motion,
    moving: FloatArray,
    rounding: float,
    lines: NDArray[np.intp],
) -> tuple[TorquePart, ...]:
    parts = []
    scale = np.maximum(motion.unsure, rounding * motion.fastest)
    direction = np.clip(motion.velocity / np.where(scale > 0.0, scale, 1.0), -1.0, 1.0)
    for j, name in enumerate(recording.names):
        courses = {
            "coulomb_friction": direction[:, j] * motion.moved[j] * moving[:, j],
            "torque_offset": moving[:, j],
        }
        for what, course in courses.items():
            spectrum = np.fft.rfft(course) / course.size
            mean = np.array([spectrum[0].real])
            parts.append(TorquePart(f"{name}.{what}", j, spectrum[None, lines], mean))
    return tuple(parts)


def _last_line(position: FloatArray, noise: FloatArray, lines: NDArray[np.intp]) -> int:
    """Count the lines up to the highest at which some axis' motion stands out of its noise."""
    rows = position.shape[0]
    window = np.hanning(rows - 2)[:, None]
    bent = np.abs(np.fft.rfft(np.diff(position, 2, axis=0) * window, axis=0)) ** 2
    ratio = np.abs(2.0 * np.sin(np.pi * lines / rows)) ** 4
    white = np.maximum(noise, 1e-15 * np.abs(position).max())
    floor = ratio[:, None] * white**2 * np.sum(window**2)
    there = np.any(smoothed(bent[lines]) > STANDS_OUT * floor, axis=1)
    return int(np.flatnonzero(there)[-1]) + 1 if there.any() else 0


def bands(count: int) -> list[slice]:
    """Cut lines 1 to `count` into bands of a sixth of an octave, of at least 16 lines."""
    edges = [0]
    while edges[-1] < count:
        edges.append(max(edges[-1] + BAND_LINES, int(edges[-1] * 2 ** (1 / 6))))
    if len(edges) > 2 and edges[-1] > count:
        edges.pop(-2)
    edges[-1] = count
    return [slice(a, b) for a, b in pairwise(edges)]


def smoothed(power: FloatArray) -> FloatArray:
    """Mean of each band in all its lines, along the first axis."""
    result = np.empty_like(power)
    for band in bands(power.shape[0]):
        result[band] = power[band].mean(axis=0)
    return result


def reweighted(block: Spectra, left: TorqueResidual, freedom: float) -> Spectra:
    """Take the level of the torque's noise from what a fit left of the torque.

    The level is one number per axis and record, for all lines: what friction that is not quite as
    modelled leaves is strong at low frequencies, and weights that follow it would let the faint high
    lines decide.  What the noise of the position explains is taken off.

    Parameters
    ----------
    block
    left
        From :func:`fieldtool.identify.moves.spectra.torque_residuals`.
    freedom : float
        Share of the numbers that the fit did not use up.
    """
    power = np.abs(left.residual) ** 2 / freedom
    noise = left.from_position
    level = np.median(power, axis=1, keepdims=True)
    for _ in range(20):
        weight = (level / (level + noise)) ** 2
        excess = np.sum(weight * (power - noise), axis=1, keepdims=True)
        level = np.maximum(excess / np.sum(weight, axis=1, keepdims=True), 1e-3 * level)
    least = 1e-20 * np.max(np.abs(block.torque) ** 2, axis=1, keepdims=True)
    variance = np.broadcast_to(np.maximum(level, least), power.shape)
    return replace(block, torque_variance=variance)
