"""Which combinations of chain lengths are tried on the modes that the responses hold."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import product
from math import inf, isfinite

import numpy as np

from fieldtool.errors import NotAChainError
from fieldtool.identify.chains.block_reduction import mismatch
from fieldtool.identify.chains.modal_chain import SEEN
from fieldtool.identify.chains.start_machines import all_coupled, rigid_machine, typical_machine
from fieldtool.identify.chains.trial import (
    DECISIVE,
    Trial,
    lengths_of,
    reduced_trial,
    refined_trial,
)
from fieldtool.identify.likelihood.response_data import ResponseMatrix
from fieldtool.identify.modes.fit import prior_poles
from fieldtool.identify.modes.model import ModalModel
from fieldtool.identify.modes.search import (
    ModeSearch,
    standing_out,
    with_modes,
    with_strongest_hint,
    without_mode,
)
from fieldtool.records.model import Kind, MachineModel

REDUCED = 24
"""At most so many combinations are taken apart with errors and tests of structure."""
REFINED = 6
"""At most so many combinations of one number of modes are refined."""


def simple_trials(
    data: ResponseMatrix,
    kinds: Mapping[str, Kind],
    choices: Sequence[tuple[int, ...]],
    search: ModeSearch,
    prior: MachineModel | None,
) -> list[Trial]:
    """The prior model's lengths and a machine of rigid axes, whatever modes were found."""
    starts = []
    if prior is not None and prior.names == data.names:
        starts.append(all_coupled(prior))
    rigid = (1,) * len(choices)
    if rigid not in [lengths_of(start) for start in starts]:
        starts.append(rigid_machine(search.modal, kinds))
    return [
        _from_machine(data, kinds, start, search.modal)
        for start in starts
        if all(n in given for n, given in zip(lengths_of(start), choices, strict=True))
    ]


def _from_machine(
    data: ResponseMatrix, kinds: Mapping[str, Kind], start: MachineModel, free: ModalModel
) -> Trial:
    """Refine a machine, fit its modes from its own poles, and refine again what those say.

    It is measured by the free modes that were found, which may be more than its own.
    """
    lengths = lengths_of(start)
    trial = refined_trial(data, Trial(lengths, free, None, None, inf, False, ""), start)
    count = sum(lengths) - len(lengths)
    poles = prior_poles(start if trial.refined is None else trial.refined.model, count)
    if poles.size < count or data.count <= replace(free.parts, modes=count).count:
        return trial
    try:
        with np.errstate(all="ignore"):
            modal = with_modes(data, replace(free.parts, modes=count), poles)
    except np.linalg.LinAlgError:
        return trial
    reduced = reduced_trial(modal, kinds, lengths)
    trial = replace(trial, modal=modal, reduced=reduced.reduced)
    if trial.accepted or reduced.reduced is None:
        return trial
    again = refined_trial(data, trial, reduced.reduced.model, free)
    return again if again.criterion < trial.criterion else trial


def trials_of(
    data: ResponseMatrix,
    kinds: Mapping[str, Kind],
    choices: Sequence[tuple[int, ...]],
    search: ModeSearch,
    others: Sequence[Trial],
) -> list[Trial]:
    """Try the modes that were found; less or one more where that is in doubt.

    Less where the faintest is hardly seen, more where the structure tells that one is missing and
    none of the `others` was accepted.
    """
    trials = _of_modes(data, kinds, choices, search.modal)
    fewer: ModalModel | None = search.modal
    while fewer is not None and standing_out(fewer).min(initial=inf) < SEEN:
        fewer = without_mode(data, fewer)
        if fewer is not None:
            trials += _of_modes(data, kinds, choices, fewer)
    if not any(t.accepted for t in (*trials, *others)):
        more = with_strongest_hint(data, search.modal)
        if more is not None:
            trials += _of_modes(data, kinds, choices, more)
    if not any(t.accepted for t in (*trials, *others)):
        trials = _in_need(data, kinds, trials)
    return trials


def _of_modes(
    data: ResponseMatrix,
    kinds: Mapping[str, Kind],
    choices: Sequence[tuple[int, ...]],
    modal: ModalModel,
) -> list[Trial]:
    """All combinations of lengths with this number of modes, the likely ones refined."""
    tried = [reduced_trial(modal, kinds, lengths) for lengths in _promising(modal, choices)]
    near = min((t.structure for t in tried), default=inf) + 2.0 * DECISIVE
    tried.sort(key=lambda t: (max(t.structure, near), t.unevenness))
    best = inf
    for k, trial in enumerate(tried[:REFINED]):
        beyond = trial.structure > near
        if trial.reduced is None or (beyond and isfinite(best)):
            break
        tried[k] = refined_trial(data, trial, trial.reduced.model)
        if tried[k].accepted:
            best = min(best, tried[k].criterion)
    return tried


def _combinations(choices: Sequence[tuple[int, ...]], modes: int) -> Iterator[tuple[int, ...]]:
    """Lengths whose springs are as many as the modes."""
    for lengths in product(*choices):
        if sum(lengths) - len(lengths) == modes:
            yield lengths


def _promising(modal: ModalModel, choices: Sequence[tuple[int, ...]]) -> list[tuple[int, ...]]:
    """All combinations where they are few, otherwise those nearest to the modes at a glance."""
    all_of_them = list(_combinations(choices, modal.omega.size))
    if len(all_of_them) <= REDUCED:
        return all_of_them
    try:
        far = mismatch(modal, all_of_them)
    except NotAChainError:
        return all_of_them[:REDUCED]
    return [all_of_them[k] for k in np.argsort(far, kind="stable")[:REDUCED]]


def _in_need(data: ResponseMatrix, kinds: Mapping[str, Kind], tried: list[Trial]) -> list[Trial]:
    """Nothing was accepted: start from the nearest machines' values with other lengths."""
    result = []
    left = REFINED
    for trial in tried:
        if trial.refined is None and left:
            left -= 1
            start = (
                trial.reduced.model
                if trial.reduced is not None
                else typical_machine(trial.modal, trial.lengths, kinds)
            )
            again = refined_trial(data, trial, start)
            result.append(again if again.refined is not None else trial)
        else:
            result.append(trial)
    return result
