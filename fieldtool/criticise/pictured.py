"""Where a simulation is wrong, as curves with one sentence each.

The same error is looked at by frequency, by the kind of line, by amplitude, by velocity, by position,
in time, over the whole measurement, and by the axis whose motion it goes with: before, by the
machine without effects, and after, with the causes that were found.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from fieldtool.criticise.effects.base import Context
from fieldtool.criticise.evidence.lines import Lines, unflat
from fieldtool.criticise.evidence.spans import Role
from fieldtool.criticise.pictures_file import NOISE_ONLY, Kind, Picture, Series
from fieldtool.criticise.search.fit import Fitted
from fieldtool.criticise.search.search import Found
from fieldtool.criticise.simulate.motion import Motion
from fieldtool.criticise.where.sentences import (
    LevelError,
    Parts,
    experiment_errors,
    judged_by,
    line_kinds,
    relative_error,
    relative_noise,
)
from fieldtool.criticise.where.views import View, share_with, views_of

FloatArray = NDArray[np.float64]
ROWS = 3000
"""Rows of the course in time that are kept."""
LINES = 1500
"""Lines of a spectrum that are kept: the largest of neighbours where there are more."""
BINS = 30
FEWEST = 10
"""Rows in a bin of velocity or position that is shown."""
BLOCKS = 24
"""Blocks in time that the whole measurement is cut into."""
NOISY = 1.5
"""Error over noise up to which there is nothing to see."""
SHOWS = 0.25
"""Share of the error's power from which a view is said to show it."""
SPREAD = 1.6
"""Ratio of errors from which they are said to differ."""
LEVELS_APART = 1.5
"""Ratio of the torques of experiments from which they are of different size."""
NONLINEAR = 0.01
"""Share of the torque at lines that were not excited from which it is worth a word."""


def pictures_of(found: Found) -> tuple[Picture, ...]:
    """Look at the error of every axis in every way, before and after.

    Parameters
    ----------
    found : Found
        Where a search for causes ended.
    """
    both: tuple[tuple[str, Fitted], ...] = (
        ("error before", found.before),
        ("error after", found.after),
    )
    if not found.accepted:
        both = (("error", found.before),)
    sides = tuple(_Side.of(found, label, fitted) for label, fitted in both)
    out: list[Picture] = []
    for axis in range(len(found.prepared.recording.axes)):
        for look in LOOKS:
            seen = look(sides, axis)
            if seen is not None:
                out.append(seen)
    return tuple(out)


@dataclass(frozen=True, eq=False)
class _Side:
    """The errors that one hypothesis leaves."""

    label: str
    context: Context
    parts: Parts

    @classmethod
    def of(cls, found: Found, label: str, fitted: Fitted) -> "_Side":
        simulator = found.prepared.simulator
        roles: tuple[Role, ...] = ("fit", "unseen")
        parts = [p for role in roles for p in simulator.parts(fitted.hypothesis, role)]
        return cls(label, found.prepared.context(fitted.hypothesis), parts)


Sides = tuple[_Side, ...]


def _quiet(sides: Sides, axis: int) -> str:
    """Say that there is nothing but noise; empty where all data, or those that are judged, have more."""
    for parts in (sides[0].parts, judged_by(sides[0].parts, axis)[1]):
        noise = relative_noise(parts, axis)
        if noise is None or relative_error(parts, axis) >= NOISY * noise:
            return ""
    return NOISE_ONLY


def _by_frequency(sides: Sides, axis: int) -> Picture:
    info = sides[0].context.axes[axis]
    place = int(np.argmax([lines.weight.shape[0] for lines, _ in sides[0].parts]))
    lines, _ = sides[0].parts[place]
    spacing = 1.0 / ((lines.span.stop - lines.span.start) * lines.motion.step)
    frequency = np.asarray(spacing * np.arange(lines.weight.shape[0]), dtype=np.float64)
    torque = 2 * np.abs(lines.raw(lines.motion.torque)[:, axis])
    series = [_thinned("measured torque", frequency, torque)]
    series += [
        _thinned(s.label, frequency, 2 * np.abs(_error_lines(*s.parts[place], axis))) for s in sides
    ]
    if lines.span.periods > 1:
        series.append(_thinned("noise", frequency, 2 * np.sqrt(lines.noise[:, axis])))
    low, high = _worst_band(sides[0].parts, axis)
    sentence = _quiet(sides, axis) or (
        f"most of the error lies between {low:.3g} and {high:.3g} Hz"
    )
    return Picture(
        info.name, "frequency", sentence, f"frequency in {lines.span.experiment}, Hz",
        f"torque, {info.torque_unit}", tuple(series), logarithmic=True,
    )  # fmt: skip


