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

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from fieldtool.errors import IdentificationError
from fieldtool.identify.chains.block_reduction import BlockReduced
from fieldtool.identify.chains.doubts import ModeDoubt, mode_doubts, nothing_fits, other_doubts
from fieldtool.identify.chains.trial import Trial, alike, at_errors_of_the_method, lengths_of
from fieldtool.identify.chains.trying import simple_trials, trials_of
from fieldtool.identify.likelihood.refine import RefinedModel
from fieldtool.identify.likelihood.response_data import ResponseMatrix
from fieldtool.identify.modes.model import ModalModel
from fieldtool.identify.modes.search import ModeSearch, find_modes
from fieldtool.records.model import Kind, MachineModel

ALIKE = 0.05
"""Difference of motor masses from the prior's, relative, that tells no machine from another."""


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
    mode_doubts: tuple[ModeDoubt, ...]
    """Modes that hardly rise out of the noise, are left out, or may be missing."""
    other_doubts: tuple[str, ...]
    """Other lengths that explain the responses nearly as well, and a large misfit."""
    modal: ModalModel
    """The modes that the chosen machine rests on."""
    model: MachineModel
    """Refined, with standard errors."""
    refined: RefinedModel
    """The same with covariance, delays and what the data can not tell."""
    reduced: BlockReduced | None
    """What the modes alone say, with the tests of structure; None where only the refinement of
    clipped values led to the machine."""

    @property
    def doubts(self) -> tuple[str, ...]:
        """What may be wrong, a sentence each; empty where nothing speaks against the choice."""
        return (*(one.sentence for one in self.mode_doubts), *self.other_doubts)


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
    simple = simple_trials(data, kinds or {}, choices, search, prior)
    trials = trials_of(data, kinds or {}, choices, search, simple)
    trials += [at_errors_of_the_method(t) for t in simple]
    if not any(t.accepted for t in trials):
        raise nothing_fits(data.names, search, trials, most)
    comparable = prior if prior is not None and prior.names == data.names else None
    best, decided = _best(trials, comparable)
    return _selection(data, search, trials, best, decided)


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


def _best(trials: Sequence[Trial], prior: MachineModel | None) -> tuple[Trial, str]:
    """The best of those that the responses can not tell apart, and what decided between them."""
    near = alike(trials)
    decided = ""
    lengths = lengths_of(prior) if prior is not None else ()
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


def _selection(
    data: ResponseMatrix,
    search: ModeSearch,
    trials: Sequence[Trial],
    best: Trial,
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
        tuple(mode_doubts(search, best)),
        tuple(other_doubts(data, best, trials, decided)),
        best.modal,
        best.refined.model,
        best.refined,
        best.reduced,
    )


def _candidate(trial: Trial, best: Trial) -> Candidate:
    difference = trial.criterion - best.criterion
    return Candidate(trial.lengths, trial.excess, difference, trial.accepted, trial.why)
