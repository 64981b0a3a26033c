"""Files that are whole at every instant, whatever is cut off in between."""

import os
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path


def write_durably(
    path: Path, content: bytes, check: Callable[[Path], None] = lambda _: None
) -> None:
    """Put a file in place so that a power cut leaves the old one or the new one, never a part.

    The content goes to ``NAME.part`` beside it, to the disk, and takes the name in one step; the
    folder is brought to the disk as well, where the system can do that.

    Parameters
    ----------
    path
        File.
    content
        All of it.
    check
        Sees the finished ``NAME.part`` before it takes the name; what it raises stops that.

    Raises
    ------
    OSError
        If it can not be written; what was there before is unchanged.
    """
    temporary = path.with_name(path.name + ".part")
    try:
        with temporary.open("wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        check(temporary)
        temporary.replace(path)
    finally:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)
    sync_folder(path.parent)


def remove_durably(path: Path) -> None:
    """Remove a file, if there is one, so that it stays removed.

    Raises
    ------
    OSError
        If it can not be removed.
    """
    path.unlink(missing_ok=True)
    sync_folder(path.parent)


def sync_folder(folder: Path) -> None:
    """Bring a folder's entries to the disk; Windows does so by itself and lets nobody ask."""
    with suppress(OSError):
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)
