"""How many masses each axis has, on evidence.

The responses tell how many common modes there are (:mod:`fieldtool.identify.modes.search`).  Which
axis owns them follows from the structure: chains of other lengths can not have these mode shapes
(:mod:`fieldtool.identify.chains.block_reduction`).  Every combination of lengths is tried on the modes;
those that come near are refined on the responses themselves and compared by Schwarz' criterion,
chi2 + P ln(count), with the covariance known.  A machine is accepted only if it explains the
responses as well as free modes do.

Two axes that are coupled with each other and with no third one are a special case: their two
chains and the coupling are one path from motor to motor, and every split of its springs between
the axes is a machine with positive masses that moves both motors alike, dampers included (with
last masses a, b and coupling c, the other's last spring K is seen as (c/b)**2 K behind mass a).
Only friction at a load tells them apart.  What can not be told is said.  Of machines that explain
the responses about equally well, ten units of the criterion are no more than errors of the method:
the prior model's lengths are taken, else the fewest masses, else the motor masses nearest to the
prior's, else masses and springs most alike.

The lengths of the prior model and a machine of rigid axes are tried whatever modes were found: a
joint with strong damping hardly has a mode, and errors of the method may look like some.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, product
from math import inf, isfinite, log, nan, pi, sqrt

import numpy as np
from numpy.typing import NDArray

from fieldtool.errors import FieldtoolError, IdentificationError, NotAChainError
from fieldtool.identify.chains.block_reduction import BlockReduced, mismatch, reduce_blocks
from fieldtool.identify.chains.modal_chain import SEEN
from fieldtool.identify.likelihood.refine import UNKNOWN_ABOVE, RefinedModel, refine
from fieldtool.identify.likelihood.response_data import ResponseMatrix
from fieldtool.identify.modes.fit import prior_poles
from fieldtool.identify.modes.model import ModalModel
from fieldtool.identify.modes.search import (
    ModeSearch,
    find_modes,
    standing_out,
    with_modes,
    with_strongest_hint,
    without_mode,
)
from fieldtool.records.model import AxisModel, Coupling, Estimate, Kind, MachineModel

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
ALIKE = 0.05
"""Difference of motor masses from the prior's, relative, that tells no machine from another."""
SUNK = 3.0
"""Standard errors below which a mode that is left out is noise, and not mentioned."""


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
    """Whether it explains the responses as well as free modes do, and all its masses and springs
    are known."""
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
        Same axes; its poles are one more start, its lengths are tried in any case, and with its
        motor masses it decides between machines that explain the responses equally well.
    longest : int
        Masses of the longest chain in question.

    Raises
    ------
    ValueError
        If `known` names no axis of the data, or a number is not between 1 and `longest`.
    NotEnoughDataError
        If a pair of axes was not measured or there are too few lines.
    IdentificationError
        If no machine of chains whose masses and springs are all known explains the responses; the
        sentence says what comes closest.
    """
    given = dict(known or {})
    choices = _choices(data.names, given, longest)
    most = sum(c[-1] - 1 for c in choices)
    search = find_modes(data, most, prior=prior)
    simple = _simple_trials(data, kinds or {}, choices, search, prior)
    trials = _trials(data, kinds or {}, choices, search, simple)
    trials += [_at_errors_of_the_method(t) for t in simple]
    if not any(t.accepted for t in trials):
        raise _nothing_fits(data.names, search, trials, most)
    comparable = prior if prior is not None and prior.names == data.names else None
    best, decided = _best(trials, comparable)
    return _selection(data, search, trials, best, decided)


def _best(trials: "Sequence[_Trial]", prior: MachineModel | None) -> "tuple[_Trial, str]":
    """The best of those that the responses can not tell apart, and what decided between them."""
    near = _near(trials)
    decided = ""
    lengths = _lengths(prior) if prior is not None else ()
    fewest = min(sum(t.lengths) for t in near)
    for kept, why in (
        ([t for t in near if t.lengths == lengths], "the prior model's lengths were taken"),
        ([t for t in near if sum(t.lengths) == fewest], "the fewest masses were taken"),
    ):
        if kept and len(kept) < len(near):
            near, decided = kept, why
        if decided and len(near) == 1:
            return near[0], decided
    if prior is not None:
        off = [t.motors_off(prior) for t in near]
        kept = [t for t, each in zip(near, off, strict=True) if each <= min(off) + ALIKE]
        if len(kept) < len(near):
            near, decided = kept, "the motor masses of the prior model decided"
    if len(near) > 1:
        even = "the most even masses and springs were taken"
        decided = f"{decided}, then {even}" if decided.startswith("the motor") else even
    return min(near, key=lambda t: t.unevenness), decided


def _near(trials: "Sequence[_Trial]") -> "list[_Trial]":
    """Accepted machines that the criterion can not tell from the best, each lengths once."""
    best_of: dict[tuple[int, ...], _Trial] = {}
    for trial in sorted(trials, key=lambda t: t.criterion):
        if trial.accepted:
            best_of.setdefault(trial.lengths, trial)
    accepted = list(best_of.values())
    limit = accepted[0].criterion + DECISIVE * max(accepted[0].excess, 1.0)
    return [t for t in accepted if t.criterion < limit]


def _lengths(model: MachineModel) -> tuple[int, ...]:
    return tuple(len(axis.masses) for axis in model.axes)


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
    def excess(self) -> float:
        """Chi2 over its degrees of freedom; NaN if not refined."""
        return self.refined.chi2 / max(self.refined.degrees_of_freedom, 1) if self.refined else nan

    def motors_off(self, prior: MachineModel) -> float:
        """Largest relative difference of a motor mass from the prior's."""
        if self.refined is None:
            return inf
        pairs = zip(self.refined.model.axes, prior.axes, strict=True)
        return max(abs(a.masses[0].value / b.masses[0].value - 1.0) for a, b in pairs)

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


