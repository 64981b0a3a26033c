"""What the stages of one session share: options, screen, folder, connected drives."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal, Protocol

import yaml

from drives.bus import not_imitated
from drives.canopen_drive import CanopenGroup
from drives.canopen_drive.interrupts import uninterrupted
from drives.parameters import Change, Written
from drives.profile import MachineProfile, load_machine
from drives.trace import trace_problem
from fieldtool.criticise.criticism import Criticism
from fieldtool.design.tuning import Tuning
from fieldtool.errors import OutputError
from fieldtool.experiment.forecast import AxisForecast
from fieldtool.experiment.multisine.runner import MultisineProgress
from fieldtool.experiment.stepped.plan import SweepPlan
from fieldtool.experiment.stepped.runner import Progress
from fieldtool.identify.recorded import Identified
from fieldtool.records.model import MachineModel
from fieldtool.records.recording import whole_kinds
from fieldtool.records.session_folder import SessionFolder
from fieldtool.records.yaml_file import write_yaml
from fieldtool.workflow.planning import PlannedFast
from fieldtool.workflow.verified import Verified
from fieldtool.writeback.alone import connected
from fieldtool.writeback.temporary import left_axes, left_words
from fieldtool.writeback.transaction import WriteBack
from fieldtool.writeback.unfinished import is_left_open, refuse_unfinished

PlanName = Literal["classic", "fast"]


class Screen(Protocol):
    """What a session tells while it runs; the command line shows it, scripts may ignore it."""

    def stage(self, title: str) -> None:
        """A new stage begins."""

    def say(self, sentence: str) -> None:
        """Something that a person should know."""

    def doing(self, what: str, share: float | None = None) -> None:
        """Something is computed that may take a while; ``share`` of it is done, 0 to 1, where known."""

    def plan(self, plan: SweepPlan, expected: Sequence[AxisForecast], duration: float) -> None:
        """A plan was made and checked; nothing of it has moved yet."""

    def fast_plan(self, planned: PlannedFast) -> None:
        """A fast plan was made and checked; nothing of it has moved yet."""

    def progress(self, progress: Progress | MultisineProgress) -> None:
        """A block of a sweep ended."""

    def ready(self) -> bool:
        """Whether the machine may move now; asked once, after the first plan was shown."""

    def found(self, model: MachineModel, truth: MachineModel | None) -> None:
        """The machine was identified; the truth is known of simulated machines only."""

    def designed(self, tuning: Tuning) -> None:
        """New parameters were designed; nothing was written."""

    def verified(self, result: Verified) -> None:
        """New parameters were tried on the machine; those that did not stand it are taken back."""

    def not_put_back(self, axes: Sequence[str], sentence: str) -> None:
        """The session has done all it was to do, but drives of these axes are not as they were."""


class Quiet:
    """A screen that shows nothing."""

    def stage(self, title: str) -> None:
        """Show nothing."""

    def say(self, sentence: str) -> None:
        """Show nothing."""

    def doing(self, what: str, share: float | None = None) -> None:
        """Show nothing."""

    def plan(self, plan: SweepPlan, expected: Sequence[AxisForecast], duration: float) -> None:
        """Show nothing."""

    def fast_plan(self, planned: PlannedFast) -> None:
        """Show nothing."""

    def progress(self, progress: Progress | MultisineProgress) -> None:
        """Show nothing."""

    def ready(self) -> bool:
        """Return True: who runs a session without a screen has decided."""
        return True

    def found(self, model: MachineModel, truth: MachineModel | None) -> None:
        """Show nothing."""

    def designed(self, tuning: Tuning) -> None:
        """Show nothing."""

    def verified(self, result: Verified) -> None:
        """Show nothing."""

    def not_put_back(self, axes: Sequence[str], sentence: str) -> None:
        """Show nothing: it is among the warnings."""


_NO_USE_TO_WRITE = ("plan", "excitation_time", "response", "motor_inertia")
"""Options that say nothing of a session which only writes: its parameters were designed before."""


@dataclass(frozen=True)
class Options:
    """How a session is run."""

    plan: PlanName = "fast"
    excitation_time: float | None = None
    """Seconds of excitation that the fast plan may take; its own choice where None."""
    write: bool = False
    store: bool = False
    verify: bool = True
    """Try old and new parameters on the machine when they are written; without, nothing is stored."""
    response: str = "normal"
    """Of the design: a name of :data:`fieldtool.design.tuning.RESPONSES`."""
    motor_inertia: Literal["measured", "data sheet"] = "measured"
    trace: Path | None = None
    """File that every frame of the session is noted in; none where it is None."""

    def as_dict(self, command: str = "") -> dict[str, Any]:
        """Plain values, as a session's log keeps them: of those that the command uses."""
        values = {**asdict(self), "trace": self.trace.name if self.trace else None}
        unused = _NO_USE_TO_WRITE if command in ("write", "tools") else ()
        return {key: value for key, value in values.items() if key not in unused}


