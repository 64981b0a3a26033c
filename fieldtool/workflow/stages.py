"""Whole sessions, and each stage alone: from the session folder to the session folder."""

import time
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np

from drives.bus import not_imitated
from drives.canopen_drive import CanopenGroup
from drives.errors import ProfileError, UserStopError
from drives.parameters import Change
from drives.profile import MachineProfile, load_machine
from fieldtool.design.tuning import Tuning
from fieldtool.design.tuning_file import read_tuning
from fieldtool.errors import FieldtoolError, FileFormatError, NotEnoughDataError, noting
from fieldtool.frf.response import ModelBand, save_responses
from fieldtool.identify.likelihood.model_band import relative_std
from fieldtool.identify.recorded import Identified, identify_recording
from fieldtool.records.model import Estimate, MachineModel
from fieldtool.records.model_file import write_model
from fieldtool.records.recording import load, recorded_seconds
from fieldtool.records.session_folder import SessionFolder
from fieldtool.report.pictures import draw_responses
from fieldtool.workflow.criticising import criticised
from fieldtool.workflow.designing import check_known, designed
from fieldtool.workflow.fast_measuring import measured_fast
from fieldtool.workflow.measuring import measured
from fieldtool.workflow.models import (
    check_believable,
    data_sheet_masses,
    model_of,
    prior_model,
    simulated_words,
    truth_model,
)
from fieldtool.workflow.reporting import renewing_report, report
from fieldtool.workflow.rescued import rescue
from fieldtool.workflow.session import (
    Options,
    Quiet,
    Screen,
    Session,
    SessionResult,
    never,
    open_session,
)
from fieldtool.workflow.verified import Verified
from fieldtool.workflow.writing import written
from fieldtool.writeback.alone import connected
from fieldtool.writeback.restoring import Restored, bring_back, source_of
from fieldtool.writeback.transaction import WriteBack

BAND_POINTS = 400
"""Frequencies at which the band of the model's response is kept."""
DATA_SHEET_APART = 4.0
"""Tolerances of a motor's inertia that the identified first mass may be apart without a word."""
AFTER_MEASURING = ("identify", "criticise", "design", "write")
"""Stages of a run that commands of the same names do as well, from the session folder."""
BEGIN_ANEW = (
    "Its drives begin anew with every command, holding the gains of the profile: what an earlier one "
    "wrote into them is gone."
)
Confirm = Callable[[Sequence[Change]], bool]


def run(
    machine: str | Path | MachineProfile,
    out: Path,
    options: Options | None = None,
    *,
    screen: Screen | None = None,
    confirm: Confirm = lambda _: False,
    stop_requested: Callable[[], bool] = never,
) -> SessionResult:
    """Measure, identify, criticise, design and, if wanted, write back.

    Parameters
    ----------
    machine
        Name or file of a machine profile, or the profile.
    out
        Session folder; made if missing.
    options
        Plan, and whether to write.
    screen
        Is told what happens.
    confirm
        Sees old and new parameters before the first write, and says whether to go on.
    stop_requested
        Asked in every cycle of a motion.

    Raises
    ------
    DrivesError, FieldtoolError
        With one sentence for a person.  Whatever was measured is in the session folder.
    """
    options = options or Options()
    begin = time.perf_counter()
    opened: Session | None = None
    left: tuple[str, ...] = ()
    try:
        with open_session(machine, out, screen, stop_requested, command="run", options=options) as (
            session,
            group,
        ):
            opened = session
            machine_time = _measured(session, group, options)
            left = AFTER_MEASURING
            identified = _identify(session, options)
            left = left[1:]
            session.screen.found(identified.model, truth_model(session.machine))
            model, criticism = criticised(session, identified.model, stop_requested)
            left = left[1:]
            session.screen.stage("Design new controller parameters")
            tuning = _design(
                session.folder, session.machine, model, options.response, session.screen.doing
            )
            left = left[1:]
            session.screen.designed(tuning)
            if stop_requested():
                raise UserStopError(
                    "stopped by the user before anything was written; no axis was moving"
                )
            write_back, verification = written(
                session,
                group,
                tuning,
                options,
                confirm,
                model,
                believed=True,
                ask_to_move=False,
            )
    except BaseException as error:
        if opened is not None and opened.folder.recording.is_file():
            with suppress(Exception):  # nothing may hide why it ended
                report(opened.folder.path)
            stopped = isinstance(error, UserStopError | KeyboardInterrupt)
            if left and stopped and opened.write_back is None:
                error.add_note(_rest_of(opened.folder, options, left))
        raise
    with noting(write_back.way_back):
        _reported(session)
        moving_time = _moving_time(session)
    return SessionResult(
        session.folder.path,
        identified.model,
        identified,
        tuning,
        write_back,
        truth_model(session.machine),
        machine_time,
        time.perf_counter() - begin,
        tuple(session.warnings),
        criticism,
        verification,
        moving_time,
    )


