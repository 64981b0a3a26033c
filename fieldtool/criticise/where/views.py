"""How much of an axis' error goes with its direction, its speed, its position, time, other axes ...

Each view is a set of courses; the share of the error that it explains is measured on rows that did not
make it (every other stretch of the data), so that a view with many courses gains nothing by
having many.  All courses pass the band's filter, as the error does.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fieldtool.criticise.effects.base import Context, band_limited
from fieldtool.criticise.effects.position import waves
from fieldtool.criticise.simulate.motion import FIRST, Motion, differentiate

FloatArray = NDArray[np.float64]
STRETCH = 0.5
"""s: rows that lie this close together serve the same purpose."""
SPEEDS = 8
"""Bins of the speed in each direction."""
HELD = 1e-3
"""Of a course's power: pulls its size to zero where the data say little of it."""
LARGE = 0.9
"""Quantile of the torque's size from which it is large."""


@dataclass(frozen=True)
class View:
    """One way to look at the error."""

    name: str
    share: float
    """Of the error's power in the band, that it explains on rows that did not make it."""
    words: str
    """How the error behaves, to stand after "it"."""


def views_of(context: Context, axis: int, names: Sequence[str] | None = None) -> tuple[View, ...]:
    """Look at the error of one axis in every way, or in some; by falling share.

    Parameters
    ----------
    context : Context
        With the errors that are looked at.
    axis : int
    names : sequence of str
        Ways to look; all where not given.
    """
    ways: Mapping[str, tuple[Callable[[Context, int, Motion], FloatArray], str]] = {
        "direction": (_direction, "follows the sign of the velocity"),
        "speed": (_speed, "goes with the velocity"),
        "position": (_position, "waves with the position"),
        "large torque": (_large, "comes where the torque is large"),
        "own motion": (_own, "goes with the axis' own motion, as of a wrong mass, spring or delay"),
        "other axes": (_others, "goes with the motion of another axis"),
        "one frequency": (_frequency, "has one frequency, whatever the axis does"),
    }
    views = []
    for name, (make, words) in ways.items():
        if names is not None and name not in names:
            continue
        if name == "other axes" and len(context.axes) == 1:
            continue
        courses = [make(context, axis, m) for m in context.motions]
        if courses[0].shape[1]:
            views.append(View(name, _share(context, axis, courses), words))
    return tuple(sorted(views, key=lambda v: -v.share))


def share_with(context: Context, axis: int, other: int) -> float:
    """Return the share of an axis' error, in power, that goes with the motion of one axis."""
    return _share(context, axis, [_linear(m, [other]) for m in context.motions])


