"""The search for causes: screened, fitted, tested on unseen data, one after another and in pairs."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from fieldtool.criticise.effects import candidates
from fieldtool.criticise.effects.base import Context, Effect
from fieldtool.criticise.effects.disturbance import disturbance_candidates
from fieldtool.criticise.search.afterwards import (
    Accepted,
    Reasons,
    convincing,
    pruned,
    tied,
    unharmful,
    unsigned,
)
from fieldtool.criticise.search.fit import EXACTLY, Fitted, fit, strain
from fieldtool.criticise.search.hypothesis import Hypothesis, Simulator
from fieldtool.criticise.search.instants import timed
from fieldtool.criticise.search.judge import Parts, beyond_noise, difference, judged, moved
from fieldtool.criticise.search.marks import Unmarked, marked, on_all_rows
from fieldtool.criticise.search.other_end import at_other_end
from fieldtool.criticise.search.prepare import Prepared, reweighted
from fieldtool.criticise.search.rules import (
    ALIKE_T,
    BEYOND_NOISE,
    CHANCE,
    LESS_MOVED,
    RELATED,
    STAYED,
    Tried,
    related,
    tolerance,
    why_not,
)
from fieldtool.criticise.search.screen import Screened, Tangent, screened, tangent

FloatArray = NDArray[np.float64]
FULL = 5
"""Candidates of a round that are fitted in full."""
PAIRED = 3
"""Candidates of which all pairs are fitted where none does alone."""
ROUNDS = 6
"""Most causes."""
SCREENING = 0.4
"""Share of the time of a round."""
MOST_TURNS = 6
SETTLED = 1e-3
"""Change of a number of the machine over its size, from which fit and noise are found anew."""
CLEAR = 0.9
"""Share of what is not explained, from which no other start is tried."""
ELSEWHERE, ELSEWHERE_LOOSE = 0.003, 0.3
"""Relative change of a mass, spring or coupling, and of a damper or friction, that bends a fit."""
TRACE, TRACE_MORE = 0.01, 0.04
"""Share of the error that a candidate must be expected to explain to be fitted in full: the first of an
axis, and a further one, which has to explain more."""
FAR_BEHIND = 0.3
"""Of the expected gain of what explains nearly all: with less, a candidate is not fitted beside it."""
SIMPLER = {"cogging": ("gravity",)}
"""What is the same but for a number that is fixed: a wave of the position of one a turn."""
Advance = Callable[[str, float], None]


@dataclass(frozen=True, eq=False)
class Found:
    """Where a search ended."""

    prepared: Prepared
    before: Fitted
    """The machine without effects, fitted to the same rows."""
    after: Fitted
    """With the causes, fitted to the same rows: its errors on unseen rows are what is gained."""
    final: Fitted
    """The same fitted to all rows: its numbers go into the model."""
    accepted: tuple[Accepted, ...]
    """In the order of their gain."""
    rejected: tuple[tuple[Effect, str], ...]
    unmarked: tuple[Unmarked, ...] = ()


def search(
    prepared: Prepared,
    without: frozenset[str] = frozenset(),
    advance: Advance = lambda *_: None,
    accepted_base: FloatArray | None = None,
) -> Found:
    """Find causes of what the machine's chains do not explain.

    Parameters
    ----------
    prepared : Prepared
    without : frozenset of str
        Names of effects that are not tried.
    advance : callable
        Told what is done, and a number from 0 to 1.
    accepted_base : ndarray, optional
        The machine's numbers as last accepted: where an effect bent what was identified, the first
        cause is looked for from there, too.
    """
    advance("fit the machine without effects", 0.0)
    prepared = replace(prepared, accepted=accepted_base)
    prepared, before = settled(prepared, prepared.start)
    current, accepted = before, list[Accepted]()
    rejected: Reasons = {}
    for turn in range(ROUNDS):
        found, seen = _round(
            prepared, current, accepted, without, turn, rejected, advance,
            _starts(current.hypothesis, accepted_base),
        )  # fmt: skip
        for effect in seen:
            rejected.setdefault(effect.key, (effect, "leaves no trace of what it must leave"))
        if not found:
            break
        for one in found:
            accepted = _kept(accepted, one)
        current = found[-1].tried.fitted
        prepared = reweighted(prepared, current.hypothesis)
        current = fit(prepared.simulator, current.hypothesis)
    advance("check the causes against each other", 0.9)
    current, accepted = pruned(prepared, current, accepted, rejected)
    current, accepted = tied(prepared, current, accepted, without)
    current, accepted, unmarked = marked(prepared, current, accepted, rejected, without)
    if unmarked:
        current, accepted = pruned(prepared, current, accepted, rejected)
    before = fit(prepared.simulator, before.hypothesis)
    current, accepted = unharmful(prepared, before, current, accepted, rejected)
    current, accepted = convincing(prepared, before, current, accepted, rejected)
    names = {a.tried.effect.key for a in accepted}
    names |= {t.effect.key for a in accepted for t in a.ties}
    current = current if accepted else before
    final = _on_all_rows(prepared, current) if accepted else before
    advance("describe and draw what was found", 0.95)
    return Found(
        prepared,
        before,
        current,
        final,
        tuple(sorted(accepted, key=lambda a: -a.tried.torque)),
        tuple(r for key, r in rejected.items() if key not in names),
        tuple(unmarked),
    )


def _starts(found: Hypothesis, accepted: FloatArray | None) -> list[Hypothesis]:
    """Return from where a cause is looked for: from a fit, and before it from the accepted machine.

    What has no name yet bends a fit, and from there it may look like nothing of the library.
    """
    if accepted is None or not _elsewhere(found, accepted):
        return [found]
    off = np.array([name in found.off for name in found.machine.names])
    return [replace(found, base=np.where(off, 0.0, accepted)), found]


def _elsewhere(found: Hypothesis, accepted: FloatArray) -> bool:
    """Whether a fit is so far from the accepted machine that effects look different from there."""
    variables = found.machine.variables
    off = np.abs(found.base - accepted) / np.array([v.scale for v in variables])
    off[[v.name in found.off for v in variables]] = 0.0
    firm = np.array([v.positive or v.name.endswith(".coupling") for v in variables])
    loose = np.array(
        [not f and not v.name.endswith(".offset") for f, v in zip(firm, variables, strict=True)]
    )
    return bool(np.any(off[firm] > ELSEWHERE) or np.any(off[loose] > ELSEWHERE_LOOSE))


def settled(prepared: Prepared, start: Hypothesis) -> tuple[Prepared, Fitted]:
    """Fit and find the noise in turn, until the machine's numbers stay."""
    fitted = fit(prepared.simulator, start)
    for _ in range(MOST_TURNS):
        prepared = reweighted(prepared, fitted.hypothesis)
        before, fitted = fitted, fit(prepared.simulator, fitted.hypothesis)
        scales = fitted.hypothesis.machine.scales
        moved = np.abs(fitted.hypothesis.base - before.hypothesis.base) / scales
        if moved.max() < SETTLED:
            break
    return prepared, fitted