def _error_lines(lines: Lines, values: FloatArray, axis: int) -> NDArray[np.complex128]:
    weight = lines.weight[:, axis]
    shaped = unflat(values, lines.weight.shape[1])[:, axis]
    out = np.full(weight.size, np.nan, dtype=np.complex128)
    out[weight > 0] = shaped[weight > 0] / weight[weight > 0]
    return out


def _thinned(label: str, x: FloatArray, y: NDArray[np.floating[Any]]) -> Series:
    """Leave out the line at zero; of many neighbours keep the largest."""
    x, y = x[1:], y[1:]
    width = -(-x.size // LINES)
    if width > 1:
        whole = x.size // width * width
        x = x[:whole].reshape(-1, width).mean(axis=1)
        blocks = np.where(np.isnan(y[:whole]), -np.inf, y[:whole]).reshape(-1, width)
        y = blocks.max(axis=1)
        y = np.where(np.isinf(y), np.nan, y)
    return Series(label, x, np.asarray(y, dtype=np.float64))


def _worst_band(parts: Parts, axis: int) -> tuple[float, float]:
    """Find the shortest band, in thirds of octaves, that has half of the error's power."""
    frequency, power = [], []
    for lines, values in parts:
        seconds = (lines.span.stop - lines.span.start) * lines.motion.step
        frequency.append(np.arange(1, lines.weight.shape[0]) / seconds)
        power.append(np.abs(np.nan_to_num(_error_lines(lines, values, axis)[1:])) ** 2)
    f, p = np.concatenate(frequency), np.concatenate(power)
    thirds = np.floor(3 * np.log2(f)).astype(int)
    first, count = int(thirds.min()), int(np.ptp(thirds)) + 1
    sums = np.concatenate([[0.0], np.cumsum(np.bincount(thirds - first, p, count))])
    best = (0, count)
    for a in range(count):
        b = int(np.searchsorted(sums, sums[a] + 0.5 * sums[-1]))
        if b <= count and b - a < best[1] - best[0]:
            best = (a, b)
    return float(2 ** ((first + best[0]) / 3)), float(2 ** ((first + best[1]) / 3))


def _by_lines(sides: Sides, axis: int) -> Picture | None:
    kinds = [line_kinds(s.parts) for s in sides]
    if kinds[0] is None:
        return None
    rows = [
        np.array([100 * getattr(k, what)[axis] for what in ("excited", "odd", "even")])
        for k in kinds
        if k is not None
    ]
    odd, even = rows[0][1] / 100, rows[0][2] / 100
    if max(odd, even) < NONLINEAR:
        sentence = f"below {100 * NONLINEAR:g} % of the torque at frequencies that were not excited"
    elif odd > SPREAD * even:
        sentence = (
            f"{100 * odd:.2g} % of the torque is at odd multiples that were not excited: something "
            "bends the same way in both directions, as dry friction, play, and springs do"
        )
    elif even > SPREAD * odd:
        sentence = (
            f"{100 * even:.2g} % of the torque is at even multiples: something differs between the two "
            "directions or sides, or goes with the position"
        )
    else:
        sentence = (
            f"{100 * odd:.2g} % of the torque is at odd and {100 * even:.2g} % at even multiples that "
            "were not excited: the axis does not answer linearly"
        )
    info = sides[0].context.axes[axis]
    x = np.arange(3.0)
    series = tuple(Series(s.label, x, row) for s, row in zip(sides, rows, strict=True))
    names = ("excited lines", "odd lines left out", "even lines")
    return Picture(info.name, "lines", sentence, "", "error, % of the torque", series, names)


def _by_amplitude(sides: Sides, axis: int) -> Picture:
    info = sides[0].context.axes[axis]
    levels = [experiment_errors(s.parts) for s in sides]
    torque = np.array([level.torque[axis] for level in levels[0]])
    series = tuple(
        Series(s.label, torque, np.array([100 * level.error[axis] for level in found]))
        for s, found in zip(sides, levels, strict=True)
    )
    return Picture(
        info.name,
        "amplitude",
        _quiet(sides, axis) or _amplitude_sentence(levels[0], axis),
        f"size of the experiment: RMS of the torque, {info.torque_unit}",
        "error, % of the torque",
        series,
    )


def _amplitude_sentence(levels: Sequence[LevelError], axis: int) -> str:
    torque = np.array([level.torque[axis] for level in levels])
    error = np.array([level.error[axis] for level in levels])
    if torque.min() <= 0 or torque.max() < LEVELS_APART * torque.min():
        return "all experiments are of one size, so nobody can say how the error goes with it"
    small, large = error[np.argmin(torque)], error[np.argmax(torque)]
    if small > SPREAD * large:
        return f"{small / large:.2g} times as large a share at small amplitudes as at large ones"
    if large > SPREAD * small:
        return f"{large / small:.2g} times as large a share at large amplitudes as at small ones"
    return "about the same share at small and large amplitudes"


def _shared(sides: Sides, axis: int, names: Sequence[str], nothing: str) -> tuple[str, View | None]:
    """Say how much of the error one of some views shows."""
    quiet = _quiet(sides, axis)
    if quiet:
        return quiet, None
    views = views_of(sides[0].context, axis, names)
    if not views or views[0].share < SHOWS:
        return nothing, None
    best = views[0]
    return f"{100 * best.share:.0f} % of the error {best.words}", best


def _by_velocity(sides: Sides, axis: int) -> Picture:
    sentence, _ = _shared(
        sides, axis, ("direction", "speed"), "the error does not go with the velocity"
    )
    return _binned(sides, axis, "velocity", "/s", sentence)


def _by_position(sides: Sides, axis: int) -> Picture:
    sentence, _ = _shared(sides, axis, ("position",), "the error does not go with the position")
    return _binned(sides, axis, "position", "", sentence)


def _binned(sides: Sides, axis: int, what: str, per: str, sentence: str) -> Picture:
    info = sides[0].context.axes[axis]
    series = []
    for side in sides:
        motions, errors = side.context.motions, side.context.errors
        values = np.concatenate([getattr(m, f"smooth_{what}")[:, axis] for m in motions])
        error = np.concatenate([e[:, axis] for e in errors])
        counted = np.concatenate([m.counted[:, axis] for m in motions]) > 0
        series.append(_means(side.label, values[counted], error[counted]))
    kind = cast("Kind", what)
    unit = f"{info.position_unit}{per}"
    return Picture(
        info.name, kind, sentence, f"{what}, {unit}", f"mean error, {info.torque_unit}",
        tuple(series),
    )  # fmt: skip


def _means(label: str, values: FloatArray, error: FloatArray) -> Series:
    if values.size < FEWEST or np.ptp(values) == 0:
        return Series(label, np.zeros(0), np.zeros(0), np.zeros(0))
    edges = np.linspace(values.min(), values.max(), BINS + 1)
    place = np.clip(np.searchsorted(edges, values) - 1, 0, BINS - 1)
    count = np.bincount(place, minlength=BINS)
    full = count >= FEWEST
    mean = np.bincount(place, error, BINS)[full] / count[full]
    square = np.bincount(place, error**2, BINS)[full] / count[full]
    std = np.sqrt(np.maximum(square - mean**2, 0.0) / count[full])
    return Series(label, (edges[1:] + edges[:-1])[full] / 2, mean, std)


def _in_time(sides: Sides, axis: int) -> Picture:
    """Show the middle of the experiment with the largest error."""
    context = sides[0].context
    info = context.axes[axis]
    k = int(np.argmax([float(np.sum(e[:, axis] ** 2)) for e in context.errors]))
    motion = context.motions[k]
    begin = max(0, (motion.rows - ROWS) // 2)
    rows = slice(begin, begin + ROWS)
    time = motion.clock[rows] - motion.clock[0]
    series = [Series("measured torque", time, motion.torque[rows, axis])]
    series += [Series(s.label, time, s.context.errors[k][rows, axis]) for s in sides]
    largest = float(np.abs(context.errors[k][rows, axis]).max())
    sentence = f"at most {largest:.2g} {info.torque_unit} in this stretch are not explained"
    return Picture(
        info.name, "time", sentence, f"time in {motion.experiment}, s",
        f"torque, {info.torque_unit}", tuple(series),
    )  # fmt: skip


def _over_session(sides: Sides, axis: int) -> Picture:
    info = sides[0].context.axes[axis]
    series = tuple(_blocks(side, axis) for side in sides)
    y = series[0].y
    half = y.size // 2
    sentence = _quiet(sides, axis)
    if not sentence and half:
        early, late = (float(np.sqrt(np.mean(part**2))) for part in (y[:half], y[half:]))
        if late > SPREAD * early:
            sentence = (
                f"{late / max(early, 1e-12):.2g} times as large in the later half of the data"
            )
        elif early > SPREAD * late:
            sentence = (
                f"{early / max(late, 1e-12):.2g} times as large in the earlier half of the data"
            )
    return Picture(
        info.name, "session", sentence or "no drift: early and late data are explained alike",
        "time since the first sample, s", f"RMS of the error, {info.torque_unit}", series,
    )  # fmt: skip


def _blocks(side: _Side, axis: int) -> Series:
    """RMS of the error in blocks of rows that are compared, in the order of time."""
    motions, errors = side.context.motions, side.context.errors
    clock = np.concatenate([m.clock for m in motions])
    error = np.concatenate([e[:, axis] for e in errors])
    counted = [m.counted[:, axis] * _compared(side.parts, m) for m in motions]
    compared = np.flatnonzero(np.concatenate(counted))
    blocks = [b for b in np.array_split(compared, BLOCKS) if b.size]
    x = np.array([clock[b].mean() for b in blocks])
    return Series(side.label, x, np.array([np.sqrt(np.mean(error[b] ** 2)) for b in blocks]))


def _compared(parts: Parts, motion: Motion) -> FloatArray:
    """1 in the rows of an experiment that are compared, else 0."""
    out = np.zeros(motion.rows)
    for lines, _ in parts:
        if lines.span.experiment == motion.experiment:
            out[lines.span.start : lines.span.stop] = 1.0
    return out


def _by_axes(sides: Sides, axis: int) -> Picture | None:
    context = sides[0].context
    names = tuple(info.name for info in context.axes)
    if len(names) == 1:
        return None
    shares = [[100 * share_with(s.context, axis, k) for k in range(len(names))] for s in sides]
    quiet = _quiet(sides, axis)
    first = np.array(shares[0])
    others = np.where(np.arange(len(names)) == axis, -np.inf, first)
    worst = int(np.argmax(others))
    if quiet:
        sentence = quiet
    elif first[worst] > 100 * SHOWS and first[worst] > first[axis]:
        sentence = f"{first[worst]:.0f} % of the error goes with the motion of {names[worst]}"
    elif first[axis] > 100 * SHOWS:
        sentence = f"{first[axis]:.0f} % of the error goes with the axis' own motion"
    else:
        sentence = "the error goes neither with its own motion nor with that of another axis"
    x = np.arange(float(len(names)))
    series = tuple(Series(s.label, x, np.array(row)) for s, row in zip(sides, shares, strict=True))
    y = "share of the error, %"
    return Picture(names[axis], "axes", sentence, "motion of", y, series, names)


def _by_everything(sides: Sides, axis: int) -> Picture:
    views = views_of(sides[0].context, axis)
    names = tuple(v.name for v in views)
    x = np.arange(float(len(names)))
    series = []
    for side in sides:
        shares = {v.name: 100 * v.share for v in views_of(side.context, axis)}
        series.append(Series(side.label, x, np.array([shares.get(n, 0.0) for n in names])))
    quiet = _quiet(sides, axis)
    best = next((v for v in views if v.share > SHOWS), None)
    sentence = quiet or (f"it {best.words}" if best else "it follows none of these clearly")
    name = sides[0].context.axes[axis].name
    return Picture(name, "follows", sentence, "", "share of the error, %", tuple(series), names)


LOOKS: tuple[Callable[[Sides, int], Picture | None], ...] = (
    _by_everything, _by_frequency, _by_lines, _by_amplitude, _by_velocity, _by_position,
    _in_time, _over_session, _by_axes,
)  # fmt: skip