def measure(
    machine: str | Path | MachineProfile,
    out: Path,
    options: Options | None = None,
    *,
    screen: Screen | None = None,
    stop_requested: Callable[[], bool] = never,
) -> float:
    """Measure with the plan that the options name; return the seconds of excitation.

    Raises
    ------
    DrivesError, FieldtoolError
        As :func:`run`.
    """
    options = options or Options()
    with open_session(machine, out, screen, stop_requested, command="measure", options=options) as (
        session,
        group,
    ):
        return _measured(session, group, options)


def identify(
    source: Path, options: Options | None = None, masses: Mapping[str, int] | None = None
) -> Identified:
    """Identify from a session folder or a recording; in a session folder the model is kept.

    Raises
    ------
    FileFormatError
        If there is no recording.
    IdentificationError
        If the data do not allow it.
    """
    options = options or Options()
    folder = SessionFolder.of_source(source)
    if folder:
        rescue(folder)
    recording = load(folder.recording if folder else source)
    prior = None
    motors: dict[str, Estimate] = {}
    if folder and folder.machine.is_file():
        machine = load_machine(folder.machine)
        prior, motors = prior_model(machine), data_sheet_masses(machine, options)
        lengths = {axis.name: len(axis.masses) for axis in prior.axes}
        if any(lengths.get(name) != count for name, count in (masses or {}).items()):
            prior = None  # of chains of another length
    identified = identify_recording(recording, masses or {}, prior, motors)
    if folder:
        _keep(folder, identified, prior)
    return identified


def draw(identified: Identified, path: Path) -> None:
    """Draw measured and modelled responses, with bands, as a PNG.

    Raises
    ------
    NotEnoughDataError
        If the data were moves from a prior model, without a measured response.
    OutputError
        If the file can not be written.
    """
    if not identified.responses:
        raise NotEnoughDataError(
            "there is no measured response to draw: the model was fitted to the moves themselves"
        )
    draw_responses(
        identified.responses,
        identified.model,
        None,
        path,
        identified.fitted,
        identified.torque_units,
    )


def write(
    folder_path: Path,
    options: Options,
    confirm: Confirm,
    *,
    screen: Screen | None = None,
    machine: MachineProfile | None = None,
    stop_requested: Callable[[], bool] = never,
) -> tuple[WriteBack, Verified | None]:
    """Write a session folder's tuning into the machine's drives, and try it on the machine.

    ``machine`` is the session's own profile, on another bus if need be; the folder's where None.
    Old and new parameters move the machine a little (``Options.verify``).  The second result is what
    that trial showed; None where nothing was written or tried.

    Raises
    ------
    DrivesError, FieldtoolError
        As :func:`run`.
    """
    folder = SessionFolder.existing(folder_path)
    tuning = read_tuning(folder.needed(folder.tuning, "`fieldtool design` on this folder"))
    profile = machine or folder.machine
    say = (screen or Quiet()).say
    with (
        renewing_report(folder_path, say),
        open_session(profile, folder_path, screen, stop_requested, True, "write", options) as (
            session,
            group,
        ),
    ):
        known = folder.model.is_file()
        model = model_of(session.machine, folder.model) if known else prior_model(session.machine)
        return written(
            session, group, tuning, options, confirm, model, believed=known, ask_to_move=True
        )


