"""Measure with the fast plan: a weak pilot, then the plan that it allows, all loops closed."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from drives.canopen_drive import CanopenGroup
from drives.canopen_drive.recovery import lost_its_host
from drives.errors import StoppedError, UserStopError
from drives.profile import MachineProfile, load_machine
from fieldtool.experiment.axes import Axes
from fieldtool.experiment.directions import check_directions, small_moves
from fieldtool.experiment.forecast import Setting
from fieldtool.experiment.multisine.design import fast_cycle_times, longest_cycle, mode_band
from fieldtool.experiment.multisine.forecast import FOLLOWING_ERROR, experiment_peaks
from fieldtool.experiment.multisine.plan import MultisinePlan
from fieldtool.experiment.multisine.runner import run_multisine
from fieldtool.experiment.stepped.design import undamped_modes
from fieldtool.identify.likelihood.expected import Noise
from fieldtool.identify.multisine.pilot import PilotFindings, read_pilot
from fieldtool.records.model import FloatArray, MachineModel
from fieldtool.records.recording import Experiment, Recording, RecordingWriter
from fieldtool.workflow.adapted import (
    freed_of_friction,
    torques_foreseen,
    torques_of,
    with_room_for_torque,
)
from fieldtool.workflow.models import check_torque_scale, prior_model
from fieldtool.workflow.planning import (
    Advance,
    PlannedFast,
    Timing,
    Wanted,
    plan_main,
    plan_pilot,
    timing,
    usual_seconds,
)
from fieldtool.workflow.preparation import (
    axes_of,
    check_seen,
    recording_header,
    setting_of,
    window_notes,
    without_feed_forward,
)
from fieldtool.workflow.rescued import keeping
from fieldtool.workflow.session import Options, Screen, Session
from fieldtool.workflow.stopped import check_loops, judge_stop
from fieldtool.writeback.alone import connected
from fieldtool.writeback.temporary import backed_up

GUESSED_NOISE = 1e-3
"""Of the rated torque: noise of the torque before the pilot has measured it (one count of 0x6077)."""
TOLERATED = 1.05
"""Excitation time over what was asked for, above which it is said."""
LATE_SHARE = 0.01
"""Of the pilot's cycles that may begin late; with more, the next longer cycle is tried."""
SEED = 22
"""Of the random phases: the same machine gets the same plan."""


def measured_fast(session: Session, group: CanopenGroup, options: Options) -> float:
    """Back the parameters up, run pilot and main experiments, and return the seconds of excitation."""
    before = session.folder.parameters_before
    with backed_up(session.machine.name, group.drives, before), group.without_feed_forward():
        return FastMeasurement(session, group, options).run()


def plan(
    machine: str | Path | MachineProfile,
    options: Options | None = None,
    *,
    screen: Screen | None = None,
) -> PlannedFast:
    """Plan a fast measurement of a machine, with its drives' gains; nothing moves or is written.

    Raises
    ------
    DrivesError, FieldtoolError
        If the machine can not be reached, or no plan keeps its limits.
    """
    profile = machine if isinstance(machine, MachineProfile) else load_machine(machine)
    options = options or Options()
    with connected(profile, to_move=False) as group:
        for drive in group.drives:
            if lost_its_host(drive) is None:  # no obstacle to a plan, and not reset for it
                drive.check_idle()
            drive.read_scaling()
            drive.check_limits()
        group.check_can_measure()
        setting = setting_of(profile, group, prior_model(profile))
        bare = tuple(map(without_feed_forward, group.drives, setting.loops))
        setting = replace(setting, loops=bare)
        cycle_time = fast_cycle_times(setting.model, group.shortest_cycle)[0]
        times = timing(setting, options.excitation_time or usual_seconds(setting.model))
        planned, _ = planned_before(
            group, setting, cycle_time, times, screen.doing if screen else lambda *_: None
        )
        notes = window_notes(group, setting)
    if screen is not None:
        for note in (*_longer_than_asked(planned, options.excitation_time), *notes):
            screen.say(note)
        screen.fast_plan(planned)
    return planned


