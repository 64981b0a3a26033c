"""What the simulation gets wrong, before and after, as one PNG: a row of pictures an axis."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from fieldtool.criticise.criticism import Criticism
from fieldtool.criticise.pictures_file import Picture
from fieldtool.report.picture_file import save_picture

COLORS = {
    "measured torque": "#9aa5b1",
    "error": "#d1495b",
    "error before": "#d1495b",
    "error after": "#1f3b73",
    "noise": "#c9a227",
}
COLUMNS = ("time", "frequency", "velocity", "position")


def draw_criticism(criticism: Criticism, pictures: Sequence[Picture], path: Path) -> None:
    """Draw the torque's error of every axis in time, by frequency, by velocity and by position.

    Parameters
    ----------
    criticism : Criticism
        For the heading.
    pictures : sequence of Picture
        Of every axis.
    path : Path
        PNG file to write.

    Raises
    ------
    OutputError
        If the file can not be written.
    """
    axes = list(dict.fromkeys(p.axis for p in pictures))
    figure = Figure(figsize=(16, 1 + 3.2 * len(axes)), layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.subplots(len(axes), len(COLUMNS), squeeze=False)
    for row, axis in zip(grid, axes, strict=True):
        for plot, kind in zip(row, COLUMNS, strict=True):
            for picture in pictures:
                if picture.axis == axis and picture.kind == kind:
                    _draw(plot, picture)
        row[0].set_ylabel(f"{axis}: {row[0].get_ylabel()}")
    for plot in grid[0][:2]:
        plot.legend(fontsize=8, loc="upper right")
    names = ", ".join(f"{c.effect} ({c.axis_words})" for c in criticism.causes)
    figure.suptitle(f"{criticism.verdict}: {names or 'no cause named'}", fontsize=11)
    save_picture(figure, path, 100)


def _draw(plot: Axes, picture: Picture) -> None:
    for series in picture.series:
        color = COLORS.get(series.label, "black")
        if series.std is not None:
            plot.errorbar(
                series.x, series.y, series.std, color=color, lw=1, marker=".", ms=3, elinewidth=0.6
            )
        elif picture.logarithmic:
            plot.loglog(
                series.x, np.maximum(series.y, 1e-12), color=color, lw=0.6, label=series.label
            )
        else:
            plot.plot(series.x, series.y, color=color, lw=0.7, label=series.label)
    if not picture.logarithmic:
        plot.axhline(0.0, color=COLORS["measured torque"], lw=0.5)
    plot.set_xlabel(picture.x)
    plot.set_ylabel(picture.y, fontsize=8)
