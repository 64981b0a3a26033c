"""How many masses each axis has, on evidence.

The responses tell how many common modes there are (:mod:`fieldtool.identify.mode_search`).  Which
axis owns them follows from the structure: chains of other lengths can not have these mode shapes
(:mod:`fieldtool.identify.block_reduction`).  Every combination of lengths is tried on the modes;
those that come near are refined on the responses themselves and compared by Schwarz' criterion,
chi2 + P ln(count), with the covariance known.  A machine is accepted only if it explains the
responses as well as free modes do.

Two axes that are coupled with each other and with no third one are a special case: their two
chains and the coupling are one path from motor to motor, and every split of its springs between
the axes is a machine with positive masses that moves both motors alike, dampers included (with
last masses a, b and coupling c, the other's last spring K is seen as (c/b)**2 K behind mass a).
Only friction at a load tells them apart.  What can not be told is said, and the machine whose
masses and springs are most alike is taken.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from math import inf, isfinite, log, pi, sqrt

import numpy as np
from numpy.typing import NDArray

from fieldtool.errors import FieldtoolError, IdentificationError, NotAChainError
from fieldtool.identify.block_reduction import BlockReduced, mismatch, reduce_blocks
from fieldtool.identify.modal_chain import SEEN
from fieldtool.identify.modal_model import ModalModel
from fieldtool.identify.mode_search import (
    ModeSearch,
    find_modes,
    standing_out,
    with_strongest_hint,
    without_mode,
)
from fieldtool.identify.refine import RefinedModel, refine
from fieldtool.identify.response_data import ResponseMatrix
from fieldtool.records.model import AxisModel, Estimate, Kind, MachineModel

FloatArray = NDArray[np.float64]
REDUCED = 24
"""At most so many combinations are taken apart with errors and tests of structure."""
REFINED = 6
"""At most so many combinations of one number of modes are refined."""
DECISIVE = 30.0
"""Difference of the criterion above which one of two models is out of the question."""
SPREAD = 6.0
"""Standard deviations of chi2 by which an accepted machine may explain less than free modes."""
UNEXPLAINED = 100.0
"""Misfit over noise above which no model is accepted: errors ten times the noise."""
FAR = 4.0
"""Misfit over noise above which the model is called doubtful though nothing is better."""


@dataclass(frozen=True)
class Candidate:
    """One combination of chain lengths and what speaks for or against it."""

    masses: tuple[int, ...]
    """N of each axis."""
    excess: float
    """Chi2 of the refined model over its degrees of freedom; NaN if not refined."""
    difference: float
    """Schwarz' criterion above that of the best; infinite if not refined."""
    accepted: bool
    """Whether it explains the responses as well as free modes do."""
    why: str
    """One sentence."""


@dataclass(frozen=True, eq=False)
class OrderSelection:
    """The number of masses of each axis, and the machine."""

    masses: Mapping[str, int]
    """N of each axis."""
    evidence: tuple[Candidate, ...]
    """All combinations that were tried, best first."""
    runner_up: Candidate | None
    """The best of the others; None if there was no other."""
    doubts: tuple[str, ...]
    """What may be wrong, a sentence each; empty where nothing speaks against the choice."""
    modal: ModalModel
    """The modes that the chosen machine rests on."""
    model: MachineModel
    """Refined, with standard errors."""
    refined: RefinedModel
    """The same with covariance, delays and what the data can not tell."""
    reduced: BlockReduced | None
    """What the modes alone say, with the tests of structure; None where only the refinement of
    clipped values led to the machine."""


