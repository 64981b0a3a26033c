"""Measured and modelled responses as one PNG."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import FormatStrFormatter, LogLocator, NullFormatter

from fieldtool.errors import OutputError
from fieldtool.frf.matrix import OTHERS_FREE
from fieldtool.frf.response import FrequencyResponse
from fieldtool.identify.refine import machine_response
from fieldtool.records.model import FloatArray, MachineModel

MEASURED, MODEL, PRIOR = "#1f3b73", "#d1495b", "#9aa5b1"
POINTS = 2000
CONFIDENCE = 1.96


def draw_responses(
    responses: Mapping[str, FrequencyResponse],
    model: MachineModel,
    prior: MachineModel | None,
    path: Path,
) -> None:
    """Draw each motor's acceleration per torque: measured with 95 % bars, model, prior model.

    Parameters
    ----------
    responses
        By condition; the one with the other axes free is drawn, or the only one.
    model, prior
        Identified model, and the machine as last accepted.
    path
        PNG file to write.

    Raises
    ------
    OutputError
        If the file can not be written.
    """
    measured = responses.get(OTHERS_FREE) or next(iter(responses.values()))
    names = measured.axes
    figure = Figure(figsize=(9.0, 3.2 * len(names) + 0.8), layout="constrained")
    FigureCanvasAgg(figure)
    plots = figure.subplots(len(names), 1, sharex=True, squeeze=False)[:, 0]
    low, high = measured.frequencies[0] * 0.9, measured.frequencies[-1] * 1.1
    grid = np.geomspace(low, high, POINTS)
    for k, (name, plot) in enumerate(zip(names, plots, strict=True)):
        unit = "1/(kg m²)" if model.axes[k].kind == "rotary" else "1/kg"
        if prior is not None:
            plot.loglog(grid, _gain(prior, grid, k), color=PRIOR, lw=1.2, label="prior model")
        plot.loglog(grid, _gain(model, grid, k), color=MODEL, lw=1.4, label="identified model")
        frequencies, response, std = measured.element(k, k)
        scale = (2 * np.pi * frequencies) ** 2
        plot.errorbar(
            frequencies,
            np.abs(response) * scale,
            yerr=CONFIDENCE * std * scale,
            fmt="o",
            ms=3.5,
            color=MEASURED,
            ecolor=MEASURED,
            elinewidth=0.8,
            label="measured, 95 %",
        )
        plot.set_title(f"{name}: motor acceleration per motor torque", loc="left", fontsize=10)
        plot.set_ylabel(unit)
        plot.grid(visible=True, which="both", alpha=0.25)
    plots[-1].xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    plots[-1].xaxis.set_major_formatter(FormatStrFormatter("%g"))
    plots[-1].xaxis.set_minor_formatter(NullFormatter())
    plots[0].legend(loc="upper left", fontsize=8, frameon=False)
    plots[-1].set_xlabel("frequency, Hz")
    try:
        figure.savefig(path, dpi=110)
    except OSError as error:
        raise OutputError(f"{path}: can not be written ({error.strerror}).") from error


def _gain(model: MachineModel, frequencies: FloatArray, axis: int) -> FloatArray:
    omega = 2 * np.pi * frequencies
    gain: FloatArray = np.abs(machine_response(model, omega)[:, axis, axis]) * omega**2
    return gain