def _on_all_rows(prepared: Prepared, current: Fitted) -> Fitted:
    return fit(on_all_rows(prepared), current.hypothesis, enough=EXACTLY)


def _round(
    prepared: Prepared,
    current: Fitted,
    accepted: Sequence[Accepted],
    without: frozenset[str],
    turn: int,
    rejected: Reasons,
    advance: Advance,
    starts: Sequence[Hypothesis],
) -> tuple[list[Accepted], list[Effect]]:
    """Try everything once on top of what is accepted; return what is found and what was looked at."""
    simulator = prepared.simulator
    unseen = simulator.parts(current.hypothesis, "unseen")
    everything = [*simulator.parts(current.hypothesis, "fit"), *unseen]
    active = {
        axis
        for axis in range(len(prepared.recording.axes))
        if beyond_noise(everything, [axis]) >= BEYOND_NOISE
    }
    context = prepared.context(current.hypothesis)
    # A single line is little beside the noise of all lines, and yet stands out of those around it.
    lines = "periodic_disturbance" not in without and disturbance_candidates(context)
    if not active and not lines:
        return [], []
    what = f"look for cause {len(accepted) + 1}"

    def step(share: float) -> None:
        advance(what, 0.9 * (turn + share) / ROUNDS)

    best: dict[object, Tried] = {}
    looked: list[Effect] = []
    chosen: list[Screened] = []
    for number, start in enumerate(starts):
        pool = candidates(prepared.context(start), without)
        pool = [e for e in pool if {e.axis, e.other} & active or e.name == "periodic_disturbance"]
        at = tangent(simulator, start)
        ranked = screened(simulator, at, pool, _part(step, number, len(starts)))
        chosen = _chosen(ranked, at, {a.tried.effect.axis for a in accepted})
        looked += [s.effect for s in ranked]
        clear = 0.0
        for k, one in enumerate(chosen):
            if one.gain < FAR_BEHIND * clear and one.effect.name != "measurement_delay":
                continue
            step((number + SCREENING + (1 - SCREENING) * k / len(chosen)) / len(starts))
            fitted = timed(simulator, fit(simulator, _grown(start, one), shared=at.of_machine))
            key = one.effect.key
            if not np.isfinite(fitted.cost):
                rejected[key] = (one.effect, "the simulated machine runs away with it")
                continue
            if key not in best or fitted.cost < best[key].fitted.cost:
                best[key] = judged(simulator, fitted, fitted.hypothesis.effects[-1], unseen)
                if _clear(best[key]):
                    clear = max(clear, one.gain)
        if any(_clear(t) for t in best.values()):
            break
    tried = _with_other_end(simulator, list(best.values()), unseen)
    good = []
    for candidate in tried:
        why = _why_not(prepared, context, accepted, candidate)
        rejected[candidate.effect.key] = (candidate.effect, why)
        if not why:
            good.append(candidate)
    signed = []
    for candidate in good:
        why = unsigned(prepared, candidate.fitted.hypothesis, candidate.effect, candidate.share)
        rejected[candidate.effect.key] = (candidate.effect, why)
        if not why:
            signed.append(candidate)
    if signed:
        return [_winner(prepared, signed, rejected)], looked
    if accepted:
        return [], looked  # what pairs alone explain is looked for once, before anything has a name
    return _pair(prepared, context, current, accepted, at, chosen[:PAIRED], unseen), looked


