"""What the next measurement of a machine should be, from what a recording has told of it."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from drives.api import AxisLimits
from drives.profile import load_machine
from fieldtool.design.rule import rule
from fieldtool.errors import IdentificationError
from fieldtool.experiment.forecast import Setting
from fieldtool.experiment.multisine.design import fast_cycle_times, longest_cycle
from fieldtool.identify.likelihood.expected import Noise
from fieldtool.identify.multisine.pilot import measured_noise
from fieldtool.identify.recorded import Identified
from fieldtool.records.closed_loop import AxisLoop
from fieldtool.records.model import FloatArray
from fieldtool.records.recording import Recording, load
from fieldtool.records.session_folder import SessionFolder
from fieldtool.workflow.planning import PlannedFast, Wanted, plan_main, timing, usual_seconds
from fieldtool.workflow.session import Options
from fieldtool.workflow.stages import identify

SEED = 31
"""Of the random phases: another realisation than the first measurement's."""
GUESSED_NOISE = 1e-3
"""Of the largest torque, and of the largest motion, where the recording does not tell the noise."""


def next_plan(
    source: Path, options: Options | None = None, masses: Mapping[str, int] | None = None
) -> tuple[Identified, PlannedFast]:
    """Identify from a session folder or a recording, and plan the measurement to follow.

    Limits are those of the session's machine profile; a recording alone has none, so the plan stays
    within what the recording has done.  Where the recording has no controllers, those that the
    model suggests are reckoned with.

    Raises
    ------
    FileFormatError
        If there is no recording.
    IdentificationError
        If the data do not allow a model.
    PlanRefusedError
        If no plan keeps the limits.
    """
    options = options or Options()
    found = identify(source, options, masses)
    folder = SessionFolder.of_source(source)
    recording = load(folder.recording if folder else source)
    limits = _envelope(recording)
    if folder and folder.machine.is_file():
        limits = tuple(axis.limits.watched for axis in load_machine(folder.machine).axes)
    centre = np.array([sum(one.travel) / 2 for one in limits])
    setting = Setting(found.model, _loops(recording, found), limits, centre)
    cycle_time = recording.sample_period
    if cycle_time > longest_cycle(found.model):
        cycle_time = fast_cycle_times(found.model, 0.0)[0]
    seconds = options.excitation_time or usual_seconds(found.model)
    times = timing(setting, seconds)
    planned = plan_main(setting, cycle_time, _noise(recording, found), times, Wanted(), SEED)
    return found, replace(planned, rests_on="identified model")


def _loops(recording: Recording, found: Identified) -> tuple[AxisLoop, ...]:
    if all(axis.controller is not None for axis in recording.axes):
        return tuple(
            AxisLoop(c.position_p, c.velocity_p, c.velocity_i, 0.0)
            for axis in recording.axes
            if (c := axis.controller) is not None
        )
    return tuple(replace(loop, velocity_ff=0.0, inertia_ff=0.0) for loop in rule(found.model))


def _envelope(recording: Recording) -> tuple[AxisLimits, ...]:
    """Return what the recording has done: nobody has said that more is allowed."""
    step = recording.sample_period
    limits = []
    for k in range(len(recording.axes)):
        positions = [e.position[:, k] for e in recording.experiments]
        error = [
            float(np.max(np.abs(e.position_reference[:, k] - e.position[:, k])))
            for e in recording.experiments
            if e.position_reference is not None
            and bool(np.all(np.isfinite(e.position_reference[:, k])))
        ]
        limits.append(
            AxisLimits(
                (
                    min(float(p.min()) for p in positions),
                    max(float(p.max()) for p in positions),
                ),
                max(_fastest(p, step) for p in positions),
                np.inf,
                max(float(np.max(np.abs(e.torque[:, k]))) for e in recording.experiments),
                max(error, default=np.inf),
            )
        )
    return tuple(limits)


def _fastest(position: FloatArray, step: float) -> float:
    """Largest velocity over some samples at a time: single counts of an encoder are no motion."""
    apart = max(1, min(10, position.size // 4))
    return float(np.max(np.abs(position[apart:] - position[:-apart]))) / (apart * step)


def _noise(recording: Recording, found: Identified) -> Noise:
    try:
        return measured_noise(recording, found.model)
    except IdentificationError:
        torque = np.max([np.abs(e.torque).max(axis=0) for e in recording.experiments], axis=0)
        motion = np.max([np.ptp(e.position, axis=0) for e in recording.experiments], axis=0)
        return Noise(GUESSED_NOISE * torque, GUESSED_NOISE * motion)
