"""A design as a PNG: sensitivity before and after, step, move, and what more gain would bring."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from fieldtool.design.margins import Margins
from fieldtool.design.predict import AxisPrediction
from fieldtool.design.tuning import Tuning
from fieldtool.errors import OutputError
from fieldtool.report.picture_file import save_picture

BEFORE, AFTER, LOAD = "#b0483a", "#1f6f8b", "#7aa95c"


def draw_design(tuning: Tuning, units: Mapping[str, str], path: Path) -> None:
    """Draw one row an axis: sensitivity, step, the end of the move, trade.

    Parameters
    ----------
    tuning
        As designed, with its histories (one that was read from a file has none).
    units
        Unit of position of each axis.
    path
        PNG file.

    Raises
    ------
    OutputError
        If the file can not be written, or there is nothing to draw.
    """
    if tuning.prediction is None or any(a.curves is None for a in tuning.prediction.axes):
        raise OutputError(f"{path}: there are no curves to draw; run `fieldtool design` again")
    rows = len(tuning.axes)
    figure = Figure(figsize=(15, 3.1 * rows + 0.5), layout="constrained")
    grid = figure.subplots(rows, 4, squeeze=False)
    for k, axis in enumerate(tuning.prediction.axes):
        before = tuning.present.axes[k] if tuning.present else None
        unit = units.get(axis.axis, "rad")
        _sensitivity(grid[k][0], before, axis, tuning.bound)
        _step(grid[k][1], before, axis)
        _move(grid[k][2], before, axis, unit)
        _trade(grid[k][3], tuning, k)
    grid[0][0].legend(fontsize=8)
    grid[0][2].legend(fontsize=8)
    figure.suptitle(
        f"Designed parameters ({tuning.response or 'as read'}): predicted, before and after"
    )
    save_picture(figure, path, 110)


def _sensitivity(
    plot: Axes, before: AxisPrediction | None, after: AxisPrediction, bound: float
) -> None:
    for one, colour, name in ((before, BEFORE, "before"), (after, AFTER, "designed")):
        if one is not None and one.sensitivity is not None:
            frequency, size = one.sensitivity
            plot.semilogx(
                frequency,
                20 * np.log10(np.maximum(size, 1e-4)),
                color=colour,
                label=name,
                lw=1.4,
            )
    plot.axhline(20 * np.log10(bound), color="0.4", ls="--", lw=1, label=f"bound {bound:.3g}")
    plot.axhline(-3, color="0.8", lw=0.8)
    plot.set_ylim(-40, 20)
    plot.set_ylabel(f"{after.axis}: sensitivity [dB]")
    plot.set_xlabel("Hz")


def _step(plot: Axes, before: AxisPrediction | None, after: AxisPrediction) -> None:
    last = 0.0
    for one, colour in ((before, BEFORE), (after, AFTER)):
        if one is None or one.curves is None or one.step is None:
            continue
        plot.plot(one.curves.step_time, one.curves.step, color=colour, lw=1.4)
        last = max(last, _shown(one.step.settling_time, one.curves.step_time))
    plot.axhline(1.0, color="0.8", lw=0.8)
    if last > 0:
        plot.set_xlim(0, 1.3 * last)
    plot.set_ylabel("step, no feed-forward")
    plot.set_xlabel("s")


def _move(plot: Axes, before: AxisPrediction | None, after: AxisPrediction, unit: str) -> None:
    last = 0.0
    for one, colour, name in ((before, BEFORE, "before"), (after, AFTER, "designed")):
        if one is None or one.curves is None or one.move is None or one.load is None:
            continue
        curves = one.curves
        plot.plot(curves.time, curves.reference - curves.position, color=colour, lw=1.4,
                  label=f"motor {name}")  # fmt: skip
        plot.plot(curves.time, curves.reference - curves.load, color=colour, lw=0.9, ls=":",
                  label=f"last mass {name}")  # fmt: skip
        last = max(last, _shown(one.load.positioning_time, curves.time))
        last = max(last, _shown(one.move.positioning_time, curves.time))
    if after.move is not None:
        plot.axhspan(-after.move.band, after.move.band, color="0.92")
    if last > 0:
        plot.set_xlim(0, 1.2 * last)
    plot.set_ylabel(f"error on the move [{unit}]")
    plot.set_xlabel("s")


def _shown(time: float, times: np.ndarray[tuple[int, ...], np.dtype[np.float64]]) -> float:
    return min(time, float(times[-1]))


def _others(tuning: Tuning, k: int) -> list[tuple[str, Margins]]:
    """Return what one could have instead: the present parameters, and the other responses' own."""
    there = [("before", tuning.present)]
    there += [
        (one.response, one.prediction)
        for one in tuning.responses
        if one.response != tuning.response and not one.instead
    ]
    return [(name, one.axes[k].margins) for name, one in there if one is not None and one.stable]


def _trade(plot: Axes, tuning: Tuning, k: int) -> None:
    there = [p for p in tuning.trade if np.isfinite(p.sensitivity_peak[k])]
    bandwidth = [p.bandwidth[k] for p in there]
    peak = [p.sensitivity_peak[k] for p in there]
    plot.plot(bandwidth, peak, "o-", color="0.5", ms=3, lw=1)
    for point in there:
        if point.factor == 1.0:
            plot.plot(point.bandwidth[k], point.sensitivity_peak[k], "o", color=AFTER)
    for name, one in _others(tuning, k):
        peak.append(one.sensitivity_peak)
        place = (one.bandwidth, one.sensitivity_peak)
        plot.plot(*place, "s", color=BEFORE if name == "before" else LOAD, ms=5)
        plot.annotate(name, place, (4, -9), textcoords="offset points", fontsize=8)
    plot.axhline(tuning.bound, color="0.4", ls="--", lw=1)
    plot.set_ylim(0.9, max(1.5 * tuning.bound, min(max(peak, default=1.0), 4.0)))
    plot.set_xlabel("bandwidth [Hz], all gains scaled")
    plot.set_ylabel("peak of sensitivity")
