"""Bring new parameters into the drives: all or nothing, read back, undoable."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from drives.canopen_drive import CanopenDrive
from drives.errors import NotSupportedError, ProfileError
from drives.parameters import (
    Backup,
    Change,
    HeldObject,
    Written,
    back_up,
    load_backup,
    planned_changes,
    restore,
    save_backup,
    store,
    write,
)
from fieldtool.design.tuning import Tuning
from fieldtool.errors import OutputError

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

    @property
    def sentence(self) -> str:
        """Where the new values are, for a person."""
        if not self.in_memory:
            return "Nothing was written: the drives hold their old parameters."
        if self.stored:
            return "The new parameters are in the drives and stored: they survive a power cycle."
        return (
            "The new parameters are in the drives' working memory only: a power cycle brings the old "
            "ones back. Use --store to keep them."
        )


def take_backup(machine: str, drives: Sequence[CanopenDrive], path: Path) -> Path:
    """Back up every writable parameter of every drive to a file; return the file.

    A backup that is there already is never overwritten: it holds what the drives held before the
    first write.  Where it holds what the drives hold now, it is this backup; otherwise this one
    gets the next free name, ``NAME-2.yaml`` and so on.

    Raises
    ------
    OutputError
        If the file can not be written; then nothing may be changed.
    """
    backup = back_up(machine, drives)
    for candidate in _names(path):
        try:
            if candidate.exists():
                if _holds(candidate, backup):
                    return candidate
                continue
            save_backup(backup, candidate)
        except (OSError, ProfileError) as error:
            reason = error.strerror if isinstance(error, OSError) else str(error)
            raise OutputError(
                f"{candidate}: the backup of the drives' parameters can not be written ({reason}). "
                "Nothing is written to the drives without it. Make room, or choose another folder."
            ) from error
        return candidate
    raise OutputError(f"{path}: there are too many backups beside it. Choose another folder.")


def _names(path: Path) -> Iterator[Path]:
    yield path
    for number in range(2, 1000):
        yield path.with_name(f"{path.stem}-{number}{path.suffix}")


def _holds(path: Path, backup: Backup) -> bool:
    """Whether this file is a whole backup of the same drives with the same values."""
    try:
        return load_backup(path).drives == backup.drives
    except ProfileError:
        return False


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
    tuning: Tuning,
    backup_path: Path,
    confirm: Confirm,
    keep: bool = False,
) -> WriteBack:
    """Back up, show, ask, write, read back, and store if wanted.

    Parameters
    ----------
    machine
        Name, for the backup.
    drives
        Disabled drives.
    tuning
        New parameters.
    backup_path
        File for the backup, written before the first change; see :func:`take_backup`.
    confirm
        Sees old and new values and says whether to write.
    keep
        Store in non-volatile memory too.

    Raises
    ------
    WriteBackError, WriteBackMixedError
        As ``drives.parameters.write``; and if not every drive stores the parameters.
    OutputError
        If the backup can not be written; nothing was changed.
    """
    changes = changes_for(drives, tuning)
    backup_path = take_backup(machine, drives, backup_path)
    if not confirm(changes):
        return WriteBack((), changes, in_memory=False, stored=False, backup=backup_path)
    written = write(drives, changes)
    if keep:
        store(drives)
    return WriteBack(written, changes, in_memory=True, stored=keep, backup=backup_path)


def undo(drives: Sequence[CanopenDrive], path: Path, keep: bool = False) -> tuple[HeldObject, ...]:
    """Bring a backup back into the drives it was made on; return what had to be written."""
    written = restore(drives, load_backup(path))
    if keep:
        store(drives)
    return written
