"""The three responses side by side: bandwidth, margin and what else a technician chooses by."""

from collections.abc import Callable
from math import isfinite, isnan, nan

from drives.units import unit_on
from fieldtool.design.no_worse import arrival
from fieldtool.design.predict import AxisPrediction, Prediction
from fieldtool.design.tuning import BOUND, Choice, Tuning
from fieldtool.report.words import listed

CHOSEN = " *"
"""Behind the name of the response that is designed for."""
EMPTY = "-"


def _worst(one: AxisPrediction) -> float:
    """Return the largest peak of sensitivity over the model's uncertainty; NaN where not computed."""
    if "sensitivity_peak" not in one.spread:
        return nan
    return max(one.margins.sensitivity_peak, one.spread["sensitivity_peak"][1])


FIGURES: tuple[tuple[str, str, Callable[[AxisPrediction], float]], ...] = (
    ("bandwidth", "Hz", lambda one: one.margins.bandwidth),
    ("peak of sensitivity", "", lambda one: one.margins.sensitivity_peak),
    ("the same, up to (95 %)", "", _worst),
    ("move: arrives after", "s", arrival),
    ("step: settling", "s", lambda one: nan if one.step is None else one.step.settling_time),
    ("move: torque", "N m", lambda one: one.peak_torque),
    ("compliance", "rad/(N m)", lambda one: one.compliance),
)
"""Title, unit on a rotary axis, figure."""


def choice_titles(tuning: Tuning) -> tuple[str, ...]:
    """Return the titles of the table's columns; the chosen response is marked."""
    before = ("before",) if tuning.present else ()
    return ("axis", "figure", *before, *(_title(one, tuning) for one in tuning.responses))


def choice_rows(tuning: Tuning) -> list[tuple[str, ...]]:
    """Return a row for each axis and figure that is known of any response; none where nobody chose."""
    if not tuning.responses:
        return []
    columns = [one.prediction for one in tuning.responses]
    if tuning.present:
        columns.insert(0, tuning.present)
    rows = []
    for axis in tuning.axes:
        for title, unit, of in FIGURES:
            cells = [_cell(one, axis.axis, of) for one in columns]
            named = f"{title}, {unit_on(axis.kind, unit)}" if unit else title
            if set(cells) != {EMPTY}:
                rows.append((axis.axis, named, *cells))
    return rows


def choice_sentences(tuning: Tuning) -> list[str]:
    """Return what the table's marks mean, what was not computed, and the commands that go on."""
    if not tuning.responses:
        return []
    told = []
    for one in tuning.responses:
        if one.response == tuning.response:
            continue  # the design's own notes tell it
        if one.refused:
            told.append(f"{one.response} can not be had; by itself it is refused: {one.refused}")
        if one.instead:
            told.append(
                f"{one.response} = {one.instead}: no {one.response} response that is nowhere slower "
                f"keeps its margin, so these are the {one.instead} one's parameters."
            )
        if one.kept:
            told.append(f"{one.response} keeps the present parameters of {listed(one.kept)}.")
    missing = [one.response for one in tuning.responses if not (one.prediction or one.refused)]
    all_three = "" if missing else " --compare"
    told.append(f"* is what was chosen; for another: `{_command(tuning, 'NAME')}{all_three}`.")
    if missing:
        command = _command(tuning, tuning.response)
        told.append(
            f"{listed(missing)}: not computed in this design; `{command} --compare` shows all three, in "
            f"the time that {tuning.responses[-1].response} takes."
        )
    return told


def _command(tuning: Tuning, response: str) -> str:
    """Return the command that designs for a response within the same bound."""
    bound = max(one.bound for one in tuning.responses)
    more = f" --bound {bound:g}" if bound != BOUND else ""
    return f"fieldtool design FOLDER --response {response}{more}"


def _title(one: Choice, tuning: Tuning) -> str:
    same = f" = {one.instead}" if one.instead else ""
    return f"{one.response}{same}{CHOSEN if one.response == tuning.response else ''}"


def _cell(prediction: Prediction | None, axis: str, of: Callable[[AxisPrediction], float]) -> str:
    found = [one for one in prediction.axes if one.axis == axis] if prediction else []
    if prediction is None or not found:
        return EMPTY
    if not prediction.stable:
        return "unstable"
    value = of(found[0])
    if isnan(value):
        return EMPTY
    return f"{value:.3g}" if isfinite(value) else "does not"