def select_order(
    data: ResponseMatrix,
    kinds: Mapping[str, Kind] | None = None,
    *,
    known: Mapping[str, int] | None = None,
    prior: MachineModel | None = None,
    longest: int = 5,
) -> OrderSelection:
    """Choose the number of masses of every axis and identify the machine.

    Parameters
    ----------
    data : ResponseMatrix
        All pairs of axes measured; lines below and around all modes.
    kinds : mapping of axis name to rotary or linear, optional
        Rotary where not given.
    known : mapping of axis name to N, optional
        Axes whose number of masses is known.
    prior : MachineModel, optional
        Same axes; its poles are one more start.
    longest : int
        Masses of the longest chain in question.

    Raises
    ------
    ValueError
        If `known` names no axis of the data, or a number is not between 1 and `longest`.
    NotEnoughDataError
        If a pair of axes was not measured or there are too few lines.
    IdentificationError
        If no machine of chains explains the responses; the sentence says what comes closest.
    """
    given = dict(known or {})
    choices = _choices(data.names, given, longest)
    most = sum(c[-1] - 1 for c in choices)
    search = find_modes(data, most, prior=prior)
    trials = _trials(data, kinds or {}, choices, search)
    if not any(t.accepted for t in trials):
        raise _nothing_fits(data.names, search, trials, most)
    return _selection(data, search, trials, _best(trials, prior))


def _best(trials: "Sequence[_Trial]", prior: MachineModel | None) -> "_Trial":
    """The best by the criterion; of those that it can not tell apart, the prior's or most even."""
    accepted = [t for t in trials if t.accepted]
    lowest = min(t.criterion for t in accepted)
    near = [t for t in accepted if t.criterion < lowest + DECISIVE]
    lengths = tuple(len(axis.masses) for axis in prior.axes) if prior is not None else ()
    return min(near, key=lambda t: (t.lengths != lengths, t.criterion + t.unevenness))


def _choices(names: Sequence[str], known: Mapping[str, int], longest: int) -> list[tuple[int, ...]]:
    """Possible N of each axis, rising."""
    unknown = sorted(set(known) - set(names))
    if unknown:
        raise ValueError(f"no axis {', '.join(unknown)}; there are {', '.join(names)}")
    if longest < 1:
        raise ValueError(f"the longest chain has at least one mass, got {longest}")
    for name, n in known.items():
        if n < 1:
            raise ValueError(f"axis {name}: a chain has at least one mass, got {n}")
    return [(known[name],) if name in known else tuple(range(1, longest + 1)) for name in names]


@dataclass(frozen=True, eq=False)
class _Trial:
    """One combination of lengths, as far as it was tried."""

    lengths: tuple[int, ...]
    modal: ModalModel
    reduced: BlockReduced | None
    refined: RefinedModel | None
    criterion: float
    accepted: bool
    why: str

    @property
    def structure(self) -> float:
        """Misfit of the structure, like chi2; what orders the trials before refinement."""
        return inf if self.reduced is None else self.reduced.misfit

    @property
    def unevenness(self) -> float:
        """Sum over all chains of squared logarithms of masses and springs over their mean."""
        machine = self.refined or self.reduced
        if machine is None:
            return inf
        total = 0.0
        for axis in machine.model.axes:
            for chain in (axis.masses, axis.springs):
                logs = np.log([e.value for e in chain]) if chain else np.zeros(1)
                total += float(np.sum((logs - logs.mean()) ** 2))
        return total


def _trials(
    data: ResponseMatrix,
    kinds: Mapping[str, Kind],
    choices: Sequence[tuple[int, ...]],
    search: ModeSearch,
) -> list[_Trial]:
    """Try the modes that were found; one less or more where that is in doubt.

    Less where the faintest is hardly seen, more where the structure tells that one is missing.
    """
    trials = _of_modes(data, kinds, choices, search.modal)
    if standing_out(search.modal).min(initial=inf) < SEEN:
        fewer = without_mode(data, search.modal)
        if fewer is not None:
            trials += _of_modes(data, kinds, choices, fewer)
    if not any(t.accepted for t in trials):
        more = with_strongest_hint(data, search.modal)
        if more is not None:
            trials += _of_modes(data, kinds, choices, more)
    if not any(t.accepted for t in trials):
        trials = _in_need(data, kinds, trials)
    return trials


def _of_modes(
    data: ResponseMatrix,
    kinds: Mapping[str, Kind],
    choices: Sequence[tuple[int, ...]],
    modal: ModalModel,
) -> list[_Trial]:
    """All combinations of lengths with this number of modes, the likely ones refined."""
    tried = [_reduced(modal, kinds, lengths) for lengths in _promising(modal, choices)]
    near = min((t.structure for t in tried), default=inf) + 2.0 * DECISIVE
    tried.sort(key=lambda t: (max(t.structure, near), t.unevenness))
    best = inf
    for k, trial in enumerate(tried[:REFINED]):
        beyond = trial.structure > near
        if trial.reduced is None or (beyond and isfinite(best)):
            break
        tried[k] = _refined(data, trial, trial.reduced.model)
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


