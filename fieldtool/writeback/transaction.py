"""Bring new parameters into the drives: all or nothing, read back, undoable."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from drives.canopen_drive import CanopenDrive
from drives.errors import NotSupportedError
from drives.parameters import (
    Action,
    Backup,
    Change,
    DriveRecord,
    Journal,
    JournalEntry,
    Memory,
    Step,
    Storing,
    Transaction,
    Written,
    back_up,
    check_can_store,
    check_disabled,
    load_backup,
    planned_changes,
)
from drives.parameters.journal import State
from drives.parameters.values import same
from drives.profile import Store
from fieldtool.design.tuning import Tuning
from fieldtool.writeback.backups import keep_backup
from fieldtool.writeback.earlier import left_before, other_than_first
from fieldtool.writeback.unfinished import JOURNAL, JournalKeeper, not_kept, refuse_unfinished

Confirm = Callable[[Sequence[Change]], bool]


@dataclass(frozen=True)
class WriteBack:
    """What was written, and where it is kept."""

    written: tuple[Written, ...]
    """Empty where nothing was written."""
    changes: tuple[Change, ...]
    """What the tuning would change, or has changed."""
    in_memory: bool
    """The drives work with the new values."""
    stored: bool
    """The new values survive a power cycle."""
    backup: Path | None
    to_store: str = ""
    """What stores the new values that are in working memory; empty where nothing does."""

    @property
    def differs(self) -> bool:
        """Whether any new value is another one than the drive held before."""
        return any(change.differs for change in self.changes)

    @property
    def sentence(self) -> str:
        """Where the new values are, for a person."""
        if not self.in_memory:
            return "Nothing was written: the drives hold their old parameters."
        if self.stored:
            return "The new parameters are in the drives and stored: they survive a power cycle."
        keep = f" To keep them: {self.to_store}." if self.to_store else ""
        return (
            "The new parameters are in the drives' working memory only: a power cycle brings back what "
            f"was stored.{keep}"
        )

    @property
    def way_back(self) -> str:
        """For whatever goes wrong afterwards: where the new values are, and what takes them out again.

        Empty where nothing was written.
        """
        if not self.in_memory or self.backup is None:
            return ""
        stored = " --store" if self.stored else ""
        return f"{self.sentence} `fieldtool restore {self.backup.parent}{stored}` takes them back."


def changes_for(drives: Sequence[CanopenDrive], tuning: Tuning) -> tuple[Change, ...]:
    """Return what a tuning would change, in the order of writing; nothing is written.

    Raises
    ------
    NotSupportedError
        If the tuning names an axis or a parameter that the machine does not have, or a value does
        not fit.
    """
    by_axis = {drive.axis: drive for drive in drives}
    unknown = [axis.axis for axis in tuning.axes if axis.axis not in by_axis]
    if unknown:
        raise NotSupportedError(
            f"the tuning is for axis {', '.join(unknown)}, which this machine does not have; its axes "
            f"are {', '.join(by_axis)}. Nothing was written."
        )
    changes: list[Change] = []
    for axis in tuning.axes:
        changes += planned_changes(by_axis[axis.axis], axis.parameters)
    return tuple(changes)


def apply(
    machine: str,
    drives: Sequence[CanopenDrive],
    changes: tuple[Change, ...],
    backup_path: Path,
    confirm: Confirm,
    keep: bool = False,
    say: Callable[[str], None] = lambda _: None,
    prove: Callable[[], None] | None = None,
    stop_requested: Callable[[], bool] = lambda: False,
) -> WriteBack:
    """Back up, show, ask, write, read back, and store if wanted: all drives or none.

    The journal, ``write-journal.yaml`` beside the backup, is on the disk before the first write.

    Parameters
    ----------
    machine
        Name, for backup and journal.
    drives
        All drives of the machine, disabled.
    changes
        What is to be written, in the order of writing: :func:`changes_for`.
    backup_path
        File for the backup, written before the first change; see :func:`keep_backup`.
    confirm
        Sees old and new values and says whether to write.
    keep
        Store in non-volatile memory too.
    say
        Is told which drive stores, and how long that may take.
    prove
        Tries the new parameters once all drives hold them in working memory; what it raises
        (``drives.errors.NotVerifiedError``) takes the write back.  Nothing is stored before.
    stop_requested
        Asked before each drive stores and before the write ends.

    Raises
    ------
    UnfinishedWriteError
        If a write before was cut off; nothing was changed.
    NotSupportedError, DriveFaultError
        If a value does not fit, an old one was read differently for the backup, or a drive is enabled;
        nothing was changed.
    OutputError
        If backup or journal can not be written; nothing was changed.
    WriteBackError
        If a drive refused, altered a value or did not store, or the new parameters were not proven:
        all drives hold their old values.
    WriteBackMixedError
        If not all of them could be brought back; says which drive holds what.
    UserStopError
        If the user stopped: all drives hold their old values.
    """
    refuse_unfinished(machine, drives, backup_path.parent)
    if keep:
        for drive in drives:
            check_can_store(drive)
    boots = {drive.axis: drive.boots for drive in drives}
    taken = back_up(machine, drives)
    check_agreed(drives, changes, taken)
    backup_path = keep_backup(taken, backup_path)
    if not confirm(changes):
        return WriteBack((), changes, in_memory=False, stored=False, backup=backup_path)
    check_disabled(drives)
    storing = Storing.ALL if keep else Storing.NONE
    journal_path = backup_path.with_name(JOURNAL)
    earlier = left_before(journal_path, drives)
    journal = planned_journal(machine, drives, changes, backup_path.name, storing, earlier)
    keeper = JournalKeeper(journal_path)
    backup = load_backup(backup_path)
    wanted = {(one.axis, one.info.address): one.wanted for one in changes}
    tell = tell_storing(drives, say)
    transaction = Transaction(
        drives, journal, backup, keeper, tell, prove, stop_requested, wanted, boots
    )
    written = tuple(Written(change, change.after) for change in changes)
    result = WriteBack(written, changes, in_memory=True, stored=keep, backup=backup_path)
    try:
        with keeper:
            transaction.write()
    except OSError as error:
        raise not_kept(keeper, error) from error
    except BaseException as error:
        if transaction.journal.state is State.NEW:
            error.add_note(result.way_back)
        elif transaction.journal.state is State.OLD and (note := other_than_first(backup_path)):
            error.add_note(note)
        raise
    return result


def check_agreed(drives: Sequence[CanopenDrive], changes: Sequence[Change], backup: Backup) -> None:
    """Refuse to write where an old value is not what the backup holds: one of the two is wrong.

    What is in no backup is read once more.

    Raises
    ------
    NotSupportedError
        With axis, object and both values.
    """
    by_axis = {drive.axis: drive for drive in drives}
    held = {(part.axis, h.info.address): h.value for part in backup.drives for h in part.held}
    for change in changes:
        again = held.get((change.axis, change.info.address))
        if again is None:
            again = by_axis[change.axis].read(change.info)
        if not same(change.info, change.before_raw, again):
            raise NotSupportedError(
                f"{change.axis}, {change.name}, object {change.info.address}: read as "
                f"{change.before_raw}, then as {again}, so what would have to be restored is not known. "
                "Check the drive's supply and the bus, and that nobody else writes to the drive, and "
                "try again. Nothing was written."
            )


def tell_storing(
    drives: Sequence[CanopenDrive], say: Callable[[str], None]
) -> Callable[[Step], None]:
    """Return what tells a person that a drive begins to store, and how long that may take."""
    longest = {
        d.axis: d.profile.store.timeout for d in drives if isinstance(d.profile.store, Store)
    }

    def tell(step: Step) -> None:
        if step.action is Action.STORE and step.axis in longest:
            say(f"{step.axis}: storing, at most {longest[step.axis]:g} s")

    return tell


def planned_journal(
    machine: str,
    drives: Sequence[CanopenDrive],
    changes: Sequence[Change],
    backup: str,
    storing: Storing,
    earlier: Mapping[str, Memory],
) -> Journal:
    """Return the journal of a write of which nothing is done yet.

    ``earlier`` is what the writes before it have left (:func:`left_before`).
    """
    return Journal(
        machine,
        datetime.now(UTC).isoformat(timespec="seconds"),
        backup,
        storing,
        tuple(
            DriveRecord(
                drive.axis,
                drive.node_id,
                drive.identity.vendor_id,
                drive.identity.product_code,
                drive.identity.revision,
                drive.identity.serial_number,
                tuple(
                    JournalEntry(change.info, change.before_raw, change.after_raw)
                    for change in changes
                    if change.axis == drive.axis
                ),
                earlier=earlier.get(drive.axis, Memory.UNTOUCHED),
            )
            for drive in drives
        ),
    )
