"""One multisine experiment of several axes, made ready: whole periods, excited lines, sound torque.

Which lines are excited is read from the references, which are free of noise: under closed loops a
line can be coherent in position and torque and still hold nothing but the loop's own noise.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fieldtool.errors import NotEnoughDataError
from fieldtool.frf.multisine.period import quantum, samples_of_period, whole_periods
from fieldtool.frf.multisine.periods import average_periods, excited_lines
from fieldtool.frf.phasors import ComplexArray, FloatArray
from fieldtool.records.recorded import Experiment, Recording

LineArray = NDArray[np.intp]
TORQUE_OFFSET = "torque_offset"
"""Extra signal ``AXIS.torque_offset``, N m or N: what was added to the drive's own torque."""
_NEAR, _FAR = 0.01, 0.001
"""Of the strongest line within an octave, and of all: above both a line counts as excited."""
_OVER_ROUNDING = 6.0
_HELD_SHARE = 0.004
"""Share of the samples at an extreme, from which it is a limit."""
_CORNER = 2.2
"""Time that a flank takes on four times the way, over the time it takes at first: 2 from the top of a
parabola and less from a flatter one, which slow down before; 4 where a straight flank is cut off."""
_RANDOM = 0.5
"""Square of the steps over that of the deviations: 2 of white noise, little along a smooth curve."""


@dataclass(frozen=True, eq=False)
class JointInput:
    """What was asked for in one experiment."""

    experiment: Experiment
    samples: int
    """N of one period."""
    rows: slice
    """The whole periods."""
    periods: int
    """P."""
    reference: ComplexArray
    """(K, 2M): phasors of position references, then torque references, at lines 1 to K, K just below
    half the samples; 0 where there is none."""
    known: NDArray[np.bool_]
    """(M,): whether an axis has a reference in the recording at all, be it at rest."""
    excited: NDArray[np.bool_]
    """(K, M): at which lines each axis was excited by its own references."""

    @property
    def lines(self) -> LineArray:
        """Numbers of the lines at which any axis was excited, (L,)."""
        return np.flatnonzero(np.any(self.excited, axis=1)) + 1

    def frequencies(self, sample_period: float) -> FloatArray:
        """Of lines 1 to K, Hz."""
        return np.arange(1, self.reference.shape[0] + 1) / (self.samples * sample_period)


def joint_input(recording: Recording, experiment: Experiment) -> JointInput:
    """Find period, whole periods and excited lines of one experiment, and check its torques.

    Raises
    ------
    NotEnoughDataError
        If there is no period, there are fewer than two of them, or a torque is saturated.
    """
    N = samples_of_period(experiment, recording.sample_period)
    rows, periods = whole_periods(experiment, N)
    for axis, information in enumerate(recording.axes):
        if information.name not in experiment.free:
            unit = information.torque_unit
            check_saturation(experiment, axis, information.name, unit, rows, periods)
    M = len(recording.axes)
    K = (N - 1) // 2
    reference = np.zeros((K, 2 * M), dtype=np.complex128)
    excited = np.zeros((K, M), dtype=np.bool_)
    known = np.zeros(M, dtype=np.bool_)
    weights = (np.arange(1, K + 1.0) ** 2, np.ones(K))
    for kind, weight in enumerate(weights):
        for axis, information in enumerate(recording.axes):
            values = _asked(experiment, kind, axis, information.name)
            if values is None:
                continue
            known[axis] = True
            phasors, rounding = _periodic_part(values[rows], N)
            reference[:, kind * M + axis] = phasors
            excited[:, axis] |= _stand_out(np.abs(phasors), weight, rounding)
    return JointInput(experiment, N, rows, periods, reference, known, excited)


def with_lines(recording: Recording, one: JointInput) -> JointInput:
    """Return ``one`` with excited lines: if it has no reference at all, those its torques show.

    Raises
    ------
    NotEnoughDataError
        If its references are at rest, or no line of a driven axis' torque stands out of the noise.
    """
    if np.any(one.excited):
        return one
    names = ", ".join(one.experiment.driven)
    if all(one.known[recording.names.index(name)] for name in one.experiment.driven):
        raise NotEnoughDataError(
            f"experiment {one.experiment.name}: the references of {names} have no line that stands out: "
            "they were not excited; check the amplitude, the period, and the columns of the references."
        )
    excited = one.excited.copy()
    torques = one.experiment.torque[one.rows]
    average = average_periods(torques, one.samples * recording.sample_period,
                              recording.sample_period, 0)  # fmt: skip
    for name in one.experiment.driven:
        axis = recording.names.index(name)
        try:
            excited[excited_lines(average, axis, "torque", axis), axis] = True
        except NotEnoughDataError as error:
            raise NotEnoughDataError(
                f"experiment {one.experiment.name}, axis {name}: {error}"
            ) from error
    return replace(one, excited=excited)


