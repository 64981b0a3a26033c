"""The machine has the last word: old and new parameters are tried by the same short test.

The old ones first, with what the drives hold; then, inside the write's transaction and before anything
is stored, the new ones.  What the trial raises takes the write back.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from drives.canopen_drive import CanopenGroup
from drives.errors import (
    STOPPED_AT_REST,
    DrivesError,
    NotVerifiedError,
    OscillationError,
    SafetyStopError,
    StoppedError,
    UserStopError,
)
from drives.parameters import Change
from drives.parameters.journal import State
from fieldtool.design.servo import Servo
from fieldtool.design.tuning import SOFTEST, Tuning, why_not_stored
from fieldtool.design.verdict import Comparison, doubts, faults, strayed
from fieldtool.errors import (
    FieldtoolError,
    IdentificationError,
    OutputError,
    PlanRefusedError,
)
from fieldtool.experiment.axes import Axes, torque_limits
from fieldtool.experiment.verification.oscillation import HOLD_LEVEL, LOUDEST
from fieldtool.experiment.verification.steps import nudge_size
from fieldtool.experiment.verification.trial import Tried, run_trial, still_allowed
from fieldtool.records.model import FloatArray, MachineModel
from fieldtool.records.recording import Experiment, RecordingWriter
from fieldtool.records.yaml_file import write_yaml
from fieldtool.report.verification_picture import (
    History,
    draw_verification,
    foreseen_move,
    same_times,
)
from fieldtool.workflow.preparation import axes_of, recording_header, setting_of
from fieldtool.workflow.rescued import keeping
from fieldtool.workflow.session import Session
from fieldtool.workflow.trial_checks import check_no_worse
from fieldtool.workflow.trial_guards import TrialGuards
from fieldtool.workflow.trial_plan import (
    TrialPlan,
    encoder_swing,
    no_room,
    plan_trial,
    torque_steps,
    wait_for_standstill,
)
from fieldtool.workflow.trial_records import TrialRecords
from fieldtool.workflow.verified import Verdict, Verified
from fieldtool.writeback.earlier import other_than_first
from fieldtool.writeback.temporary import backed_up

TRIALS = 3
"""Times that a trial is begun at most, where this computer was late in a move."""
WEIGHTLESS = 1 / 3
"""Share of the work that may be missing in a nudge, below which torques at rest are as good a nudge
farther on: from there a nudge misses three times as much by a weight as from where it was known."""
LOUDER = 1.5
"""Times its swing with the old parameters by which a torque may swing at rest."""


class Verification:
    """The trial of one write; its steps are called in order: plan, before, prove, ended.

    Parameters
    ----------
    session
        Its folder gets ``verification.yaml``, ``verification.png`` and the raw data.
    group
        Of the machine; all drives disabled.
    tuning
        What is to be written.
    model
        Of the machine.
    believed
        Whether it was identified; else it is the prior model, and what it predicts is not judged by.
    """

    def __init__(
        self,
        session: Session,
        group: CanopenGroup,
        tuning: Tuning,
        model: MachineModel,
        *,
        believed: bool,
    ) -> None:
        self._session, self._group, self._believed = session, group, believed
        self._stated = (
            {axis.axis: axis.sensitivity_peak for axis in tuning.axes} if believed else {}
        )
        self._bound, self._tuning = tuning.bound, tuning
        self.not_stored = why_not_stored(tuning.bound, identified=believed)
        """Why the new parameters are not stored even if they stand their trial; empty if they may be."""
        self._setting = setting_of(session.machine, group, model)
        self._axes: Axes = axes_of(group, self._setting)
        self._plan: TrialPlan | None = None
        self._changes: tuple[Change, ...] = ()
        self._old: Tried | None = None
        self._guards: TrialGuards | None = None
        self._recorder: RecordingWriter | None = None
        self._histories: list[tuple[Comparison, History, History]] = []
        self.result: Verified | None = None
        """What the trial showed; ``verified`` is no more than a judgement before :meth:`ended`."""

    def plan(self, changes: Sequence[Change]) -> TrialPlan:
        """Plan the trial for what a write changes; nothing moves.

        Raises
        ------
        PlanRefusedError
            If the new parameters are not stable by the model, or nothing may move.
        """
        self._changes = tuple(changes)
        try:
            wait_for_standstill(self._group)
        except PlanRefusedError as error:
            raise PlanRefusedError(f"{error} Nothing was moved or written.") from None
        self._plan = self._plan_here()
        return self._plan

    def _plan_here(self) -> TrialPlan:
        designed = self._tuning.prediction if self._believed else None
        plan = plan_trial(
            self._group, self._setting, self._changes, self._bound, self._stated, designed
        )
        if self._believed and self._tuning.response != SOFTEST:
            check_no_worse(plan.before, plan.after, plan.trial.cycle_time)
        for note in plan.notes:
            self._session.warn(note)
        return plan

    def before(self) -> None:
        """Try the parameters that are in the drives.

        Raises
        ------
        OscillationError
            If an axis swings or runs away with them; nothing was written.
        StoppedError
            If a limit was passed, or the user stopped.
        """
        plan = self._planned
        self._session.screen.stage(
            "Try the old parameters: hold still, small moves, small excitation"
        )
        self._session.screen.say(_what_moves(plan, self._axes))
        name, path = self._session.machine.name, self._session.folder.parameters_before
        with backed_up(name, self._group.drives, path) as held, self._recording() as keep:
            try:
                self._old = self._run("before", keep, trusts_loops=True)
            except (OscillationError, IdentificationError) as error:
                error.add_note(
                    "That was with the parameters that are in the drives now, in a trial before "
                    "anything was written; nothing was. If the axis swings, lower its gains by hand "
                    "(velocity_i, then position_p and velocity_p); if it sags as it is enabled, or "
                    "another one pushes it away, raise velocity_i and position_p. Then measure and "
                    "design anew: `fieldtool run`. If you have seen that it only sags by its weight, "
                    "`sag` in its limits in the machine profile may say how far."
                )
                if note := other_than_first(held):
                    error.add_note(note)
                raise

    def prove(self) -> None:
        """Try the parameters that were just written into working memory.

        Raises
        ------
        NotVerifiedError
            If they swing, are worse than the old ones, or not as predicted.
        UserStopError
            If the user stopped.
        """
        self._session.screen.stage(
            "Try the new parameters: hold still, small moves, small excitation"
        )
        tried: Tried | None = None
        reasons: tuple[str, ...] = ("the trial was cut short",)
        try:
            with self._recording() as keep:
                tried = self._run("after", keep, trusts_loops=False)
            reasons = self._judge(tried)
            self._heed_stop()
        except UserStopError:
            reasons = ("the user stopped the trial",)
            raise
        except (StoppedError, FieldtoolError) as error:
            reasons = (str(error),)
            failed = NotVerifiedError(f"the new parameters do not stand their trial: {error}")
            for note in getattr(error, "__notes__", ()):
                failed.add_note(note)
            raise failed from error
        finally:
            self._close()
            self._conclude(tried, reasons)
        if reasons:
            raise NotVerifiedError(
                f"the new parameters do not stand their trial: {'; '.join(reasons)}"
            )

    @property
    def _records(self) -> TrialRecords:
        return TrialRecords(self._planned, self._axes, self._setting.model)

    @property
    def _planned(self) -> TrialPlan:
        if self._plan is None:
            raise AssertionError("a trial is planned first")
        return self._plan

    def _run(self, name: str, keep: Callable[[Experiment], None], *, trusts_loops: bool) -> Tried:
        """Do a trial; once more where this computer was late in a move, which stopped it.

        That is no word on the loops.  All drives are disabled in between, and nothing begins anew that
        a person stopped, that left anything to be said, or that may have changed what is known; nor
        anything after an alarm, whatever may have made it, but the old parameters' trial once.
        """
        began = [drive.read_position() for drive in self._group.drives]
        swung = name != "before"
        for left, label in zip(reversed(range(TRIALS)), _labels(name), strict=True):
            try:
                return self._try(name, label, keep, trusts_loops=trusts_loops)
            except SafetyStopError as error:
                times = f"{left} time{'s' if left > 1 else ''} at most"
                why = f"That says nothing of the loops: the trial is begun again, {times}"
                if isinstance(error, OscillationError) and error.held_up:
                    late = (
                        f"Shortly before, this computer was {1000 * error.held_up:.0f} ms late in the "
                        "move: that alone may have done it"
                    )
                    if swung:  # the loops may swing by themselves
                        error.add_note(f"{late}. Close other programs, and write again.")
                    swung, why = True, f"{late}, and the trial is begun again"
                if not left or not error.held_up or hasattr(error, "__notes__"):
                    raise
                if blocked := self._blocked(began, name):
                    error.add_note(f"The trial could not be begun again: {blocked}")
                    raise
                self._session.warn(f"{error} {why}.")
                if name == "before":
                    self._guards = None  # it begins where the axes stand now, and learns anew
        raise AssertionError("the last trial ends or raises")

    def _blocked(self, began: Sequence[float], name: str) -> str:
        """Say why a trial can not be begun again where the axes stand now; empty if it can.

        The old parameters' trial begins from anywhere, by other moves where there is no room for those
        that were planned, and learns anew.  With the new ones it is compared with torques at rest that
        are known where the old one began, and where no weight shows as far from there as a nudge goes.

        Raises
        ------
        UserStopError
            If a person stopped meanwhile.
        """
        self._heed_stop()
        try:
            wait_for_standstill(self._group)
            if text := no_room(self._group, self._planned.trial):
                if name != "before":
                    return text
                try:
                    self._plan = self._plan_here()
                except PlanRefusedError as error:
                    return f"{text} {error}"
                self._session.screen.say(_what_moves(self._plan, self._axes))
            now = [drive.read_position() for drive in self._group.drives]
        except UserStopError:
            raise
        except (DrivesError, FieldtoolError) as error:
            return str(error)
        self._heed_stop()
        if name == "before":
            return ""
        ways = {move.axis: nudge_size(move, self._axes) for move in self._planned.trial.moves}
        weightless = self._guards is not None and self._guards.missing < WEIGHTLESS
        nudges = [weightless * abs(ways.get(k, 0.0)) for k in range(len(now))]
        far = np.abs(np.subtract(now, began)) > still_allowed(self._axes) + nudges
        away = [axis for axis, is_far in zip(self._axes.names, far, strict=True) if is_far]
        return f"{', '.join(away)} is not where it began. Write again." if away else ""

    def _heed_stop(self) -> None:
        if self._group.stop_requested():
            raise UserStopError(STOPPED_AT_REST)

    def _try(
        self, name: str, label: str, keep: Callable[[Experiment], None], *, trusts_loops: bool
    ) -> Tried:
        servos = self._planned.old if name == "before" else self._planned.new
        cycle = self._planned.trial.cycle_time
        pairs = zip(self._group.drives, servos, strict=True)
        wait_for_standstill(self._group)
        if self._guards is None:
            self._guards = TrialGuards(self._group, self._axes, cycle, self._session.warn)
        tried = run_trial(
            self._group,
            self._planned.trial,
            self._axes,
            keep,
            label,
            trusts_loops=trusts_loops,
            louder=self._louder(servos),
            steps=np.array([torque_steps(drive, servo, cycle) for drive, servo in pairs]),
            fed=np.array([servo.fed for servo in servos]).T,
            sags=None if self._old is None else self._old.sags,
            guards=self._guards.of(servos, self._old),
            report=self._session.screen.progress,
            exciting=partial(self._ready_to_excite, servos),
        )
        self._guards.learn()
        return tried

    @contextmanager
    def _ready_to_excite(self, servos: Sequence[Servo]) -> Iterator[None]:
        """Wait for standstill; where references excite, feed-forward would take most of the limits."""
        lines = self._planned.lines
        by_reference = lines is not None and not np.all(lines.by_torque)
        wait_for_standstill(self._group)
        with self._group.without_feed_forward() if by_reference else nullcontext():
            if by_reference and self._guards is not None:
                self._guards.without_feed_forward(servos)
            yield

    def _louder(self, servos: Sequence[Servo]) -> FloatArray:
        """Return times the usual level by which torques may swing at rest: what encoders' steps do."""
        limits = torque_limits(self._axes.limits)
        pairs = zip(self._group.drives, servos, strict=True)
        swings = np.array([encoder_swing(drive, servo) for drive, servo in pairs])
        if self._old is not None:
            swings = np.maximum(swings, LOUDER * self._old.noise)
        louder: FloatArray = np.clip(swings / (HOLD_LEVEL * limits), 1.0, LOUDEST)
        return louder

    @contextmanager
    def _recording(self) -> Iterator[Callable[[Experiment], None]]:
        """Give what keeps raw data, in one file for both trials; rows are saved while axes move."""
        if self._recorder is None:
            header = recording_header(
                self._session.machine,
                self._group,
                self._planned.trial.cycle_time,
                with_lengths=False,
            )
            path = _free(self._session.folder.path / "verification.h5")
            self._recorder = RecordingWriter(path, header)
        try:
            with keeping(self._session.folder, self._recorder, self._group) as keep:
                yield keep
        except BaseException:
            self._close()
            raise

    def _close(self) -> None:
        if self._recorder is not None:
            self._recorder.close()
            self._recorder = None

    def _judge(self, tried: Tried) -> tuple[str, ...]:
        plan, soft = self._planned, self._tuning.response == SOFTEST
        return tuple(
            text
            for one in self._records.compared(self._old, tried)
            for text in faults(
                one, plan.trial.cycle_time, self._bound, believed=self._believed, softer=soft
            )
        )

    def _conclude(self, tried: Tried | None, reasons: tuple[str, ...]) -> None:
        """Say what was found; what the drives are left with is not known yet."""
        compared = self._records.compared(self._old, tried)
        self._histories = [
            (one, self._records.history(self._old, k), self._records.history(tried, k))
            for k, one in enumerate(compared)
        ]
        moves = (
            same_times(one, before, foreseen_move(self._planned.after, k), after)
            for k, (one, before, after) in enumerate(self._histories)
        )
        cycle = self._planned.trial.cycle_time
        doubtful: list[str] = []
        for one in () if reasons else compared:
            doubtful += strayed(one)
            doubtful += doubts(one, cycle) if self._believed else ()
        told = (*self._records.notes(compared), *doubtful)
        self.result = Verified(
            "restored" if reasons else "verified",
            reasons,
            compared,
            self._changes,
            self._bound,
            "identified" if self._believed else "prior",
            cycle,
            (*self._planned.notes, *told),
            tuple(moves),
        )
        self._session.screen.verified(self.result)
        for text in told:  # what was planned was said then
            self._session.warn(text)

    def ended(self, error: BaseException | None, held: State) -> None:
        """Keep what came of it, once the write has ended: ``verified`` only if the new values are held.

        Neither a disk that is full nor a picture that can not be drawn hides it.

        Parameters
        ----------
        error
            What took the write back, or came when it had ended; None: nothing.
        held
            What the drives hold by the write's journal.
        """
        if self.result is None:
            return
        if held is not State.NEW:
            reasons = self.result.reasons
            if error is not None and (not reasons or held is State.OPEN):
                reasons = (*reasons, str(error) or type(error).__name__)
            verdict: Verdict = "mixed" if held is State.OPEN else "restored"
            self.result = replace(self.result, verdict=verdict, reasons=reasons)
        folder = self._session.folder
        folder.note("verified", verdict=self.result.verdict, reasons=list(self.result.reasons))
        try:
            write_yaml(folder.verification, self.result.as_dict())
        except OutputError as failed:
            self._session.warn(str(failed))
        try:
            picture = folder.verification_picture
            draw_verification(self._histories, self._planned.after, self._bound, picture)
        except Exception as failed:
            self._session.warn(f"{folder.verification_picture}: not drawn ({failed})")


def _labels(name: str) -> tuple[str, ...]:
    """Return what the experiments of each trial are called after: names are given once."""
    return (name, *(f"{name}, begun again ({k})" for k in range(1, TRIALS)))


def _what_moves(plan: TrialPlan, axes: Axes) -> str:
    ways = ", ".join(
        f"{move.axis} by {move.distance:.3g} {axes.unit(k)} at up to {move.velocity:.3g} "
        f"{axes.unit(k)}/s"
        for k, move in enumerate(plan.moves)
    )
    return (
        f"About {plan.trial.duration:.0f} s: {ways}, each out and back"
        f"{'; then all a little at the same time' if plan.trial.excitation else ''}."
    )


def _free(path: Path) -> Path:
    """Return the path, or the next one with a number that is not there yet."""
    number, candidate = 2, path
    while candidate.exists():
        candidate = path.with_name(f"{path.stem}-{number}{path.suffix}")
        number += 1
    return candidate
