"""Read trace files, frame by frame: they may be longer than what fits into memory."""

from collections.abc import Generator
from pathlib import Path
from typing import IO, Any

import can

from drives.errors import ProfileError, UserStopError
from drives.trace import FORMATS

_READERS: dict[str, Any] = {
    ".asc": can.ASCReader,
    ".blf": can.BLFReader,
    ".log": can.CanutilsLogReader,
}


def _opened(path: Path) -> IO[Any]:
    """Open a trace; whoever reads it closes it, whatever is in it."""
    if path.suffix.lower() == ".blf":
        return path.open("rb")
    return path.open(encoding="utf-8", errors="replace")


def read_trace(path: Path) -> Generator[can.Message]:
    """Yield the frames of a trace in the order in which the host sent and received them.

    A file that was cut short, as by a crash, is read up to there.

    Raises
    ------
    ProfileError
        If there is no such file, its suffix is none of ``drives.trace.FORMATS``, or it is no trace.
    """
    if not path.is_file():
        raise ProfileError(path, "no such file")
    if path.suffix.lower() not in FORMATS:
        raise ProfileError(path, f"is no trace: these end in {', '.join(FORMATS)}")
    found = 0
    try:
        with _opened(path) as file:
            for message in _READERS[path.suffix.lower()](file):
                found += 1
                yield message
    except UserStopError:
        raise
    except Exception as error:  # the readers raise whatever they stumble upon
        if not found:
            said = " ".join(str(error).split())[:120] or type(error).__name__
            raise ProfileError(path, f"is no trace that can be read ({said})") from None
    if not found:
        raise ProfileError(path, "is no trace: there is no frame in it")
