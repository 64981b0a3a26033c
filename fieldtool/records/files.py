"""Read and write whole files with clear errors; a file is replaced in one step or not at all."""

import errno
import os
import tempfile
from pathlib import Path

from fieldtool.errors import FileFormatError, OutputError

MEBIBYTE = 1024 * 1024


def write_atomic(path: Path | str, content: bytes | memoryview) -> None:
    """Write ``content`` beside ``path``, flush it to the disk and rename it into place.

    Whatever happens, ``path`` holds either what it held before or all of ``content``.

    Raises
    ------
    OutputError
        If the folder is missing or not writable, or the disk is full; the sentence says which.
    """
    path = Path(path)
    _refuse_folder(path)
    temporary: str | None = None
    try:
        handle, temporary = tempfile.mkstemp(prefix=f".{path.name}.", dir=path.parent)
        with os.fdopen(handle, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.chmod(temporary, _mode_of(path))
        os.replace(temporary, path)
        temporary = None
    except OSError as error:
        raise OutputError(_reason(path, len(content), error)) from error
    finally:
        if temporary is not None:
            Path(temporary).unlink(missing_ok=True)


def check_writable(path: Path) -> None:
    """Refuse a path to which :func:`write_atomic` could write nothing; what is there is unchanged.

    Raises
    ------
    OutputError
        As :func:`write_atomic`.
    """
    _refuse_folder(path)
    try:
        with tempfile.NamedTemporaryFile(prefix=f".{path.name}.", dir=path.parent):
            pass
    except OSError as error:
        raise OutputError(_reason(path, 0, error)) from error


def write_new(path: Path, text: str) -> None:
    """Write a text file that must not be there yet; where that fails, nothing is left of it.

    Raises
    ------
    FileExistsError
        If it is there already; it is unchanged.
    OutputError
        If it can not be written.
    """
    try:
        with path.open("x", encoding="utf-8") as file:
            try:
                file.write(text)
                file.flush()
                os.fsync(file.fileno())
            except OSError:
                path.unlink(missing_ok=True)
                raise
    except FileExistsError:
        raise
    except OSError as error:
        raise OutputError(_reason(path, len(text), error)) from error


def make_folder(path: Path | str) -> Path:
    """Make the folder ``path`` and its parents if they are missing; return it.

    Raises
    ------
    OutputError
        If it can not be made, or something else has its name.
    """
    path = Path(path)
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(
            f"the folder {path} can not be made ({error.strerror}): choose another folder."
        ) from error
    return path


def read_text(path: Path | str, max_bytes: int) -> str:
    """Return the UTF-8 text of ``path`` without a byte order mark.

    Raises
    ------
    FileFormatError
        If the file is missing, unreadable, larger than ``max_bytes`` or not UTF-8.
    """
    path = Path(path)
    check_size(path, max_bytes)
    try:
        return path.read_bytes().decode("utf-8-sig")
    except OSError as error:
        raise FileFormatError(path, f"can not be read ({error.strerror}).") from error
    except UnicodeDecodeError as error:
        line = error.object[: error.start].count(b"\n") + 1
        raise FileFormatError(path, "is not UTF-8 text: save it as UTF-8.", line) from error


def check_size(path: Path | str, max_bytes: int) -> int:
    """Return the size of the file in bytes.

    Raises
    ------
    FileFormatError
        If ``path`` is no readable file or is larger than ``max_bytes``.
    """
    path = Path(path)
    try:
        status = path.stat()
    except OSError as error:
        raise FileFormatError(path, f"can not be opened ({error.strerror}).") from error
    if not path.is_file():
        raise FileFormatError(path, "is not a file.")
    if status.st_size > max_bytes:
        raise FileFormatError(
            path,
            f"is {status.st_size / MEBIBYTE:.1f} MiB, the limit is {max_bytes / MEBIBYTE:.0f} MiB.",
        )
    return status.st_size


def _refuse_folder(path: Path) -> None:
    if os.path.isdir(path):  # false where that can not be seen, too
        raise OutputError(f"{path} is a folder, not a file: give a file name to write to.")


def _mode_of(path: Path) -> int:
    """Permissions for the new file: those of the old one, else what a plain open would give."""
    try:
        return path.stat().st_mode & 0o777
    except OSError:
        mask = os.umask(0)
        os.umask(mask)
        return 0o666 & ~mask


def _reason(path: Path, size: int, error: OSError) -> str:
    if error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
        return (
            f"{path} can not be written: no room for {size / MEBIBYTE:.1f} MiB on the disk "
            f"({error.strerror}); what was there before is unchanged. Make room and try again."
        )
    if error.errno in (errno.ENOENT, errno.ENOTDIR):
        return f"{path} can not be written: there is no folder {path.parent}. Make it first."
    return (
        f"{path} can not be written ({error.strerror}): check that the folder {path.parent} "
        "is writable and that no other program holds the file."
    )
