"""Bring a tuning into the drives, and try it there: only what has stood its trial may be stored."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace

from drives.canopen_drive import CanopenGroup
from drives.canopen_drive.interrupts import uninterrupted
from drives.errors import (
    STOPPED_AT_REST,
    NotSupportedError,
    OscillationError,
    ProfileError,
    StoppedError,
    UserStopError,
)
from drives.parameters import Change, can_store, load_journal
from drives.parameters.journal import State
from fieldtool.design.tuning import Tuning, why_not_stored
from fieldtool.errors import NotPutBackError, OutputError, PlanRefusedError
from fieldtool.records.model import MachineModel
from fieldtool.workflow.session import Options, Session, parameter_table
from fieldtool.workflow.verified import Verified
from fieldtool.workflow.verifying import Verification
from fieldtool.writeback.earlier import (
    may_be_stored,
    refuse_other_drives,
    written_since,
)
from fieldtool.writeback.temporary import left_axes, left_words
from fieldtool.writeback.transaction import WriteBack, apply, changes_for

Confirm = Callable[[Sequence[Change]], bool]


def written(
    session: Session,
    group: CanopenGroup,
    tuning: Tuning,
    options: Options,
    confirm: Confirm,
    model: MachineModel,
    *,
    believed: bool,
    ask_to_move: bool,
) -> tuple[WriteBack, Verified | None]:
    """Write a tuning if the options say so, and have the machine judge it.

    Parameters
    ----------
    session, group
        Of the machine; all drives disabled.
    tuning
        New parameters.
    options
        Whether to write, to try, to store.
    confirm
        Sees old and new values and says whether to write.
    model
        Of the machine, to plan the trial by and to compare with.
    believed
        Whether it was identified.
    ask_to_move
        Whether nobody has been asked yet whether the machine may move.

    Raises
    ------
    WrongDeviceError
        If the session was begun on other drives.
    PlanRefusedError
        If something is to be stored untried, the new parameters are bad by the model, or the drives
        hold them already since an earlier write: there would be nothing to compare them with.
    OscillationError
        If an axis swings with its old parameters; nothing was written.
    WriteBackError, WriteBackMixedError
        As :func:`fieldtool.writeback.transaction.apply`; also if the new parameters fail their trial.
    UserStopError
        If the user stopped; where the write had ended, a note says so.
    NotPutBackError
        If drives hold what the measurement, or the old parameters' trial, had set for its time; nothing
        was written.
    """
    if not options.write:
        try:
            changes = changes_for(group.drives, tuning)
        except NotSupportedError as error:  # a drive whose gains are for its maker's software
            session.warn(str(error))
            changes = ()
        designed = WriteBack((), changes, in_memory=False, stored=False, backup=None)
        session.folder.note("parameters", rows=parameter_table(designed))
        return designed, None
    if options.store and not options.verify:
        raise PlanRefusedError(
            "only parameters that were tried on the machine are stored: leave --no-verify or --store "
            "away. Nothing was written."
        )
    _refuse_left(session, group)
    refuse_other_drives(session.folder.parameters_before, group.drives)
    verification, never = None, why_not_stored(tuning.bound, identified=believed)
    if options.verify:
        verification = Verification(session, group, tuning, model, believed=believed)
        never = verification.not_stored
        if verification.not_stored and options.store:
            raise PlanRefusedError(
                f"the new parameters are not stored: {verification.not_stored}. Leave --store away to "
                "try them. Nothing was moved or written."
            )
        if verification.not_stored:
            session.warn(
                f"CAREFUL, the new parameters are for a trial only: {verification.not_stored}."
            )
    changes = changes_for(group.drives, tuning)
    storable = not never and all(can_store(drive) for drive in group.drives)
    again = _again(session, store=storable)
    if written_since(session.folder.journal) and not any(change.differs for change in changes):
        raise PlanRefusedError(
            "the drives hold these parameters already, since a write of this session, so that a trial "
            f"would compare them with themselves. To have them tried against the old ones: {again}. "
            "Nothing was moved or written."
        )
    if verification is not None:
        verification.plan(changes)

    def agreed(changes: Sequence[Change]) -> bool:
        with _before_the_write():
            if not confirm(changes):
                return False
            if verification is not None:
                if ask_to_move and not session.ready():
                    raise UserStopError("not begun: nothing was moved")
                verification.before()
                _refuse_left(session, group)
            _forget_earlier(session)
            session.screen.stage("Write the new parameters, and read them back")
            return True

    try:
        result = apply(
            session.machine.name,
            group.drives,
            changes_for(group.drives, tuning),
            session.folder.parameters_before,
            agreed,
            options.store,
            session.screen.say,
            verification.prove if verification else None,
            group.stop_requested,
        )
    except BaseException as error:
        if verification is not None:
            with uninterrupted():
                verification.ended(error, _held_after(session))
        raise
    with uninterrupted():  # a stop waits until it stands in the folder what the drives hold
        if storable:
            more = " once more" if verification is not None else ""
            result = replace(result, to_store=f"{again}, which tries them{more}")
        session.write_back = result
        if verification is not None:
            verification.ended(None, State.NEW if result.in_memory else State.OLD)
        session.folder.note("parameters", rows=parameter_table(result))
        session.folder.note("write", written=result.in_memory, stored=result.stored)
    if result.in_memory and group.stop_requested():
        raise UserStopError(STOPPED_AT_REST)
    if result.in_memory and verification is None:
        session.warn("The new parameters were not tried on the machine (--no-verify).")
    return result, verification.result if verification else None


@contextmanager
def _before_the_write() -> Iterator[None]:
    """Have whatever stops the work here, or refuses to go on, say that nothing was written."""
    try:
        yield
    except (StoppedError, PlanRefusedError) as error:
        if not isinstance(error, OscillationError):  # which says so
            error.add_note("That was before the write: nothing was written.")
        raise


def _refuse_left(session: Session, group: CanopenGroup) -> None:
    """Write nothing into drives that still hold what a motion had set for its time."""
    if left := left_axes(group.drives):
        raise NotPutBackError(f"{left_words(left, session.folder.path)}. Nothing was written.")


def _again(session: Session, *, store: bool) -> str:
    """Return the commands that try new parameters against those from before the first write."""
    folder = session.folder
    back = " --store" if may_be_stored(folder.journal) else ""
    keep = " --store" if store else ""
    return f"`fieldtool restore {folder.path}{back}`, then `fieldtool write {folder.path}{keep}`"


def _forget_earlier(session: Session) -> None:
    """Remove the verdict of a write before: from now on the drives do not hold those values."""
    path = session.folder.verification
    try:
        path.unlink(missing_ok=True)
    except OSError as error:
        raise OutputError(
            f"{path}: can not be removed ({error.strerror}). Nothing was written."
        ) from error


def _held_after(session: Session) -> State:
    """Return what the drives hold by the journal of a write that an error has ended."""
    try:
        return load_journal(session.folder.journal).state
    except (ProfileError, OSError):
        return State.OPEN  # what can not be read is not known to have ended
