"""Where commands print: tables and sentences on a console, JSON on standard output."""

import json
import sys
from collections.abc import Mapping
from typing import Annotated, Any

import typer
from rich.console import Console

Json = Annotated[bool, typer.Option("--json", help="Print one JSON object and nothing else.")]
"""Option of every command that can answer a program."""
WIDTH = 120
"""Columns where there is no terminal."""


def console_of(as_json: bool) -> Console:
    """Return the console to show things on: standard error where JSON goes to standard output."""
    console = Console(stderr=as_json, highlight=False)
    return console if console.is_terminal else Console(stderr=as_json, highlight=False, width=WIDTH)


def print_json(data: Mapping[str, Any]) -> None:
    """Print one JSON object on standard output."""
    sys.stdout.write(json.dumps(data, indent=2, allow_nan=False) + "\n")
