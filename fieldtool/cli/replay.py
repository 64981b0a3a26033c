"""``fieldtool replay``: a session shown again from its trace, without drives."""

import sys
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.text import Text

from drives.objects import ObjectAddress
from drives.profile import MachineProfile
from drives.replay import Decoded
from fieldtool.cli.output import Json, console_of, indented, print_json, put
from fieldtool.cli.screen import TerminalScreen
from fieldtool.cli.sheet import Sheet
from fieldtool.cli.stop_key import stop_key
from fieldtool.cli.tracing import unused
from fieldtool.workflow.replay_again import Again, again
from fieldtool.workflow.replaying import Replayed, Wanted, find_source, replay

KINDS = ("nmt", "sync", "sdo", "pdo", "emcy", "heartbeat", "error", "other")
DIFFERS = 3
"""Exit code when something else was sent or measured than then."""
MOST_LINES = 12
"""Lines of aborts, emergencies ... that are shown."""


def replay_command(
    source: Annotated[Path, typer.Argument(help="Session folder with a trace, or a trace file.")],
    frames: Annotated[bool, typer.Option("--frames", help="Show every frame, decoded.")] = False,
    kind: Annotated[
        list[str] | None,
        typer.Option("--kind", help=f"Show frames of this kind: {', '.join(KINDS)}. Repeatable."),
    ] = None,
    node: Annotated[
        list[int] | None, typer.Option("--node", help="Show frames of this node. Repeatable.")
    ] = None,
    wanted_object: Annotated[
        list[str] | None,
        typer.Option("--object", help="Show frames with this object, as 0x6041. Repeatable."),
    ] = None,
    begin: Annotated[
        float | None, typer.Option("--from", help="Seconds since the first frame.")
    ] = None,
    end: Annotated[
        float | None, typer.Option("--to", help="Seconds since the first frame.")
    ] = None,
    limit: Annotated[
        int | None, typer.Option("--limit", help="Show so many frames at most.", min=1)
    ] = None,
    machine: Annotated[
        str | None, typer.Option("--machine", help="Machine profile; the session's otherwise.")
    ] = None,
    do_again: Annotated[
        bool,
        typer.Option("--again", help="Let the tool do the session again, on the trace alone."),
    ] = False,
    out: Annotated[
        Path | None, typer.Option("--out", help="Folder for what --again makes.")
    ] = None,
    as_json: Json = False,
) -> None:
    """Show a session again from its trace: what every frame meant, and what they amount to."""
    console = console_of(as_json)
    found = find_source(source, machine)
    if do_again:
        folder = out or unused(found.trace.parent / "again")
        with stop_key(), TerminalScreen(console) as screen:
            done = again(found, folder, screen)
        _show_again(console, done)
        if as_json:
            print_json(
                {
                    "folder": str(done.folder),
                    "same_frames": done.same_frames,
                    "rows_compared": done.rows,
                    "differences": list(done.differences),
                }
            )
        if done.differences:
            sys.exit(DIFFERS)
        return
    wanted = _wanted(kind, node, wanted_object, begin, end)
    listed = _Listed(found.machine, limit, as_json)
    shown = wanted if frames or wanted != Wanted() else None
    with stop_key():
        result = replay(found, shown, listed.take)
    show(console, result)
    if listed.left_out:
        console.print(f"{listed.left_out} more frames were not shown (--limit).")
    if as_json:
        data = result.as_dict()
        if shown is not None:
            data = {**data, "shown": listed.rows, "not_shown": listed.left_out}
        print_json(data)


def _wanted(
    kind: list[str] | None,
    node: list[int] | None,
    wanted_object: list[str] | None,
    begin: float | None,
    end: float | None,
) -> Wanted:
    kinds = frozenset(text.lower() for text in kind or ())
    unknown = kinds - set(KINDS)
    if unknown:
        raise typer.BadParameter(
            f"--kind {', '.join(sorted(unknown))}: there is {', '.join(KINDS)}"
        )
    try:
        addresses = frozenset(ObjectAddress.parse(text) for text in wanted_object or ())
    except ValueError as error:
        raise typer.BadParameter(f"--object: {error}") from None
    return Wanted(kinds, frozenset(node or ()), addresses, begin, end)


class _Listed:
    """Frames as they are shown: printed at once, or kept for the JSON object."""

    def __init__(self, machine: MachineProfile | None, limit: int | None, as_json: bool) -> None:
        self._names = {a.node_id: a.name for a in machine.axes} if machine is not None else {}
        self._limit, self._as_json = limit, as_json
        self.rows: list[dict[str, Any]] = []
        self.shown = self.left_out = 0

    def take(self, frame: Decoded, seconds: float) -> None:
        """Show a frame."""
        if self._limit is not None and self.shown >= self._limit:
            self.left_out += 1
            return
        self.shown += 1
        if self._as_json:
            self.rows.append(_row(frame, seconds))
        else:
            put(self._line(frame, seconds))

    def _line(self, frame: Decoded, seconds: float) -> str:
        who = str(frame.node) if frame.node else ""
        name = self._names.get(frame.node, "")
        way = ">" if frame.sent else "<"
        return (
            f"{frame.number:8d} {seconds:12.6f} {way} {frame.identifier:03X} {frame.kind:9} "
            f"{who:>3} {name:10} {_plain(frame.text)}\n"
        )


