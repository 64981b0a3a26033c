"""What a fitted hypothesis gains on data that no fit has seen, axis by axis."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from fieldtool.criticise.effects.base import Effect
from fieldtool.criticise.evidence.lines import Lines
from fieldtool.criticise.search.fit import Fitted
from fieldtool.criticise.search.hypothesis import Simulator
from fieldtool.criticise.search.instants import tried_unseen
from fieldtool.criticise.search.rules import BESIDE_NOISE, LEFT, Tried
from fieldtool.criticise.search.significance import Comparison, compared
from fieldtool.criticise.where.sentences import relative_noise

FloatArray = NDArray[np.float64]
Parts = Sequence[tuple[Lines, FloatArray]]
UNSURE_NOISE = 0.25
"""Of the power of an error, that may be noise though the estimate of the noise is smaller."""


def judged(simulator: Simulator, fitted: Fitted, effect: Effect, before: Parts) -> Tried:
    """Measure what a fitted hypothesis with an effect gains over what was before, on unseen data."""
    after = simulator.parts(fitted.hypothesis, "unseen")
    axes = [effect.axis] if effect.other is None else [effect.axis, effect.other]
    return Tried(
        fitted,
        effect,
        compared(before, after).best_of(tried_unseen(simulator, fitted.hypothesis, effect)),
        explained_share(before, after, axes),
        explained_torque(before, after, effect.axis),
        beyond_noise(before, axes),
        at_noise(after),
    )


def at_noise(parts: Parts) -> bool:
    """Whether the noise is known, and nothing else is left that would tell two exact forms wrongly."""
    lost = relative_errors(parts)
    for axis, error in enumerate(lost):
        noise = relative_noise(parts, axis)
        if noise is None or error > max(BESIDE_NOISE * noise**2, noise**2 + LEFT**2):
            return False
    return True


def explained_share(before: Parts, after: Parts, axes: Sequence[int]) -> float:
    """Return the share of the power of some axes' errors, noise taken off, that is explained."""
    there = sum(axis_power(before, axis) for axis in axes)
    gained = there - sum(axis_power(after, axis) for axis in axes)
    noise = sum(expected_noise(before, axis) for axis in axes)
    return gained / max(there - noise, UNSURE_NOISE * there, 1e-300)


def difference(simulator: Simulator, worse: Fitted, better: Fitted) -> Comparison:
    """Compare two fits on unseen data."""
    return compared(
        simulator.parts(worse.hypothesis, "unseen"), simulator.parts(better.hypothesis, "unseen")
    )


def beyond_noise(parts: Parts, axes: Sequence[int]) -> float:
    """Return the power of the errors of some axes over that of noise; infinite where that is unknown."""
    there = sum(axis_power(parts, axis) for axis in axes)
    noise = sum(expected_noise(parts, axis) for axis in axes)
    return there / noise if noise else float("inf")


def moved(fitted: Fitted, accepted: FloatArray | None) -> float:
    """Return how far a fit takes the machine from what was accepted: squares of relative changes.

    0 where that is not known.
    """
    if accepted is None:
        return 0.0
    hypothesis = fitted.hypothesis
    off = (hypothesis.base - accepted) / hypothesis.machine.scales
    counted = [
        not n.endswith(".offset") and n not in hypothesis.off for n in hypothesis.machine.names
    ]
    return float(np.sum(np.minimum(off[counted] ** 2, 1.0)))


def axis_power(parts: Parts, axis: int) -> float:
    """Sum of squares of the weighted errors of one axis."""
    return sum(
        float(np.sum(values.reshape(2, *lines.weight.shape)[:, :, axis] ** 2))
        for lines, values in parts
    )


def expected_noise(parts: Parts, axis: int) -> float:
    """Return what noise alone makes of :func:`axis_power`; 0 where the noise is not known."""
    return sum(
        float(np.count_nonzero(lines.weight[:, axis]))
        for lines, _ in parts
        if lines.span.periods > 1
    )


def relative_errors(parts: Parts) -> FloatArray:
    """Return power of the error over power of the torque in the band, of each axis, (M,)."""
    lost = whole = 0.0
    for lines, values in parts:
        counted = lines.weight > 0
        both = values.reshape(2, *lines.weight.shape) / np.where(counted, lines.weight, np.inf)
        lost = lost + np.sum(both**2, axis=(0, 1))
        whole = whole + np.sum(np.abs(lines.raw(lines.motion.torque)) ** 2, axis=0)
    return np.asarray(lost / np.maximum(whole, 1e-300))


def explained_torque(before: Parts, after: Parts, axis: int) -> float:
    """RMS of what is explained over RMS of the torque, of one axis, in the band."""
    gained = whole = 0.0
    for (lines, first), (_, second) in zip(before, after, strict=True):
        counted = lines.weight[:, axis] > 0
        weight = np.where(counted, lines.weight[:, axis], np.inf)
        for values, sign in ((first, 1.0), (second, -1.0)):
            both = values.reshape(2, *lines.weight.shape)[:, :, axis] / weight
            gained += sign * float(np.sum(both**2))
        torque = lines.raw(lines.motion.torque)[:, axis]
        whole += float(np.sum(np.abs(torque) ** 2))
    return float(np.sqrt(max(gained, 0.0) / max(whole, 1e-300)))