def planned_before(
    group: CanopenGroup,
    setting: Setting,
    cycle_time: float,
    times: Timing,
    advance: Advance = lambda *_: None,
) -> tuple[PlannedFast, MultisinePlan]:
    """Plan with the prior model, before anything has moved; return it all, and the pilot."""
    offsets = group.torque_offsets
    advance("plan the pilot", 0.0)
    pilot = plan_pilot(setting, cycle_time, times, SEED, offsets)
    guess = _guessed_noise(group)
    main = plan_main(setting, cycle_time, guess, times, Wanted(), SEED + 1, offsets, advance)
    for drive, move in zip(group.drives, main.moves, strict=True):
        check_seen(drive, move.excursion, "the excitation")
    return replace(main, pilot=pilot), pilot


def _longer_than_asked(planned: PlannedFast, seconds: float | None) -> tuple[str, ...]:
    """Return a sentence if the plan takes clearly longer than was asked for."""
    if seconds is None or planned.duration <= TOLERATED * seconds:
        return ()
    return (
        f"{seconds:g} s are too short for this machine: run-in and two periods that are long enough for "
        f"its slowest motion take {planned.duration:.0f} s in all, the shortest plan there is. That one "
        "is used.",
    )


def _guessed_noise(group: CanopenGroup) -> Noise:
    rated = np.array([drive.rated_torque for drive in group.drives])
    counts = np.array([drive.scaling.position for drive in group.drives])
    return Noise(GUESSED_NOISE * rated, counts / np.sqrt(12))


