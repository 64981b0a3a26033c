"""Before and after: what new parameters did on the machine, against the old ones and the prediction."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from fieldtool.report.figures import layout, log_ticks
from fieldtool.report.material import Material
from fieldtool.report.section import Block, Plot, Plots, Section, Table, Words
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
    held = material.documents.get("verification")
    if held is None:
        return None
    axes: Sequence[Mapping[str, Any]] = held.get("axes") or ()
    rows = [
        (
            str(axis["axis"]),
            title,
            *(_cell(axis, when, name) for when in COLOURS),
            _unit(str(axis.get("unit", "")), unit),
        )
        for axis in axes
        for title, name, unit in FIGURES
    ]
    blocks: list[Block] = [
        Table(("axis", "figure", *COLOURS, "unit"), tuple(rows), "The same short test each time.")
    ]
    plots = [plot for axis in axes for plot in (_move(axis), _sensitivity(axis)) if plot]
    if plots:
        blocks.append(Plots(tuple(plots)))
    notes = tuple(str(note) for note in held.get("notes") or ())
    if notes:
        blocks.append(Words(notes, "list"))
    return Section("Before and after", str(held.get("sentence", "")), tuple(blocks))


def _cell(axis: Mapping[str, Any], when: str, name: str) -> str:
    figures = axis.get(when)
    value = figures.get(name) if figures else None
    if value is None:
        return ""
    if name == "settling_time":
        return AT_ONCE if value == 0 else f"{value:.3g} s"
    return f"{value:.3g}"


def _unit(position: str, unit: str) -> str:
    return {"position": position, "torque": TORQUES.get(position, "")}.get(unit, unit)


def _lines(curves: Mapping[str, tuple[Any, Any]]) -> list[dict[str, Any]]:
    return [
        {
            "x": x,
            "y": y,
            "name": name,
            "mode": "lines",
            "line": {"color": COLOURS[name], "dash": "dash" if name == "predicted" else "solid"},
        }
        for name, (x, y) in curves.items()
    ]


def _move(axis: Mapping[str, Any]) -> Plot | None:
    curves = axis.get("curves") or {}
    known = {name: (curves["time"], curves[name]) for name in COLOURS if name in curves}
    if not known:
        return None
    figure = {
        "data": _lines(known),
        "layout": layout("time, s", f"position, {axis.get('unit', '')}"),
    }
    return Plot(figure, f"{axis['axis']}: its typical move")


def _sensitivity(axis: Mapping[str, Any]) -> Plot | None:
    curves = axis.get("sensitivity") or {}
    known = {
        name: (curves[name]["frequency"], curves[name]["size"])
        for name in COLOURS
        if curves.get(name)
    }
    if not known:
        return None
    look = layout("frequency, Hz", "sensitivity", logarithmic=True)
    for which, k in (("xaxis", 0), ("yaxis", 1)):
        log_ticks(look[which], np.concatenate([np.asarray(c[k], float) for c in known.values()]))
    figure = {"data": _lines(known), "layout": look}
    return Plot(figure, f"{axis['axis']}: sensitivity, all other loops closed")
