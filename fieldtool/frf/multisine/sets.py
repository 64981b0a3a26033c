"""Which experiments are solved together, and whether they are enough and different enough.

A set is M experiments of one design (same period, lines and amplitude level) in the order in which
they were measured: one realisation.  What is left over joins the last set of its design.
"""

from collections.abc import Sequence
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from fieldtool.errors import NotEnoughDataError
from fieldtool.frf.multisine.lines import LinePhasors, axis_signal_to_noise, same_level
from fieldtool.frf.phasors import ComplexArray, FloatArray

_MAX_CONDITION = 1e3
_ALIKE = 0.98
_WITHIN_NOISE = 3.0


def check_axes_excited(measured: Sequence[LinePhasors], axes: tuple[str, ...]) -> None:
    """Refuse experiments that leave an axis without excitation.

    Raises
    ------
    NotEnoughDataError
        Naming the axis, and whether its torque moved at all.
    """
    M = len(axes)
    for axis, name in enumerate(axes):
        if not any(one.given.known[axis] for one in measured):
            continue
        if any(np.any(one.given.excited[:, axis]) for one in measured):
            continue
        ratios = np.concatenate([axis_signal_to_noise(one, axis, M) for one in measured])
        moved = (
            "its torque is within the noise"
            if np.median(ratios) < _WITHIN_NOISE
            else "its torque only answers the other axes"
        )
        raise NotEnoughDataError(
            f"axis {name} was not excited: none of the {len(measured)} experiments has a line in its "
            f"reference, and {moved}; measure again with all axes driven, or leave the axis out."
        )


def experiment_sets(measured: Sequence[LinePhasors], axes: tuple[str, ...]) -> list[list[int]]:
    """Return the sets of experiments to be solved together, as places in ``measured``.

    Raises
    ------
    NotEnoughDataError
        If there are fewer experiments than axes, or those of a set are alike.
    """
    M = len(axes)
    periods: dict[int, list[int]] = {}
    for place, one in enumerate(measured):
        periods.setdefault(one.given.samples, []).append(place)
    if max(len(places) for places in periods.values()) < M:
        raise _too_few(measured, axes, max(len(places) for places in periods.values()))
    sets = [one for places in periods.values() for one in _sets_of(measured, places, M)]
    for members in sets:
        _check_different([measured[place] for place in members], axes)
    return sets


def _too_few(
    measured: Sequence[LinePhasors], axes: tuple[str, ...], most: int
) -> NotEnoughDataError:
    names = ", ".join(one.name for one in measured)
    return NotEnoughDataError(
        f"the response matrix of {len(axes)} axes ({', '.join(axes)}) needs {len(axes)} different "
        f"multisine experiments with one period, there are {most} ({names}): measure "
        f"{len(axes) - most} more, with other phases or other axes driven."
    )


def _sets_of(measured: Sequence[LinePhasors], places: list[int], M: int) -> list[list[int]]:
    """Cut the experiments of one period into sets of M, those of one level and lines together."""
    designs: list[list[int]] = []
    for place in places:
        one = measured[place]
        for design in designs:
            first = measured[design[0]]
            alike = same_level(one.level, first.level)
            if alike and np.array_equal(one.given.lines, first.given.lines):
                design.append(place)
                break
        else:
            designs.append([place])
    sets, rest = [], []
    for design in designs:
        if len(design) < M:
            rest += design
            continue
        cuts = [design[at : at + M] for at in range(0, len(design), M)]
        if len(cuts[-1]) < M:
            rest_of_design = cuts.pop()
            cuts[-1] = cuts[-1] + rest_of_design
        if all(_condition([measured[p] for p in cut]) < _MAX_CONDITION for cut in cuts):
            sets += cuts
        else:
            sets.append(design)
    if len(rest) >= M:
        sets.append(sorted(rest))
    return sets or [places]


