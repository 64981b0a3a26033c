"""``fieldtool write`` and ``restore``: parameters into the drives, and back."""

from pathlib import Path
from typing import Annotated

import typer

from fieldtool import workflow
from fieldtool.cli.asking import WriteQuestion
from fieldtool.cli.bus_options import Bitrate, Channel, Interface, on_bus
from fieldtool.cli.options import Store, Verify, Yes, tried
from fieldtool.cli.output import Json, console_of, print_json, written_as_dict
from fieldtool.cli.restored import show_restored
from fieldtool.cli.screen import TerminalScreen, show_parameters
from fieldtool.cli.stop_key import may_move, stop_key
from fieldtool.cli.stoppable import StoppableScreen
from fieldtool.cli.tracing import TraceFile, TraceWanted, trace_path
from fieldtool.errors import noting
from fieldtool.records.session_folder import SessionFolder


def write(
    folder: Annotated[Path, typer.Argument(help="Session folder with a tuning.")],
    yes: Yes = False,
    store: Store = False,
    verify: Verify = True,
    interface: Interface = None,
    channel: Channel = None,
    bitrate: Bitrate = None,
    trace: TraceWanted = False,
    trace_file: TraceFile = None,
    as_json: Json = False,
) -> None:
    """MOVES THE MACHINE. Write the session folder's tuning: backup, write, read back, try."""
    console = console_of(as_json)
    traced = trace_path(trace, trace_file, folder)
    options = workflow.Options(write=True, store=store, verify=tried(verify, store), trace=traced)
    with stop_key() as key, TerminalScreen(console, may_move(yes)) as screen:
        stoppable = StoppableScreen(screen, key)
        ask = WriteQuestion(console, key, yes=yes, store=store)
        profile = on_bus(SessionFolder.existing(folder).profile, interface, channel, bitrate)
        result, verified = workflow.write(
            folder, options, ask, screen=stoppable, machine=profile, stop_requested=key
        )
    with noting(result.way_back):
        show_parameters(console, result, listed=ask.refused)
        if as_json:
            trial = verified.as_dict() if verified else None
            done = written_as_dict(folder, result) | {"verification": trial}
            screen.print_json(done)
    ask.end()
    screen.end()


def restore(
    backup: Annotated[Path, typer.Argument(help="Backup file, or the session folder with it.")],
    machine: Annotated[
        str | None, typer.Option("--machine", help="Machine profile; the session's otherwise.")
    ] = None,
    store: Annotated[
        bool, typer.Option("--store", help="Store the restored parameters too.")
    ] = False,
    interface: Interface = None,
    channel: Channel = None,
    bitrate: Bitrate = None,
    same_drives: Annotated[
        bool,
        typer.Option(
            "--same-drives",
            help="You know that drives without a serial number are those of the backup.",
        ),
    ] = False,
    without: Annotated[
        list[str] | None,
        typer.Option(
            "--without",
            help="Leave this axis as it is: its drive is gone or was exchanged; may be repeated.",
        ),
    ] = None,
    trace: TraceWanted = False,
    trace_file: TraceFile = None,
    as_json: Json = False,
) -> None:
    """Bring a backup of the drives' parameters back, or take back a write that was cut off."""
    folder = backup.parent if backup.is_file() else backup
    if machine is None:
        machine = str(SessionFolder.existing(folder).profile)
    traced = trace_path(trace, trace_file, folder)
    console = console_of(as_json)
    with stop_key(), TerminalScreen(console) as screen:
        profile = on_bus(machine, interface, channel, bitrate)
        restored = workflow.restore(
            profile, backup, store, traced, same_drives, without or (), screen
        )
    show_restored(console, restored)
    if as_json:
        print_json(restored.as_dict())