def _row(frame: Decoded, seconds: float) -> dict[str, Any]:
    return {
        "number": frame.number,
        "seconds": seconds,
        "sent": frame.sent,
        "identifier": frame.identifier,
        "data": frame.data.hex(),
        "kind": frame.kind,
        "node": frame.node,
        "object": str(frame.address) if frame.address is not None else None,
        "text": frame.text,
        "values": [
            {
                "object": str(v.address),
                "name": v.name,
                "raw": v.raw if isinstance(v.raw, int | str) else float(v.raw),
                "physical": v.physical,
                "unit": v.unit or None,
            }
            for v in frame.values
        ],
    }


def _plain(text: str) -> str:
    """Return text from the bus without what would act on a terminal."""
    return "".join(c if c.isprintable() else "?" for c in text)


def show(console: Console, result: Replayed) -> None:
    """Show what a trace amounts to."""
    s = result.statistics
    kinds = ", ".join(f"{count} {kind}" for kind, count in s.kinds.items())
    console.print(Text(f"{result.source.trace}: {s.frames} frames in {s.seconds:.3f} s: {kinds}."))
    if s.pace is not None:
        p = s.pace
        console.print(
            f"SYNC: {p.syncs}, every {p.median * 1000:.4g} ms (median); deviation "
            f"{p.deviation * 1e6:.3g} us, shortest {p.shortest * 1000:.4g} ms, longest "
            f"{p.longest * 1000:.4g} ms; {p.late} late; {p.pauses} pauses."
        )
        console.print(indented(pace_words(p.syncs, p.late, p.pauses)))
    console.print(
        f"Bus load: {100 * s.mean_load:.1f} % in the mean, {100 * s.peak_load:.1f} % at most over "
        "0.1 s (worst-case stuffing)."
    )
    console.print(indented(load_words(s.peak_load)))
    if s.pdos:
        titles = ("PDOs of node", "received", "missing", "doubled")
        table = Sheet(*titles, numbers=titles)
        for one in s.pdos:
            table.add(*map(str, (one.node, one.received, one.missing, one.doubled)))
        console.print(table)
        console.print(
            indented(pdo_words(sum(p.missing for p in s.pdos), sum(p.doubled for p in s.pdos)))
        )
    for what, lines in (
        (
            "SDO aborts (objects that a drive refused; many are asked for only to see whether it "
            "has them)",
            s.aborts,
        ),
        ("Emergencies (faults that drives told of by themselves)", s.emergencies),
        ("Boot-ups (drives that were switched on, or reset)", s.boots),
    ):
        if lines:
            console.print(Text(f"{what}:"))
            for line in lines[:MOST_LINES]:
                console.print(indented(f"{_plain(line)}"))
            if len(lines) > MOST_LINES:
                console.print(indented(f"... and {len(lines) - MOST_LINES} more"))
    if s.unanswered:
        console.print(f"SDO requests without an answer: {s.unanswered}.")
    _show_recording(console, result)


LATE_SHARE = 0.01
"""Of the cycles that may be late before it is said that it matters."""
HIGH_LOAD = 0.9
"""Of the bus' time: more leaves no room for anything else."""


def pace_words(syncs: int, late: int, pauses: int) -> str:
    """Say what the pace of the SYNCs means."""
    if late > LATE_SHARE * max(syncs, 1):
        said = (
            "That many late cycles spoil data: close other programs, or use a longer cycle "
            "(shortest_cycle in the machine profile)."
        )
    else:
        said = "The cycles came as they should; a late one is measured again by itself."
    if pauses:
        said += " Pauses are where nothing was to move, as between experiments."
    return said


def load_words(peak: float) -> str:
    """Say what the load of the bus means."""
    if peak > HIGH_LOAD:
        return (
            "Above 90 % frames wait for each other: a higher bit rate or a longer cycle. "
            "Simulated buses, where frames take no time, may show more than 100 %."
        )
    return "Below 90 % every frame has its place in the cycle."


def pdo_words(missing: int, doubled: int) -> str:
    """Say what missing and doubled PDOs mean."""
    if not missing and not doubled:
        return "Every drive answered every SYNC once, as it has to."
    return (
        "Each drive has to answer every SYNC once: missing ones point to a bad cable, a "
        "termination or a drive that is too slow for the cycle, doubled ones to a second node "
        "with the same id."
    )


def _show_recording(console: Console, result: Replayed) -> None:
    if not result.experiments:
        return
    rows = sum(one.rows for one in result.experiments)
    found = sum(one.rows_found for one in result.experiments)
    same = all(one.whole for one in result.experiments)
    console.print(
        Text(
            f"Recording: {found} of {rows} rows in {len(result.experiments)} experiments are what the "
            "trace's PDOs say, positions and torques of all axes."
            + ("" if same else " These are not:"),
            style="green" if same else "red",
        )
    )
    for one in result.experiments:
        if not one.whole:
            console.print(
                indented(f"{one.experiment}: {one.rows_found} of {one.rows} rows", style="red")
            )


def _show_again(console: Console, done: Again) -> None:
    if not done.differences:
        console.print(
            Text(
                f"The tool sent the same frames as then, and recorded the same: {done.rows} rows, every "
                f"number. What it made is in {done.folder}.",
                style="green",
            )
        )
        return
    for text in done.differences:
        console.print(Text(f"! {text}", style="red"))
