"""Measure what tells a cause from its rivals, where a criticism left a tie."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from drives.canopen_drive import CanopenGroup
from drives.profile import MachineProfile, load_machine
from fieldtool.criticise.criticise import Criticised, criticise, starting_model
from fieldtool.criticise.criticism import Cause, Criticism, Rejected, Rival
from fieldtool.criticise.criticism_file import read_criticism
from fieldtool.criticise.separate import DECISIVE, Separation, separation
from fieldtool.errors import FileFormatError, NotEnoughDataError, PlanRefusedError
from fieldtool.experiment.forecast import Setting
from fieldtool.experiment.multisine.design import SHARE_OF_LIMITS
from fieldtool.experiment.multisine.forecast import forecast_multisine, scaled_to_limits
from fieldtool.experiment.multisine.plan import MultisinePlan
from fieldtool.frf.velocity_band import white_noise
from fieldtool.identify.likelihood.expected import Noise, expected_accuracy
from fieldtool.records.model import MachineModel
from fieldtool.records.model_file import write_model
from fieldtool.records.recording import Recording, load, save
from fieldtool.records.same_axes import axes_differ
from fieldtool.records.session_folder import SessionFolder
from fieldtool.workflow.criticising import alike, keep
from fieldtool.workflow.fast_measuring import SEED, FastMeasurement
from fieldtool.workflow.models import model_of, prior_model
from fieldtool.workflow.planning import PlannedFast, Wanted, excitations, plan_main, plan_pilot
from fieldtool.workflow.proposals import Ground, Proposal, expected_data, proposals
from fieldtool.workflow.reporting import report
from fieldtool.workflow.session import Options, Screen, Session, never, open_session
from fieldtool.writeback.temporary import backed_up

SAME_CYCLE = 1e-9
"""s: cycle times that differ by less are the same."""
EARLIER = "earlier"
"""Stands before the names of experiments that were measured before."""


@dataclass(frozen=True, eq=False)
class Question:
    """A session whose criticism left a tie."""

    folder: SessionFolder
    recording: Recording
    model: MachineModel
    prior: MachineModel | None
    criticism: Criticism
    cause: Cause

    @property
    def words(self) -> str:
        """Cause and rivals in words."""
        rivals = " or ".join(t.effect for t in self.cause.ties)
        return f"{self.cause.effect} or {rivals}, {self.cause.axis_words}"


@dataclass(frozen=True)
class Distinguished:
    """What a measurement that was to tell rivals apart came to."""

    folder: Path
    question: str
    answer: str
    """One sentence."""
    criticism: Criticism
    machine_time: float

    def as_dict(self) -> dict[str, Any]:
        """Plain values, as ``--json`` prints them."""
        return {
            "folder": str(self.folder),
            "question": self.question,
            "answer": self.answer,
            "criticism": self.criticism.as_dict(),
            "time": {"excitation_s": self.machine_time, "machine_s": self.machine_time},
        }


def question_of(folder_path: Path, machine: MachineProfile) -> Question:
    """Read a session whose criticism left a tie.

    Raises
    ------
    FileFormatError
        If the folder lacks model, recording or criticism, or is of another machine.
    PlanRefusedError
        If its criticism leaves no tie.
    """
    folder = SessionFolder.existing(folder_path)
    folder.needed(folder.criticism, "`fieldtool criticise` on this folder")
    model, recording = model_of(machine, folder.model), load(folder.recording)
    if differ := axes_differ(recording.axes, f"the machine {machine.name}", machine.axes):
        raise FileFormatError(folder.recording, f"{differ}, or measure the machine anew.")
    criticism = read_criticism(folder.criticism, model)
    tied = [c for c in criticism.causes if c.ties]
    if not tied:
        raise PlanRefusedError(
            f"{folder_path}: its criticism leaves no tie (verdict: {criticism.verdict}), so there "
            "is nothing to tell apart. Nothing was moved."
        )
    return Question(
        folder, recording, model, alike(prior_model(machine), model), criticism, tied[0]
    )


def distinguish(
    machine: str | Path | MachineProfile,
    earlier: Path,
    out: Path,
    options: Options | None = None,
    *,
    screen: Screen | None = None,
    stop_requested: Callable[[], bool] = never,
) -> Distinguished:
    """Plan and run the experiment that tells a cause from its rivals; criticise all data together.

    Parameters
    ----------
    machine
        Name or file of a machine profile, or the profile.
    earlier
        Session folder whose criticism left a tie; it stays as it is.
    out
        New session folder: it gets both recordings.
    options, screen, stop_requested
        As for :func:`fieldtool.workflow.measure`.

    Raises
    ------
    PlanRefusedError
        If there is no tie, or nothing within the limits could decide it; nothing was moved.
    DrivesError, FieldtoolError
        As :func:`fieldtool.workflow.run`.
    """
    options = options or Options()
    profile = machine if isinstance(machine, MachineProfile) else load_machine(machine)
    question = question_of(earlier, profile)
    with open_session(
        profile, out, screen, stop_requested, command="distinguish", options=options
    ) as (session, group):
        session.folder.note("question", earlier=str(earlier), words=question.words)
        before = session.folder.parameters_before
        with backed_up(profile.name, group.drives, before), group.without_feed_forward():
            work = _Distinguishing(session, group, options, question)
            seconds = work.run()
    found, answer = _judged(session, question)
    session.folder.note("answer", words=answer)
    session.screen.say(answer)
    report(session.folder.path)
    return Distinguished(out, question.words, answer, found.criticism, seconds)


def _judged(session: Session, question: Question) -> tuple[Criticised, str]:
    """Put both recordings into the new folder, weigh the rivals, criticise without those that lost."""
    session.screen.stage("Criticise with both recordings")
    folder, cause = session.folder, question.cause
    new = load(folder.recording)
    earlier = tuple(replace(e, name=f"{EARLIER} {e.name}") for e in question.recording.experiments)
    both = replace(new, experiments=(*earlier, *new.experiments))
    save(both, folder.recording)
    write_model(question.model, folder.model)
    start = starting_model(question.model, question.prior)
    apart = separation(both, start, question.criticism, cause, session.screen.doing)
    best, evidence = apart.measured()
    rivals: list[Cause | Rival] = [cause, *cause.ties]
    lost = [r for k, r in enumerate(rivals) if k != best] if evidence >= DECISIVE else []
    elsewhere = {c.effect for c in question.criticism.causes if c is not cause}
    without = frozenset(r.effect for r in lost) - elsewhere - {rivals[best].effect}
    found = criticise(both, question.model, question.prior, without, advance=session.screen.doing)
    told = f"evidence {evidence:.3g}, {DECISIVE:g} decide"
    why = f"was told apart by a measurement ({told})"
    rejected = tuple(Rejected(r.effect, r.axis, r.location, why) for r in lost)
    criticism = replace(found.criticism, rejected=(*rejected, *found.criticism.rejected))
    found = replace(found, criticism=criticism)
    keep(folder, found, question.model)
    if lost:
        names = ", ".join(r.effect for r in lost)
        winner = f"{rivals[best].effect} of {cause.axis_words}"
        return found, f"Told apart: it is {winner}, and not {names} ({told})."
    every = " or ".join(r.effect for r in rivals)
    return found, f"Not told apart: {every} of {cause.axis_words} ({told})."


class _Distinguishing(FastMeasurement):
    """A fast measurement whose experiments are those that tell rivals apart."""

    def __init__(
        self,
        session: Session,
        group: CanopenGroup,
        options: Options,
        question: Question,
    ) -> None:
        self._question = question
        super().__init__(session, group, options)
        step = question.recording.sample_period
        self._cycles = tuple(t for t in self._cycles if abs(t - step) < SAME_CYCLE)
        if not self._cycles:
            raise PlanRefusedError(
                f"{question.folder.path}: was measured with a cycle of {step * 1000:g} ms, which "
                "this bus and machine do not allow now, so both recordings could not be put "
                "together. Nothing was moved."
            )
        self._chosen: MultisinePlan | None = None

    def start_model(self) -> MachineModel:
        """Plan with the machine as it was identified."""
        question = self._question
        return replace(starting_model(question.model, question.prior), effects=())

    def _plan_all(self, cycle_time: float) -> MultisinePlan:
        """Find the experiments that decide, and show them; nothing has moved yet."""
        question, screen = self._question, self._session.screen
        screen.stage(f"Plan what tells apart: {question.words}")
        apart = separation(
            question.recording,
            starting_model(question.model, question.prior),
            question.criticism,
            question.cause,
            screen.doing,
        )
        noise = _noise(question.recording)
        pilot = plan_pilot(self._setting, cycle_time, self._times, SEED, self._offsets)
        main = plan_main(
            self._setting, cycle_time, noise, self._times, Wanted(), SEED + 1, self._offsets,
            screen.doing,
        )  # fmt: skip
        best = self._best(apart, main.plan)
        screen.say(f"Chosen: {best.words}.")
        self._chosen = best.plan
        screen.fast_plan(self._planned(best.plan, noise, pilot))
        return pilot

    def _best(self, apart: Separation, main: MultisinePlan) -> Proposal:
        """Return the first proposal that decides by simulation.

        Raises
        ------
        PlanRefusedError
            If none does.
        """
        question, screen = self._question, self._session.screen
        names = self._setting.model.names
        ground = Ground(
            self._setting, main, tuple(names.index(a) for a in question.cause.axes), self._offsets
        )
        tried: list[tuple[float, Proposal]] = []
        pair = frozenset({question.cause.effect, question.cause.ties[0].effect})
        for proposal in proposals(ground, pair):
            screen.doing(f"try in simulation: {proposal.words}")
            try:
                evidence = apart.expected(expected_data(proposal.plan, self._setting))
            except NotEnoughDataError:
                continue
            screen.say(
                f"{proposal.words}: evidence {evidence:.3g} to expect ({DECISIVE:g} decide)."
            )
            tried.append((evidence, proposal))
            if evidence >= DECISIVE:
                return proposal
        if not tried:
            raise PlanRefusedError(
                f"{question.words}: no experiment that could tell them apart fits the limits. "
                "Nothing was moved. Wider limits, where the machine allows them, give more room."
            )
        evidence, nearest = max(tried, key=lambda t: t[0])
        raise PlanRefusedError(
            f"{question.words}: nothing within the limits would tell them apart; the nearest is "
            f"{nearest.words}, with an evidence of {evidence:.2g} where {DECISIVE:g} decide. "
            "Nothing was moved. Wider limits or more time (--time) would help, or knowing one of "
            "them from a data sheet."
        )

    def _plan_after(
        self,
        recording: Recording,
        pilot: MultisinePlan,
    ) -> tuple[PlannedFast, Setting]:
        """See that the machine is still the one that was planned with, and that all limits are kept."""
        session, chosen = self._session, self._chosen
        if chosen is None:
            raise PlanRefusedError("nothing was planned")
        found, known = self._read(recording, pilot.cycle_time)
        try:
            forecast_multisine(chosen, known)
        except PlanRefusedError:
            chosen = scaled_to_limits(chosen, known, SHARE_OF_LIMITS)
            session.screen.say("By what the pilot has found, the excitation has to be weaker.")
        planned = replace(self._planned(chosen, found.noise, None), rests_on="pilot's model")
        session.screen.fast_plan(planned)
        return planned, known

    def _planned(
        self, plan: MultisinePlan, noise: Noise, pilot: MultisinePlan | None
    ) -> PlannedFast:
        setting = self._setting
        return PlannedFast(
            plan,
            forecast_multisine(plan, setting),
            expected_accuracy(setting.model, excitations(plan, setting), noise),
            Wanted(),
            "machine as identified before",
            pilot,
        )


def _noise(recording: Recording) -> Noise:
    found = [
        np.median([white_noise(getattr(e, what)) for e in recording.experiments], axis=0)
        for what in ("torque", "position")
    ]
    return Noise(found[0], found[1])