def restore(
    machine: str | Path | MachineProfile,
    backup: Path,
    store: bool = False,
    trace: Path | None = None,
    same_drives: bool = False,
    without: Collection[str] = (),
    screen: Screen | None = None,
) -> Restored:
    """Bring a backup back into a machine's drives, or take back a write that was cut off.

    Parameters
    ----------
    machine
        Name or file of a machine profile, or the profile.
    backup
        Session folder, or a backup file.
    store
        Store in non-volatile memory too.
    trace
        File that every frame is noted in; none where it is None.
    same_drives
        The user's word that drives without a serial number are those of the backup.
    without
        Axes that are left as they are: their drives are gone, or were exchanged.
    screen
        Is told what happens.

    Raises
    ------
    ProfileError, WrongDeviceError, WriteBackMixedError
        If the backup is none, was made on other drives, or does not come back whole.
    """
    screen = screen or Quiet()
    if backup.is_dir():
        _rescued(SessionFolder(backup), screen)
    source = source_of(backup, store)
    profile = machine if isinstance(machine, MachineProfile) else load_machine(machine)
    lacking = [axis for axis in without if axis not in {a.name for a in profile.axes}]
    if lacking:
        raise ProfileError(profile.path, f"has no axis {', '.join(lacking)} to leave out")
    axes = tuple(axis for axis in profile.axes if axis.name not in without)
    profile = profile.model_copy(update={"axes": axes})
    screen.stage(f"Connect to {profile.name}")
    simulated = simulated_words(profile)
    if simulated:
        screen.say(f"{simulated} {BEGIN_ANEW}")
    folder = SessionFolder(source.backup_path.parent)
    with (
        renewing_report(folder.path, screen.say),
        connected(profile, trace=trace, to_move=False) as group,
    ):
        screen.stage("Bring the old parameters back")
        restored = bring_back(
            profile.name,
            group.drives,
            source,
            store=store,
            same_drives=same_drives,
            without=without,
            say=screen.say,
        )
        if backup.is_dir() or folder.events.is_file():  # a file may lie anywhere
            name = source.backup_path.name
            memory = {one.axis: one.memory.value for one in restored.outcomes}
            folder.note(
                "restored",
                stored=restored.stored,
                memory=memory,
                without=sorted(without),
                backup=name,
            )
    return restored


def _rest_of(folder: SessionFolder, options: Options, left: Sequence[str]) -> str:
    """Return the commands of the stages that a run which was stopped has left undone.

    Files do not tell: an earlier run's may lie in the folder, and a criticism may have been refused.
    """
    motors = " --motor-inertia data-sheet" if options.motor_inertia == "data sheet" else ""
    response = f" --response {options.response}" if options.response != "normal" else ""
    asked = {"identify": motors, "design": response}
    *before, last = (f"`fieldtool {stage} {folder.path}{asked.get(stage, '')}`" for stage in left)
    then = f"{', '.join(before)}, then " if before else ""
    return f"To go on without measuring again: {then}{last}."


def _rescued(folder: SessionFolder, screen: Screen) -> None:
    """Rescue what was measured; what can not be rescued does not keep drives from being restored."""
    try:
        rescue(folder, screen.say)
    except FieldtoolError as error:
        screen.say(f"What the axes did last could not be put into the recording: {error}")


def _reported(session: Session) -> None:
    """Write the report; a full disk does not undo what was done."""
    try:
        report(session.folder.path)
    except FieldtoolError as error:
        session.warn(f"The report was not written: {error}")


