"""``fieldtool tools``: parameter sets of several tool set-ups of one machine."""

from collections.abc import Sequence
from datetime import datetime
from pathlib import Path
from typing import Annotated

import typer
from rich.text import Text

from fieldtool import workflow
from fieldtool.cli.asking import WriteQuestion
from fieldtool.cli.bus_options import Bitrate, Channel, Interface, on_bus
from fieldtool.cli.output import Json, console_of, indented, print_json, written_as_dict
from fieldtool.cli.screen import TerminalScreen, show_parameters
from fieldtool.cli.sheet import Sheet
from fieldtool.cli.stop_key import stop_key
from fieldtool.errors import noting
from fieldtool.workflow.tools import Difference
from fieldtool.writeback.tool_sets import ToolSet
from fieldtool.writeback.transaction import WriteBack

tools_app = typer.Typer(
    no_args_is_help=True,
    help="Parameter sets of several tool set-ups of one machine: keep, compare, switch.",
)
Machine = Annotated[str, typer.Argument(help="Name of a machine profile, or path of its file.")]
Name = Annotated[str, typer.Argument(help="Name of the tool set.")]


@tools_app.command("list")
def list_tools(machine: Machine, as_json: Json = False) -> None:
    """List the tool sets of a machine."""
    found = workflow.tools_of(machine)
    console = console_of(as_json)
    if as_json:
        print_json(found.as_dict())
        return
    if found.whole:
        console.print(_tools_table(found.whole))
    elif not found.bad:
        console.print("No tool set is kept yet: fieldtool tools keep MACHINE NAME --from SESSION")
    for name, problem in found.bad.items():
        console.print(indented(f"{name}: can not be used. {problem}"))


@tools_app.command()
def keep(
    machine: Machine,
    name: Name,
    session: Annotated[
        Path | None,
        typer.Option("--from", help="Session folder that wrote them; the drives' own otherwise."),
    ] = None,
    interface: Interface = None,
    channel: Channel = None,
    bitrate: Bitrate = None,
    as_json: Json = False,
) -> None:
    """Keep what a session wrote, or what the drives hold now, as a tool set."""
    tool = workflow.keep_tool(on_bus(machine, interface, channel, bitrate), name, session)
    console = console_of(as_json)
    count = sum(len(part.held) for part in tool.parameters.drives)
    tried = "stood their trial on the machine" if tool.verified else "were NOT tried on the machine"
    console.print(Text(f"{name}: {count} parameters kept in {tool.path}; they {tried}."))
    if as_json:
        print_json(tool.as_dict())


@tools_app.command()
def compare(machine: Machine, one: Name, other: Name, as_json: Json = False) -> None:
    """Show in what two tool sets differ."""
    a, b, differences = workflow.compare_tools(machine, one, other)
    console = console_of(as_json)
    console.print(_tools_table((a, b)))
    console.print(_difference_table(a, b, differences))
    if not differences:
        console.print(indented("They hold the same parameters."))
    if as_json:
        print_json(
            {
                "tools": [a.as_dict(), b.as_dict()],
                "differences": [
                    {
                        "axis": d.axis,
                        "name": d.name,
                        "object": str(d.address),
                        "values": {one: d.one, other: d.other},
                    }
                    for d in differences
                ],
            }
        )


@tools_app.command()
def switch(
    machine: Machine,
    name: Name,
    yes: Annotated[bool, typer.Option("--yes", help="Do not ask before writing.")] = False,
    store: Annotated[
        bool,
        typer.Option("--store", help="Keep them in non-volatile memory too, if they were tried."),
    ] = False,
    same_drives: Annotated[
        bool,
        typer.Option(
            "--same-drives",
            help="You know that drives without a serial number are those of the tool set.",
        ),
    ] = False,
    interface: Interface = None,
    channel: Channel = None,
    bitrate: Bitrate = None,
    out: Annotated[
        Path | None,
        typer.Option("--out", help="Folder for backup and journal; a new one otherwise."),
    ] = None,
    as_json: Json = False,
) -> None:
    """Write a tool set into the drives: backup, write, read back; nothing moves."""
    console = console_of(as_json)
    folder = out or Path("sessions") / f"{Path(machine).stem}-{name}-{datetime.now():%Y%m%d-%H%M%S}"
    taking_back = "Stopping; what was written is taken back ..."
    with stop_key(taking_back) as key, TerminalScreen(console) as screen:
        ask = WriteQuestion(console, key, yes=yes, store=store)
        result = workflow.switch_tool(
            on_bus(machine, interface, channel, bitrate),
            name,
            folder,
            ask,
            store=store,
            same_drives=same_drives,
            screen=screen,
            stop_requested=key,
        )
    with noting(result.way_back):
        show_parameters(console, result, listed=ask.refused)
        if result.in_memory:
            console.print(indented(_taken_back(result)))
        if as_json:
            screen.print_json(written_as_dict(folder, result))
    ask.end()
    screen.end()


def _taken_back(result: WriteBack) -> str:
    """Say what takes a switch back."""
    if not result.differs:
        return "The drives held these values before: only a backup from before they did takes them back."
    stored = " --store" if result.stored else ""
    return f"`fieldtool restore {result.backup}{stored}` takes it back."


def _tools_table(tools: Sequence[ToolSet]) -> Sheet:
    figures = ("settles in, s", "sensitivity peak")
    table = Sheet("tool set", "kept (UTC)", "tried", "axis", *figures, numbers=figures)
    for tool in tools:
        first = (tool.name, tool.kept[:16], "yes" if tool.verified else "NO")
        rows = tool.figures or {"": {}}
        for k, (axis, measured) in enumerate(rows.items()):
            cells = [
                "" if (value := measured.get(name)) is None else f"{value:.3g}"
                for name in ("settling_time", "sensitivity_peak")
            ]
            table.add(*(first if k == 0 else ("",) * 3), axis, *cells)
    return table


def _difference_table(a: ToolSet, b: ToolSet, differences: Sequence[Difference]) -> Sheet:
    held = (f"{a.name} (drive)", f"{b.name} (drive)")
    table = Sheet("axis", "parameter", "object", *held, numbers=held)
    for d in differences:
        values = [
            "" if v is None else f"{v:.7g}" if isinstance(v, float) else str(v)
            for v in (d.one, d.other)
        ]
        table.add(d.axis, d.name, str(d.address), *values)
    return table
