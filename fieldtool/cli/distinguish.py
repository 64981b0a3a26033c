"""``fieldtool measure MACHINE --to-distinguish SESSION``: measure what tells rivals apart."""

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.text import Text

from drives.profile import MachineProfile
from fieldtool import workflow
from fieldtool.cli.criticise import show_criticism
from fieldtool.cli.screen import TerminalScreen
from fieldtool.cli.stop_key import StopKey
from fieldtool.cli.stoppable import StoppableScreen

ToDistinguish = Annotated[
    Path | None,
    typer.Option(
        "--to-distinguish",
        help="Session folder whose criticism left a tie: measure what tells the rivals apart.",
    ),
]


def tell_apart(
    machine: MachineProfile,
    earlier: Path,
    folder: Path,
    options: workflow.Options,
    screen: TerminalScreen,
    key: StopKey,
    console: Console,
    as_json: bool,
) -> None:
    """Plan, measure and criticise, and show what it came to."""
    if options.plan != "fast":
        raise typer.BadParameter("--to-distinguish is for the fast plan")
    done = workflow.distinguish(
        machine, earlier, folder, options, screen=StoppableScreen(screen, key), stop_requested=key
    )
    show_criticism(console, done.criticism)
    console.print(Text(done.answer, style="bold"))
    console.print(Text(f"Both recordings, criticism and report are in {folder}."))
    if as_json:
        screen.print_json(done.as_dict())
