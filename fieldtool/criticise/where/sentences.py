"""Where the simulation is wrong, in plain sentences, with the numbers that pictures show."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fieldtool.criticise.criticism import Base
from fieldtool.criticise.effects.base import Context
from fieldtool.criticise.evidence.lines import Lines, unflat
from fieldtool.criticise.where.views import View, views_of

FloatArray = NDArray[np.float64]
Parts = Sequence[tuple[Lines, FloatArray]]
SHOWS = 0.25
"""Share of the error from which a view is worth a sentence."""
ALIKE = 0.05
"""Shares that differ by less are alike: the simpler view is told."""
CHANGED = 1.6
"""Ratio of the errors of early and late data from which it is said that something changed."""
GROWS = 0.3
"""Exponent by which the relative error grows or falls with the amplitude, from which it is said."""
NO_POWER = 1e-100
"""Power of an error, SI units, that is none."""
SIMPLE = (
    "direction",
    "one frequency",
    "large torque",
    "speed",
    "position",
    "other axes",
    "own motion",
)
"""Views from the simplest on."""


@dataclass(frozen=True)
class AxisError:
    """How wrong one axis is, in the band, on the rows that it is judged by."""

    axis: str
    data: Base
    error: float
    """RMS of torque measured less simulated over RMS of the torque."""
    noise: float | None
    """The same of the noise; None where no period repeats."""
    overall: tuple[float, float | None]
    """Error and noise on all rows that are compared."""
    sentence: str


@dataclass(frozen=True)
class LevelError:
    """How wrong one experiment is."""

    experiment: str
    torque: tuple[float, ...]
    """RMS of the torque, per axis."""
    error: tuple[float, ...]
    """Relative, per axis."""


@dataclass(frozen=True)
class LineKinds:
    """Power of the error at the lines of periodic experiments, relative to the torque's, per axis."""

    excited: tuple[float, ...]
    odd: tuple[float, ...]
    """At odd harmonics that were not excited: friction, cubic springs."""
    even: tuple[float, ...]
    """At even ones: asymmetry, gravity, cogging."""


def axis_errors(context: Context, parts: Parts) -> tuple[AxisError, ...]:
    """Say of every axis how wrong it is on the data that it is judged by, and what the error follows."""
    out = []
    for axis, info in enumerate(context.axes):
        data, judged = judged_by(parts, axis)
        error, noise = relative_error(judged, axis), relative_noise(judged, axis)
        overall = relative_error(parts, axis), relative_noise(parts, axis)
        if data == "nothing":
            why = (
                "at all frequencies its encoder's steps or noise hide what torque its motion needs; "
                "larger motions would show it"
                if any(_moves(lines, axis) for lines, _ in parts)
                else "it stands still in all that is compared"
            )
            sentence = f"{info.name}: nothing can be said of its torque: {why}"
        else:
            sentence = _sentence(context, parts, axis, error, noise)
        out.append(AxisError(info.name, data, error, noise, overall, sentence))
    return tuple(out)


def judged_by(parts: Parts, axis: int) -> tuple[Base, Parts]:
    """Return the rows that an axis is judged by: unseen ones where they tell of its torque, else all."""
    unseen = [(lines, v) for lines, v in parts if lines.span.role == "unseen"]
    if _tells(unseen, axis):
        return "unseen", unseen
    return ("all" if _tells(parts, axis) else "nothing"), parts


def _tells(parts: Parts, axis: int) -> bool:
    return any(np.any(lines.weight[:, axis] > 0.0) for lines, _ in parts)


def relative_error(parts: Parts, axis: int) -> float:
    """RMS of the error over RMS of the torque in the band, of some spans.

    Beside a torque that is exactly 0 it is 1, or 0 where there is no error either.
    """
    lost, whole = _powers(parts, axis, lambda lines, values: np.abs(_raw(lines, values, axis)) ** 2)
    return float(np.sqrt(lost / whole)) if whole > 0.0 else float(lost > NO_POWER)


def relative_noise(parts: Parts, axis: int) -> float | None:
    """RMS of the noise over RMS of the torque in the band; None where it is not known."""
    if not all(lines.span.periods > 1 for lines, _ in parts):
        return None
    lost, whole = _powers(
        parts, axis, lambda lines, _: lines.noise[:, axis] * (lines.weight[:, axis] > 0)
    )
    return float(np.sqrt(lost / whole)) if whole > 0.0 else None


def experiment_errors(parts: Parts) -> tuple[LevelError, ...]:
    """Say of every experiment how wrong it is: the error by level of amplitude."""
    out = []
    for name in dict.fromkeys(lines.span.experiment for lines, _ in parts):
        mine = [(lines, v) for lines, v in parts if lines.span.experiment == name]
        axes = range(mine[0][0].weight.shape[1])
        torque = tuple(float(np.std(mine[0][0].motion.torque[:, a])) for a in axes)
        out.append(LevelError(name, torque, tuple(relative_error(mine, a) for a in axes)))
    return tuple(out)