def references_at(members: Sequence[LinePhasors], lines: NDArray[np.intp]) -> ComplexArray | None:
    """Return the references of experiments, (L, R, E), rows of size 1; None if any is unknown.

    Only rows (signals of axes) that say something are there.
    """
    if not all(np.all(one.given.known) for one in members):
        return None
    values = np.stack([one.given.reference[lines - 1] for one in members], axis=2)
    size = np.sqrt(np.mean(np.abs(values) ** 2, axis=2, keepdims=True))
    used = size > 1e-9 * size.max(axis=(0, 2), keepdims=True)
    scaled: ComplexArray = np.where(used, values / np.where(size > 0, size, 1.0), 0.0)
    return scaled[:, np.any(used, axis=(0, 2))]


def inputs_at(members: Sequence[LinePhasors], lines: NDArray[np.intp]) -> ComplexArray:
    """Return what tells experiments apart, (L, R, E): references, where unknown the torques."""
    references = references_at(members, lines)
    if references is not None:
        return references
    M = members[0].mean.shape[1] // 2
    torques = np.stack([one.mean[lines - 1, M:] for one in members], axis=2)
    size = np.sqrt(np.mean(np.abs(torques) ** 2, axis=2, keepdims=True))
    scaled: ComplexArray = torques / np.where(size > 0, size, 1.0)
    return scaled


def common_lines(members: Sequence[LinePhasors], count: int) -> NDArray[np.intp]:
    """Numbers of the lines that at least ``count`` of the experiments excite."""
    everything = np.concatenate([one.given.lines for one in members])
    lines, times = np.unique(everything, return_counts=True)
    return lines[times >= count]


def _conditions(members: Sequence[LinePhasors]) -> FloatArray:
    """Condition numbers of the inputs at the common lines, (L,)."""
    M = members[0].mean.shape[1] // 2
    lines = common_lines(members, len(members))
    if lines.size == 0:
        return np.empty(0)
    values = inputs_at(members, lines)
    size = np.linalg.norm(values, axis=1, keepdims=True)
    singular = np.linalg.svd(values / np.where(size > 0, size, 1.0), compute_uv=False)
    if singular.shape[1] < M:
        return np.full(lines.size, np.inf)
    smallest = np.maximum(singular[:, M - 1], np.finfo(float).tiny)
    conditions: FloatArray = singular[:, 0] / smallest
    return conditions


def _condition(members: Sequence[LinePhasors]) -> float:
    conditions = _conditions(members)
    return float(np.median(conditions)) if conditions.size else 1.0


def _check_different(members: Sequence[LinePhasors], axes: tuple[str, ...]) -> None:
    condition = _condition(members)
    if condition < _MAX_CONDITION:
        return
    lines = common_lines(members, len(members))
    frequency = members[0].frequencies[lines[lines.size // 2] - 1]
    pairs = [
        f"{a.name} and {b.name}"
        for a, b in combinations(members, 2)
        if _likeness(a, b, lines) > _ALIKE
    ]
    which = f"{', '.join(pairs)} are alike" if pairs else "they are combinations of each other"
    raise NotEnoughDataError(
        f"the experiments {', '.join(one.name for one in members)} are no {len(axes)} different "
        f"ones: the condition number of their inputs at {frequency:.4g} Hz is {condition:.1e} (limit "
        f"{_MAX_CONDITION:.0e}), {which}; measure again with orthogonal phases, so that no "
        "experiment repeats another."
    )


def _likeness(a: LinePhasors, b: LinePhasors, lines: NDArray[np.intp]) -> float:
    """Median over the lines of the correlation of two experiments' inputs: 1 for the same."""
    values = inputs_at([a, b], lines)
    one, other = values[:, :, 0], values[:, :, 1]
    product = np.abs(np.sum(one.conj() * other, axis=1))
    sizes = np.linalg.norm(one, axis=1) * np.linalg.norm(other, axis=1)
    return float(np.median(product / np.where(sizes > 0, sizes, 1.0)))
