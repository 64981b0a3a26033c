"""Figures as plotly has them, built as plain values: only the page in the browser needs plotly.

Names come from files, so every text is escaped: plotly reads some HTML in texts.
"""

from collections.abc import Mapping
from html import escape
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fieldtool.criticise.pictures_file import Picture, Series
from fieldtool.frf.response import FrequencyResponse, ModelBand
from fieldtool.identify.likelihood.refine import machine_response
from fieldtool.records.model import MachineModel
from fieldtool.report.numbers import CONFIDENCE

FloatArray = NDArray[np.float64]
Figure = dict[str, Any]
MEASURED, MODEL, PRIOR, NOISE = "#1f3b73", "#d1495b", "#9aa5b1", "#c9a227"
COLORS = {
    "measured torque": PRIOR,
    "error": MODEL,
    "error before": MODEL,
    "error after": MEASURED,
    "noise": NOISE,
}
POINTS = 400
FEW_DECADES = 2.5
"""On a logarithmic axis, below which 2 and 5 are labelled between the powers of ten."""
MOST_DECADES = 7
"""Powers of ten that are labelled; of more, every second or third."""
SMALLEST_PLAIN = 1e-3
"""Smaller numbers are labelled as powers of ten, and larger ones than its inverse."""
NEXT_TO_NOTHING = 1e-300
"""Smaller numbers, and larger ones than its inverse, have no labels."""
WIDEST = 5.0
"""Natural logarithm of the largest factor that a band shows."""
FAINTEST = 1e-7
"""Of the largest value: what is below is not drawn."""
DIGITS = 5


def numbers(values: FloatArray) -> list[float | None]:
    """Return plain numbers, rounded to what a screen can show; gaps where there is none."""
    return [
        float(f"{v:.{DIGITS}g}") if np.isfinite(v) else None
        for v in np.asarray(values, dtype=np.float64).tolist()
    ]


def layout(x: str, y: str, *, logarithmic: bool = False, legend: bool = True) -> Figure:
    """Return how a figure looks that has one pair of axes."""
    kind = {"type": "log"} if logarithmic else {}
    frame = {
        "automargin": True,
        "zeroline": False,
        "gridcolor": "#e6e9ed",
        "linecolor": "#6b7683",
        "ticks": "outside",
    }
    return {
        "margin": {"l": 64, "r": 12, "t": 28, "b": 46},
        "font": {"family": "system-ui, sans-serif", "size": 12, "color": "#24292f"},
        "paper_bgcolor": "white",
        "plot_bgcolor": "white",
        "hovermode": "closest",
        "showlegend": legend,
        "legend": {"orientation": "h", "y": 1.02, "yanchor": "bottom", "x": 0},
        "xaxis": {**frame, **kind, "title": {"text": escape(x)}},
        "yaxis": {**frame, **kind, "title": {"text": escape(y)}},
    }


def response_figure(
    measured: FrequencyResponse | None,
    model: MachineModel,
    prior: MachineModel | None,
    band: ModelBand | None,
    place: tuple[int, int],
    unit: str,
) -> Figure:
    """Return acceleration of one motor per torque of another: measured, modelled, as last accepted.

    Parameters
    ----------
    measured
        With standard errors, shown as 95 % bars.
    model, prior
        The identified machine, and the one as last accepted.
    band
        How well the model's response is known: the 95 % band about it.
    place
        Numbers of the axis that moves and of the one whose torque drives it.
    unit
        Of the ratio.
    """
    i, j = place
    data: list[Figure] = []
    grid = _grid(measured, band)
    curve = _size(model, grid, i, j)
    if prior is not None and prior.names == model.names:
        data.append(_line("as last accepted", grid, _size(prior, grid, i, j), PRIOR, 1.2))
    if band is not None and band.relative_std.shape[1:] == (len(model.names),) * 2:
        std = np.interp(grid, band.frequencies, band.relative_std[:, i, j])
        factor = np.exp(np.minimum(CONFIDENCE * std, WIDEST))
        low = _line("", grid, curve / factor, MODEL, 0.0)
        high = _line("model, 95 % band", grid, curve * factor, MODEL, 0.0)
        data += [
            {**low, "showlegend": False, "hoverinfo": "skip"},
            {**high, "fill": "tonexty", "fillcolor": "rgba(209,73,91,0.25)", "hoverinfo": "skip"},
        ]
    data.append(_line("model", grid, curve, MODEL, 1.6))
    largest = float(curve.max())
    if measured is not None:
        f, response, std = measured.element(i, j)
        scale = (2 * np.pi * f) ** 2
        size = np.abs(response) * scale
        bar = CONFIDENCE * std * scale
        data.append(
            {
                "type": "scatter",
                "mode": "markers",
                "name": "measured, 95 %",
                "x": numbers(f),
                "y": numbers(size),
                "error_y": {
                    "type": "data",
                    "symmetric": False,
                    "array": numbers(bar),
                    "arrayminus": numbers(np.minimum(bar, 0.9 * size)),
                    "thickness": 0.8,
                    "width": 2,
                    "color": MEASURED,
                },
                "marker": {"color": MEASURED, "size": 4},
            }
        )
        largest = max(largest, float(size.max(initial=0.0)))
    look = layout("frequency, Hz", unit, logarithmic=True, legend=place == (0, 0))
    smallest = max(float(curve[curve > 0].min(initial=largest)) / 3, largest * FAINTEST)
    look["yaxis"]["range"] = numbers(np.log10([smallest, 2.0 * largest]))
    log_ticks(look["xaxis"], grid)
    log_ticks(look["yaxis"], np.array([smallest, 2.0 * largest]))
    return {"data": data, "layout": look}


