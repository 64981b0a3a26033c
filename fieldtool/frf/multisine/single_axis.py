"""Periodic multisine experiments: response, noise and distortion from the same data.

The response is the ratio of the means of output and input over the periods; its error follows
from the covariance of both over the periods (errors in variables), so a noisy torque is no bias.

Distortion: between the excited lines a straight (linear) machine shows only noise.  What repeats
there is distortion, on odd lines from friction and saturation, on even ones from unsymmetric
effects.  But the measured torque has content at those lines too (the drive's own imperfection),
and what the machine makes of it is no distortion: it is computed from the response and taken away.

Source: Pintelon and Schoukens, System Identification: A Frequency Domain Approach, chapters 2-4.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fieldtool.errors import NotEnoughDataError
from fieldtool.frf.multisine.periods import PeriodAverage, average_periods, excited_lines
from fieldtool.frf.phasors import ComplexArray, FloatArray, Phasors
from fieldtool.records.recorded import Experiment, Recording

_NEIGHBOURS = 6


@dataclass(frozen=True)
class DistortionLevels:
    """Root mean squares of the driven axis's position at the lines of a band, rad or m (peak)."""

    excited: float
    odd: float
    """Odd lines that were not excited; NaN where the band has none."""
    even: float
    noise: float
    """Standard error of the mean at the lines that were not excited."""


@dataclass(frozen=True, eq=False)
class Distortion:
    """What the driven axis's position shows between the excited lines, inside their band."""

    axis: str
    frequencies: FloatArray
    """(U,), Hz, of the lines that were not excited."""
    odd: NDArray[np.bool_]
    """(U,)."""
    raw: FloatArray
    """(U,): modulus of the position as measured."""
    unexplained: FloatArray
    """(U,): modulus of what the measured torque at these lines does not explain."""
    noise: FloatArray
    """(U,): standard error of the mean of the complex amplitude, sqrt(E|e|^2)."""
    excited_frequencies: FloatArray
    """(L,), Hz."""
    excited: FloatArray
    """(L,): modulus of the position at the excited lines."""

    def levels(self, low: float, high: float, *, raw: bool = False) -> DistortionLevels:
        """Return root mean squares over the band from ``low`` to ``high`` Hz, both included."""
        values = self.raw if raw else self.unexplained
        inside = (self.frequencies >= low) & (self.frequencies <= high)
        driven = (self.excited_frequencies >= low) & (self.excited_frequencies <= high)
        return DistortionLevels(
            excited=_rms(self.excited[driven]),
            odd=_rms(values[inside & self.odd]),
            even=_rms(values[inside & ~self.odd]),
            noise=_rms(self.noise[inside]),
        )


@dataclass(frozen=True, eq=False)
class MultisineResult:
    """One multisine experiment, averaged."""

    phasors: Phasors
    """At the excited lines, all axes."""
    skipped: int
    """Leading periods left out as transient."""
    periods: int
    """Periods averaged."""
    distortion: Distortion | None
    """None where every line in the band was excited, or more than one axis was driven."""


def analyse_multisine(
    recording: Recording,
    experiment: Experiment,
    lines: Sequence[int] | None = None,
    skip: int | None = None,
) -> MultisineResult:
    """Return phasors and distortion of one periodic experiment.

    Parameters
    ----------
    recording, experiment
        The experiment needs a ``period``.
    lines
        Numbers of the excited lines (1 is the inverse of the period); None finds them from the
        reference, else from the measured torque of the driven axes.
    skip
        Leading periods to leave out; None finds them.

    Raises
    ------
    NotEnoughDataError
        If there is no period, no driven axis, too few periods, or no excited line.
    """
    if experiment.period is None or not experiment.driven:
        missing = "a period" if experiment.period is None else "a driven axis"
        raise NotEnoughDataError(
            f"experiment {experiment.name} is periodic data without {missing}: add it to the "
            "description of the recording."
        )
    M = len(recording.axes)
    driven = [recording.names.index(name) for name in experiment.driven]
    references = [_reference(experiment, axis) for axis in driven]
    signals = np.column_stack(
        [experiment.position, experiment.torque, *(values for values, _ in references)]
    )
    average = average_periods(signals, experiment.period, recording.sample_period, skip)
    if lines is None:
        found = [
            excited_lines(average, 2 * M + place, kind, M + axis)
            for place, (axis, (_, kind)) in enumerate(zip(driven, references, strict=True))
        ]
        places = np.unique(np.concatenate(found))
    else:
        places = _given_lines(lines, average)
    kept = slice(0, 2 * M)
    phasors = Phasors(
        experiment=experiment.name,
        axes=recording.names,
        driven=experiment.driven,
        free=experiment.free,
        frequencies=average.frequencies[places],
        position=average.mean[places, :M],
        torque=average.mean[places, M : 2 * M],
        covariance=average.covariance[places, kept, kept],
    )
    distortion = None
    if len(driven) == 1:
        distortion = _distortion(experiment.driven[0], average, places, driven[0], M + driven[0])
    return MultisineResult(phasors, average.skipped, average.periods, distortion)