def _share(context: Context, axis: int, courses: Sequence[FloatArray]) -> float:
    """Explain one half of the stretches by what fits the other half, and the other way round."""
    rows, sides, halves = [], [], []
    for motion, error, course in zip(context.motions, context.errors, courses, strict=True):
        skip = max(1, int(1 / (motion.step * 4 * context.top)))
        counted = motion.counted[:, axis]
        filtered = band_limited(course * counted[:, None], motion.step, context.top)
        rows.append(filtered[::skip])
        sides.append(error[::skip, axis])
        halves.append((motion.clock[::skip] // STRETCH) % 2)
    A, b, half = np.vstack(rows), np.concatenate(sides), np.concatenate(halves)
    scale = np.linalg.norm(A, axis=0)
    A = A[:, scale > 0] / scale[scale > 0]
    if not A.shape[1]:
        return 0.0
    left, held = 0.0, HELD * np.eye(A.shape[1])
    for fold in (0, 1):
        seen = half == fold
        # A course that one half hardly has must not be guessed for the other one.
        solved = np.linalg.solve(A[seen].T @ A[seen] + held, A[seen].T @ b[seen])
        left += float(np.sum((b[~seen] - A[~seen] @ solved) ** 2))
    return max(0.0, 1.0 - left / max(float(b @ b), 1e-300))


def _direction(_: Context, axis: int, motion: Motion) -> FloatArray:
    return np.column_stack([np.sign(motion.smooth_velocity[:, axis]), np.ones(motion.rows)])


def _speed(context: Context, axis: int, motion: Motion) -> FloatArray:
    """Straight pieces over the velocity."""
    fastest = max(context.fastest(axis), 1e-300)
    nodes = np.concatenate([-np.linspace(1, 0, SPEEDS + 1), np.linspace(0, 1, SPEEDS + 1)])
    v = np.clip(motion.smooth_velocity[:, axis] / fastest, -1.0, 1.0)
    out = np.zeros((motion.rows, nodes.size))
    for side in (-1.0, 1.0):
        inside = np.sign(v) == side
        place = np.abs(v) * SPEEDS
        low = np.minimum(place.astype(np.intp), SPEEDS - 1)
        part = place - low
        first = SPEEDS - low if side < 0 else SPEEDS + 1 + low
        second = SPEEDS - low - 1 if side < 0 else SPEEDS + 2 + low
        rows = np.flatnonzero(inside)
        out[rows, first[rows]] += 1 - part[rows]
        out[rows, second[rows]] += part[rows]
    return out


def _position(context: Context, axis: int, motion: Motion) -> FloatArray:
    """Waves at the orders that stand out most, once a turn on rotary axes, the same times v^2."""
    orders = waves(context, axis, accelerated=False)
    rising = waves(context, axis, accelerated=True)
    if context.axes[axis].kind == "rotary":
        orders = [*orders, 1.0]
    q, square = motion.position[:, axis], motion.smooth_velocity[:, axis] ** 2
    columns = [f(order * q) for order in orders for f in (np.sin, np.cos)]
    columns += [square * f(order * q) for order in rising for f in (np.sin, np.cos)]
    return (
        np.column_stack([*columns, np.ones(motion.rows)]) if columns else np.zeros((motion.rows, 0))
    )


def _large(context: Context, axis: int, motion: Motion) -> FloatArray:
    torque = motion.torque[:, axis]
    limit = LARGE * context.largest_torque(axis)
    nodes = [f * limit for f in (0.5, 0.7, 0.85, 1.0)]
    return np.column_stack([torque - np.clip(torque, -n, n) for n in nodes])


def _own(_: Context, axis: int, motion: Motion) -> FloatArray:
    return _linear(motion, [axis])


def _others(_: Context, axis: int, motion: Motion) -> FloatArray:
    return _linear(motion, [k for k in range(motion.position.shape[1]) if k != axis])


def _linear(motion: Motion, axes: Sequence[int]) -> FloatArray:
    """Position, its first three derivatives, and the derivative of the torque."""
    q = motion.position[:, axes] - motion.position[:, axes].mean(axis=0)
    jerk = differentiate(motion.acceleration[:, axes], FIRST, motion.step)
    torque = motion.torque[:, axes]
    return np.hstack(
        [q, motion.velocity[:, axes], motion.acceleration[:, axes], jerk,
         differentiate(torque, FIRST, motion.step)]
    )  # fmt: skip


def _frequency(context: Context, axis: int, motion: Motion) -> FloatArray:
    """Sine and cosine at the line that stands out most and is no harmonic of the excitation."""
    place = context.motions.index(motion)
    error = context.errors[place][:, axis]
    power = np.abs(np.fft.rfft(error * np.hanning(error.size)))
    frequency = np.fft.rfftfreq(error.size, motion.step)
    power[(frequency < 5.0 / (error.size * motion.step)) | (frequency > context.top)] = 0.0
    for fundamental, spacing in context.fundamentals:
        off = np.abs(frequency - fundamental * np.rint(frequency / fundamental))
        power[off <= 0.6 * spacing] = 0.0
    k = int(np.argmax(power))
    near = power[max(k - 1, 0) : k + 2] ** 2
    shift = float(np.arange(near.size) @ near / max(near.sum(), 1e-300)) - min(k, 1)
    phase = 2 * np.pi * (frequency[k] + shift * frequency[1]) * motion.clock
    return np.column_stack([np.sin(phase), np.cos(phase)])