def line_kinds(parts: Parts) -> LineKinds | None:
    """Compare excited, odd and even lines; None without periodic experiments."""
    periodic = [(lines, v) for lines, v in parts if lines.span.periods > 1]
    if not periodic:
        return None
    axes = periodic[0][0].weight.shape[1]
    sums = np.zeros((4, axes))
    for lines, values in periodic:
        torque = np.abs(lines.raw(lines.motion.torque)) ** 2
        error = np.abs(unflat(values, axes) / np.maximum(lines.weight, 1e-300)) ** 2
        error[lines.weight == 0] = 0.0
        harmonic = np.arange(torque.shape[0]) / lines.span.periods
        whole = harmonic == np.rint(harmonic)
        excited = whole & np.any(torque > 1e-3 * torque[1:].max(axis=0), axis=1)
        excited[0] = False
        for k, chosen in enumerate((
            excited,
            whole & ~excited & (harmonic % 2 == 1),
            whole & ~excited & (harmonic % 2 == 0) & (harmonic > 0),
        )):  # fmt: skip
            sums[k] += error[chosen].sum(axis=0)
        sums[3] += torque.sum(axis=0)
    shares = np.sqrt(sums[:3] / np.maximum(sums[3], 1e-300))
    return LineKinds(*(tuple(row.tolist()) for row in shares))


def _powers(
    parts: Parts, axis: int, power: Callable[[Lines, FloatArray], FloatArray]
) -> tuple[float, float]:
    """Return the power of an error or noise, and that of the torque, in the band."""
    lost = whole = 0.0
    for lines, values in parts:
        lost += float(np.sum(power(lines, values)))
        torque = lines.raw(lines.motion.torque)[:, axis]
        whole += float(np.sum(np.abs(torque) ** 2))
    return lost, whole


def _moves(lines: Lines, axis: int) -> bool:
    return bool(np.any(lines.motion.counted[lines.span.start : lines.span.stop, axis] > 0.0))


def _raw(lines: Lines, values: FloatArray, axis: int) -> FloatArray:
    weight = lines.weight[:, axis]
    shaped = unflat(values, lines.weight.shape[1])[:, axis]
    return np.asarray(np.where(weight > 0, shaped / np.where(weight > 0, weight, 1.0), 0.0))


def _band(parts: Parts, axis: int) -> tuple[float, float]:
    """Find the third of an octave with most of the error."""
    frequency, power = [], []
    for lines, values in parts:
        seconds = (lines.span.stop - lines.span.start) * lines.motion.step
        frequency.append(np.arange(lines.weight.shape[0]) / seconds)
        power.append(np.abs(_raw(lines, values, axis)) ** 2)
    f, p = np.concatenate(frequency), np.concatenate(power)
    inside = f > 0
    thirds = np.floor(3 * np.log2(f[inside]))
    sums = {t: p[inside][thirds == t].sum() for t in np.unique(thirds)}
    best = max(sums, key=lambda t: sums[t])
    return float(2 ** (best / 3)), float(2 ** ((best + 1) / 3))


def _sentence(
    context: Context,
    parts: Parts,
    axis: int,
    error: float,
    noise: float | None,
) -> str:
    """Say how large the error is on the data that the axis is judged by, and its form in all data."""
    name = context.axes[axis].name
    data, judged = judged_by(parts, axis)
    if noise is not None and error < 1.5 * noise:
        return (
            f"{name}: the torque of {data} data is explained to {_percent(error)}; its noise is "
            f"{_percent(noise)}"
        )
    clauses = []
    follows = _follows(views_of(context, axis))
    if not follows:
        low, high = _band(judged, axis)
        clauses.append(f"most of it lies between {low:.3g} and {high:.3g} Hz")
    looks = [w for w in (follows, _in_time(parts, axis) or _with_amplitude(parts, axis)) if w]
    if looks:
        clauses.append(f"{'in all data ' if data == 'unseen' else ''}it {', and '.join(looks)}")
    beyond = f" (noise {_percent(noise)})" if noise is not None else ""
    return (
        f"{name}: {_percent(error)} of the torque of {data} data is not explained{beyond}; "
        f"{'; '.join(clauses)}"
    )


def _follows(views: Sequence[View]) -> str:
    showing = [v for v in views if v.share > SHOWS]
    if not showing:
        return ""
    alike = [v for v in showing if v.share > showing[0].share - ALIKE]
    best = min(alike, key=lambda v: SIMPLE.index(v.name))
    return f"{best.words} ({100 * best.share:.0f} % of it)"


def _in_time(parts: Parts, axis: int) -> str:
    """Early against late experiments or stretches."""
    if len(parts) < 4:
        return ""
    ordered = sorted(parts, key=lambda p: p[0].motion.clock[p[0].span.start])
    half = len(ordered) // 2
    early, late = relative_error(ordered[:half], axis), relative_error(ordered[half:], axis)
    if not early or not late:
        return ""
    if late > CHANGED * early:
        return f"is {late / early:.1f} times as large in the later half"
    if early > CHANGED * late:
        return f"is {early / late:.1f} times as large in the earlier half"
    return ""


def _with_amplitude(parts: Parts, axis: int) -> str:
    levels = experiment_errors(parts)
    torque = np.array([level.torque[axis] for level in levels])
    error = np.array([level.error[axis] for level in levels])
    if (
        torque.size < 2
        or torque.min() <= 0
        or torque.max() < 1.5 * torque.min()
        or error.min() <= 0
    ):
        return ""
    slope = float(np.polyfit(np.log(torque), np.log(error), 1)[0])
    if slope < -GROWS:
        return "is relatively larger at small amplitudes"
    if slope > GROWS:
        return "is relatively larger at large amplitudes"
    return ""


def _percent(share: float) -> str:
    return f"{100 * share:.2g} %"
