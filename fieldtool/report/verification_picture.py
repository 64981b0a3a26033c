"""The trial as one PNG: each axis' move, sensitivity, response and step before, as predicted, after."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import FormatStrFormatter, LogLocator, NullFormatter

from fieldtool.design.predict import Prediction
from fieldtool.design.verdict import Comparison
from fieldtool.records.model import FloatArray
from fieldtool.report.picture_file import save_picture

BEFORE, PREDICTED, AFTER, REFERENCE = "#9aa5b1", "#d1495b", "#1f3b73", "#2b2b2b"
History = tuple[FloatArray, ...] | None
"""Time, reference and position of a move from where it began."""
POINTS = 240
"""Of a move that is kept as numbers."""
BANDS = 12.0
"""Half the height of the picture of the error, in bands about the target."""


def draw_verification(
    axes: Sequence[tuple[Comparison, History, History]],
    prediction: Prediction,
    bound: float,
    path: Path,
) -> None:
    """Draw move, error at its end, sensitivity, response and step of every axis.

    Parameters
    ----------
    axes
        Comparison, and what was measured before and after; None where it was not.
    prediction
        Of the new parameters.
    bound
        Peak of sensitivity that they were designed for.
    path
        PNG file to write.

    Raises
    ------
    OutputError
        If the file can not be written.
    """
    figure = Figure(figsize=(20.0, 3.3 * len(axes) + 0.5), layout="constrained")
    FigureCanvasAgg(figure)
    plots = figure.subplots(len(axes), 5, squeeze=False)
    asked = f"{bound:g} ({20 * np.log10(bound):.2g} dB)"
    for row, (k, (one, before, after)) in zip(plots, enumerate(axes), strict=True):
        foreseen = foreseen_move(prediction, k)
        _draw_move(row[0], one, before, foreseen, after)
        _draw_error(row[1], one, before, foreseen, after)
        _draw_by_frequency(row[2], one, "size", "sensitivity", bound, asked)
        _draw_by_frequency(row[3], one, "response", "response of the loop", 0.5**0.5, "-3 dB")
        _draw_step(row[4], one)
    for plot in (plots[0, 0], plots[0, 2], plots[0, 3], plots[0, 4]):
        if plot.get_legend_handles_labels()[0]:
            plot.legend(loc="best", fontsize=8)
    save_picture(figure, path, 110)


def foreseen_move(prediction: Prediction, k: int) -> History:
    """Return an axis' move as it was predicted; None where the machine would not be stable."""
    curves = prediction.axes[k].curves
    return None if curves is None else (curves.time, curves.reference, curves.position)


def same_times(
    one: Comparison, before: History, foreseen: History, after: History
) -> dict[str, list[float]]:
    """Return an axis' move out, before, predicted and after, at POINTS times in common."""
    parts = _parts(one, before, foreseen, after)
    known = [(name, part) for name, _, _, part in parts if part is not None]
    if not known:
        return {}
    time = np.linspace(0, _end(one, parts), POINTS)
    reference = known[0][1]
    curves = {"time": time, "reference": np.interp(time, reference[0], reference[1])}
    curves |= {name: np.interp(time, part[0], part[2]) for name, part in known}
    return {name: [float(f"{v:.6g}") for v in values] for name, values in curves.items()}


def _out(history: History, one: Comparison) -> tuple[FloatArray, FloatArray, FloatArray] | None:
    """Return the move out alone: time, reference, position."""
    if history is None:
        return None
    time, reference, position = history
    there = np.flatnonzero(np.abs(reference) >= abs(one.distance) * (1 - 1e-9))
    stop = int(there[-1]) + 1 if there.size else reference.size
    return time[:stop], reference[:stop], position[:stop]


def _parts(
    one: Comparison, before: History, foreseen: History, after: History
) -> list[tuple[str, str, str, tuple[FloatArray, FloatArray, FloatArray] | None]]:
    return [
        ("before", BEFORE, "-", _out(before, one)),
        ("after", AFTER, "-", _out(after, one)),
        ("predicted", PREDICTED, "--", _out(foreseen, one)),
    ]