def log_ticks(axis: Figure, values: FloatArray) -> None:
    """Label a logarithmic axis so that every label is a number of its own: 0.5, 1, 2, 5, 10 ...

    Powers of ten alone where the values range over many decades; one to nine of each where over less
    than one.
    """
    shown = values[(values > NEXT_TO_NOTHING) & (values < 1 / NEXT_TO_NOTHING)]
    if not shown.size:
        return
    low, high = np.log10(shown.min()), np.log10(shown.max())
    digits = (1, 2, 5) if high - low < FEW_DECADES else (1,)
    step = 1 + int((high - low) / MOST_DECADES)
    first, last = int(np.floor(low)), int(np.ceil(high))
    ticks = [d * 10.0**k for k in range(first, last + 1, step) for d in digits]
    if sum(low <= np.log10(t) <= high for t in ticks) < 2:
        ticks = [d * 10.0**k for k in range(first, last + 1) for d in range(1, 10)]
    axis |= {"tickmode": "array", "tickvals": ticks, "ticktext": [_tick(t) for t in ticks]}


def _tick(value: float) -> str:
    if SMALLEST_PLAIN <= value <= 1 / SMALLEST_PLAIN:
        return f"{value:g}"
    power = int(np.floor(np.log10(value) + 1e-9))
    factor = f"{value / 10.0**power:g}"
    return f"{'' if factor == '1' else factor + '·'}10<sup>{power}</sup>"


def _grid(measured: FrequencyResponse | None, band: ModelBand | None) -> FloatArray:
    if measured is not None and measured.frequencies.size:
        low, high = measured.frequencies[0] * 0.9, measured.frequencies[-1] * 1.1
    elif band is not None:
        low, high = band.frequencies[0], band.frequencies[-1]
    else:
        low, high = 0.5, 200.0
    return np.geomspace(float(low), float(high), POINTS)


def _size(model: MachineModel, grid: FloatArray, i: int, j: int) -> FloatArray:
    omega = 2 * np.pi * grid
    return np.asarray(np.abs(machine_response(model, omega)[:, i, j]) * omega**2)


def _line(name: str, x: FloatArray, y: FloatArray, color: str, width: float) -> Figure:
    return {
        "type": "scatter",
        "mode": "lines",
        "name": name,
        "x": numbers(x),
        "y": numbers(y),
        "line": {"color": color, "width": width},
    }


def picture_figure(picture: Picture) -> Figure:
    """Return one way to look at the error of an axis."""
    look = layout(picture.x, picture.y, logarithmic=picture.logarithmic)
    if picture.categories:
        data = [
            {
                "type": "bar",
                "name": escape(s.label),
                "x": [escape(picture.categories[int(k)]) for k in s.x],
                "y": numbers(s.y),
                "marker": {"color": COLORS.get(s.label, PRIOR)},
            }
            for s in picture.series
        ]
        look["xaxis"]["type"] = "category"
        return {"data": data, "layout": {**look, "barmode": "group"}}
    points = picture.kind == "amplitude"
    data = [_series(s, points=points) for s in picture.series]
    if picture.logarithmic:
        log_ticks(look["xaxis"], np.concatenate([s.x for s in picture.series]))
        log_ticks(look["yaxis"], np.concatenate([s.y for s in picture.series]))
    if picture.kind in ("amplitude", "session"):
        look["yaxis"]["rangemode"] = "tozero"
    return {"data": data, "layout": look}


def _series(series: Series, *, points: bool) -> Figure:
    color = COLORS.get(series.label, PRIOR)
    out = _line(escape(series.label), series.x, series.y, color, 1.1)
    if points or series.std is not None:
        out["mode"] = "markers" if points else "lines+markers"
        out["marker"] = {"color": color, "size": 8 if points else 4}
    if series.std is not None:
        out["error_y"] = {
            "type": "data",
            "array": numbers(CONFIDENCE * series.std),
            "thickness": 0.8,
            "width": 2,
            "color": color,
        }
    return out


def bars_figure(groups: Mapping[str, Mapping[str, float | None]], y: str) -> Figure:
    """Return bars side by side: for each label the values by name."""
    colors = {"before": MODEL, "after": MEASURED, "noise floor": NOISE}
    data = [
        {
            "type": "bar",
            "name": label,
            "x": [escape(name) for name in values],
            "y": [None if v is None else float(f"{v:.4g}") for v in values.values()],
            "marker": {"color": colors.get(label, PRIOR)},
        }
        for label, values in groups.items()
    ]
    look = layout("", y)
    look["xaxis"]["type"] = "category"
    look["yaxis"]["rangemode"] = "tozero"
    return {"data": data, "layout": {**look, "barmode": "group"}}
