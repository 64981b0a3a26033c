"""``fieldtool identify`` and ``compare``: models from recordings, and how well they predict."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from fieldtool import workflow
from fieldtool.cli.options import Motor, Seconds, check_output, options_of
from fieldtool.cli.output import Json, console_of, indented, print_json
from fieldtool.cli.screen import TerminalScreen, model_table


def identify(
    source: Annotated[Path, typer.Argument(help="Session folder, or recording (FILE.h5).")],
    masses: Annotated[
        list[str] | None, typer.Option("--masses", help="Chain length, as AXIS=N; may be repeated.")
    ] = None,
    motor_inertia: Motor = "measured",
    seconds: Seconds = None,
    plan_only: Annotated[
        bool,
        typer.Option("--plan-only", help="Show what the next measurement should be, as well."),
    ] = False,
    picture: Annotated[
        Path | None,
        typer.Option("--picture", help="Draw measured and modelled response (FILE.png)."),
    ] = None,
    as_json: Json = False,
) -> None:
    """Identify masses, springs, couplings and dampers from a recording."""
    check_output("--picture", picture)
    console = console_of(as_json)
    options = options_of("fast", False, False, motor_inertia, seconds)
    planned, lengths = None, _lengths(masses or [])
    with TerminalScreen(console) as screen:
        screen.doing("find modes and numbers of masses, fit masses, springs, couplings and dampers")
        if plan_only:
            found, planned = workflow.next_plan(source, options, lengths)
        else:
            found = workflow.identify(source, options, lengths)
    if picture is not None:
        workflow.draw(found, picture)
    console.print(model_table(found.model, None, found.torque_units))
    if found.chain is not None:
        for line in found.chain.sentences:
            console.print(indented(line))
    for note in found.notes:
        console.print(indented(f"{note}"))
    if planned is not None:
        with TerminalScreen(console) as screen:
            screen.stage("What the next measurement should be")
            screen.fast_plan(planned)
    if as_json:
        data = {"model": found.model.as_dict(), "notes": list(found.notes)}
        print_json({**data, "plan": planned.as_dict()} if planned is not None else data)


def compare(
    recording: Annotated[Path, typer.Argument(help="Recording (FILE.h5) with a load-side signal.")],
    model: Annotated[
        Path | None, typer.Option("--model", help="model.yaml; identified otherwise.")
    ] = None,
    low: Annotated[float, typer.Option(help="Lowest frequency to compare, Hz.")] = 11.0,
    high: Annotated[float, typer.Option(help="Highest frequency to compare, Hz.")] = 200.0,
    as_json: Json = False,
) -> None:
    """Predict a signal that no fit has seen (the load side), and print the error."""
    console = console_of(as_json)
    comparisons = workflow.compare(recording, model, (low, high))
    for c in comparisons:
        console.print(
            f"{c.experiment}: load-side response, {c.frequencies.size} lines from {low:g} to {high:g} "
            f"Hz, never used in the fit: median error {c.median_db:.2f} dB and "
            f"{c.median_degrees:.2f} degrees."
        )
    if as_json:
        print_json(
            {
                "comparisons": [
                    {
                        "experiment": c.experiment,
                        "lines": int(c.frequencies.size),
                        "median_db": c.median_db,
                        "median_degrees": c.median_degrees,
                    }
                    for c in comparisons
                ]
            }
        )


def _lengths(masses: Sequence[str]) -> dict[str, int]:
    lengths = {}
    for text in masses:
        name, equals, count = text.partition("=")
        if not equals or not count.isdigit() or not 1 <= int(count) <= 16:
            raise typer.BadParameter(f"--masses takes AXIS=N with N from 1 to 16, got {text!r}")
        if name in lengths:
            raise typer.BadParameter(f"--masses names {name} twice")
        lengths[name] = int(count)
    return lengths
