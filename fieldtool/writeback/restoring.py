"""Bring a backup back, or take a write back that was cut off."""

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from drives.canopen_drive import CanopenDrive
from drives.errors import NotSupportedError, ProfileError, UserStopError
from drives.parameters import (
    Action,
    Backup,
    DriveBackup,
    DriveOutcome,
    DriveRecord,
    HeldObject,
    Journal,
    JournalEntry,
    Memory,
    Phase,
    Step,
    Storing,
    Transaction,
    check_can_store,
    check_disabled,
    check_objects,
    check_same_drives,
    check_set_up,
    load_backup,
    load_journal,
)
from drives.parameters.access import needs_password
from drives.parameters.journal import Goal
from fieldtool.writeback.earlier import FIRST_BACKUP, memory_seen_from
from fieldtool.writeback.transaction import tell_storing
from fieldtool.writeback.unfinished import JOURNAL, JournalKeeper, not_kept, refuse_elsewhere


@dataclass(frozen=True)
class Source:
    """What is brought back: a backup, and the journal of the write that it was taken for."""

    backup_path: Path
    backup: Backup
    journal: Journal | None
    lost_journal: bool = False
    """There is a journal, but it can not be read."""

    @property
    def cut_off(self) -> bool:
        """Whether the write had not ended."""
        return self.lost_journal or (self.journal is not None and self.journal.is_open)


@dataclass(frozen=True)
class Restored:
    """What was found in the drives, and what was done."""

    backup: Path
    cut_off: Journal | None
    """The write that had been cut off and was taken back; None if there was none."""
    outcomes: tuple[DriveOutcome, ...]
    had_write: bool
    """Whether there is a journal that says what old and new values are."""
    left_out: tuple[str, ...]
    """Axes that were not brought back, because the user said so."""
    notes: tuple[str, ...]

    @property
    def written(self) -> tuple[HeldObject, ...]:
        """All values that differed and were brought back."""
        return tuple(held for outcome in self.outcomes for held in outcome.written)

    @property
    def stored(self) -> bool:
        """Whether the old values are known to be in the non-volatile memory of all drives."""
        return all(outcome.memory is Memory.OLD for outcome in self.outcomes)

    def as_dict(self) -> dict[str, Any]:
        """Plain values, as ``--json`` prints them."""
        return {
            "state": "old",
            "cut_off": self.cut_off is not None,
            "begun": self.cut_off.begun if self.cut_off else None,
            "backup": str(self.backup),
            "stored": self.stored,
            "left_out": list(self.left_out),
            "drives": [
                {
                    "axis": outcome.axis,
                    "node_id": outcome.node_id,
                    "found": outcome.found.value if self.had_write else None,
                    "brought_back": [
                        {
                            "object": str(held.info.address),
                            "name": held.info.name,
                            "value": held.value,
                        }
                        for held in outcome.written
                    ],
                    "working_memory": "old",
                    "non_volatile_memory": outcome.memory.value,
                }
                for outcome in self.outcomes
            ],
            "notes": list(self.notes),
        }


def source_of(path: Path, store: bool) -> Source:
    """Read what a session folder or a backup file holds to be brought back.

    Of a folder whose write was cut off, it is the backup that was taken for that write; otherwise
    its first backup, from before the tool changed anything.

    Raises
    ------
    ProfileError
        If backup or journal are none, or not whole.
    """
    folder = path if path.is_dir() else path.parent
    journal_path = folder / JOURNAL
    journal, lost = None, False
    if journal_path.exists():
        try:
            journal = load_journal(journal_path)
        except ProfileError as error:
            if path.is_dir() or not store:
                raise ProfileError(
                    error.path,
                    f"{str(error).partition(': ')[2]}. It would say what the drives' non-volatile "
                    "memory holds. To bring a backup back without it, and store it in all drives: "
                    f"fieldtool restore {folder / FIRST_BACKUP} --store",
                    error.line,
                ) from error
            lost = True
    if path.is_dir():
        name = journal.backup if journal is not None and journal.is_open else FIRST_BACKUP
        path = path / name
    return Source(path, load_backup(path), journal, lost)