class FastMeasurement:
    """One fast measurement; what its steps share."""

    def __init__(self, session: Session, group: CanopenGroup, options: Options) -> None:
        self._session, self._group = session, group
        self._setting = setting_of(session.machine, group, self.start_model())
        self._cycles = fast_cycle_times(self._setting.model, group.shortest_cycle)
        self._times = timing(
            self._setting, options.excitation_time or usual_seconds(self._setting.model)
        )
        self._asked = options.excitation_time
        self._wanted = Wanted()
        self._offsets = group.torque_offsets
        self._axes: Axes = axes_of(group, self._setting)

    def start_model(self) -> MachineModel:
        """Return the model that is planned with before the pilot."""
        return prior_model(self._session.machine)

    def run(self) -> float:
        """Return the seconds of excitation."""
        pilot = self._plan_all(self._cycles[0])
        if not self._session.ready():
            raise UserStopError("not begun: nothing was moved")
        for cycle_time in self._cycles:
            if cycle_time != pilot.cycle_time:
                pilot = plan_pilot(self._setting, cycle_time, self._times, SEED, self._offsets)
            seconds = self._with_cycle(pilot, last=cycle_time == self._cycles[-1])
            if seconds is not None:
                return seconds
        raise UserStopError("not begun: nothing was excited")

    def _with_cycle(self, pilot: MultisinePlan, last: bool) -> float | None:
        """Measure with the pilot's cycle; None if this computer can not keep it."""
        session, group = self._session, self._group
        header = recording_header(session.machine, group, pilot.cycle_time, with_lengths=False)
        with (
            RecordingWriter(session.folder.recording, header) as recording,
            keeping(session.folder, recording, group) as keep,
        ):
            session.screen.stage("Check that every axis moves the right way")
            session.screen.say(small_moves(self._axes))
            late = group.late_cycles
            check_directions(group, self._axes, pilot.cycle_time, keep)
            rows = sum(e.samples for e in recording.recording.experiments)
            if group.late_cycles - late > LATE_SHARE * max(rows, 1) and not last:
                session.warn(
                    f"{group.late_cycles - late} of {rows} cycles of {pilot.cycle_time * 1000:g} ms "
                    "began late on this computer: the next longer cycle is tried."
                )
                return None
            session.screen.stage("Measure, pilot: weak, to find noise, friction and modes")
            seconds = self._run(pilot, self._setting, keep)
            session.screen.stage("Read the pilot, and plan the main experiments")
            main, known = self._plan_after(recording.recording, pilot)
            session.screen.stage("Measure, main experiments: all axes at once")
            return seconds + self._run(main.plan, known, keep)

    def _run(
        self, plan: MultisinePlan, setting: Setting, keep: Callable[[Experiment], None]
    ) -> float:
        errors = experiment_peaks(plan, setting)[:, FOLLOWING_ERROR, :]
        report = self._session.screen.progress
        begun: list[Experiment] = []

        def noting(experiment: Experiment) -> None:
            begun.append(experiment)
            keep(experiment)

        try:
            return run_multisine(self._group, plan, self._axes, noting, report, errors)
        except StoppedError as error:
            done = sum(one.complete for one in begun)
            following = plan.experiments[done].name if done < len(plan.experiments) else ""
            judge_stop(error, begun, following, self._axes, plan.cycle_time, keep)
            raise

    def _plan_all(self, cycle_time: float) -> MultisinePlan:
        """Plan with the prior model, and show it; nothing has moved yet."""
        screen = self._session.screen
        screen.stage("Plan pilot and main experiments with the machine as last accepted")
        planned, pilot = planned_before(
            self._group, self._setting, cycle_time, self._times, screen.doing
        )
        for note in _longer_than_asked(planned, self._asked):
            self._session.warn(note)
        for note in window_notes(self._group, self._setting):
            self._session.warn(note)
        screen.fast_plan(planned)
        return pilot

    def _read(self, recording: Recording, cycle_time: float) -> tuple[PilotFindings, Setting]:
        """Return what the pilot found, and the machine by it; refuse what it shows to be wrong."""
        session = self._session
        session.screen.doing("find noise, friction and modes in the pilot")
        found = read_pilot(recording, self._setting.model)
        check_torque_scale(found.torque_ratio, self._setting.model)
        for note in found.notes:
            session.warn(note)
        if longest_cycle(found.model) < cycle_time:
            session.warn(
                f"The pilot puts a mode at {mode_band(found.model)[1]:.3g} Hz, too fast for the cycle "
                f"of {cycle_time * 1000:g} ms; its model is not used, the plan rests on the prior "
                "model. Friction that holds an axis looks like a stiff spring."
            )
            found = replace(found, model=self._setting.model, friction=None)
        if found.model is not self._setting.model:
            modes = ", ".join(f"{w / (2 * np.pi):.2f}" for w in undamped_modes(found.model)[0])
            session.screen.say(f"Resonances found: {modes} Hz." if modes else "The axes are rigid.")
        known = replace(self._setting, model=found.model)
        check_loops(known)
        return found, known

    def _plan_after(
        self, recording: Recording, pilot: MultisinePlan
    ) -> tuple[PlannedFast, Setting]:
        """Plan the main experiments with what the pilot found, and return what that is."""
        session = self._session
        found, now_known = self._read(recording, pilot.cycle_time)
        main = plan_main(
            now_known,
            pilot.cycle_time,
            found.noise,
            self._times,
            self._wanted,
            SEED + 1,
            self._offsets,
            session.screen.doing,
        )
        taken = torques_of(recording.experiments)
        if found.friction is None:
            main = self._gentler(main, taken, pilot)
        else:
            main = freed_of_friction(main, now_known, found.noise, found.friction)
            beside = np.maximum(taken - torques_foreseen(pilot, now_known), 0.0)
            main = with_room_for_torque(main, now_known, found.noise, beside)
        for note in main.plan.notes:
            session.screen.say(note)
        if now_known.model is not self._setting.model:
            main = replace(main, rests_on="pilot's model")
        session.screen.fast_plan(main)
        return main, now_known

    def _gentler(self, main: PlannedFast, taken: FloatArray, pilot: MultisinePlan) -> PlannedFast:
        """Return a plan that rests on a model which does not explain the pilot, so much weaker.

        By what axes' torques were in the pilot, over what that model had foreseen.
        """
        more = float(np.max(taken / torques_foreseen(pilot, self._setting)))
        if more <= 1.0:
            return main
        self._session.warn(
            f"In the pilot the torques went up to {more:.3g} times what the model says: the main "
            "experiments are made so much weaker."
        )
        return replace(main, plan=main.plan.scaled(1 / more))