def _simple_trials(
    data: ResponseMatrix,
    kinds: Mapping[str, Kind],
    choices: Sequence[tuple[int, ...]],
    search: ModeSearch,
    prior: MachineModel | None,
) -> list[_Trial]:
    """The prior model's lengths and a machine of rigid axes, whatever modes were found."""
    starts = []
    if prior is not None and prior.names == data.names:
        starts.append(_all_coupled(prior))
    rigid = (1,) * len(choices)
    if rigid not in [_lengths(start) for start in starts]:
        starts.append(_rigid_machine(search.modal, kinds))
    return [
        _from_machine(data, kinds, start, search.modal)
        for start in starts
        if all(n in given for n, given in zip(_lengths(start), choices, strict=True))
    ]


def _at_errors_of_the_method(trial: _Trial) -> _Trial:
    """Accept a simple machine whose misfit is small, though free modes follow what it leaves."""
    if trial.refined is None or not trial.excess < FAR or _not_known(trial.refined.model):
        return trial
    why = f"misfit {sqrt(trial.excess):.3g} times the noise, more than that of free modes"
    return trial if trial.accepted else replace(trial, accepted=True, why=why)


def _from_machine(
    data: ResponseMatrix, kinds: Mapping[str, Kind], start: MachineModel, free: ModalModel
) -> _Trial:
    """Refine a machine, fit its modes from its own poles, and refine again what those say.

    It is measured by the free modes that were found, which may be more than its own.
    """
    lengths = _lengths(start)
    trial = _refined(data, _Trial(lengths, free, None, None, inf, False, ""), start)
    count = sum(lengths) - len(lengths)
    poles = prior_poles(start if trial.refined is None else trial.refined.model, count)
    if poles.size < count or data.count <= replace(free.parts, modes=count).count:
        return trial
    try:
        with np.errstate(all="ignore"):
            modal = with_modes(data, replace(free.parts, modes=count), poles)
    except np.linalg.LinAlgError:
        return trial
    reduced = _reduced(modal, kinds, lengths)
    trial = replace(trial, modal=modal, reduced=reduced.reduced)
    if trial.accepted or reduced.reduced is None:
        return trial
    again = _refined(data, trial, reduced.reduced.model, free)
    return again if again.criterion < trial.criterion else trial


def _trials(
    data: ResponseMatrix,
    kinds: Mapping[str, Kind],
    choices: Sequence[tuple[int, ...]],
    search: ModeSearch,
    others: Sequence[_Trial],
) -> list[_Trial]:
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


def _refined(
    data: ResponseMatrix, trial: _Trial, start: MachineModel, free: ModalModel | None = None
) -> _Trial:
    """The trial refined; accepted if as good as free modes, its own where no others are given."""
    modal = free or trial.modal
    try:
        with np.errstate(all="ignore"):  # a start from afar may go astray, which chi2 tells
            found = refine(
                start,
                data,
                fit_delay=modal.parts.delay,
                fit_friction=True,
                fit_load_friction=True,
                delays=[float(d) for d in modal.delays],
            )
    except (FieldtoolError, np.linalg.LinAlgError) as error:
        return replace(trial, why=f"can not be refined: {error}")
    price = len(found.names) * log(max(data.count, 2))
    limit = min(_acceptable(modal, found), UNEXPLAINED * found.degrees_of_freedom)
    excess = found.chi2 / max(found.degrees_of_freedom, 1)
    why = f"misfit {sqrt(excess):.3g} times the noise, free modes {sqrt(modal.excess):.3g}"
    unknown = _not_known(found.model)
    explains = found.chi2 <= limit
    if not explains:
        why = f"it does not explain the responses ({why})"
    elif unknown:
        why += f", but the responses do not tell {', '.join(unknown)}"
    accepted = explains and not unknown
    return replace(trial, refined=found, criterion=found.chi2 + price, accepted=accepted, why=why)


