"""The small multisine that measures sensitivities: every axis has frequencies of its own.

At a line that only one axis excites, all loops closed, its torque over the torque that was added is its
own sensitivity with the others closed.  So one experiment serves all axes.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fieldtool.errors import PlanRefusedError
from fieldtool.experiment.axes import torque_limits
from fieldtool.experiment.forecast import Setting
from fieldtool.experiment.multisine.design import settle_time
from fieldtool.experiment.multisine.excitation import signals
from fieldtool.experiment.multisine.forecast import (
    experiment_peaks,
    predicted_phasors,
    scaled_to_limits,
)
from fieldtool.experiment.multisine.phases import low_crest
from fieldtool.experiment.multisine.plan import MultisineExperiment, MultisinePlan
from fieldtool.experiment.multisine.stream import TAIL
from fieldtool.records.closed_loop import ComplexArray
from fieldtool.records.model import FloatArray

SHARE = 0.15
"""Of every limit that it may take, by the model."""
LINES, NEAR_LINES = 24, 9
"""Of each axis over the band, and about each of its peaks."""
NEAR = 0.2
"""To both sides of a peak."""
BELOW, ABOVE = 4.0, 4.0
"""The band reaches from the lowest peak over the one to the highest peak times the other."""
FINE = 14.0
"""Periods of the lowest peak in a period of the multisine, for each axis."""
SHORTEST, LONGEST = 1.0, 8.0
"""Seconds of a period."""
HIGHEST = 0.2
"""Highest line as a share of the sampling rate."""
FAINT = 0.2
"""What a filter passes below which an input is not raised any more."""
REACH = 3
"""Odd lines to both sides that may take a line's place where another axis has it."""
SEED = 5


@dataclass(frozen=True, eq=False)
class Lines:
    """Which axis is excited at which line."""

    number: NDArray[np.int64]
    """Periods in a period, odd, rising, shape (L,)."""
    axis: NDArray[np.int64]
    """Of each line, shape (L,)."""
    by_torque: NDArray[np.bool_]
    """Whether a torque offset excites it, shape (L,); else the position reference."""
    samples: int
    """Cycles of a period."""


def sensitivity_plan(
    settings: Sequence[Setting],
    peaks: Sequence[Sequence[float]],
    offsets: Sequence[bool],
    cycle_time: float,
) -> tuple[MultisinePlan, Lines]:
    """Return a multisine whose size keeps SHARE of all limits with each of these settings.

    Parameters
    ----------
    settings
        Model, limits and centres with the loops that it will meet: old ones, new ones.
    peaks
        Where sensitivities are largest, Hz, for each axis.
    offsets
        Which axes' drives take torque offsets; the others are excited by their references.
    cycle_time
        Seconds.

    Raises
    ------
    PlanRefusedError
        If no frequencies fit the cycle, or loops are not stable by the model.
    """
    number, axis, samples = _lines(peaks, cycle_time)
    lines = Lines(number, axis, np.array(offsets, dtype=np.bool_)[axis], samples)
    omega: FloatArray = 2 * np.pi / (samples * cycle_time) * number.astype(np.float64)
    unit = np.min([_unit(setting, lines, omega) for setting in settings], axis=0)
    spread = np.zeros((number.size, len(peaks)))
    spread[np.arange(number.size), axis] = unit
    phasors = spread * np.exp(1j * low_crest(number, spread, SEED))
    period = samples * cycle_time
    experiment = MultisineExperiment(
        name="sensitivity",
        cycle_time=cycle_time,
        samples=samples,
        lines=number,
        detection=np.zeros(0, dtype=np.int64),
        reference=np.where(lines.by_torque[:, None], 0, phasors),
        torque=np.where(lines.by_torque[:, None], phasors, 0),
        periods=2 if period < LONGEST / 2 else 1,
        settle=samples,
        bias=np.zeros(len(peaks)),
        tail=round(TAIL * settle_time(settings[0].model) / cycle_time),
    )
    plan = MultisinePlan(cycle_time, (experiment,))
    scaled = [_scaled(plan, setting) for setting in settings]
    smallest = min(scaled, key=lambda one: float(np.abs(_inputs(one)).sum()))
    return smallest, lines