def _asked(experiment: Experiment, kind: int, axis: int, name: str) -> FloatArray | None:
    """Return an axis' position reference (kind 0) or torque reference or offset (1), (n,)."""
    values = experiment.torque_reference if kind else experiment.position_reference
    if values is not None and not np.any(np.isnan(values[:, axis])):
        return values[:, axis]
    return experiment.extra.get(f"{name}.{TORQUE_OFFSET}") if kind else None


def _periodic_part(values: FloatArray, N: int) -> tuple[ComplexArray, float]:
    """Phasors of a reference's mean period without its drift, and what rounding adds to them."""
    drift = np.mean(values[N:] - values[:-N]) / N
    straight = values - drift * np.arange(values.size)
    period = straight.reshape(-1, N).mean(axis=0)
    phasors: ComplexArray = np.fft.rfft(period)[1 : (N + 1) // 2] * (2 / N)
    rounding = max(quantum(values) / np.sqrt(3 * N), 1e-12 * float(np.max(np.abs(values))))
    return phasors, rounding


def _stand_out(size: FloatArray, weight: FloatArray, rounding: float) -> NDArray[np.bool_]:
    """Lines above their neighbours' share, and above what rounding of the reference adds."""
    weighted = size * weight
    lines = np.arange(1, size.size + 1)
    first, last = (lines + 1) // 2 - 1, np.minimum(2 * lines, size.size)
    real = np.where(size > _OVER_ROUNDING * rounding, weighted, 0.0)
    if not np.any(real):
        return np.zeros(size.size, dtype=np.bool_)
    strongest = np.array([real[a:b].max() for a, b in zip(first, last, strict=True)])
    standing: NDArray[np.bool_] = (real > _NEAR * strongest) & (real > _FAR * real.max())
    return standing


def check_saturation(
    experiment: Experiment, axis: int, name: str, unit: str, rows: slice, periods: int
) -> None:
    """Refuse a torque that stays at its extreme, where what drives it would go on.

    At an extreme of a smooth curve, as many samples lie within a small distance w below the peak as
    lie between w and 4 w; a limit holds many in the first band and few in the second.  It holds at
    least 4 in a row, at least once in every period: they stand still but for noise and resolution,
    and the torque arrives or leaves at a speed.  A crest made flat by several sines does not.

    Raises
    ------
    NotEnoughDataError
        With axis, value, and the share of samples.
    """
    torque = experiment.torque[rows, axis]
    span = float(np.ptp(torque))
    if span == 0:
        return
    step = quantum(torque)
    width = max(0.002 * span, 0.5 * step)
    outer = 4 * width + 2.5 * step
    if 2 * outer > span:
        return
    held, total = [], 0
    for sign in (1.0, -1.0):
        depth = float(np.max(sign * torque)) - sign * torque
        top, below = depth <= width, (depth > width) & (depth <= outer)
        count = int(np.count_nonzero(top))
        often = count > _HELD_SHARE * torque.size and count > 3 * int(np.count_nonzero(below))
        if often and _held(depth, width, outer, step) >= periods:
            held.append(f"{sign * float(np.max(sign * torque)):.4g} {unit}")
            total += count
    if held:
        raise NotEnoughDataError(
            f"experiment {experiment.name}: the torque of {name} is saturated, it stays at "
            f"{' and '.join(held)} for {100 * total / torque.size:.1f} % of the samples: lower the "
            "amplitude of the excitation, or raise the drive's torque limit if the machine allows it."
        )


def _held(depth: FloatArray, width: float, outer: float, step: float) -> int:
    """Count the stretches of 4 samples or more at the top that a limit holds."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], (depth <= width).astype(np.int8), [0]])))
    levels = (width, outer, outer + 4 * (outer - width))
    count = 0
    for start, stop in zip(edges[::2], edges[1::2], strict=True):
        inner = (stop - start) // 4
        flanks = depth[start::-1], depth[stop - 1 :]
        if stop - start >= 4 and _stands_still(depth[start + inner : stop - inner], step):
            quick = max(1.5, (stop - start) / 10)
            count += any(_is_corner(flank, levels, quick) for flank in flanks)
    return count


def _stands_still(values: FloatArray, step: float) -> bool:
    """Whether values differ by no more than their resolution, or by noise."""
    deviations = float(np.sum((values - values.mean()) ** 2))
    steps = float(np.sum(np.diff(values) ** 2))
    return float(np.ptp(values)) < 1.5 * step or steps > _RANDOM * deviations


def _is_corner(depth: FloatArray, levels: tuple[float, float, float], quick: float) -> bool:
    """Whether a flank, from the top outwards, goes on at the speed at which it leaves the top.

    One that is past all levels in less than ``quick`` samples is steep from the first.
    """
    passed = []
    for level in levels:
        k = int(np.argmax(depth > level))
        if depth[k] <= level:
            return False
        passed.append(k - (depth[k] - level) / (depth[k] - depth[k - 1]))
    near, middle, far = passed
    left = int(np.argmax(depth > levels[0]))
    return bool(far - left < quick or far - middle > _CORNER * (middle - near))
