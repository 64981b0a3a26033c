"""What a session folder knows of the drives: which they were, and what earlier writes have left in them.

No drive tells what it has stored, so what is known must not be lost: each journal in a folder takes it
over from the one whose place it takes.
"""

from collections.abc import Iterable, Mapping
from pathlib import Path

from drives.errors import ProfileError, WrongDeviceError
from drives.parameters import DriveRecord, Journal, Memory, load_backup, load_journal
from drives.parameters.guard import other_number
from drives.parameters.journal import State
from drives.parameters.values import ParameterDrive

FIRST_BACKUP = "parameters-before.yaml"
"""From before the tool changed anything: what ``fieldtool restore FOLDER`` brings back."""


def refuse_other_drives(backup_file: Path, drives: Iterable[ParameterDrive]) -> None:
    """Refuse to write what was designed for other drives than those that are there now.

    Parameters
    ----------
    backup_file
        The session's first backup; where there is none that can be read, nothing is known.
    drives
        Identified.

    Raises
    ------
    WrongDeviceError
        With axis and numbers.
    """
    try:
        parts = load_backup(backup_file).drives if backup_file.is_file() else ()
    except ProfileError:
        return
    by_axis = {part.axis: part for part in parts}
    for drive in drives:
        part = by_axis.get(drive.axis)
        other = None if part is None else other_number(part, drive)
        if other is not None:
            number, was, found = other
            raise WrongDeviceError(
                f"{drive.axis}: this session was begun on a drive with {number} {was}, node "
                f"{drive.node_id} now has {found}. New parameters are written only into the drives "
                "that they were designed for. Were node ids swapped? If a drive was exchanged on "
                "purpose, measure the machine again: fieldtool run. Nothing was moved or written."
            )


def written_since(journal_file: Path) -> bool:
    """Whether drives were written after the first backup, and are not known to hold its values again.

    A write that was taken back has brought its own backup back, which may be a later one.
    """
    try:
        journal = load_journal(journal_file)
    except (ProfileError, OSError):
        return False
    is_back = journal.state is State.OLD and journal.backup == FIRST_BACKUP
    return journal.writes and not is_back


def other_than_first(backup: Path) -> str:
    """Say that drives hold other values than before a folder's first write; empty where they do not.

    Parameters
    ----------
    backup
        In that folder, of what they hold now.
    """
    if backup.name == FIRST_BACKUP:
        return ""
    return (
        f"The drives hold what they held before this write, not what is in {FIRST_BACKUP}, from before "
        f"the first write of this session: `fieldtool restore {backup.parent}` brings that back."
    )


def may_be_stored(journal_file: Path) -> bool:
    """Whether a drive's non-volatile memory holds, or may hold, other values than the first backup's."""
    try:
        journal = load_journal(journal_file)
    except (ProfileError, OSError):
        return False
    held = {memory_seen_from(FIRST_BACKUP, journal, record) for record in journal.drives}
    return not held <= {Memory.UNTOUCHED, Memory.OLD}


def left_before(journal_file: Path, drives: Iterable[ParameterDrive]) -> Mapping[str, Memory]:
    """Return what each drive's non-volatile memory is known to hold before a new journal, by axis.

    Seen from the folder's first backup: ``OLD`` are that backup's values.  ``UNKNOWN`` where the
    journal that would say it can not be read; a drive that was exchanged has nothing of it.
    """
    if not journal_file.is_file():
        return {}
    try:
        journal = load_journal(journal_file)
    except ProfileError:
        return {drive.axis: Memory.UNKNOWN for drive in drives}
    here = {
        (d.axis, d.identity.vendor_id, d.identity.product_code, d.identity.serial_number)
        for d in drives
    }
    return {
        record.axis: memory_seen_from(FIRST_BACKUP, journal, record)
        for record in journal.drives
        if (record.axis, record.vendor_id, record.product_code, record.serial_number) in here
    }


def memory_seen_from(backup: str, journal: Journal, record: DriveRecord) -> Memory:
    """Return what a drive's non-volatile memory holds: old values are those of this backup.

    Of a write that was cut off it is what that write itself has done: taking it back stores nothing
    that it had not stored.
    """
    if record.memory is Memory.UNTOUCHED:
        if journal.is_open or record.earlier is Memory.UNTOUCHED:
            return Memory.UNTOUCHED
        return record.earlier if backup == FIRST_BACKUP else Memory.UNKNOWN
    if record.memory is Memory.OLD and backup != journal.backup:
        return Memory.UNKNOWN
    return record.memory