def expected_peaks(plan: MultisinePlan, setting: Setting) -> FloatArray:
    """Return the largest values of an excitation, as ``experiment_peaks``, feed-forward included."""
    peaks: FloatArray = experiment_peaks(plan, setting).max(axis=0)
    peaks[3] = np.maximum(peaks[3], _steady_torque(plan, setting))
    return peaks


def _scaled(plan: MultisinePlan, setting: Setting) -> MultisinePlan:
    scaled = scaled_to_limits(plan, setting, SHARE)
    limits = torque_limits(setting.limits)
    used = float((_steady_torque(scaled, setting) / (SHARE * limits)).max())
    return scaled.scaled(1 / used) if used > 1 else scaled


def _steady_torque(plan: MultisinePlan, setting: Setting) -> FloatArray:
    """Return the largest torques of the periodic motion, (M,): with the inertia that is fed forward."""
    one = plan.experiments[0]
    torque = signals(predicted_phasors(one, setting)[1], one.lines, one.samples)
    return np.asarray(np.abs(torque).max(axis=0), dtype=np.float64)


def _inputs(plan: MultisinePlan) -> ComplexArray:
    return plan.experiments[0].torque + plan.experiments[0].reference


def _unit(setting: Setting, lines: Lines, omega: FloatArray) -> FloatArray:
    """Return inputs, shape (L,), whose torque alone, before any loop answers, is the axis' limit."""
    unit = np.empty(omega.size)
    loop = setting.closed_loop(())
    for k, (own, limits) in enumerate(zip(setting.loops, setting.limits, strict=True)):
        here = lines.axis == k
        s = 1j * omega[here]
        if np.all(lines.by_torque[here]):
            passed = np.abs(own.filtered(s))
        else:
            passed = np.abs(loop.response(omega[here], k)[1][:, k])
        unit[here] = limits.torque / np.maximum(passed, FAINT * passed.max())
    return unit


def _lines(
    peaks: Sequence[Sequence[float]], cycle_time: float
) -> tuple[NDArray[np.int64], NDArray[np.int64], int]:
    """Return line numbers, the axis of each, and the cycles of a period.

    Raises
    ------
    PlanRefusedError
        If the peaks are too fast for the cycle.
    """
    every = [f for own in peaks for f in own]
    period = min(max(FINE * len(peaks) / min(every), SHORTEST), LONGEST)
    samples = round(period / cycle_time)
    period = samples * cycle_time
    low = max(min(every) / BELOW, 1 / period)
    high = min(max(every) * ABOVE, HIGHEST / cycle_time)
    if max(every) > high:
        raise PlanRefusedError(
            f"the loops' sensitivity is largest at {max(every):.3g} Hz; with a cycle of "
            f"{1000 * cycle_time:g} ms it can be seen up to {high:.3g} Hz only."
        )
    taken: dict[int, int] = {}
    wanted = [
        (k, f)
        for k, own in enumerate(peaks)
        for centre in own
        for f in np.linspace(centre * (1 - NEAR), min(centre * (1 + NEAR), high), NEAR_LINES)
    ]
    wanted += [(k, f) for f in np.geomspace(low, high, LINES) for k in range(len(peaks))]
    for k, f in wanted:
        odd = 2 * int(f * period / 2) + 1
        free = min(_free(odd, taken, k), key=lambda n: abs(n - f * period), default=None)
        if free is not None and 0 < free / period <= HIGHEST / cycle_time:
            taken[free] = k
    number = np.array(sorted(taken), dtype=np.int64)
    return number, np.array([taken[int(n)] for n in number], dtype=np.int64), samples


def _free(odd: int, taken: Mapping[int, int], axis: int) -> list[int]:
    """Return the nearest odd lines that no axis has; none where the axis has the nearest itself."""
    if taken.get(odd) == axis:
        return []
    near = [odd + 2 * j for j in range(-REACH, REACH + 1) if odd + 2 * j > 0]
    return [n for n in near if n not in taken]
