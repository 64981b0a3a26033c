"""Where commands print: tables and sentences on a console, JSON on standard output."""

import json
import os
import shutil
import sys
import textwrap
from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any, NoReturn

import typer
from rich.console import Console, ConsoleOptions, RenderableType
from rich.text import Text

from drives.errors import UserStopError
from fieldtool import workflow
from fieldtool.writeback.transaction import WriteBack

Json = Annotated[bool, typer.Option("--json", help="Print one JSON object and nothing else.")]
"""Option of every command that can answer a program."""
WIDTH = 120
"""Columns where there is no terminal."""
INDENT = 2
"""Spaces before sentences below a heading."""


class _Console(Console):
    """A console that ends the session, as the user's stop does, when nobody reads it any more."""

    def on_broken_pipe(self) -> None:
        """Raise UserStopError instead of leaving at once."""
        self.quiet = True
        nobody_reads()


def console_of(as_json: bool) -> Console:
    """Return the console to show things on: standard error where JSON goes to standard output."""
    plain: dict[str, Any] = {
        "stderr": as_json, "highlight": False, "markup": False, "emoji": False
    }  # fmt: skip
    console = _Console(**plain)
    return console if console.is_terminal else _Console(**plain, width=WIDTH)


def nobody_reads() -> NoReturn:
    """End a command whose output nobody reads any more.

    Raises
    ------
    UserStopError
        Always: what moves is stopped, what was changed is put back.
    """
    drop_output()
    raise UserStopError("the output was closed before its end: stopped.")


def drop_output() -> None:
    """Let what is still to be written to standard output go nowhere."""
    with suppress(OSError, ValueError):
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, sys.stdout.fileno())
        os.close(nowhere)


def put(text: str) -> None:
    """Write plain text on standard output."""
    try:
        sys.stdout.write(text)
        sys.stdout.flush()
    except BrokenPipeError:
        nobody_reads()


def confirmed(question: str) -> bool:
    """Ask a person, on standard error; no answer at all is a no."""
    try:
        return typer.confirm(told(question), err=True)
    except typer.Abort:
        with suppress(OSError):
            sys.stderr.write("\n")
        return False


class _Indented:
    """A sentence all of whose lines are indented, and that ends where its words end."""

    def __init__(self, text: Text) -> None:
        self._text = text

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> Iterator[Text]:
        for line in self._text.wrap(console, max(options.max_width - INDENT, 1)):
            line.rstrip()
            yield Text(" " * INDENT).append_text(line)


def indented(text: str, style: str = "") -> RenderableType:
    """Return a sentence below a heading, all of its lines indented."""
    return _Indented(Text(text, style=style))


def told(text: str) -> str:
    """Return a text for standard error: on a terminal no word is broken at the end of a line."""
    if not sys.stderr.isatty():
        return text
    width = max(shutil.get_terminal_size().columns, 20)
    lines = (
        textwrap.wrap(line, width, break_long_words=False, break_on_hyphens=False)
        for line in text.split("\n")
    )
    return "\n".join("\n".join(line) for line in lines)


def written_as_dict(folder: Path, result: WriteBack) -> dict[str, Any]:
    """Return what ``--json`` prints of a write."""
    return {
        "folder": str(folder),
        "written": result.in_memory,
        "stored": result.stored,
        "parameters": workflow.parameter_table(result),
    }


def print_json(data: Mapping[str, Any]) -> None:
    """Print one JSON object on standard output."""
    put(json.dumps(data, indent=2, allow_nan=False) + "\n")
