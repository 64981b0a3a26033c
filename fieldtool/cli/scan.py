"""``fieldtool scan``: what is on the bus, on the screen."""

import sys
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.padding import Padding
from rich.text import Text

from drives.profile import BusProfile, MachineProfile
from drives.scan import ScannedNode
from fieldtool.cli.bus_options import Bitrate, Channel, Interface, channel_of, on_bus
from fieldtool.cli.output import Json, console_of, print_json
from fieldtool.cli.progress import ShareBar
from fieldtool.cli.sheet import Sheet
from fieldtool.cli.tracing import TraceFile, trace_path
from fieldtool.workflow.scanning import ScanResult
from fieldtool.workflow.scanning import scan as scan_bus
from fieldtool.workflow.skeleton import write_skeleton

LONGEST_LISTENING = 120.0
NOBODY = 3
"""Exit code when no node was found."""
_STYLES = {"fits": "green", "may fit": "yellow", "does not fit": "red"}


def scan(
    machine: Annotated[
        str | None, typer.Argument(help="Machine profile whose bus is scanned, to compare with.")
    ] = None,
    interface: Interface = None,
    channel: Channel = None,
    bitrate: Bitrate = None,
    listen: Annotated[
        float,
        typer.Option(
            "--listen", help="Seconds of listening first.", min=0.1, max=LONGEST_LISTENING
        ),
    ] = 1.5,
    ask: Annotated[
        bool | None,
        typer.Option(
            "--ask/--listen-only",
            help="Ask nodes also beside another master; or never. Otherwise only without one.",
        ),
    ] = None,
    profile: Annotated[
        Path | None,
        typer.Option("--profile", help="Write a machine profile to be completed (FILE.yaml)."),
    ] = None,
    trace_file: TraceFile = None,
    as_json: Json = False,
) -> None:
    """Show what is on the bus, and which drive profile fits. Writes nothing, changes no state."""
    bus, known = _bus(machine, interface, channel, bitrate)
    console = console_of(as_json)
    with ShareBar(console, "listening") as told:
        result = scan_bus(
            bus,
            known,
            listen=listen,
            ask=ask,
            trace=trace_path(False, trace_file, Path()),
            progress=told,
        )
    show(console, result)
    if profile is not None and result.scan.nodes:
        axes, still_open = write_skeleton(result, profile)
        console.print(
            Text(
                f"{profile} written: {axes} axes, {still_open} places to fill in. Until then nothing "
                "moves with it: `fieldtool check` names what is missing, with its line."
            )
        )
    if as_json:
        print_json(result.as_dict())
    if not result.scan.nodes:
        sys.exit(NOBODY)


def _bus(
    machine: str | None, interface: str | None, channel: str | None, bitrate: int | None
) -> tuple[BusProfile, MachineProfile | None]:
    """Return where to scan, and the machine that should be there, if one was given."""
    if machine is not None:
        known = on_bus(machine, interface, channel, bitrate)
        return known.bus, known
    if interface is None:
        raise typer.BadParameter("give a machine profile, or --interface (and --channel)")
    try:
        bus = BusProfile(interface=interface).elsewhere(None, channel_of(channel), bitrate)
    except ValueError:
        raise typer.BadParameter(f"--interface {interface!r} is no name of an interface") from None
    return bus, None


def show(console: Console, result: ScanResult) -> None:
    """Show what was found: a table of nodes, then what each would miss, then problems."""
    scanned, traffic = result.scan, result.scan.traffic
    heard = f"{traffic.frames} frames in {traffic.seconds:.1f} s of listening"
    if traffic.sync_period is not None:
        heard += f", a SYNC every {traffic.sync_period * 1000:.3g} ms"
    where = f"{result.bus.interface} {'' if result.bus.channel is None else result.bus.channel}"
    console.print(
        Text(f"{where.strip()}, {result.bus.bitrate} bit/s: {heard}; {len(scanned.nodes)} nodes.")
    )
    if scanned.nodes:
        console.print(_table(scanned.nodes))
    _show_details(console, scanned.nodes)
    for sentence in scanned.problems:
        console.print(Text(f"! {sentence[0].upper()}{sentence[1:]}", style="yellow"))
    if result.machine is not None:
        for remark in result.remarks:
            console.print(Text(f"! {remark}", style="yellow"))
        if scanned.asked and not result.remarks:
            console.print(Text(f"Every node is as {result.machine.name} says.", style="green"))


def _table(nodes: tuple[ScannedNode, ...]) -> Sheet:
    table = Sheet("node", "device", "vendor:product", "serial", "state", "profile")
    for node in nodes:
        identity, fit = node.identity, next(iter(node.fits), None)
        state = ", ".join(part for part in (node.heard.state, node.power) if part)
        if identity is None:
            row = [str(node.node_id), "not asked" if not node.answers else "?", "", "", state]
        else:
            row = [
                str(node.node_id),
                identity.device_name or "(no name)",
                f"{identity.vendor_id:X}:{identity.product_code:X}",
                str(identity.serial_number),
                state,
            ]
        profile = Text()
        if fit is not None and not fit.fits:
            profile = Text("none fits", style="red")
        elif fit is not None:
            profile = Text(f"{fit.profile} {fit.verdict}", style=_STYLES[fit.verdict])
        table.add(*row, profile)
    return table


def _show_details(console: Console, nodes: tuple[ScannedNode, ...]) -> None:
    """Show what there is to say of each node; nodes of which it is the same stand together."""
    same: dict[tuple[tuple[str, str], ...], list[int]] = {}
    for node in nodes:
        same.setdefault(_details(node), []).append(node.node_id)
    for lines, ids in same.items():
        if lines:
            word = "node" if len(ids) == 1 else "nodes"
            console.print(Text(f"{word} {', '.join(map(str, ids))}", style="bold"))
        for text, style in lines:
            console.print(Padding(Text(text, style=style), (0, 0, 0, 2)))


def _details(node: ScannedNode) -> tuple[tuple[str, str], ...]:
    """Return lines and their styles."""
    lines: list[tuple[str, str]] = []
    fit = next(iter(node.fits), None)
    if node.identity is not None and node.identity.firmware:
        lines.append((f"firmware {node.identity.firmware}", ""))
    if node.modes is not None:
        lines.append((f"modes: {', '.join(node.modes) or 'none that CiA 402 defines'}", ""))
    if fit is not None:
        lines.append((f"profile {fit.profile} {fit.verdict}: {fit.why}", ""))
        lines += [(f"differs: {text}", "yellow") for text in fit.differences]
    for need in node.needs:
        shown = f"{need.what} ({need.shown})" + (
            f": {need.consequence}" if need.consequence else ""
        )
        if need.found == "missing":
            lines.append((f"missing: {shown}", "red" if need.blocks else "yellow"))
        elif need.found == "not known":
            lines.append((f"not known: {shown}", "yellow"))
    heard = node.heard
    if heard.heartbeat is not None:
        lines.append((f"heartbeat every {heard.heartbeat:.3g} s", ""))
    if heard.booted:
        lines.append(("booted while listening", ""))
    if heard.pdos:
        lines.append((f"sends {', '.join(heard.pdos)}", ""))
    lines += [(f"emergency {text}", "red") for text in heard.emergencies]
    if node.problem:
        lines.append((node.problem, "yellow"))
    return tuple(lines)
