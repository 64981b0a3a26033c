"""Whether what sets a cause apart from its relatives is itself in the data.

Effects of a family share most of what they leave (a delay and a lag: a phase that grows with the
frequency).  A name is sure only where the effect's own mark is seen.  Each effect states its marks
(:class:`~fieldtool.criticise.effects.base.Mark`): a number that is 0 for itself and 1 for its relative,
in a model that contains both.  It is fitted beside everything else, to all data, with its standard
error; the relative need not be in the library for that.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from typing import Literal

from fieldtool.criticise.effects.base import Effect, Mark
from fieldtool.criticise.search.afterwards import Accepted, Reasons
from fieldtool.criticise.search.fit import EXACTLY, Fitted, fit
from fieldtool.criticise.search.hypothesis import Simulator
from fieldtool.criticise.search.judge import at_noise
from fieldtool.criticise.search.prepare import Prepared
from fieldtool.criticise.search.rules import Tried

SURE = 5.0
"""Standard errors by which a number has to be nearer to the effect than to its relative."""
HALF, QUARTER = 0.5, 0.25
FEW_STEPS = 6
Shown = Literal["its own", "neither", "its relative's"]


@dataclass(frozen=True)
class Reading:
    """What the data say of one mark."""

    mark: Mark
    number: float
    """0: the effect itself; 1: its relative."""
    std: float
    sure: bool = True
    """Whether what is left is noise, of which a standard error is known; else it may be of anything."""

    @property
    def shown(self) -> Shown:
        """Whose mark the data show."""
        if self.mark.special:
            number = abs(self.number) if self.mark.either_sign else self.number
            if number <= max(HALF, SURE * self.std):
                return "its own"
            return "neither" if self.mark.or_else else "its relative's"
        if self.sure and self.number + SURE * self.std < QUARTER:
            return "its own"
        other = self.sure and self.number - SURE * self.std > 1.0 - QUARTER
        return "its relative's" if other else "neither"


@dataclass(frozen=True, eq=False)
class Unmarked:
    """What would fit as a cause, but may as well be what was not tried."""

    effect: Effect
    mark: Mark
    fitted: Fitted


def on_all_rows(prepared: Prepared) -> Simulator:
    """Return a simulator that may see everything."""
    lines = tuple(
        replace(one, span=replace(one.span, role="fit")) for one in prepared.simulator.lines
    )
    return Simulator(prepared.motions, lines)


def readings(
    prepared: Prepared, current: Fitted, effect: Effect, relatives: Collection[str]
) -> tuple[Reading, ...]:
    """Fit the number of each mark of a cause beside all else.

    Parameters
    ----------
    prepared : Prepared
    current : Fitted
        With the cause in it.
    effect : Effect
    relatives : collection of str
        Names of those whose marks are asked for.
    """
    hypothesis = current.hypothesis
    place = hypothesis.place_of(effect)
    marks = hypothesis.effects[place].marks(hypothesis.values[place], prepared.context(hypothesis))
    marks = tuple(m for m in marks if m.relative in relatives)
    if not marks:
        return ()
    sure = at_noise(prepared.simulator.parts(hypothesis, "unseen"))
    simulator, axis = on_all_rows(prepared), prepared.recording.names[effect.axis]
    out = []
    for mark in marks:
        wider = hypothesis if mark.beside is None else hypothesis.with_effect(mark.beside)
        name = f"{axis}.{mark.number}"
        if mark.beside is not None:
            name = f"{len(wider.effects) - 1}:{mark.beside.name}.{mark.number}"
        fitted = fit(simulator, wider, enough=EXACTLY)
        if name not in fitted.names:
            continue
        k = fitted.names.index(name)
        value, std = float(fitted.values[k]), float(fitted.std[k])
        out.append(Reading(mark, value / mark.whole, std / abs(mark.whole), sure))
    return tuple(out)


def marked(
    prepared: Prepared,
    current: Fitted,
    accepted: Sequence[Accepted],
    rejected: Reasons,
    without: frozenset[str] = frozenset(),
) -> tuple[Fitted, list[Accepted], list[Unmarked]]:
    """Give a cause its name for sure, as one of a tie, or not at all, by whose mark the data show.

    Of two that do as well, the one whose mark is shown is named alone; where neither's is, they are a
    tie.  A relative that was tried and did worse is no matter; one that could not be tried (``without``)
    may be the cause unless the mark against it is shown.
    """
    kept, unmarked = list[Accepted](), list[Unmarked]()
    for a in accepted:
        found, current = _one(prepared, current, a, rejected, without)
        if isinstance(found, Unmarked):
            unmarked.append(found)
        else:
            kept.append(found)
    return current, kept, unmarked


def _one(
    prepared: Prepared,
    current: Fitted,
    a: Accepted,
    rejected: Reasons,
    without: frozenset[str],
) -> tuple[Accepted | Unmarked, Fitted]:
    effect = a.tried.effect
    rivals = {t.effect.name for t in a.ties if t.effect.axis == effect.axis}
    for reading in readings(prepared, current, effect, rivals | without):
        mark = reading.mark
        rival = next((t for t in a.ties if _is(t, mark.relative, effect.axis)), None)
        if reading.shown != "its own" and mark.relative in without:
            rejected[effect.key] = (effect, lacking(mark))
            less = current.hypothesis.without(current.hypothesis.place_of(effect))
            return Unmarked(effect, mark, current), fit(prepared.simulator, less)
        if rival is None or (mark.special and reading.shown != "its relative's"):
            continue
        first, second = replace(a.tried, fitted=current), rival
        if reading.number > HALF:
            first, second = replace(rival, fitted=_swapped(prepared, current, effect, rival)), first
        ties = tuple(t for t in a.ties if t is not rival)
        if reading.shown == "neither":
            ties = (second, *ties)
        else:
            why = f"what tells {first.effect.name} from it is shown"
            rejected[second.effect.key] = (second.effect, why)
        beside = replace(a.tried, effect=first.effect, fitted=first.fitted)
        return Accepted(beside, ties), first.fitted
    return a, current


def _swapped(prepared: Prepared, current: Fitted, effect: Effect, rival: Tried) -> Fitted:
    """Put a rival in a cause's place, all else fitted beside."""
    hypothesis = current.hypothesis.without(current.hypothesis.place_of(effect))
    hypothesis = hypothesis.with_effect(rival.effect)
    values = rival.fitted.hypothesis.values[rival.fitted.hypothesis.place_of(rival.effect)]
    return fit(prepared.simulator, replace(hypothesis, values=(*hypothesis.values[:-1], values)))


def _is(tried: Tried, name: str, axis: int) -> bool:
    return tried.effect.name == name and tried.effect.axis == axis


def lacking(mark: Mark) -> str:
    """Say that an effect fits, and why it has no name."""
    return f"fits, but as {mark.relative} might; what would tell is not shown: {mark.words}"