def _not_known(model: MachineModel) -> list[str]:
    """Masses and springs whose standard error is half of them or more."""
    named = [
        (f"{axis.name} {what} {k}", each)
        for axis in model.axes
        for what, chain in (("mass", axis.masses), ("spring", axis.springs))
        for k, each in enumerate(chain, start=1)
    ]
    return [name for name, e in named if not e.std < UNKNOWN_ABOVE * e.value]


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
    data: ResponseMatrix,
    search: ModeSearch,
    trials: Sequence[_Trial],
    best: _Trial,
    decided: str,
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
        (*_mode_doubts(search, best), *_other_doubts(data, best, trials, decided)),
        best.modal,
        best.refined.model,
        best.refined,
        best.reduced,
    )


def _candidate(trial: _Trial, best: _Trial) -> Candidate:
    difference = trial.criterion - best.criterion
    return Candidate(trial.lengths, trial.excess, difference, trial.accepted, trial.why)


def _mode_doubts(search: ModeSearch, best: _Trial) -> list[str]:
    """Modes that hardly rise out of the noise, are left out, or may be missing."""
    if max(best.lengths) == 1 and best.excess < FAR:
        return []  # what is left is noise and errors of the method, which free modes follow
    doubts = []
    larger = max((search.modal, best.modal), key=lambda modal: modal.omega.size)
    for w, seen in zip(larger.omega, standing_out(larger), strict=True):
        left_out = not np.any(np.abs(best.modal.omega - w) < 0.02 * w)
        if left_out and seen < SUNK:
            continue
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


def _other_doubts(
    data: ResponseMatrix, best: _Trial, trials: Sequence[_Trial], decided: str
) -> list[str]:
    """Other lengths that explain the responses nearly as well, and a large misfit."""
    doubts = []
    rivals = [t for t in _near(trials) if t.lengths != best.lengths]
    if rivals:
        listed = "; or ".join(_listed(data.names, t.lengths) for t in rivals)
        nearest = min(t.criterion for t in rivals) - best.criterion
        doubts.append(
            f"the responses can hardly tell the masses {_listed(data.names, best.lengths)} from "
            f"{listed} (criterion {nearest:+.2g}, {DECISIVE:.0f} are decisive): {decided}; give the "
            "number of masses of an axis where it is known"
        )
    if best.excess > FAR:
        doubts.append(
            f"the misfit is {sqrt(best.excess):.3g} times the noise: something is not linear or changes "
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
    if not trials or modes > most:
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
    unknown = nearest.refined is not None and _not_known(nearest.refined.model)
    return IdentificationError(
        f"{found}, but no machine of chains that are coupled at their last masses explains them"
        f"{' with all masses and springs known' if unknown else ''}; "
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


def _rigid_machine(modal: ModalModel, kinds: Mapping[str, Kind]) -> MachineModel:
    """Axes of one mass each, with the couplings of the measured rigid body."""
    mass = np.linalg.pinv(modal.rigid, hermitian=True)
    diagonal = np.diag(mass)
    if not (diagonal > 0.0).all():
        return _all_coupled(typical_machine(modal, (1,) * len(modal.names), kinds))
    axes = [
        AxisModel(name, kinds.get(name, "rotary"), (Estimate(float(each)),), ())
        for name, each in zip(modal.names, diagonal, strict=True)
    ]
    values = {
        (modal.names[i], modal.names[j]): float(mass[i, j])
        for i, j in zip(*np.triu_indices(len(axes), 1), strict=True)
    }
    couplings = tuple(Coupling(pair, value) for pair, value in values.items())
    coupled = MachineModel(tuple(axes), couplings)
    if np.linalg.eigvalsh(coupled.mass_matrix)[0] <= 0.0:
        return _all_coupled(MachineModel(tuple(axes)))
    return coupled


def _all_coupled(model: MachineModel) -> MachineModel:
    """The model with the couplings that it does not list, from zero."""
    listed = {frozenset(coupling.axes) for coupling in model.couplings}
    missing = tuple(
        Coupling((one, other), 0.0)
        for one, other in combinations(model.names, 2)
        if frozenset((one, other)) not in listed
    )
    return replace(model, couplings=(*model.couplings, *missing))