def _with_other_end(simulator: Simulator, tried: Sequence[Tried], unseen: Parts) -> list[Tried]:
    """Try a further mass that does best at the other end of its chain: the motor hardly tells them."""
    out = {t.effect.key: t for t in tried}
    least = min(tried, key=lambda t: t.fitted.cost, default=None)
    if least is None or least.effect.name != "extra_mode":
        return list(out.values())
    hung = at_other_end(least.fitted.hypothesis)
    if hung is None:
        return list(out.values())
    fitted = fit(simulator, hung)
    key = fitted.hypothesis.effects[-1].key
    if np.isfinite(fitted.cost) and (key not in out or fitted.cost < out[key].fitted.cost):
        out[key] = judged(simulator, fitted, fitted.hypothesis.effects[-1], unseen)
    return list(out.values())


def _clear(tried: Tried) -> bool:
    """Whether a candidate explains nearly all that is left, and not by chance."""
    return tried.share >= CLEAR and tried.gain.p <= CHANCE


def _part(step: Callable[[float], None], number: int, starts: int) -> Callable[[float], None]:
    """Return what is told of the screening from one start."""
    return lambda share: step((number + SCREENING * share) / starts)


def _why_not(
    prepared: Prepared, context: Context, accepted: Sequence[Accepted], candidate: Tried
) -> str:
    known = all(span.periods > 1 for span in prepared.spans.spans)
    level = max(
        (
            a.tried.torque
            for a in accepted
            if a.tried.effect.axis == candidate.effect.axis
            and related(a.tried.effect.name, candidate.effect.name)
        ),
        default=0.0,
    )
    further = any(a.tried.effect.axis == candidate.effect.axis for a in accepted)
    return why_not(candidate, context, known, level, further)


def _chosen(ranked: Sequence[Screened], at: Tangent, named: set[int]) -> list[Screened]:
    """Take the best few, the delay always among them, and what they contain or are relatives of."""
    cost = float(at.side @ at.side)
    promising = [
        s for s in ranked if s.gain > (TRACE_MORE if s.effect.axis in named else TRACE) * cost
    ]
    chosen = promising[:FULL]
    names = {(n, s.effect.axis) for s in chosen for n in (*s.effect.replaces, *s.effect.relatives)}
    axes = {s.effect.axis for s in chosen}
    return chosen + [
        s
        for s in promising[FULL:]
        if (s.effect.name == "measurement_delay" and s.effect.axis in axes)
        or (s.effect.name, s.effect.axis) in names
    ]


