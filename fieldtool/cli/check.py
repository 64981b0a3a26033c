"""``fieldtool check``: a table of pass, warn, fail before the first motion."""

import sys
from datetime import datetime
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.text import Text

from fieldtool import workflow
from fieldtool.cli.bus_options import Bitrate, Channel, Interface, on_bus
from fieldtool.cli.output import Json, confirmed, console_of, print_json
from fieldtool.cli.sheet import Sheet
from fieldtool.cli.stop_key import somebody_there, stop_key
from fieldtool.cli.tracing import TraceFile, TraceWanted, trace_path
from fieldtool.experiment.checks.finding import Finding, Status
from fieldtool.workflow.checking import CheckResult, unit_of, way_of

STYLES: dict[Status, str] = {
    "pass": "green",
    "warn": "yellow",
    "fail": "bold red",
    "not tried": "dim",
}
FAILED, STOPPED, LEFT = 3, 4, 7
"""Exit codes: refused before motion; stopped for safety; drives hold what was set for the moves."""


def check(
    machine: Annotated[str, typer.Argument(help="Name of a machine profile, or path of its file.")],
    move: Annotated[
        bool | None,
        typer.Option(
            "--move/--no-move", help="Move every axis a little, or none; asked otherwise."
        ),
    ] = None,
    yes: Annotated[bool, typer.Option("--yes", help="Move without asking.")] = False,
    interface: Interface = None,
    channel: Channel = None,
    bitrate: Bitrate = None,
    trace: TraceWanted = False,
    trace_file: TraceFile = None,
    as_json: Json = False,
) -> None:
    """Check a machine before its first motion. MOVES EVERY AXIS A LITTLE, if you say so."""
    profile = on_bus(machine, interface, channel, bitrate)
    console = console_of(as_json)
    folder = Path("sessions") / f"check-{Path(machine).stem}-{datetime.now():%Y%m%d-%H%M%S}"
    traced = trace_path(trace, trace_file, folder)
    if traced is not None and trace_file is None:
        folder.mkdir(parents=True, exist_ok=True)

    simulated = workflow.simulated_words(profile)
    if simulated:
        console.print(Text(simulated, style="bold yellow"))

    def may_move() -> bool:
        if move is not None:
            return move
        if yes:
            return True
        if not somebody_there():
            return False
        axes = ", ".join(f"{a.name} by {way_of(a):.2g} {unit_of(a)}" for a in profile.axes)
        return confirmed(
            f"Now every axis is enabled and moves a little and back: {axes}. Keep clear of the "
            "machine.\nMove the axes now?"
        )

    with stop_key() as key:
        result = workflow.check(
            profile,
            may_move=may_move,
            stop_requested=key,
            trace=traced,
            say=lambda text: console.print(Text(f"▶ {text}", style="bold")),
        )
    show(console, result)
    if traced is not None and traced.is_file():
        console.print(Text(f"Every frame is in {traced}."))
    if as_json:
        print_json(result.as_dict())
    if result.verdict == "fail":
        sys.exit(STOPPED if result.stopped else LEFT if result.not_put_back else FAILED)


def show(console: Console, result: CheckResult) -> None:
    """Show all findings, those of the machine first, then axis by axis, and the summary."""
    table = Sheet("", "check", "found, and what to do", gap=1)
    axes = list(dict.fromkeys(one.axis for one in result.findings))
    for axis in sorted(axes, key=bool):
        if axis:
            table.add()
            table.add("", Text(axis, style="bold"))
        for one in result.findings:
            if one.axis == axis:
                table.add(*_row(one))
    console.print(table)
    style = STYLES[result.verdict]
    console.print(Text(result.sentence, style=style))


def _row(one: Finding) -> tuple[Text, Text, Text]:
    found = Text(one.found)
    if one.todo:
        found.append(f"\n→ {one.todo}", style=STYLES[one.status])
    return Text(one.status, style=STYLES[one.status]), Text(one.check), found
