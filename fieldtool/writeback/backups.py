"""Backups of the drives' parameters in a session folder: none is ever overwritten."""

from collections.abc import Iterator, Sequence
from pathlib import Path

from drives.canopen_drive import CanopenDrive
from drives.errors import ProfileError
from drives.parameters import Backup, back_up, load_backup, save_backup
from fieldtool.errors import OutputError


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
    return keep_backup(back_up(machine, drives), path)


def keep_backup(backup: Backup, path: Path) -> Path:
    """Write a backup that was just taken to a file, as :func:`take_backup`."""
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
