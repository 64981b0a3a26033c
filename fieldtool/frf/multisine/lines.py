"""Steady phasors of every joint experiment at every line, corrected, with their noise."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fieldtool.frf.held_targets import folded_phasors, held_offset
from fieldtool.frf.multisine.inputs import TORQUE_OFFSET, JointInput
from fieldtool.frf.multisine.transient import SteadySpectra, noise_covariance, steady_spectra
from fieldtool.frf.phasors import ComplexArray, FloatArray, Phasors
from fieldtool.records.recorded import Recording

_FREEDOM_AN_AXIS = 30.0
_LEAST_FREEDOM = 60.0
_SAME_LEVEL = 1.15
"""Experiments whose references differ by less are of one amplitude level."""
_SAME_NOISE = 2.0
"""Experiments whose noise powers differ by less share one estimate."""


@dataclass(frozen=True, eq=False)
class LinePhasors:
    """One experiment's phasors at lines 1 to L, excited or not."""

    given: JointInput
    level: float
    """Size of its references relative to the strongest experiment's, 1 at most."""
    frequencies: FloatArray
    """(L,), Hz."""
    mean: ComplexArray
    """(L, 2M): positions, then torques."""
    covariance: ComplexArray
    """(L, 2M, 2M): E[e e^H] of the errors of ``mean``."""
    freedom: FloatArray
    """(L,): complex degrees of freedom that ``covariance`` was estimated from."""
    transient: float
    """Largest share of the transient in a signal: RMS of what was taken out over that of the rest,
    over the excited lines."""

    @property
    def name(self) -> str:
        """Of the experiment."""
        return self.given.experiment.name

    def phasors(self, axes: tuple[str, ...]) -> Phasors:
        """Return the phasors at the excited lines alone."""
        places, M = self.given.lines - 1, len(axes)
        return Phasors(
            experiment=self.name,
            axes=axes,
            driven=self.given.experiment.driven,
            free=self.given.experiment.free,
            frequencies=self.frequencies[places],
            position=self.mean[places, :M],
            torque=self.mean[places, M:],
            covariance=self.covariance[places],
        )


def line_phasors(
    recording: Recording,
    inputs: Sequence[JointInput],
    offset_sampled: float | None = None,
    offset_rows: int = 1,
) -> list[LinePhasors]:
    """Return the steady phasors of all experiments, in their order.

    Experiments with the same period and the same number of periods are freed of their transients
    together, because they have the same poles.

    Parameters
    ----------
    recording, inputs
        The experiments, with excited lines.
    offset_sampled, offset_rows
        When torques are sampled after a held torque offset took effect, s, and in which row it
        shows (see :func:`~fieldtool.frf.held_targets.held_offset`); None: no correction, because a
        filter behind the offset leaves nothing of its steps, as where the fast plan uses one.
    """
    levels = _levels(inputs)
    groups: dict[tuple[int, int], list[int]] = {}
    for place, one in enumerate(inputs):
        groups.setdefault((one.samples, one.periods), []).append(place)
    result: dict[int, LinePhasors] = {}
    M = len(recording.axes)
    for (N, periods), members in groups.items():
        last = max(int(inputs[place].lines[-1]) for place in members)
        signals = np.hstack([_signals(inputs[place]) for place in members])
        spectra = steady_spectra(signals, periods, last, recording.sample_period)
        frequencies = np.arange(1, last + 1) / (N * recording.sample_period)
        noise = _noise(spectra, [levels[place] for place in members], 2 * M)
        for at, place in enumerate(members):
            own = slice(at * 2 * M, (at + 1) * 2 * M)
            mean = spectra.mean[:, own].copy()
            mean[:, M:] += _correction(
                recording, inputs[place], frequencies, offset_sampled, offset_rows
            )
            covariance, freedom = noise[at]
            excited = inputs[place].lines - 1
            transient = _share(spectra.transient[excited, own], mean[excited])
            result[place] = LinePhasors(
                inputs[place], levels[place], frequencies, mean, covariance, freedom, transient
            )
    return [result[place] for place in range(len(inputs))]