def bring_back(
    machine: str,
    drives: Sequence[CanopenDrive],
    source: Source,
    *,
    store: bool = False,
    same_drives: bool = False,
    without: Collection[str] = (),
    say: Callable[[str], None] = lambda _: None,
) -> Restored:
    """Bring all parameters of a backup back into all its drives, and store them where that is needed.

    Parameters
    ----------
    machine
        Name, for the journal.
    drives
        Of the machine; disabled.
    source
        What is brought back.
    store
        Store in all drives.  After a write that was cut off, drives whose non-volatile memory may
        hold new values store the old ones in any case.
    same_drives
        The user's word that drives without a serial number are those of the backup.
    without
        Axes that are left as they are: their drives are gone, or were exchanged.
    say
        Is told what is done with which drive.

    Raises
    ------
    ProfileError, WrongDeviceError, DriveFaultError, NotSupportedError, OutputError, UnfinishedWriteError
        Before anything is written; the last if what was cut off in these drives is in another folder.
    WriteBackMixedError
        If a value could not be restored or stored; every other one was.
    """
    before = source.journal
    cut_off = before if before is not None and before.is_open else None
    parts = tuple(part for part in source.backup.drives if part.axis not in without)
    if not parts:
        raise ProfileError(source.backup_path, "holds no other axis. Nothing was written.")
    journal = journal_back(machine, source, store)
    check_same_drives(drives, parts, "backup", trusted=same_drives)
    if cut_off is not None:
        there = tuple(record for record in cut_off.drives if record.axis not in without)
        check_same_drives(drives, there, "write journal", trusted=same_drives)
    if not all(drive.begins_anew for drive in drives):
        refuse_elsewhere(machine, source.backup.drives, source.backup_path.parent, cut_off)
    by_axis = {drive.axis: drive for drive in drives}
    notes = []
    for part in parts:
        drive, record = by_axis[part.axis], journal.drive(part.axis)
        check_objects(drive, (h.info for h in part.held), source.backup_path, "backup")
        check_set_up(part.axis, part.set_up, source.backup_path)
        journal_path = source.backup_path.with_name(JOURNAL)
        check_objects(drive, (e.info for e in record.entries), journal_path, "write journal")
        if journal.storing is Storing.ALL or record.memory in (Memory.NEW, Memory.UNKNOWN):
            check_can_store(drive)
        if part.revision_number not in (0, drive.identity.revision):
            notes.append(
                f"{part.axis}: the backup was made with firmware revision "
                f"0x{part.revision_number:08X}, the drive now has 0x{drive.identity.revision:08X}."
            )
    taking_part = [by_axis[part.axis] for part in parts]
    check_disabled(taking_part)
    for drive in taking_part:
        if needs_password(drive) and drive.axis_profile.password is None:
            raise NotSupportedError(
                f"{drive.axis}: the drive's parameters are locked, and no password is known: a session "
                "folder keeps none. Add `--machine FILE` with the machine profile that gives `password` "
                "at this axis. Nothing was written."
            )
    keeper = JournalKeeper(source.backup_path.with_name(JOURNAL))
    counts = {part.axis: len(part.held) for part in parts}

    def tell(step: Step) -> None:
        if step.action is Action.BRING_BACK:
            say(f"{step.axis}: comparing {counts[step.axis]} parameters, and bringing them back")
        tell_storing(drives, say)(step)

    backup = source.backup if source.cut_off else _without_set_up(source.backup)
    transaction = Transaction(taking_part, journal, backup, keeper, tell)
    try:
        with keeper:
            transaction.restore()
    except OSError as error:
        raise not_kept(keeper, error, back=_made_writable(cut_off)) from error
    except (UserStopError, KeyboardInterrupt):
        keeper.settle(transaction.journal)
        raise
    keeper.settle(transaction.journal)
    if transaction.unsaved is not None:
        notes.append(
            f"{transaction.unsaved} The drives are in order, but the journal does not say so: run "
            "fieldtool restore once more."
        )
    return Restored(
        source.backup_path,
        cut_off,
        tuple(transaction.outcomes.values()),
        had_write=journal.writes,
        left_out=tuple(p.axis for p in source.backup.drives if p.axis in without),
        notes=tuple(notes),
    )


def _made_writable(cut_off: Journal | None) -> str:
    """Say what to do about a session folder that can not be written."""
    advice = "Make the folder writable and make room on its disk"
    if cut_off is None:
        advice += ", or copy it to where that is so and restore the copy"
    return f"{advice}. Then restore again."


def _without_set_up(backup: Backup) -> Backup:
    """Return what is brought back where no motion was cut off: how PDOs are set up is no parameter."""
    return replace(backup, drives=tuple(replace(part, set_up=()) for part in backup.drives))


def journal_back(machine: str, source: Source, store: bool) -> Journal:
    """Return the journal of bringing a backup back; it goes on where one before was cut off."""
    before = source.journal
    begun = datetime.now(UTC).isoformat(timespec="seconds")
    missing = set[str]()
    if before is not None and before.is_open:
        begun = before.begun  # by which a folder that was moved is known again
        missing = {record.axis for record in before.drives}
    missing -= {part.axis for part in source.backup.drives}
    if missing:
        raise ProfileError(
            source.backup_path,
            f"holds nothing for axis {', '.join(sorted(missing))}, into which a write was cut off. Use "
            "the session folder instead. Nothing was written.",
        )
    if store:
        storing = Storing.ALL
    elif before is None or not before.is_open:
        storing = Storing.NONE
    else:
        storing = before.storing if before.goal is Goal.OLD else Storing.NEEDED
    return Journal(
        machine,
        begun,
        source.backup_path.name,
        storing,
        tuple(_record_back(part, source) for part in source.backup.drives),
        Goal.OLD,
    )


def _record_back(part: DriveBackup, source: Source) -> DriveRecord:
    entries: tuple[JournalEntry, ...] = ()
    memory = Memory.UNKNOWN if source.lost_journal else Memory.UNTOUCHED
    earlier = memory
    if source.journal is not None:
        old = {held.info.address: held.value for held in part.held}
        for record in source.journal.drives:
            if record.axis == part.axis:
                memory = memory_seen_from(source.backup_path.name, source.journal, record)
                earlier = record.earlier
                entries = tuple(
                    JournalEntry(e.info, old.get(e.info.address, e.before), e.after)
                    for e in record.entries
                )
    return DriveRecord(
        part.axis,
        part.node_id,
        part.vendor_id,
        part.product_code,
        part.revision_number,
        part.serial_number,
        entries,
        Phase.GOING_BACK,
        memory,
        memory,
        earlier,
    )
