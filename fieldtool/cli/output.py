"""Where commands print: tables and sentences on a console, JSON on standard output."""

import json
import shutil
import sys
import textwrap
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.padding import Padding
from rich.text import Text

from fieldtool import workflow
from fieldtool.writeback.transaction import WriteBack

Json = Annotated[bool, typer.Option("--json", help="Print one JSON object and nothing else.")]
"""Option of every command that can answer a program."""
WIDTH = 120
"""Columns where there is no terminal."""


def console_of(as_json: bool) -> Console:
    """Return the console to show things on: standard error where JSON goes to standard output."""
    console = Console(stderr=as_json, highlight=False)
    return console if console.is_terminal else Console(stderr=as_json, highlight=False, width=WIDTH)


def indented(text: str, style: str = "") -> Padding:
    """Return a sentence below a heading, all of its lines indented."""
    return Padding(Text(text, style=style), (0, 0, 0, 2), expand=False)


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
    sys.stdout.write(json.dumps(data, indent=2, allow_nan=False) + "\n")
