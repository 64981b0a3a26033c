"""What the simulation gets wrong, before and after, as one PNG: a row of pictures an axis."""

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from fieldtool.criticise.criticise import Criticised
from fieldtool.criticise.effects.base import Context, FloatArray
from fieldtool.errors import OutputError

BEFORE, AFTER, MEASURED = "#d1495b", "#1f3b73", "#9aa5b1"
SHOWN_ROWS = 4000
"""Rows of the course in time that are drawn."""
BINS = 30


def draw_criticism(criticised: Criticised, path: Path) -> None:
    """Draw the torque's error of every axis in time, by frequency, by velocity and by position.

    Parameters
    ----------
    criticised : Criticised
    path : Path
        PNG file to write.

    Raises
    ------
    OutputError
        If the file can not be written.
    """
    found = criticised.found
    contexts = [found.prepared.context(f.hypothesis) for f in (found.before, found.after)]
    axes = contexts[0].axes
    figure = Figure(figsize=(16, 1 + 3.2 * len(axes)), layout="constrained")
    grid = figure.subplots(len(axes), 4, squeeze=False)
    for k, info in enumerate(axes):
        _in_time(grid[k][0], contexts, k)
        _by_frequency(grid[k][1], contexts, k)
        _binned(grid[k][2], contexts, k, "velocity", f"velocity, {info.position_unit}/s")
        _binned(grid[k][3], contexts, k, "position", f"position, {info.position_unit}")
        grid[k][0].set_ylabel(f"{info.name}: torque, {info.torque_unit}")
    grid[0][0].legend(fontsize=8, loc="upper right")
    names = ", ".join(f"{c.effect} ({c.axis_words})" for c in criticised.criticism.causes)
    figure.suptitle(f"{criticised.criticism.verdict}: {names or 'no cause named'}", fontsize=11)
    try:
        FigureCanvasAgg(figure)
        figure.savefig(path, dpi=100)
    except OSError as error:
        raise OutputError(f"{path} can not be written ({error.strerror}).") from error


def _in_time(axes: Axes, contexts: list[Context], axis: int) -> None:
    """The experiment with the largest error, its middle."""
    sizes = [float(np.sum(e[:, axis] ** 2)) for e in contexts[0].errors]
    k = int(np.argmax(sizes))
    motion = contexts[0].motions[k]
    begin = max(0, (motion.rows - SHOWN_ROWS) // 2)
    rows = slice(begin, begin + SHOWN_ROWS)
    time = motion.clock[rows] - motion.clock[0]
    axes.plot(time, motion.torque[rows, axis], color=MEASURED, lw=0.6, label="measured torque")
    for context, color, label in zip(
        contexts, (BEFORE, AFTER), ("error before", "after"), strict=True
    ):
        axes.plot(time, context.errors[k][rows, axis], color=color, lw=0.8, label=label)
    axes.set_xlabel(f"time in {motion.experiment}, s")


def _by_frequency(axes: Axes, contexts: list[Context], axis: int) -> None:
    k = int(np.argmax([m.rows for m in contexts[0].motions]))
    motion = contexts[0].motions[k]
    window = np.hanning(motion.rows)
    frequency = np.fft.rfftfreq(motion.rows, motion.step)
    inside = (frequency > 0) & (frequency <= contexts[0].top)
    torque = motion.torque[:, axis] - motion.torque[:, axis].mean()
    courses = [(torque, MEASURED), (contexts[0].errors[k][:, axis], BEFORE)]
    courses.append((contexts[1].errors[k][:, axis], AFTER))
    for course, color in courses:
        size = np.abs(np.fft.rfft(course * window))[inside] * 4 / motion.rows
        axes.loglog(frequency[inside], np.maximum(size, 1e-12), color=color, lw=0.6)
    axes.set_xlabel("frequency, Hz")


def _binned(axes: Axes, contexts: list[Context], axis: int, what: str, label: str) -> None:
    """Mean of the error in bins of velocity or position, with its standard error."""
    for context, color in zip(contexts, (BEFORE, AFTER), strict=True):
        values = np.concatenate([_signal(m, what)[:, axis] for m in context.motions])
        error = np.concatenate([e[:, axis] for e in context.errors])
        counted = np.concatenate([m.counted[:, axis] for m in context.motions]) > 0
        centre, mean, std = _means(values[counted], error[counted])
        axes.errorbar(centre, mean, std, color=color, lw=1, marker=".", ms=3, elinewidth=0.6)
    axes.axhline(0.0, color=MEASURED, lw=0.5)
    axes.set_xlabel(label)


def _signal(motion: object, what: str) -> FloatArray:
    return np.asarray(getattr(motion, f"smooth_{what}"), dtype=np.float64)


def _means(values: FloatArray, error: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    edges = np.linspace(values.min(), values.max(), BINS + 1)
    place = np.clip(np.searchsorted(edges, values) - 1, 0, BINS - 1)
    count = np.bincount(place, minlength=BINS)
    full = count >= 10
    mean = np.bincount(place, error, BINS)[full] / count[full]
    square = np.bincount(place, error**2, BINS)[full] / count[full]
    std = np.sqrt(np.maximum(square - mean**2, 0.0) / count[full])
    return (edges[1:] + edges[:-1])[full] / 2, mean, std