def _reference(experiment: Experiment, axis: int) -> tuple[FloatArray, str]:
    """Return what was asked of an axis, (n,), and what kind of signal that is."""
    for name in ("torque_reference", "position_reference"):
        values: FloatArray | None = getattr(experiment, name)
        if values is not None and not np.any(np.isnan(values[:, axis])):
            return values[:, axis], name
    return experiment.torque[:, axis], "torque"


def _given_lines(lines: Sequence[int], average: PeriodAverage) -> NDArray[np.intp]:
    places = np.unique(np.asarray(lines, dtype=np.intp)) - 1
    if places.size == 0 or places[0] < 0 or places[-1] >= average.mean.shape[0]:
        raise NotEnoughDataError(
            f"the lines given must lie between 1 and {average.mean.shape[0]} (half the sample "
            f"rate), got {sorted(set(lines))[:5]} ..."
        )
    return places


def _distortion(
    axis: str, average: PeriodAverage, places: NDArray[np.intp], position: int, torque: int
) -> Distortion | None:
    between = np.setdiff1d(np.arange(places[0], places[-1] + 1), places)
    if between.size == 0 or places.size < 4:
        return None
    f = average.frequencies
    response = average.mean[places, position] / average.mean[places, torque]
    predicted = between_lines(f[places], response, f[between])
    explained = predicted * average.mean[between, torque]
    return Distortion(
        axis=axis,
        frequencies=f[between],
        odd=(between + 1) % 2 == 1,
        raw=np.abs(average.mean[between, position]),
        unexplained=np.abs(average.mean[between, position] - explained),
        noise=np.sqrt(average.covariance[between, position, position].real),
        excited_frequencies=f[places],
        excited=np.abs(average.mean[places, position]),
    )


def between_lines(
    measured_at: FloatArray, response: ComplexArray, wanted: FloatArray
) -> ComplexArray:
    """Interpolate responses (L, ...) by local rational functions (a0 + a1 x) / (1 + b1 x).

    Six nearest lines, least squares, one b1 for all elements (each over its own size): follows one
    resonance or antiresonance.  The apparent mass's w^2 is taken out first, so that a rigid body is
    a constant.

    Parameters
    ----------
    measured_at
        (L,), Hz.
    response
        (L, ...): one element or a matrix at each.
    wanted
        (U,), Hz.

    Returns
    -------
    ndarray
        (U, ...).
    """
    flat = response.reshape(measured_at.size, -1) * measured_at[:, None] ** 2
    result = np.empty((wanted.size, flat.shape[1]), dtype=np.complex128)
    count = min(_NEIGHBOURS, measured_at.size)
    for place, frequency in enumerate(wanted):
        near = np.argsort(np.abs(measured_at - frequency), kind="stable")[:count]
        x = measured_at[near] - frequency
        x = x / np.max(np.abs(x))
        y = flat[near]  # (count, elements)
        line = np.column_stack([np.ones_like(x), x])
        Q, _ = np.linalg.qr(line)
        size = np.sqrt(np.mean(np.abs(y) ** 2, axis=0))
        scaled_y = y / np.where(size > 0, size, 1.0)
        slope = x[:, None] * scaled_y
        slope_left = slope - Q @ (Q.T @ slope)
        y_left = scaled_y - Q @ (Q.T @ scaled_y)
        power = float(np.sum(np.abs(slope_left) ** 2))
        b1 = -np.sum(slope_left.conj() * y_left) / power if power > 0 else 0.0
        solution, *_ = np.linalg.lstsq(line, y * (1 + b1 * x)[:, None], rcond=None)
        result[place] = solution[0]
    scaled: ComplexArray = result / wanted[:, None] ** 2
    return scaled.reshape(wanted.size, *response.shape[1:])


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2))) if values.size else float("nan")