def _reduced(modal: ModalModel, kinds: Mapping[str, Kind], lengths: tuple[int, ...]) -> _Trial:
    masses = dict(zip(modal.names, lengths, strict=True))
    try:
        reduced = reduce_blocks(modal, masses, kinds)
    except NotAChainError as error:
        return _Trial(lengths, modal, None, None, inf, False, str(error))
    why = (
        f"not refined: modes differ from those of such chains by {sqrt(reduced.misfit):.3g} "
        f"standard errors"
    )
    return _Trial(lengths, modal, reduced, None, inf, False, why)


def _refined(data: ResponseMatrix, trial: _Trial, start: MachineModel) -> _Trial:
    modal = trial.modal
    delay = modal.parts.delay
    try:
        with np.errstate(all="ignore"):  # a start from afar may go astray, which chi2 tells
            found = refine(
                start,
                data,
                fit_delay=delay,
                fit_friction=True,
                fit_load_friction=True,
                delays=[float(d) for d in modal.delays],
            )
    except (FieldtoolError, np.linalg.LinAlgError) as error:
        return replace(trial, why=f"can not be refined: {error}")
    price = len(found.names) * log(max(data.count, 2))
    limit = min(_acceptable(modal, found), UNEXPLAINED * found.degrees_of_freedom)
    accepted = found.chi2 <= limit
    excess = found.chi2 / found.degrees_of_freedom
    why = f"misfit {excess:.3g} times the noise, free modes {modal.excess:.3g}"
    if not accepted:
        why += ": chains of these lengths do not explain the responses"
    return replace(trial, refined=found, criterion=found.chi2 + price, accepted=accepted, why=why)


def _acceptable(modal: ModalModel, found: RefinedModel) -> float:
    """Largest chi2 of a machine that explains the responses as free modes do.

    A machine has fewer parameters than free modes, each of which may cost one unit; a tenth on
    top, as free modes may follow what is not linear.
    """
    unit = max(modal.excess, 1.0)
    dof = found.degrees_of_freedom
    fewer = max(dof - modal.degrees_of_freedom, 0)
    return max(
        modal.chi2 + unit * (fewer + SPREAD * sqrt(2.0 * max(fewer, 1))) + 0.1 * unit * dof,
        unit * (dof + SPREAD * sqrt(2.0 * dof)),
    )


def _in_need(data: ResponseMatrix, kinds: Mapping[str, Kind], tried: list[_Trial]) -> list[_Trial]:
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
            again = _refined(data, trial, start)
            result.append(again if again.refined is not None else trial)
        else:
            result.append(trial)
    return result


def _selection(
    data: ResponseMatrix, search: ModeSearch, trials: Sequence[_Trial], best: _Trial
) -> OrderSelection:
    ranked = sorted(trials, key=lambda t: (t is not best, not t.accepted, t.criterion, t.structure))
    evidence = tuple(_candidate(t, best) for t in ranked)
    others = tuple(c for c in evidence if c.masses != best.lengths)
    runner_up = others[0] if others else None
    if best.refined is None:
        raise IdentificationError("no machine was refined")
    return OrderSelection(
        dict(zip(data.names, best.lengths, strict=True)),
        evidence,
        runner_up,
        (*_mode_doubts(search, best), *_other_doubts(data, best, trials)),
        best.modal,
        best.refined.model,
        best.refined,
        best.reduced,
    )


def _candidate(trial: _Trial, best: _Trial) -> Candidate:
    excess = (
        trial.refined.chi2 / trial.refined.degrees_of_freedom if trial.refined else float("nan")
    )
    difference = trial.criterion - best.criterion
    return Candidate(trial.lengths, excess, difference, trial.accepted, trial.why)