def _signals(one: JointInput) -> FloatArray:
    experiment = one.experiment
    return np.hstack([experiment.position[one.rows], experiment.torque[one.rows]])


def _share(transient: ComplexArray, mean: ComplexArray) -> float:
    steady = np.sqrt(np.mean(np.abs(mean) ** 2, axis=0))
    moving = np.sqrt(np.mean(np.abs(transient) ** 2, axis=0))
    return float(np.max(moving[steady > 0] / steady[steady > 0], initial=0.0))


def _levels(inputs: Sequence[JointInput]) -> list[float]:
    """Size of each experiment's references over the largest there is of the same axis, (E,)."""
    sizes = np.array([np.sqrt(np.sum(np.abs(one.reference) ** 2, axis=0)) for one in inputs])
    largest = sizes.max(axis=0)
    shares = sizes / np.where(largest > 0, largest, 1.0)
    levels = [float(np.median(row[row > 0])) if np.any(row > 0) else 1.0 for row in shares]
    return [level / max(levels) for level in levels]


def same_level(a: float, b: float) -> bool:
    """Tell whether two experiments are of one amplitude level."""
    return max(a, b) <= _SAME_LEVEL * min(a, b)


def _noise(
    spectra: SteadySpectra, levels: Sequence[float], width: int
) -> list[tuple[ComplexArray, FloatArray]]:
    """Covariance of each experiment's noise; those with the same level and noise share it."""
    wanted = max(_LEAST_FREEDOM, _FREEDOM_AN_AXIS * width / 2)
    columns = [np.arange(e * width, (e + 1) * width) for e in range(len(levels))]
    power = np.array([np.mean(np.abs(spectra.residual[:, own]) ** 2, axis=0) for own in columns])
    power = np.maximum(power, np.finfo(float).tiny)
    shared: list[list[int]] = []
    for e, level in enumerate(levels):
        for group in shared:
            ratio = power[e] / power[group[0]]
            if same_level(level, levels[group[0]]) and np.all(
                (ratio < _SAME_NOISE) & (ratio > 1 / _SAME_NOISE)
            ):
                group.append(e)
                break
        else:
            shared.append([e])
    result: dict[int, tuple[ComplexArray, FloatArray]] = {}
    for group in shared:
        estimate = noise_covariance(spectra, [columns[e] for e in group], wanted)
        result |= dict.fromkeys(group, estimate)
    return [result[e] for e in range(len(levels))]


def _correction(
    recording: Recording,
    one: JointInput,
    frequencies: FloatArray,
    sampled: float | None,
    rows: int,
) -> ComplexArray:
    """What has to be added to the torque's phasors, (L, M)."""
    M, L = len(recording.axes), frequencies.size
    correction = -folded_phasors(recording, frequencies, one.reference[:L, :M])
    T = recording.sample_period
    for axis, name in enumerate(recording.names):
        values = one.experiment.extra.get(f"{name}.{TORQUE_OFFSET}")
        if values is None or sampled is None:
            continue
        offset = _line_spectrum(values[one.rows], one.periods, L)[:, None]
        correction[:, axis] += held_offset(frequencies, offset, T, sampled, rows)[:, 0]
    return correction


def _line_spectrum(values: FloatArray, periods: int, lines: int) -> ComplexArray:
    spectrum: ComplexArray = np.fft.rfft(values)[periods : periods * lines + 1 : periods]
    return spectrum * (2 / values.size)


def axis_signal_to_noise(one: LinePhasors, axis: int, axes: int) -> NDArray[np.float64]:
    """Torque amplitude over its standard error at the excited lines, (L,)."""
    places = one.given.lines - 1
    column = axes + axis
    error = np.sqrt(np.maximum(one.covariance[places, column, column].real, 0.0))
    size = np.abs(one.mean[places, column])
    ratio: NDArray[np.float64] = size / np.maximum(error, np.finfo(float).tiny)
    return ratio
