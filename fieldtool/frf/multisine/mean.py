"""The mean of several realisations of a response matrix, with its covariance and their scatter."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fieldtool.frf.matrix import SOLVED
from fieldtool.frf.phasors import ComplexArray, FloatArray
from fieldtool.frf.response import FrequencyResponse

_STANDS_OUT = 5.0
"""Modulus of an element over its standard error, from which a logarithm is safe."""
_NEAR = 0.5
"""Largest relative distance of a realisation from the mean for its logarithm to be safe."""
_LEVELS_APART = 1.15
_SAME_FREQUENCY = 1e-6
_NEIGHBOURS = 8
"""Lines either side over which the scatter between realisations is judged."""


@dataclass(frozen=True, eq=False)
class SetResponse:
    """The response matrix from one set of experiments."""

    names: tuple[str, ...]
    """Of the experiments."""
    level: float
    """Amplitude of the references relative to the strongest there are."""
    frequencies: FloatArray
    """(F,), Hz, rising."""
    response: ComplexArray
    """(F, M, M)."""
    covariance: ComplexArray
    """(F, M*M, M*M): E[e e^H], elements row after row."""
    freedom: FloatArray
    """(F,)."""
    left_out: int
    """Excited lines without an answer."""


@dataclass(frozen=True, eq=False)
class MeanResponse:
    """Mean of sets."""

    response: FrequencyResponse
    freedom: FloatArray
    """(F,): complex degrees of freedom behind the covariance."""
    notes: tuple[str, ...]


def averaged(sets: Sequence[SetResponse], axes: tuple[str, ...]) -> MeanResponse:
    """Return the weighted mean of all sets at every frequency that any of them has.

    A set's weight at a frequency is the inverse of its variance (of all elements, each relative to
    its mean variance).  Where sets scatter more than their noise, judged over 17 lines, the
    covariance is raised by the factor that explains it.
    """
    grid, places = _merged([one.frequencies for one in sets])
    M = len(axes)
    response = np.empty((grid.size, M, M), dtype=np.complex128)
    covariance = np.empty((grid.size, M * M, M * M), dtype=np.complex128)
    freedom = np.empty(grid.size)
    chi, degrees = np.zeros(grid.size), np.zeros(grid.size)
    for f in range(grid.size):
        rows = [
            (one, int(np.searchsorted(place, f)))
            for one, place in zip(sets, places, strict=True)
            if f in place
        ]
        values = np.array([one.response[row] for one, row in rows])
        spreads = np.array([one.covariance[row] for one, row in rows])
        freedom[f] = max(one.freedom[row] for one, row in rows)
        response[f], covariance[f] = _mean(values, spreads)
        if len(rows) > 1:
            chi[f] = _scatter(values - response[f], spreads)
            degrees[f] = (len(rows) - 1) * M * M
    factor = _raise(chi, degrees)
    covariance *= factor[:, None, None]
    std = np.sqrt(np.einsum("fkk->fk", covariance).real / 2).reshape(response.shape)
    result = FrequencyResponse(axes, grid, response, std, SOLVED, covariance)
    notes = (*_notes(factor, grid, sets), *level_change(sets, axes))
    return MeanResponse(result, freedom, notes)


def level_change(sets: Sequence[SetResponse], axes: tuple[str, ...]) -> tuple[str, ...]:
    """Say where the response changes most from the strongest to the weakest amplitude level.

    Of all elements and lines that both levels have, those count whose difference noise explains with
    a chance below 0.1 % in the whole comparison; sizes are relative to sqrt(G_ii G_jj).
    """
    strong, weak = (pick(sets, key=lambda one: one.level) for pick in (max, min))
    if strong.level <= _LEVELS_APART * weak.level:
        return ()
    grid, (here, there) = _merged([strong.frequencies, weak.frequencies])
    _, a, b = np.intersect1d(here, there, return_indices=True)
    if a.size == 0:
        return ()
    G, other = strong.response[a], weak.response[b]
    power = np.einsum("fkk->fk", strong.covariance[a] + weak.covariance[b]).real.reshape(G.shape)
    own = np.sqrt(np.abs(np.einsum("fii->fi", G)))
    relative = np.abs(other - G) / (own[:, :, None] * own[:, None, :])
    # |error|^2 / power has the distribution exp(-x); a fifth for the noise's own error.
    clear = np.abs(other - G) ** 2 > 1.2 * (np.log(G.size) + 7) * power
    if not np.any(clear):
        return ()
    f, i, j = np.unravel_index(int(np.argmax(np.where(clear, relative, -1.0))), G.shape)
    return (
        f"The response of {axes[i]} to the torque of {axes[j]} changes by "
        f"{100 * relative[f, i, j]:.2g} % at {grid[here[a[f]]]:.3g} Hz when the amplitude falls to "
        f"{weak.level / strong.level:.2g} of the strongest: the machine is not straight (linear) there.",
    )


def _merged(lists: Sequence[FloatArray]) -> tuple[FloatArray, list[NDArray[np.intp]]]:
    """All frequencies, rising and each once (to 1e-6), and where the members of each list are."""
    everything = np.sort(np.concatenate(lists))
    grid = everything[np.diff(everything, prepend=-1.0) > _SAME_FREQUENCY * everything]
    edges = grid * (1 - _SAME_FREQUENCY)
    return grid, [np.searchsorted(edges, one, side="right") - 1 for one in lists]


def _mean(values: ComplexArray, spreads: ComplexArray) -> tuple[ComplexArray, ComplexArray]:
    """Mean of R matrices (R, M, M) with covariances (R, M*M, M*M)."""
    power = np.einsum("rkk->rk", spreads).real
    weights = 1 / np.mean(power / power.mean(axis=0), axis=1)
    weights /= weights.sum()
    linear = np.einsum("r,rij->ij", weights, values)
    error = np.sqrt(power).reshape(values.shape)
    clear = np.all(np.abs(values) > _STANDS_OUT * error, axis=0)
    clear &= np.all(np.abs(values - linear) < _NEAR * np.abs(linear), axis=0)
    ratio = np.where(clear, values / np.where(clear, linear, 1.0), 1.0)
    logarithmic = linear * np.exp(np.einsum("r,rij->ij", weights, np.log(ratio)))
    covariance = np.einsum("r,rkl->kl", weights**2, spreads)
    return np.where(clear, logarithmic, linear), covariance


def _scatter(deviation: ComplexArray, spreads: ComplexArray) -> float:
    """Sum over the realisations of the whitened square of their deviations."""
    total = 0.0
    for one, spread in zip(deviation.reshape(deviation.shape[0], -1), spreads, strict=True):
        size = np.sqrt(np.diagonal(spread).real)
        correlation = spread / np.outer(size, size) + 1e-9 * np.eye(size.size)
        white = one / size
        total += float(np.real(white.conj() @ np.linalg.solve(correlation, white)))
    return total


def _raise(chi: FloatArray, degrees: FloatArray) -> FloatArray:
    """Factor of the covariance at every frequency, 1 where the scatter is what noise explains."""
    factor = np.ones(chi.size)
    for f in range(chi.size):
        near = slice(max(0, f - _NEIGHBOURS), f + _NEIGHBOURS + 1)
        freedom = float(degrees[near].sum())
        if freedom == 0:
            continue
        ratio = float(chi[near].sum()) / freedom
        # chi is estimated with covariances that have errors of their own: a fifth on top.
        if ratio > 1.2 + 6 / np.sqrt(freedom):
            factor[f] = ratio
    return factor


def _notes(factor: FloatArray, grid: FloatArray, sets: Sequence[SetResponse]) -> tuple[str, ...]:
    if np.all(factor <= 1):
        return ()
    worst = int(np.argmax(factor))
    levels = {round(one.level, 1) for one in sets}
    why = (
        "the response depends on the amplitude (friction, backlash)"
        if len(levels) > 1
        else "the machine answers different phases differently (friction, backlash)"
    )
    return (
        f"The {len(sets)} sets of experiments differ by {np.sqrt(factor[worst]):.1f} times their "
        f"noise around {grid[worst]:.3g} Hz: {why}; the standard errors were raised to cover it.",
    )
