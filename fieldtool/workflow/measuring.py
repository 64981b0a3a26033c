"""Measure with the classic plan: two passes, checked before motion, raw data kept as it comes."""

from dataclasses import replace

import numpy as np

from drives.canopen_drive import CanopenGroup
from drives.errors import UserStopError
from fieldtool.errors import IdentificationError
from fieldtool.experiment.directions import check_directions, small_moves
from fieldtool.experiment.forecast import forecast
from fieldtool.experiment.stepped.design import (
    chosen_cycle_time,
    classic_plan,
    lowest_mode,
    refined_plan,
    undamped_modes,
)
from fieldtool.experiment.stepped.runner import run_plan
from fieldtool.identify.classic import without_friction
from fieldtool.identify.recorded import identify_recording
from fieldtool.records.recording import Recording, RecordingWriter
from fieldtool.workflow.models import check_believable, prior_model
from fieldtool.workflow.preparation import axes_of, recording_header, setting_of, window_notes
from fieldtool.workflow.rescued import keeping
from fieldtool.workflow.session import Session
from fieldtool.writeback.temporary import backed_up

SETTLE_PERIODS = 17.0
"""Periods of the lowest mode that a tone takes to settle, for the estimate of a plan's duration."""


def measured(session: Session, group: CanopenGroup) -> float:
    """Back the parameters up, measure both passes, and return the seconds of excitation."""
    machine, folder = session.machine, session.folder
    before = folder.parameters_before
    with backed_up(machine.name, group.drives, before), group.without_feed_forward():
        return _measure_both_passes(session, group)


def _measure_both_passes(session: Session, group: CanopenGroup) -> float:
    machine, screen, folder = session.machine, session.screen, session.folder
    setting = setting_of(machine, group, prior_model(machine))
    cycle_time = chosen_cycle_time(setting.model, group.shortest_cycle)
    plan = classic_plan(setting, [axis.name for axis in machine.axes if axis.may_float], cycle_time)
    screen.stage("Plan the first pass")
    expected = forecast(plan, setting)
    guess = SETTLE_PERIODS / lowest_mode(setting.model)
    screen.plan(plan, expected, plan.expected_duration(guess))
    for note in (*plan.notes, *window_notes(group, setting)):
        screen.say(note)
    if not session.ready():
        raise UserStopError("not begun: nothing was moved")
    axes = axes_of(group, setting)
    header = recording_header(machine, group, cycle_time, with_lengths=True)
    with (
        RecordingWriter(folder.recording, header) as recording,
        keeping(folder, recording, group) as keep,
    ):
        screen.stage("Check that every axis moves the right way")
        screen.say(small_moves(axes))
        check_directions(group, axes, cycle_time, keep)
        screen.stage("Measure, pass 1 of 2: an even grid over the band of the prior model")
        machine_time = run_plan(group, plan, axes, keep, screen.progress)
        screen.say(_measured_text(recording.recording))
        screen.stage("Find the modes, and plan the second pass around them")
        try:
            found = identify_recording(recording.recording, {}, setting.model, {})
        except IdentificationError as error:
            session.warn(f"The first pass alone can not be identified ({error})")
            return machine_time
        check_believable(found.model, setting.model)
        modes = ", ".join(f"{w / (2 * np.pi):.2f}" for w in undamped_modes(found.model)[0])
        screen.say(f"Resonances found: {modes} Hz." if modes else "The axes are rigid.")
        now_known = replace(setting, model=without_friction(found.model))
        second = refined_plan(now_known, found.damping_ratios, cycle_time)
        if not second.sweeps:
            return machine_time
        screen.plan(second, forecast(second, now_known), second.expected_duration(guess))
        screen.stage("Measure, pass 2 of 2: at and beside every mode")
        machine_time += run_plan(group, second, axes, keep, screen.progress)
        screen.say(_measured_text(recording.recording))
    return machine_time


def _measured_text(recording: Recording) -> str:
    segments = [s for e in recording.experiments for s in e.segments]
    settled = sum(s.settled for s in segments)
    return f"Measured so far: {len(segments)} tones, {settled} of them settled."
