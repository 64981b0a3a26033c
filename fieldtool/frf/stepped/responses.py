"""Stepped-sine experiments: phasors of every settled segment, and the responses they give."""

from dataclasses import dataclass

import numpy as np

from fieldtool.errors import NotEnoughDataError
from fieldtool.frf.held_targets import folded_torque
from fieldtool.frf.matrix import column_responses
from fieldtool.frf.phasors import Phasors, fit_sine
from fieldtool.frf.response import FrequencyResponse
from fieldtool.frf.stepped.quality import SegmentQuality, judge
from fieldtool.records.recorded import Experiment, Recording


@dataclass(frozen=True, eq=False)
class SteppedResult:
    """What the stepped-sine experiments of a recording say."""

    responses: dict[str, FrequencyResponse]
    """By condition: ``others free``, ``others locked``, ``a + b free, others locked``."""
    phasors: tuple[Phasors, ...]
    """Of each experiment, all axes: positions and torques, for whatever is to be solved later."""
    quality: tuple[SegmentQuality, ...]
    """Of every segment that was used."""


def stepped_responses(recording: Recording) -> SteppedResult:
    """Return responses and phasors of all stepped-sine experiments of ``recording``.

    Segments that had not settled are left out.

    Raises
    ------
    NotEnoughDataError
        If there is no stepped-sine experiment with a settled segment, or a segment is too short.
    """
    experiments = [e for e in recording.experiments if e.kind == "stepped_sine"]
    pairs = [stepped_phasors(recording, experiment) for experiment in experiments]
    phasors = tuple(p for p, _ in pairs if p.frequencies.size)
    if not phasors:
        raise NotEnoughDataError(
            "the recording has no stepped-sine experiment with a settled segment: there is no "
            "frequency response to compute."
        )
    quality = tuple(q for _, group in pairs for q in group)
    return SteppedResult(column_responses(phasors), phasors, quality)


def stepped_phasors(
    recording: Recording, experiment: Experiment
) -> tuple[Phasors, tuple[SegmentQuality, ...]]:
    """Return phasors and quality of the settled segments of one experiment, F of them.

    Raises
    ------
    NotEnoughDataError
        If a segment is shorter than one period or 8 rows; says which.
    """
    M = len(recording.axes)
    signals = np.hstack([experiment.position, experiment.torque])
    driven = [recording.names.index(name) for name in experiment.driven]
    amplitudes, covariances, quality = [], [], []
    segments = [segment for segment in experiment.segments if segment.settled]
    for segment in segments:
        rows = slice(segment.start, segment.stop)
        time = experiment.time[rows] - experiment.time[segment.start]
        try:
            fit = fit_sine(time, signals[rows], segment.frequency)
        except NotEnoughDataError as error:
            raise NotEnoughDataError(
                f"experiment {experiment.name}, rows {segment.start} to {segment.stop}: {error}"
            ) from error
        amplitude = fit.amplitude.copy()
        for axis in driven:
            amplitude[M + axis] -= folded_torque(recording, experiment, segment, axis)
        amplitudes.append(amplitude)
        covariances.append(fit.covariance)
        quality.append(judge(experiment.name, fit, time, signals[rows], driven))
    values = np.array(amplitudes, dtype=np.complex128).reshape(-1, 2 * M)
    phasors = Phasors(
        experiment=experiment.name,
        axes=recording.names,
        driven=experiment.driven,
        free=experiment.free,
        frequencies=np.array([segment.frequency for segment in segments], dtype=np.float64),
        position=values[:, :M],
        torque=values[:, M:],
        covariance=np.array(covariances, dtype=np.complex128).reshape(-1, 2 * M, 2 * M),
    )
    return phasors, tuple(quality)
