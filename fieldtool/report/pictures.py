"""Measured and modelled responses as one PNG."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import FormatStrFormatter, LogLocator, NullFormatter

from fieldtool.frf.matrix import OTHERS_FREE, SOLVED
from fieldtool.frf.response import FrequencyResponse
from fieldtool.identify.likelihood.model_band import relative_std
from fieldtool.identify.likelihood.refine import RefinedModel, machine_response
from fieldtool.records.model import FloatArray, MachineModel
from fieldtool.report.picture_file import save_picture

MEASURED, MODEL, PRIOR = "#1f3b73", "#d1495b", "#9aa5b1"
POINTS = 2000
CONFIDENCE = 1.96
WIDEST = 5.0
"""Natural logarithm of the largest factor that a band shows."""
FAINTEST = 1e-7
"""Of the largest value: what is below is not drawn."""


def draw_responses(
    responses: Mapping[str, FrequencyResponse],
    model: MachineModel,
    prior: MachineModel | None,
    path: Path,
    fitted: RefinedModel | None = None,
    torque_units: Sequence[str] = (),
) -> None:
    """Draw each motor's acceleration per torque of every motor: measured, model, prior model.

    Measured points carry 95 % bars; around the model lies the band that holds the true response
    with 95 % probability if the model's structure is right.

    Parameters
    ----------
    responses
        By condition; the whole matrix, or the one with the other axes free, is drawn, else the first.
    model, prior
        Identified model, and the machine as last accepted.
    path
        PNG file to write.
    fitted
        Where the band comes from; none is drawn without it.
    torque_units
        One an axis; N m or N where left out.

    Raises
    ------
    OutputError
        If the file can not be written.
    """
    measured = responses.get(SOLVED) or responses.get(OTHERS_FREE) or next(iter(responses.values()))
    names = measured.axes
    size = len(names)
    width = max(9.0, 4.6 * size)
    figure = Figure(figsize=(width, 3.0 * size + 0.9), layout="constrained")
    FigureCanvasAgg(figure)
    plots = figure.subplots(size, size, sharex=True, squeeze=False)
    low, high = measured.frequencies[0] * 0.9, measured.frequencies[-1] * 1.1
    curves = _Curves(np.geomspace(low, high, POINTS), model, prior, fitted)
    for i in range(size):
        for j in range(size):
            plot = plots[i, j]
            curves.draw(plot, i, j)
            _draw_measured(plot, measured, i, j)
            what = "its own torque" if i == j else f"torque of {names[j]}"
            plot.set_title(f"{names[i]}: acceleration per {what}", loc="left", fontsize=10)
            plot.set_ylabel(_unit(model, i, j, torque_units) if j == 0 else "")
            plot.grid(visible=True, which="both", alpha=0.25)
    for plot in plots[-1]:
        plot.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        plot.xaxis.set_major_formatter(FormatStrFormatter("%g"))
        plot.xaxis.set_minor_formatter(NullFormatter())
        plot.set_xlabel("frequency, Hz")
    plots[0, 0].legend(loc="upper left", fontsize=8, frameon=False)
    save_picture(figure, path, 110)


class _Curves:
    """Models on a grid of frequencies, with the identified one's band."""

    def __init__(
        self,
        grid: FloatArray,
        model: MachineModel,
        prior: MachineModel | None,
        fitted: RefinedModel | None,
    ) -> None:
        omega = 2 * np.pi * grid
        scale = omega[:, None, None] ** 2
        self._grid = grid
        self._model = np.abs(machine_response(model, omega)) * scale
        same = prior is not None and prior.names == model.names
        self._prior = np.abs(machine_response(prior, omega)) * scale if prior and same else None
        self._band = relative_std(fitted, omega) if fitted is not None else None

    def draw(self, plot: Axes, i: int, j: int) -> None:
        """Draw the response of motor i to the torque of motor j."""
        grid, size = self._grid, self._model[:, i, j]
        if self._prior is not None:
            plot.loglog(grid, self._prior[:, i, j], color=PRIOR, lw=1.2, label="prior model")
        if self._band is not None and np.any(size > 0):  # there is no band about nothing
            factor = np.exp(np.minimum(CONFIDENCE * self._band[:, i, j], WIDEST))
            plot.fill_between(
                grid,
                size / factor,
                size * factor,
                color=MODEL,
                alpha=0.25,
                lw=0,
                label="model, 95 % band",
            )
        plot.loglog(grid, size, color=MODEL, lw=1.4, label="identified model")
        shown = size[size > 0]
        if shown.size:  # a coupling of zero answers nothing: no decades of rounding
            plot.set_ylim(bottom=max(shown.min() / 3, shown.max() * FAINTEST))


def _draw_measured(plot: Axes, measured: FrequencyResponse, i: int, j: int) -> None:
    frequencies, response, std = measured.element(i, j)
    scale = (2 * np.pi * frequencies) ** 2
    size = np.abs(response) * scale
    below = np.minimum(CONFIDENCE * std * scale, 0.9 * size)  # a logarithmic axis has no zero
    plot.errorbar(
        frequencies,
        size,
        yerr=np.stack([below, CONFIDENCE * std * scale]),
        fmt="o",
        ms=3.0,
        color=MEASURED,
        ecolor=MEASURED,
        elinewidth=0.8,
        label="measured, 95 %",
    )


def _unit(model: MachineModel, i: int, j: int, torque_units: Sequence[str]) -> str:
    if torque_units and torque_units[j] == "A":
        return "rad/(A s²)" if model.axes[i].kind == "rotary" else "m/(A s²)"
    kinds = {model.axes[i].kind, model.axes[j].kind}
    if kinds == {"rotary"}:
        return "1/(kg m²)"
    return "1/kg" if kinds == {"linear"} else "1/(kg m)"