def _moving_time(session: Session) -> float:
    """Return the seconds of all recordings of a session; one that can not be read is warned of."""
    seconds = 0.0
    for path in (session.folder.recording, *session.folder.trials):
        try:
            seconds += recorded_seconds(path)
        except FileFormatError as error:
            session.warn(f"The machine time lacks {path.name}: {error}")
    return seconds


def _measured(session: Session, group: CanopenGroup, options: Options) -> float:
    try:
        if options.plan == "fast":
            seconds = measured_fast(session, group, options)
        else:
            seconds = measured(session, group)
    except BaseException:
        with suppress(FieldtoolError):  # a full disk must not hide why it ended
            _tell_punctuality(session, group)
        raise
    _tell_punctuality(session, group)
    return seconds


def _tell_punctuality(session: Session, group: CanopenGroup) -> None:
    """Say how well this computer kept its cycles; a simulated machine's time passes as it is told."""
    kept = group.punctuality
    session.folder.note("cycles", count=kept.cycles, late=kept.late, worst=kept.worst)
    if kept.advice:
        session.warn(f"{kept.sentence} {kept.advice}")
    elif kept.cycles and not not_imitated(group.line.can_bus):
        session.screen.say(kept.sentence)


def _identify(session: Session, options: Options) -> Identified:
    session.screen.stage("Identify masses, springs, couplings and dampers")
    machine = session.machine
    session.screen.doing(
        "find modes and numbers of masses, fit masses, springs, couplings and dampers"
    )
    identified = identify_recording(
        load(session.folder.recording),
        {},
        prior_model(machine),
        data_sheet_masses(machine, options),
    )
    for note in (*identified.notes, *_against_data_sheet(session, identified.model)):
        session.warn(note)
    _keep(session.folder, identified, prior_model(machine))
    check_believable(identified.model, prior_model(machine))
    return identified


def _against_data_sheet(session: Session, model: MachineModel) -> list[str]:
    """Say where an identified motor mass can not be the motor's."""
    notes = []
    for axis, found in zip(session.machine.axes, model.axes, strict=True):
        sheet, first = axis.motor_inertia, found.masses[0]
        if sheet is None or len(found.masses) == 1:
            continue
        allowed = DATA_SHEET_APART * max(sheet.tolerance * sheet.value, first.std)
        if abs(first.value - sheet.value) > allowed:
            notes.append(
                f"{axis.name}: its first mass is {first.value:.4g}, the data sheet of its motor says "
                f"{sheet.value:.4g} +- {100 * sheet.tolerance:g} %. Another number of masses "
                "(--masses), or another motor or gear than the profile says?"
            )
    return notes


def _keep(folder: SessionFolder, identified: Identified, prior: MachineModel | None) -> None:
    save_responses(identified.responses, folder.frequency_response, _band(identified))
    write_model(identified.model, folder.model)
    if identified.responses:
        draw_responses(
            identified.responses,
            identified.model,
            prior,
            folder.picture,
            identified.fitted,
            identified.torque_units,
        )
    folder.note("identified", notes=list(identified.notes))


def _band(identified: Identified) -> ModelBand | None:
    """Return how well the fitted model's response is known, over the measured band and a little more."""
    if identified.fitted is None or not identified.responses:
        return None
    lines = np.concatenate([r.frequencies for r in identified.responses.values()])
    grid = np.geomspace(0.9 * lines.min(), 1.1 * lines.max(), BAND_POINTS)
    return ModelBand(grid, relative_std(identified.fitted, 2 * np.pi * grid))


def _design(
    folder: SessionFolder,
    machine: MachineProfile,
    model: MachineModel,
    response: str,
    advance: Callable[[str, float], None],
) -> Tuning:
    check_known(model)
    return designed(folder, machine, model, response, advance=advance)
