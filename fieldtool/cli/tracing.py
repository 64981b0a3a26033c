"""Where a session's trace goes."""

from pathlib import Path
from typing import Annotated

import typer

from drives.trace import FORMATS

TraceWanted = Annotated[
    bool, typer.Option("--trace", help="Note every CAN frame in trace.asc in the session folder.")
]
TraceFile = Annotated[
    Path | None,
    typer.Option(
        "--trace-file",
        help="Note every CAN frame in this file; its suffix says how: .asc, .blf or .log.",
    ),
]


def trace_path(wanted: bool, file: Path | None, folder: Path) -> Path | None:
    """Return the file to write a trace to, one that does not exist yet; None if none is wanted.

    Raises
    ------
    typer.BadParameter
        If the file named by the user exists, or has another suffix than a trace can have.
    """
    if file is None:
        return unused(folder / "trace.asc") if wanted else None
    if file.suffix.lower() not in FORMATS:
        raise typer.BadParameter(
            f"--trace-file ends in {', '.join(FORMATS)}, which says how it is written; got {file}"
        )
    if file.exists():
        raise typer.BadParameter(f"--trace-file {file} exists, and is not overwritten")
    return file


def unused(path: Path) -> Path:
    """Return the path, or one with a number that does not exist yet: trace.asc, trace-2.asc ..."""
    number, free = 2, path
    while free.exists():
        free = path.with_stem(f"{path.stem}-{number}")
        number += 1
    return free
