"""From phasors to responses: columns of ratios, and the whole matrix by solving.

A ratio theta_i / tau_j is an element of the response only where no other axis felt a torque that
matters.  That holds for axes left free; it does not for axes that were held, whose torque is what
holds them.  So there are two ways:

* :func:`column_responses` takes ratios under a stated condition (others free, others locked);
* :func:`solved_response` takes several experiments at one frequency, puts the positions into
  the columns of Theta and the torques into those of T, and solves G T = Theta.  It needs as many
  independent experiments as there are axes, whatever the other axes did.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from fieldtool.errors import NotEnoughDataError
from fieldtool.frf.phasors import ComplexArray, FloatArray, Phasors, ratio_std
from fieldtool.frf.response import FrequencyResponse

OTHERS_FREE = "others free"
OTHERS_LOCKED = "others locked"
SOLVED = "solved"
_SAME_FREQUENCY = 1e-6
"""Relative distance up to which two frequencies count as one."""
_MAX_CONDITION = 1e6


def condition_of(phasors: Phasors) -> str:
    """Say what the axes that were not driven did.

    ``others free`` if all were, ``others locked`` if all held their position, else for instance
    ``a + b free, others locked``, where a or b was driven.
    """
    moving = [axis for axis in phasors.axes if axis in (*phasors.driven, *phasors.free)]
    if len(moving) == len(phasors.axes):
        return OTHERS_FREE
    if not phasors.free:
        return OTHERS_LOCKED
    return f"{' + '.join(moving)} free, {OTHERS_LOCKED}"


def column_responses(measured: Sequence[Phasors]) -> dict[str, FrequencyResponse]:
    """Return one response per condition, from all experiments that drove one axis.

    Column j holds theta_i / tau_j for the driven axis j and the free axes i; held axes are NaN.
    The frequencies of a condition are those of all its columns together.  What was measured more
    than once is averaged by its weight.

    Raises
    ------
    NotEnoughDataError
        If there is no experiment with exactly one driven axis, or it moved nothing.
    """
    groups: dict[str, list[Phasors]] = {}
    for phasors in measured:
        if len(phasors.driven) == 1 and phasors.frequencies.size:
            groups.setdefault(condition_of(phasors), []).append(phasors)
    if not groups:
        raise NotEnoughDataError(
            "no experiment drives exactly one axis at a settled frequency: there is no response to "
            "compute. Measure each axis alone first."
        )
    return {condition: _columns(condition, group) for condition, group in groups.items()}


def solved_response(measured: Sequence[Phasors]) -> FrequencyResponse:
    """Solve G T = Theta at every frequency with enough independent experiments.

    Exact also where held axes gave way a little, because their measured torques are part of T.
    With more experiments than axes it is a least-squares solution.  The standard error follows
    to first order from the covariance of every experiment.

    Sensitivity: errors grow with the condition number of T (each experiment scaled to unit
    torque); frequencies above 1e6 are left out.

    Raises
    ------
    NotEnoughDataError
        If no frequency has as many independent experiments as there are axes.
    """
    axes = _common_axes(measured)
    grid, places = _merge_frequencies([phasors.frequencies for phasors in measured])
    frequencies, values, errors = [], [], []
    for index, frequency in enumerate(grid):
        rows = [
            (phasors, int(row))
            for phasors, place in zip(measured, places, strict=True)
            for row in np.flatnonzero(place == index)
        ]
        solved = _solve_one(rows, len(axes)) if len(rows) >= len(axes) else None
        if solved is not None:
            frequencies.append(frequency)
            values.append(solved[0])
            errors.append(solved[1])
    if not frequencies:
        raise NotEnoughDataError(
            f"no frequency has {len(axes)} independent experiments: the response matrix of "
            f"{len(axes)} axes can not be solved. Measure every axis at the same frequencies."
        )
    return FrequencyResponse(
        axes, np.array(frequencies), np.array(values), np.array(errors), SOLVED
    )


def _columns(condition: str, group: list[Phasors]) -> FrequencyResponse:
    axes = _common_axes(group)
    M = len(axes)
    grid, places = _merge_frequencies([phasors.frequencies for phasors in group])
    weight = np.zeros((grid.size, M, M))
    total = np.zeros((grid.size, M, M), dtype=np.complex128)
    for phasors, place in zip(group, places, strict=True):
        j = axes.index(phasors.driven[0])
        for i in (axes.index(name) for name in axes if name in (*phasors.driven, *phasors.free)):
            ratio, std = _ratio(phasors, i, j)
            floor = np.finfo(float).eps * np.abs(ratio)
            information = 1 / np.maximum(std, np.maximum(floor, np.finfo(float).tiny ** 0.5)) ** 2
            np.add.at(weight[:, i, j], place, information)
            np.add.at(total[:, i, j], place, information * ratio)
    there = weight > 0
    response = np.full(total.shape, np.nan + 1j * np.nan)
    std = np.full(weight.shape, np.nan)
    response[there] = total[there] / weight[there]
    std[there] = 1 / np.sqrt(weight[there])
    return FrequencyResponse(axes, grid, response, std, condition)


def _ratio(phasors: Phasors, i: int, j: int) -> tuple[ComplexArray, FloatArray]:
    numerator, denominator = phasors.position[:, i], phasors.torque[:, j]
    if np.any(denominator == 0):
        f = phasors.frequencies[np.argmax(denominator == 0)]
        raise NotEnoughDataError(
            f"experiment {phasors.experiment}: axis {phasors.axes[j]} shows no torque at {f:.6g} "
            "Hz though it is driven: check the torque signal, or drive it harder."
        )
    pair = [i, len(phasors.axes) + j]
    covariance = phasors.covariance[:, pair][:, :, pair]
    ratio = numerator / denominator
    return ratio, ratio_std(ratio, denominator, covariance)


def _solve_one(rows: list[tuple[Phasors, int]], M: int) -> tuple[ComplexArray, FloatArray] | None:
    """Return G (M, M) and its std at one frequency, None if the experiments are not independent."""
    theta = np.column_stack([phasors.position[row] for phasors, row in rows])
    torque = np.column_stack([phasors.torque[row] for phasors, row in rows])
    size = np.linalg.norm(torque, axis=0)
    if np.any(size == 0) or np.linalg.cond(torque / size) > _MAX_CONDITION:
        return None
    inverse = np.linalg.pinv(torque / size) / size[:, None]
    G = theta @ inverse
    mixing = np.hstack([np.eye(M), -G])
    variance = np.zeros((M, M))
    for experiment, (phasors, row) in enumerate(rows):
        error = mixing @ phasors.covariance[row] @ mixing.conj().T
        variance += np.outer(np.diagonal(error).real, np.abs(inverse[experiment]) ** 2)
    return G, np.sqrt(np.maximum(variance, 0.0) / 2)


def _common_axes(group: Sequence[Phasors]) -> tuple[str, ...]:
    names = {phasors.axes for phasors in group}
    if len(names) != 1:
        raise ValueError(f"phasors must be of the same axes, got {sorted(names)}")
    return next(iter(names))


def _merge_frequencies(
    lists: Sequence[FloatArray],
) -> tuple[FloatArray, list[NDArray[np.intp]]]:
    """Return all frequencies, rising and each once, and for each list where its members are."""
    everything = np.sort(np.concatenate(lists)) if lists else np.empty(0)
    new = np.diff(everything, prepend=-1.0) > _SAME_FREQUENCY * everything
    grid = everything[new]
    return grid, [np.searchsorted(grid, one, side="right") - 1 for one in lists]