def _grown(hypothesis: Hypothesis, one: Screened) -> Hypothesis:
    grown = hypothesis.with_effect(one.effect)
    return replace(grown, values=(*grown.values[:-1], one.start))


def _winner(prepared: Prepared, tried: Sequence[Tried], rejected: Reasons) -> Accepted:
    """Return the best on unseen data; the others are its rivals.

    Of those that do as well, the delay goes first, then a simpler one that is contained, then the one
    that leaves the machine as it was accepted.
    """
    simulator = prepared.simulator
    order = sorted(tried, key=lambda t: t.gain.after)
    best = order[0]
    for other in order[1:]:
        simpler = (*best.effect.replaces, *SIMPLER.get(best.effect.name, ()))
        contained = other.effect.axis == best.effect.axis and other.effect.name in simpler
        lost = other.gain.after - best.gain.after
        alike = difference(simulator, other.fitted, best.fitted).t < ALIKE_T
        if (
            other.effect.name == "measurement_delay"
            and other.effect.axis == best.effect.axis
            and (alike or lost < tolerance(best.gain, best.surely(other)))
        ):
            best = other
        elif contained and (
            (alike and strain(other.fitted) < strain(best.fitted) + ALIKE_T**2)
            or best.torque**2 - other.torque**2 < (RELATED * other.torque) ** 2
        ):
            why = f"does no better than {other.effect.name}"
            rejected[best.effect.key] = (best.effect, why)
            best = other
    if best.effect.name != "measurement_delay":
        best = _least_moved(prepared, order, best)
    rivals = tuple(t for t in tried if t is not best and not _nested(t.effect, best.effect))
    return Accepted(best, rivals)


def _least_moved(prepared: Prepared, tried: Sequence[Tried], best: Tried) -> Tried:
    """Return what explains as much as the best, but takes the machine far less from what it was."""
    first = best
    for other in tried:
        if _nested(other.effect, first.effect) or other is first:
            continue
        lost = other.gain.after - first.gain.after
        alike = (
            lost < tolerance(first.gain)
            or difference(prepared.simulator, other.fitted, first.fitted).t < ALIKE_T
        )
        there = moved(best.fitted, prepared.accepted)
        if alike and there > STAYED and moved(other.fitted, prepared.accepted) < there / LESS_MOVED:
            best = other
    return best


def _pair(
    prepared: Prepared,
    context: Context,
    current: Fitted,
    accepted: Sequence[Accepted],
    at: Tangent,
    chosen: Sequence[Screened],
    unseen: Parts,
) -> list[Accepted]:
    """Try pairs where nothing does alone; both have to be missed when the other one stays."""
    simulator = prepared.simulator
    best: list[Tried] = []
    for one, other in combinations(chosen, 2):
        if _nested(one.effect, other.effect) or one.effect.key == other.effect.key:
            continue
        grown = _grown(_grown(current.hypothesis, one), other)
        fitted = fit(simulator, grown, shared=at.of_machine)
        if not np.isfinite(fitted.cost):
            continue
        both = [judged(simulator, fitted, e, unseen) for e in fitted.hypothesis.effects[-2:]]
        if any(_why_not(prepared, context, accepted, t) for t in both):
            continue
        missed = [
            difference(
                simulator,
                fit(simulator, fitted.hypothesis.without(fitted.hypothesis.place_of(t.effect))),
                fitted,
            ).t
            for t in both
        ]
        if min(missed) >= ALIKE_T and (not best or both[0].gain.after < best[0].gain.after):
            best = both
    return [Accepted(t) for t in best]


def _nested(one: Effect, other: Effect) -> bool:
    return one.axis == other.axis and (one.name in other.replaces or other.name in one.replaces)


def _kept(accepted: Sequence[Accepted], new: Accepted) -> list[Accepted]:
    """Add a cause; what it contains goes."""
    effect = new.tried.effect
    return [
        a
        for a in accepted
        if not (a.tried.effect.axis == effect.axis and a.tried.effect.name in effect.replaces)
    ] + [new]
