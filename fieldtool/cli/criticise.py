"""``fieldtool criticise``: what the simulation gets wrong, why, and what is gained by knowing."""

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.text import Text

from fieldtool import workflow
from fieldtool.cli.options import check_output
from fieldtool.cli.output import Json, console_of, indented, print_json
from fieldtool.cli.progress import ShareBar
from fieldtool.cli.sheet import Sheet
from fieldtool.criticise.criticism import Cause, Criticism
from fieldtool.report.verdict import error_titles, meaning

STYLES = {
    "adequate": "green",
    "explained": "green",
    "partly explained": "yellow",
    "unexplained": "yellow",
}
HIDDEN = ("presliding", "rounding")
"""Numbers that are shown only where the data determine them."""


def criticise(
    source: Annotated[Path, typer.Argument(help="Session folder, or recording (FILE.h5).")],
    model: Annotated[
        Path | None,
        typer.Option("--model", help="model.yaml to criticise; the session's, or identified."),
    ] = None,
    picture: Annotated[
        Path | None, typer.Option("--picture", help="Draw the errors before and after (FILE.png).")
    ] = None,
    report: Annotated[
        Path | None,
        typer.Option(
            "--report", help="Write the report too (FILE.html); a session folder gets its own."
        ),
    ] = None,
    as_json: Json = False,
) -> None:
    """Say what the simulation of a recording gets wrong, name causes, measure the gain."""
    check_output("--picture", picture)
    check_output("--report", report)
    console = console_of(as_json)
    with ShareBar(console, "simulate") as bar:
        found = workflow.criticise(source, model, picture, bar, report)
    show_criticism(console, found.criticism)
    if source.is_dir():
        console.print(
            Text(
                f"In {source}: criticism.yaml has all of it and what was rejected, report.html "
                "shows it in a browser, criticism.png the errors."
            )
        )
    elif report is not None:
        console.print(Text(f"{report} shows it in a browser."))
    if as_json:
        print_json(
            {"criticism": found.criticism.as_dict(), "model": found.criticism.model.as_dict()}
        )


def show_criticism(console: Console, criticism: Criticism) -> None:
    """Show where it is wrong, the causes with their numbers, the gain, and what is left."""
    means = meaning(criticism).removeprefix(f"{criticism.verdict}: ")
    console.print(
        Text(f"Verdict: {criticism.verdict}", style=STYLES[criticism.verdict]).append(f" ({means})")
    )
    for sentence in (*criticism.changes, *criticism.where):
        console.print(indented(f"{sentence}"))
    if criticism.causes:
        console.print(_causes(criticism.causes))
        for cause in criticism.causes:
            for tie in cause.ties:
                axis = tie.axis if isinstance(tie.axis, str) else " - ".join(tie.axis)
                console.print(
                    indented(
                        f"{cause.effect} of {cause.axis_words}: {tie.effect} ({axis}, {tie.location}) "
                        f"explains the data as well. To tell them apart, {tie.experiment}."
                    )
                )
    for sentence in criticism.unexplained:
        console.print(indented(f"Unexplained: {sentence}"))
    console.print(_gain(criticism))
    for sentence in criticism.notes:
        console.print(indented(f"{sentence}"))


def _causes(causes: tuple[Cause, ...]) -> Sheet:
    table = Sheet("cause", "axis", "where", "numbers", "explains")
    for c in causes:
        numbers = "\n".join(
            f"{name} {n.value:.4g} +- {1.96 * n.std:.2g} {n.unit}"
            if n.std == n.std
            else f"{name} {n.value:.4g} {n.unit}"
            for name, n in c.parameters.items()
            if n.std == n.std or name not in HIDDEN
        )
        gain = f"{100 * c.gain:.2g} % of the torque"
        table.add(c.effect, c.axis_words, c.location, numbers, gain)
    return table


def _gain(criticism: Criticism) -> Sheet:
    held = criticism.held_out
    torque, row = error_titles(criticism)
    titles = ("unseen data", f"{torque} error before", "after", "noise", "position before", "after")
    table = Sheet(*titles, whole=titles[1:])
    for name, one in criticism.judged.items():
        table.add(
            row[name],
            *("hidden" if e is None else f"{100 * e:.3g} %" for e in (one.before, one.after)),
            "not known" if one.noise is None else f"{100 * one.noise:.2g} %",
            *(f"{100 * e[name].position:.2g} %" for e in (held.error_before, held.error_after)),
        )
    return table