@dataclass(frozen=True)
class SessionResult:
    """What a session found and did."""

    folder: Path
    model: MachineModel
    identified: Identified
    tuning: Tuning
    write_back: WriteBack | None
    truth: MachineModel | None
    """What the simulated machine really is; None for a real one."""
    machine_time: float
    """Seconds of excitation."""
    wall_time: float
    """Seconds."""
    warnings: tuple[str, ...]
    criticism: Criticism | None = None
    """What the simulation gets wrong; None where the data did not allow a criticism."""
    verification: Verified | None = None
    """What the trial of the new parameters showed; None where nothing was written or tried."""
    moving_time: float = 0.0
    """Seconds that were recorded in all: direction check, excitation, trials of parameters."""

    def as_dict(self) -> dict[str, Any]:
        """Plain values, as ``--json`` prints them."""
        return {
            "model": self.model.as_dict(),
            "criticism": self.criticism.as_dict() if self.criticism else None,
            "truth": self.truth.as_dict() if self.truth else None,
            "time": {
                "excitation_s": self.machine_time,
                "machine_s": self.machine_time,  # as it was called before
                "moving_s": self.moving_time,
                "wall_s": self.wall_time,
            },
            "written": self.write_back is not None and self.write_back.in_memory,
            "stored": self.write_back is not None and self.write_back.stored,
            "parameters": parameter_table(self.write_back),
            "verification": self.verification.as_dict() if self.verification else None,
            "warnings": list(self.warnings),
            "folder": str(self.folder),
        }


@dataclass
class Session:
    """What the stages of one session share."""

    folder: SessionFolder
    machine: MachineProfile
    screen: Screen
    warnings: list[str] = field(default_factory=list)
    write_back: WriteBack | None = None
    """Of a write that has ended."""

    def ready(self) -> bool:
        """Ask whether the machine may move."""
        return self.screen.ready()

    def warn(self, sentence: str) -> None:
        """Show a sentence and keep it for the result; the same one only once."""
        if sentence not in self.warnings:
            self.warnings.append(sentence)
            self.screen.say(sentence)
            self.folder.note("warning", text=sentence)


def never() -> bool:
    """Return False: nobody asks for a stop."""
    return False


