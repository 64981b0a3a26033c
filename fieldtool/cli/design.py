"""``fieldtool design``: new parameters from the model, and what they will do."""

from collections.abc import Callable, Sequence
from math import isfinite, isnan
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.text import Text

from drives.units import Kind, unit_on
from fieldtool import workflow
from fieldtool.cli.options import ResponseChoice, check_output, check_response
from fieldtool.cli.output import Json, console_of, indented, print_json
from fieldtool.cli.progress import ShareBar
from fieldtool.cli.sheet import Sheet
from fieldtool.design.drive_side import UNITS
from fieldtool.design.predict import AxisPrediction
from fieldtool.design.tuning import BOUND, MOST_BOUND, Tuning
from fieldtool.design.tuning_file import tuning_as_dict
from fieldtool.report.choices import choice_rows, choice_sentences, choice_titles
from fieldtool.report.words import AT_ONCE

Figure = Callable[[AxisPrediction], float | None]


def _motor(name: str) -> Figure:
    return lambda one: None if one.move is None else float(getattr(one.move, name))


def _load(name: str) -> Figure:
    return lambda one: None if one.load is None else float(getattr(one.load, name))


ROWS: tuple[tuple[str, str, float, Figure], ...] = (
    ("peak of sensitivity", "", 1, lambda one: one.margins.sensitivity_peak),
    ("phase margin", "degrees", 1, lambda one: one.margins.phase_margin),
    ("delay margin", "ms", 1e3, lambda one: one.margins.delay_margin),
    ("bandwidth", "Hz", 1, lambda one: one.margins.bandwidth),
    ("move: following error", "rad", 1, _motor("following_error")),
    ("move: overshoot", "rad", 1, _motor("overshoot")),
    ("move: settling", "s", 1, _motor("settling_time")),
    ("last mass: settling", "s", 1, _load("settling_time")),
    ("last mass: vibration", "rad", 1, _load("residual_peak")),
    ("move: torque", "N m", 1, lambda one: one.peak_torque),
    ("step: settling", "s", 1, lambda one: None if one.step is None else one.step.settling_time),
    ("compliance", "rad/(N m)", 1, lambda one: one.compliance),
    ("noise of torque", "N m", 1, lambda one: one.noise),
)
"""Title, unit on a rotary axis, scale, figure."""


def design(
    folder: Annotated[Path, typer.Argument(help="Session folder.")],
    response: ResponseChoice = "normal",
    bound: Annotated[
        float, typer.Option("--bound", help="Peak of sensitivity that no axis may exceed.")
    ] = BOUND,
    png: Annotated[
        Path | None,
        typer.Option("--png", help="Draw sensitivity, step, move and trade (FILE.png)."),
    ] = None,
    compare: Annotated[
        bool,
        typer.Option(
            "--compare", help="Compute all responses, to choose from; as long as stiff takes."
        ),
    ] = False,
    as_json: Json = False,
) -> None:
    """Design controller parameters from the session folder's model, and predict what they do."""
    check_response(response)
    check_output("--png", png)
    if not 1.1 < bound <= MOST_BOUND:
        raise typer.BadParameter(
            f"--bound is a number above 1.1, and {MOST_BOUND:g} at most; got {bound:g}"
        )
    console = console_of(as_json)
    with ShareBar(console, "design") as bar:
        said: list[str] = []
        tuning = workflow.redesign(
            folder, response, bound, png, bar, compare=compare, say=said.append
        )
    show_tuning(console, tuning)
    for sentence in said:
        console.print(indented(sentence))
    for axis in tuning.axes:
        console.print(Text(f"{axis.axis}:"))
        for name, value in axis.parameters.items():
            unit = unit_on(axis.kind, UNITS.get(name, ""))
            console.print(indented(f"{name:22}{value:.6g} {unit}".rstrip()))
    console.print(Text(f"Kept in {folder}; {tuning.write_words(folder)}"))
    if as_json:
        print_json(tuning_as_dict(tuning))


def show_tuning(console: Console, tuning: Tuning) -> None:
    """Show why, what is to be expected beside what is there now, and what to know."""
    for axis in tuning.axes:
        console.print(indented(f"{axis.axis}: {axis.reason}"))
    if tuning.prediction is not None:
        for table in _tables(tuning, console.width):
            console.print(table)
        if sentence := together(tuning):
            console.print(indented(sentence))
        if tuning.responses:
            console.print(_choices(tuning))
    for sentence in (
        *choice_sentences(tuning),
        *(one.sentence for one in tuning.shaping),
        *tuning.notes,
    ):
        console.print(indented(f"{sentence}"))


def _choices(tuning: Tuning) -> Sheet:
    """Return the responses side by side."""
    titles = choice_titles(tuning)
    table = Sheet(*titles, numbers=titles[2:], gap=1)
    for row in choice_rows(tuning):
        table.add(*row)
    return table


def together(tuning: Tuning) -> str:
    """Say what the peak of sensitivity is if the loops of all axes change at the same time."""
    new, now = tuning.prediction, tuning.present
    if new is None or len(new.axes) < 2:
        return ""
    peaks = [f"{one.sensitivity_peak:.3g}" for one in (new, now) if one is not None]
    before = f", {peaks[1]} before" if now is not None else ""
    return (
        f"All axes together: largest singular value of their sensitivity {peaks[0]}{before}. The bound "
        "is that of each axis with the loops of all others closed."
    )


def _tables(tuning: Tuning, width: int) -> list[Sheet]:
    """Return what is predicted, as many axes of a kind side by side as the terminal has room for."""
    kinds = {axis.axis: axis.kind for axis in tuning.axes}
    axes = tuning.prediction.axes if tuning.prediction is not None else ()
    tables = []
    for kind in dict.fromkeys(kinds.values()):
        tables += _tables_of(tuning, kind, [a for a in axes if kinds[a.axis] == kind], width)
    return tables


def _tables_of(
    tuning: Tuning, kind: Kind, axes: Sequence[AxisPrediction], width: int
) -> list[Sheet]:
    for count in range(len(axes), 0, -1):
        parts = [axes[k : k + count] for k in range(0, len(axes), count)]
        tables = [_table(tuning, kind, part) for part in parts]
        if count == 1 or max(table.natural_width for table in tables) <= width:
            return tables
    return []


def _table(tuning: Tuning, kind: Kind, axes: Sequence[AxisPrediction]) -> Sheet:
    """Return present and predicted figures of some axes of a kind."""
    now = tuning.present
    titles = [title for a in axes for title in ((f"{a.axis} before", "new") if now else (a.axis,))]
    table = Sheet("predicted", *titles, numbers=titles)
    for title, unit, scale, of in ROWS:
        shown = [one for axis in axes for one in ((now.of(axis.axis), axis) if now else (axis,))]
        zero = AT_ONCE if "settling" in title else "0"
        named = f"{title}, {unit_on(kind, unit)}" if unit else title
        table.add(named, *(_cell(of(one), scale, zero) for one in shown))
    return table


def _cell(value: float | None, scale: float, zero: str) -> str:
    if value is None or isnan(value):
        return "-"
    if value == 0:
        return zero
    return f"{scale * value:.3g}" if isfinite(value) else "does not"
