"""The search for causes: screened, fitted, tested on unseen data, one after another and in pairs."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from fieldtool.criticise.effects import candidates
from fieldtool.criticise.effects.base import Effect
from fieldtool.criticise.search.fit import Fitted, fit
from fieldtool.criticise.search.hypothesis import Hypothesis
from fieldtool.criticise.search.prepare import Prepared, reweighted
from fieldtool.criticise.search.rules import ALIKE_T, RELATED, Tried, related, why_not
from fieldtool.criticise.search.screen import Screened, Tangent, screened, tangent
from fieldtool.criticise.search.significance import Comparison, Parts, compared

FloatArray = NDArray[np.float64]
FULL = 5
"""Candidates of a round that are fitted in full."""
ROUNDS = 6
"""Most causes."""
TRACE = 0.01
"""Of the largest gain expected in a round, or of the error: less is not fitted."""
UNSURE_NOISE = 0.25
"""Of the power of an error, that may be noise though the estimate of the noise is smaller."""
Advance = Callable[[str, float], None]


@dataclass(frozen=True)
class Accepted:
    """A cause with a name, and its rivals that do as well (while searching: that may)."""

    tried: Tried
    ties: tuple[Tried, ...] = ()


@dataclass(frozen=True, eq=False)
class Found:
    """Where a search ended."""

    prepared: Prepared
    before: Fitted
    """The machine without effects, fitted to the same rows."""
    after: Fitted
    accepted: tuple[Accepted, ...]
    """In the order of their gain."""
    rejected: tuple[tuple[Effect, str], ...]
    notes: tuple[str, ...] = field(default=())


def search(
    prepared: Prepared, without: frozenset[str] = frozenset(), advance: Advance = lambda *_: None
) -> Found:
    """Find causes of what the machine's chains do not explain.

    Parameters
    ----------
    prepared : Prepared
    without : frozenset of str
        Names of effects that are not tried.
    advance : callable
        Told what is done, and a number from 0 to 1.
    """
    advance("fit the machine without effects", 0.0)
    before = fit(prepared.simulator, prepared.start)
    prepared = reweighted(prepared, before.hypothesis)
    before = fit(prepared.simulator, before.hypothesis)
    current, accepted = before, []
    rejected: dict[object, tuple[Effect, str]] = {}
    for turn in range(ROUNDS):
        found, why, seen = _round(prepared, current, accepted, without, turn, advance)
        rejected |= why
        for effect in seen:
            rejected.setdefault(effect.key, (effect, "leaves no trace of what it must leave"))
        if found is None:
            break
        accepted = _kept(accepted, found)
        current = found.tried.fitted
        prepared = reweighted(prepared, current.hypothesis)
        current = fit(prepared.simulator, current.hypothesis)
    current, accepted = _pruned(prepared, current, accepted, rejected)
    current, accepted = _tied(prepared, current, accepted, advance)
    names = {a.tried.effect.key for a in accepted}
    names |= {t.effect.key for a in accepted for t in a.ties}
    advance("done", 1.0)
    return Found(
        prepared,
        before,
        current,
        tuple(sorted(accepted, key=lambda a: -a.tried.torque)),
        tuple(r for key, r in rejected.items() if key not in names),
    )


def _round(
    prepared: Prepared,
    current: Fitted,
    accepted: Sequence[Accepted],
    without: frozenset[str],
    turn: int,
    advance: Advance,
) -> tuple[Accepted | None, dict[object, tuple[Effect, str]], list[Effect]]:
    """Try everything once on top of what is accepted."""
    simulator = prepared.simulator
    context = prepared.context(current.hypothesis)
    before = simulator.parts(current.hypothesis, "unseen")
    pool = candidates(context, without)
    base = turn / ROUNDS
    what = "look for a cause" if not accepted else f"look for cause {len(accepted) + 1}"

    def step(share: float) -> None:
        advance(what, base + share / ROUNDS)

    at = tangent(simulator, current.hypothesis)
    ranked = screened(simulator, at, pool, lambda s: step(0.4 * s))
    chosen = _chosen(ranked, at)
    tried: list[Tried] = []
    rejected: dict[object, tuple[Effect, str]] = {}
    for k, one in enumerate(chosen):
        step(0.4 + 0.6 * k / len(chosen))
        tried.append(_tried(prepared, current, at, one, before))
    known = all(span.periods > 1 for span in prepared.spans.spans)
    fit_for_a_name = []
    for one in tried:
        level = max(
            (a.tried.torque for a in accepted
             if a.tried.effect.axis == one.effect.axis
             and related(a.tried.effect.name, one.effect.name)),
            default=0.0,
        )  # fmt: skip
        why = why_not(one, context, known, level)
        rejected[one.effect.key] = (one.effect, why)
        if not why:
            fit_for_a_name.append(one)
    if not fit_for_a_name:
        return None, rejected, [s.effect for s in ranked]
    winner = _winner(prepared, fit_for_a_name, rejected)
    return winner, rejected, [s.effect for s in ranked]


def _chosen(ranked: Sequence[Screened], at: Tangent) -> list[Screened]:
    """Take the best few, with the delay always among them, and the simpler ones that they contain."""
    cost = float(at.side @ at.side)
    promising = [s for s in ranked if s.gain > TRACE * cost]
    if not promising:
        return []
    chosen = promising[:FULL]
    names = {(n, s.effect.axis) for s in chosen for n in s.effect.replaces}
    chosen += [
        s
        for s in promising[FULL:]
        if s.effect.name == "measurement_delay" or (s.effect.name, s.effect.axis) in names
    ]
    return chosen


def _tried(
    prepared: Prepared, current: Fitted, at: Tangent, one: Screened, before: Parts
) -> Tried:
    grown = current.hypothesis.with_effect(one.effect)
    grown = replace(grown, values=(*grown.values[:-1], one.start))
    fitted = fit(prepared.simulator, grown, shared=at.of_machine)
    return judged(prepared, current.hypothesis, fitted, one.effect, before)


def judged(
    prepared: Prepared, before: Hypothesis, fitted: Fitted, effect: Effect, parts: Parts
) -> Tried:
    """Measure what a fitted hypothesis gains over another on unseen data."""
    after = prepared.simulator.parts(fitted.hypothesis, "unseen")
    axes = [effect.axis] if effect.other is None else [effect.axis, effect.other]
    there = sum(axis_power(parts, axis) for axis in axes)
    left = there - sum(axis_power(after, axis) for axis in axes)
    noise = sum(expected_noise(parts, axis) for axis in axes)
    share = left / max(there - noise, UNSURE_NOISE * there, 1e-300)
    return Tried(
        fitted,
        effect,
        compared(parts, after),
        share,
        explained_torque(parts, after, effect.axis),
        there / noise if noise else np.inf,
    )


def axis_power(parts: Parts, axis: int) -> float:
    """Sum of squares of the weighted errors of one axis."""
    return sum(
        float(np.sum(values.reshape(2, *lines.weight.shape)[:, :, axis] ** 2))
        for lines, values in parts
    )


def expected_noise(parts: Parts, axis: int) -> float:
    """Return what noise alone makes of :func:`axis_power`; 0 where the noise is not known."""
    return sum(
        float(np.count_nonzero(lines.weight[:, axis])) for lines, _ in parts if lines.span.periods > 1
    )


def explained_torque(before: Parts, after: Parts, axis: int) -> float:
    """RMS of what is explained over RMS of the torque, of one axis, in the band."""
    gained = whole = 0.0
    for (lines, first), (_, second) in zip(before, after, strict=True):
        weight = np.maximum(lines.weight[:, axis], 1e-300)
        rows = lines.weight.shape
        for values, sign in ((first, 1.0), (second, -1.0)):
            both = values.reshape(2, *rows)[:, :, axis] / weight * (lines.weight[:, axis] > 0)
            gained += sign * float(np.sum(both**2))
        torque = lines.raw(lines.motion.torque)[:, axis]
        whole += float(np.sum(np.abs(torque) ** 2))
    return float(np.sqrt(max(gained, 0.0) / max(whole, 1e-300)))


def _winner(
    prepared: Prepared, tried: Sequence[Tried], rejected: dict[object, tuple[Effect, str]]
) -> Accepted:
    """Return the best on unseen data; a simpler one that does as well instead; ties beside it."""
    order = sorted(tried, key=lambda t: t.gain.after)
    best = order[0]
    for other in order[1:]:
        contained = other.effect.axis == best.effect.axis and other.effect.name in best.effect.replaces
        if contained and (
            _difference(prepared, other, best).t < ALIKE_T
            or best.torque**2 - other.torque**2 < (RELATED * other.torque) ** 2
        ):
            rejected[best.effect.key] = (best.effect, f"does no better than {other.effect.name}")
            best = other
    rivals = tuple(t for t in tried if t is not best and not _nested(t.effect, best.effect))
    return Accepted(best, rivals)


def _nested(one: Effect, other: Effect) -> bool:
    return one.axis == other.axis and (one.name in other.replaces or other.name in one.replaces)


def _difference(prepared: Prepared, worse: Tried, better: Tried) -> Comparison:
    parts = [
        prepared.simulator.parts(t.fitted.hypothesis, "unseen") for t in (worse, better)
    ]
    return compared(*parts)


def _kept(accepted: Sequence[Accepted], new: Accepted) -> list[Accepted]:
    """Add a cause; what it contains goes."""
    effect = new.tried.effect
    return [
        a
        for a in accepted
        if not (a.tried.effect.axis == effect.axis and a.tried.effect.name in effect.replaces)
    ] + [new]


def _pruned(
    prepared: Prepared,
    current: Fitted,
    accepted: Sequence[Accepted],
    rejected: dict[object, tuple[Effect, str]],
) -> tuple[Fitted, list[Accepted]]:
    """Take each cause out again; what is not missed goes.  Gains are those beside all others."""
    kept = list(accepted)
    changed = len(kept) > 1
    while changed:
        changed = False
        judgements = []
        parts = prepared.simulator.parts(current.hypothesis, "unseen")
        for a in kept:
            place = _place(current.hypothesis, a.tried.effect)
            less = fit(prepared.simulator, current.hypothesis.without(place), steps=6)
            before = prepared.simulator.parts(less.hypothesis, "unseen")
            gain = compared(before, parts)
            torque = explained_torque(before, parts, a.tried.effect.axis)
            judgements.append((a, less, gain, torque))
        worst = min(judgements, key=lambda j: j[2].t)
        if worst[2].t < ALIKE_T:
            kept.remove(worst[0])
            effect = worst[0].tried.effect
            rejected[effect.key] = (effect, "is not missed once the others are there")
            current, changed = worst[1], len(kept) > 1
        else:
            kept = [
                replace(a, tried=replace(a.tried, gain=gain, torque=torque))
                for a, _, gain, torque in judgements
            ]
    return current, kept


def _tied(
    prepared: Prepared, current: Fitted, accepted: Sequence[Accepted], advance: Advance
) -> tuple[Fitted, list[Accepted]]:
    """Put each rival in its cause's place, everything else fitted beside; what does as well is a tie."""
    out: list[Accepted] = []
    named = {a.tried.effect.key for a in accepted}
    for k, a in enumerate(accepted):
        advance("look for ties", 0.9 + 0.1 * k / len(accepted))
        ties = []
        for rival in a.ties:
            if rival.effect.key in named:
                continue
            place = _place(current.hypothesis, a.tried.effect)
            swapped = current.hypothesis.without(place).with_effect(rival.effect)
            values = rival.fitted.hypothesis.values[rival.place]
            swapped = replace(swapped, values=(*swapped.values[:-1], values))
            fitted = fit(prepared.simulator, swapped)
            before = prepared.simulator.parts(fitted.hypothesis, "unseen")
            after = prepared.simulator.parts(current.hypothesis, "unseen")
            gain = compared(before, after)
            if gain.t < ALIKE_T:
                ties.append(replace(rival, fitted=fitted))
                if gain.after >= gain.before and a.tried.effect.name != "measurement_delay":
                    ties[-1] = replace(a.tried, fitted=current)
                    a = Accepted(replace(rival, fitted=fitted), a.ties)  # noqa: PLW2901
                    current = fitted
        out.append(Accepted(a.tried, tuple(ties)))
    return current, out


def _place(hypothesis: Hypothesis, effect: Effect) -> int:
    keys = [e.key for e in hypothesis.effects]
    return len(keys) - 1 - keys[::-1].index(effect.key)
