"""Note that drives hold other values for the time of a measurement, should it be cut off."""

import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

from drives.canopen_drive import CanopenDrive
from drives.parameters import Storing
from drives.parameters.journal import Goal
from fieldtool.writeback.backups import take_backup
from fieldtool.writeback.earlier import left_before
from fieldtool.writeback.transaction import planned_journal
from fieldtool.writeback.unfinished import JOURNAL, JournalKeeper, not_kept


@contextmanager
def backed_up(machine: str, drives: Sequence[CanopenDrive], backup_path: Path) -> Iterator[Path]:
    """Back all parameters up, and leave a note for as long as the drives may hold others.

    A measurement switches feed-forward off, arms fail-safe objects and maps PDOs, and puts all of it
    back when it ends, however it ends.  If the tool is killed, or a drive can not be reached any more,
    it can not; and a drive that restarts has lost what was not stored in it.  Then the note makes the
    next session ask for ``fieldtool restore``, so that no later backup takes such values for the
    machine's own.
    The journal of a write that has ended is put back afterwards: it says what the drives have stored.
    Gives the backup's file.

    Raises
    ------
    OutputError
        If backup or note can not be written; nothing was changed.
    """
    boots = {drive.axis: drive.boots for drive in drives}
    backup = take_backup(machine, drives, backup_path)
    keeper = JournalKeeper(backup.with_name(JOURNAL))
    earlier = left_before(keeper.path, drives)
    journal = planned_journal(machine, drives, (), backup.name, Storing.NONE, earlier)
    journal = replace(journal, goal=Goal.OLD).turned_back(distrust=True)
    with keeper:
        try:
            before = keeper.ended_before()
            keeper(journal)
        except OSError as error:
            raise not_kept(keeper, error) from error
        try:
            yield backup
        finally:
            for drive in drives:
                drive.left_changed |= drive.boots != boots[drive.axis]
            left = left_axes(drives)
            if not left:
                keeper.forget(journal, before)
            elif (cause := sys.exc_info()[1]) is not None:
                cause.add_note(left_words(left, backup.parent))


def left_axes(drives: Sequence[CanopenDrive]) -> list[str]:
    """Return the axes whose drives still hold what was set for a time."""
    return [drive.axis for drive in drives if drive.left_changed]


def left_words(axes: Sequence[str], folder: Path) -> str:
    """Say that drives still hold what was set for a time, and what brings the old values back."""
    return (
        f"{', '.join(axes)}: not everything is as it was before. Once all drives can be reached "
        f"again: fieldtool restore {folder}"
    )