def _draw_move(
    plot: Axes, one: Comparison, before: History, foreseen: History, after: History
) -> None:
    parts = _parts(one, before, foreseen, after)
    if _empty(plot, f"{one.axis}: move", [part for _, _, _, part in parts]):
        return
    measured = next((part for _, _, _, part in parts if part is not None), None)
    if measured is not None:
        plot.plot(measured[0], measured[1], ":", color=REFERENCE, lw=1.0, label="reference")
    for name, colour, style, part in parts:
        if part is not None:
            plot.plot(part[0], part[2], style, color=colour, lw=1.4, label=name)
    plot.set_xlim(0, _end(one, parts))
    plot.set_title(f"{one.axis}: move, {one.unit}", loc="left", fontsize=10)
    plot.set_xlabel("s")
    plot.grid(visible=True, alpha=0.25)


def _end(
    one: Comparison,
    parts: list[tuple[str, str, str, tuple[FloatArray, FloatArray, FloatArray] | None]],
) -> float:
    ends = [float(part[0][-1]) for _, _, _, part in parts if part is not None]
    slowest = [
        figures.settling_time
        for figures in (one.before, one.predicted, one.after)
        if figures is not None and np.isfinite(figures.settling_time)
    ]
    wanted = one.duration + 1.5 * max([*slowest, 0.3 * one.duration])
    return float(min([wanted, *ends]))


def _draw_error(
    plot: Axes, one: Comparison, before: History, foreseen: History, after: History
) -> None:
    parts = _parts(one, before, foreseen, after)
    if _empty(plot, f"{one.axis}: distance from the target", [part for _, _, _, part in parts]):
        return
    plot.axhspan(-one.band, one.band, color="#e8ecf1")
    for name, colour, style, part in parts:
        if part is not None:
            plot.plot(part[0], part[2] - one.distance, style, color=colour, lw=1.2, label=name)
    plot.axvline(one.duration, color=REFERENCE, ls=":", lw=1.0)
    end = _end(one, parts)
    plot.set_xlim(max(0.0, one.duration - 0.15 * end), end)
    plot.set_ylim(-BANDS * one.band, BANDS * one.band)
    plot.set_title(f"{one.axis}: distance from the target, {one.unit}", loc="left", fontsize=10)
    plot.set_xlabel("s")
    plot.grid(visible=True, alpha=0.25)


def _empty(plot: Axes, title: str, shown: Sequence[object | None]) -> bool:
    """Say that a panel has nothing to show, where it has nothing."""
    if any(one is not None for one in shown):
        return False
    plot.set_title(f"{title}: not measured", loc="left", fontsize=10)
    plot.set_axis_off()
    return True


def _draw_by_frequency(
    plot: Axes, one: Comparison, what: str, title: str, level: float, level_name: str
) -> None:
    curves = [
        (name, colour, style, curve.frequency, values)
        for name, colour, style, curve in (
            ("before", BEFORE, "-", one.sensitivity_before),
            ("after", AFTER, "o-", one.sensitivity_after),
            ("predicted", PREDICTED, "--", one.sensitivity_predicted),
        )
        if curve is not None and (values := getattr(curve, what)) is not None
    ]
    if _empty(plot, f"{one.axis}: {title}", [v if np.any(v > 0) else None for *_, v in curves]):
        return
    for name, colour, style, frequency, values in curves:
        plot.loglog(frequency, values, style, color=colour, lw=1.2, ms=2.5, label=name)
    plot.axhline(level, color=REFERENCE, ls=":", lw=1.0, label=level_name)
    plot.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    plot.xaxis.set_major_formatter(FormatStrFormatter("%g"))
    plot.xaxis.set_minor_formatter(NullFormatter())
    plot.set_title(f"{one.axis}: {title}", loc="left", fontsize=10)
    plot.set_xlabel("Hz")
    plot.grid(visible=True, which="both", alpha=0.25)


def _draw_step(plot: Axes, one: Comparison) -> None:
    steps = [
        ("before", BEFORE, "-", one.step_before),
        ("predicted", PREDICTED, "--", one.step_predicted),
    ]
    title = f"{one.axis}: step without feed-forward, by the model"
    if _empty(plot, title, [step for *_, step in steps]):
        return
    for name, colour, style, step in steps:
        if step is not None:
            course = step.as_dict()
            plot.plot(course["time"], course["position"], style, color=colour, lw=1.4, label=name)
    plot.axhline(1.0, color=REFERENCE, ls=":", lw=1.0)
    plot.set_title(title, loc="left", fontsize=10)
    plot.set_xlabel("s")
    plot.grid(visible=True, alpha=0.25)