def _mode_doubts(search: ModeSearch, best: _Trial) -> list[str]:
    """Modes that hardly rise out of the noise, are left out, or may be missing."""
    doubts = []
    larger = max((search.modal, best.modal), key=lambda modal: modal.omega.size)
    for w, seen in zip(larger.omega, standing_out(larger), strict=True):
        left_out = not np.any(np.abs(best.modal.omega - w) < 0.02 * w)
        if seen < SEEN or left_out:
            doubts.append(
                f"the mode at {w / (2 * pi):.4g} Hz is in doubt: it stands "
                f"{seen:.2g} standard errors out of the noise, {SEEN:.0f} are needed"
                + ("; the model does without it" if left_out else "")
                + "; excite more strongly or longer there"
            )
    if search.hint is not None and not np.any(
        np.abs(best.modal.omega - search.hint) < 0.05 * search.hint
    ):
        doubts.append(
            f"the responses hint at a further mode near {search.hint / (2 * pi):.4g} Hz "
            f"({sqrt(search.hint_chi2):.2g} standard errors), which is not in the model; excite "
            "more strongly there, or look for what is not linear"
        )
    return doubts


def _other_doubts(data: ResponseMatrix, best: _Trial, trials: Sequence[_Trial]) -> list[str]:
    """Other lengths that explain the responses nearly as well, and a large misfit."""
    doubts = []
    rivals = [
        t
        for t in trials
        if t is not best and t.accepted and t.criterion < best.criterion + DECISIVE
    ]
    if rivals:
        listed = "; or ".join(_listed(data.names, t.lengths) for t in rivals)
        nearest = min(t.criterion for t in rivals) - best.criterion
        doubts.append(
            f"the responses can hardly tell the masses {_listed(data.names, best.lengths)} from "
            f"{listed} (criterion {nearest:+.2g}, {DECISIVE:.0f} are decisive); the most likely "
            "with even masses and springs was taken; give the number of masses of an axis where "
            "it is known"
        )
    if best.refined is not None:
        excess = best.refined.chi2 / best.refined.degrees_of_freedom
        if excess > FAR:
            doubts.append(
                f"the misfit is {excess:.3g} times the noise: something is not linear or changes "
                "with time, or the noise is larger than stated; standard errors are enlarged by it"
            )
    return doubts


def _listed(names: Sequence[str], lengths: Sequence[int]) -> str:
    return ", ".join(f"{name} {n}" for name, n in zip(names, lengths, strict=True))


def _nothing_fits(
    names: Sequence[str], search: ModeSearch, trials: Sequence[_Trial], most: int
) -> IdentificationError:
    modes = search.modal.omega.size
    where = ", ".join(f"{w / (2 * pi):.4g}" for w in search.modal.omega)
    found = f"the responses hold {modes} modes" + (f" (at {where} Hz)" if modes else "")
    if not trials:
        return IdentificationError(
            f"{found}, more than the {most} that the given numbers of masses allow; allow longer "
            "chains or more masses"
            if modes > most
            else f"{found}, which the given numbers of masses do not allow; leave them open, or "
            "excite the modes that are missing more strongly"
        )
    nearest = min(trials, key=lambda t: (t.criterion, t.structure))
    notes = nearest.reduced.notes if nearest.reduced is not None else ()
    detail = f"; {notes[0]}" if notes else ""
    return IdentificationError(
        f"{found}, but no machine of chains that are coupled at their last masses explains them; "
        f"closest are the masses {_listed(names, nearest.lengths)}: {nearest.why}{detail}"
    )


def typical_machine(
    modal: ModalModel, lengths: Sequence[int], kinds: Mapping[str, Kind]
) -> MachineModel:
    """Chains of equal masses and springs with the measured rigid body: a start of last resort."""
    total = 1.0 / np.diag(modal.rigid)
    square = float(np.mean(modal.omega**2)) if modal.omega.size else 1.0
    axes = []
    for name, n, mass in zip(modal.names, lengths, total, strict=True):
        each = float(mass) / n
        axes.append(
            AxisModel(
                name,
                kinds.get(name, "rotary"),
                (Estimate(each),) * n,
                (Estimate(0.5 * each * square),) * (n - 1),
            )
        )
    return MachineModel(tuple(axes))