@contextmanager
def open_session(
    machine: str | Path | MachineProfile,
    out: Path,
    screen: Screen | None,
    stop_requested: Callable[[], bool],
    keep_profile: bool = False,
    command: str = "",
    options: Options | None = None,
) -> Iterator[tuple[Session, CanopenGroup]]:
    """Make the session folder, connect to the machine, and note how it ended.

    Parameters
    ----------
    machine
        Name or file of a machine profile, or the profile.
    out
        Session folder; made if missing.
    screen
        Is told what happens; None shows nothing.
    stop_requested
        Asked in every cycle of a motion.
    keep_profile
        Leave the folder's machine profile as it is.
    command, options
        What is done, for the session's log; with the file that every frame is noted in.
    """
    options = options or Options()
    profile = machine if isinstance(machine, MachineProfile) else load_machine(machine)
    folder = SessionFolder.create(out)
    if not keep_profile:
        if folder.recording.exists():
            raise OutputError(
                f"{out}: already holds a session's recording, which is not overwritten. Choose another "
                "folder with --out. Nothing was moved."
            )
        write_yaml(folder.machine, resolved(profile))
    session = Session(folder, profile, screen or Quiet())
    folder.note(
        "session",
        machine=profile.name,
        version=version("fieldtool"),
        command=command,
        options=options.as_dict(command),
    )
    session.screen.stage(f"Connect to {profile.name}")
    try:
        with connected(profile, stop_requested=stop_requested, trace=options.trace) as group:
            for text in group.recovered:
                session.warn(text)
            refuse_unfinished(profile.name, group.drives, folder.path)
            for drive in group.drives:
                identity = drive.identity
                folder.note("drive", axis=drive.axis, node=drive.node_id, name=identity.device_name)
            left_out = not_imitated(group.line.can_bus)
            if left_out:
                session.warn(
                    "SIMULATED machine: nothing real moves. What it does not imitate of a real bus: "
                    + "; ".join(left_out)
                    + "."
                )
            try:
                yield session, group
            except BaseException as error:
                # what an earlier motion left matters all the more now
                left = left_axes(group.drives) if is_left_open(folder.path) else []
                for text in (*group.warnings, *([left_words(left, folder.path)] if left else ())):
                    if text not in getattr(error, "__notes__", ()):
                        error.add_note(text)
                raise
            for text in (*group.warnings, trace_problem(group.line.can_bus)):
                if text:
                    session.warn(text)
            if left := left_axes(group.drives):
                session.warn(left_words(left, folder.path))
                session.screen.not_put_back(left, left_words(left, folder.path))
    except BaseException as error:
        with uninterrupted():  # nothing may hide why it ended
            folder.note("ended", error=type(error).__name__, text=str(error))
            if session.write_back is not None and session.write_back.way_back:
                error.add_note(session.write_back.way_back)
            if not keep_profile and folder.recording.is_file():
                error.add_note(_kept(folder))
        raise
    folder.note("ended")


def _kept(folder: SessionFolder) -> str:
    """Say where a session that an error has ended left its data, and whether they are of use."""
    words = (
        f"What was measured is kept in {folder.path}: `fieldtool report {folder.path}` shows it."
    )
    try:
        if whole_kinds(folder.recording) & {"multisine", "stepped_sine"}:
            return words
    except Exception:  # of whatever kind: why the session ended says more
        return words
    return (
        f"{words} No whole experiment that excites the axes is in it, so no machine can be identified "
        "from it: measure again, into another folder."
    )


def resolved(profile: MachineProfile) -> dict[str, Any]:
    """Return the profile as its file has it, with drive profiles found from the folder too.

    The bus is the one that is used, which may be another one than the file's.  Passwords stay out.
    """
    data: dict[str, Any] = yaml.safe_load(profile.path.read_text(encoding="utf-8"))
    data["bus"] = profile.bus.as_dict()
    simulated = (data.get("simulation") or {}).get("axes", ())
    faces = [axis["face"] for axis in simulated if isinstance(axis.get("face"), dict)]
    for part, key in (*((a, "drive") for a in data["axes"]), *((f, "profile") for f in faces)):
        beside = profile.path.parent / str(part[key])
        if beside.is_file():
            part[key] = str(beside.resolve())
    for part in (*data["axes"], *faces):
        if part.get("eds"):
            part["eds"] = str((profile.path.parent / str(part["eds"])).resolve())
        part.pop("password", None)
    return data


def parameter_table(write_back: WriteBack | None) -> list[dict[str, Any]]:
    """Return one row a parameter: axis, name, unit, before, after, read_back (null: not written)."""
    if write_back is None:
        return []
    read_back = {(w.change.axis, w.change.name): w for w in write_back.written}

    def row(change: Change) -> dict[str, Any]:
        written: Written | None = read_back.get((change.axis, change.name))
        return {
            "axis": change.axis,
            "name": change.name,
            "unit": change.unit,
            "before": change.before,
            "after": change.after,
            "read_back": written.read_back if written else None,
        }

    return [row(change) for change in write_back.changes]
