"""Before and after: what new parameters did on the machine, against the old ones and the prediction."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from fieldtool.report.figures import layout, log_ticks, numbers
from fieldtool.report.in_drives import trial_sentence
from fieldtool.report.material import Material
from fieldtool.report.section import Block, Plot, Plots, Section, Table, Words
from fieldtool.report.trial_file import AxisTrial, Figures, Values
from fieldtool.report.words import AT_ONCE

COLOURS = {"before": "#9aa5b1", "predicted": "#d1495b", "after": "#1f3b73"}
TORQUES = {"rad": "N m", "m": "N"}
FIGURES = (
    ("settles after the move in", "settling_time", ""),
    ("overshoot", "overshoot", "position"),
    ("vibration after the move", "vibration", "position"),
    ("following error", "following_error", "position"),
    ("torque", "peak_torque", "torque"),
    ("peak of sensitivity", "sensitivity_peak", ""),
    ("peak of sensitivity at", "sensitivity_frequency", "Hz"),
)
"""Title, name, unit: that of the axis' position or torque, or this one."""


def verification(material: Material) -> Section | None:
    """Show the trial's figures on one scale, moves and sensitivities."""
    trial = material.trial
    if trial is None:
        return None
    rows = [
        (
            axis.axis,
            title,
            *(_cell(getattr(axis, when), name) for when in COLOURS),
            _unit(axis.unit, unit),
        )
        for axis in trial.axes
        for title, name, unit in FIGURES
    ]
    blocks: list[Block] = [
        Table(("axis", "figure", *COLOURS, "unit"), tuple(rows), "The same short test each time.")
    ]
    draw = (_move, _sensitivity, _response, _step)
    plots = [plot for axis in trial.axes for one in draw if (plot := one(axis))]
    if plots:
        blocks.append(Plots(tuple(plots)))
    if trial.notes:
        blocks.append(Words(tuple(trial.notes), "list"))
    return Section("Before and after", trial_sentence(material), tuple(blocks))


def _cell(figures: Figures | None, name: str) -> str:
    value = getattr(figures, name, None)
    if value is None:
        return ""
    if name == "settling_time":
        return AT_ONCE if value == 0 else f"{value:.3g} s"
    return f"{value:.3g}"


def _unit(position: str, unit: str) -> str:
    return {"position": position, "torque": TORQUES.get(position, "")}.get(unit, unit)


def _lines(curves: Mapping[str, tuple[Values, Values]]) -> list[dict[str, Any]]:
    return [
        {
            "x": numbers(np.array(x)),
            "y": numbers(np.array(y)),
            "name": name,
            "mode": "lines",
            "line": {"color": COLOURS[name], "dash": "dash" if name == "predicted" else "solid"},
        }
        for name, (x, y) in curves.items()
    ]


def _move(axis: AxisTrial) -> Plot | None:
    curves = axis.curves
    known = {
        name: (curves.time, found)
        for name in COLOURS
        if (found := getattr(curves, name)) is not None
    }
    if not known:
        return None
    figure = {"data": _lines(known), "layout": layout("time, s", f"position, {axis.unit}")}
    return Plot(figure, f"{axis.axis}: its typical move")


def _sensitivity(axis: AxisTrial) -> Plot | None:
    return _by_frequency(axis, "size", "sensitivity")


def _response(axis: AxisTrial) -> Plot | None:
    return _by_frequency(axis, "response", "response of the loop")


def _by_frequency(axis: AxisTrial, what: str, title: str) -> Plot | None:
    known = {
        name: (found.frequency, values)
        for name in COLOURS
        if (found := getattr(axis.sensitivity, name)) is not None
        and (values := getattr(found, what)) is not None
    }
    if not known:
        return None
    look = layout("frequency, Hz", title, logarithmic=True)
    for which, k in (("xaxis", 0), ("yaxis", 1)):
        log_ticks(look[which], np.concatenate([np.array(c[k]) for c in known.values()]))
    figure = {"data": _lines(known), "layout": look}
    return Plot(figure, f"{axis.axis}: {title}, all other loops closed")


def _step(axis: AxisTrial) -> Plot | None:
    known = {
        name: (found.time, found.position)
        for name in COLOURS
        if (found := getattr(axis.step, name, None)) is not None
    }
    if not known:
        return None
    figure = {"data": _lines(known), "layout": layout("time, s", "position over the step")}
    return Plot(figure, f"{axis.axis}: a step without feed-forward, by the model")
