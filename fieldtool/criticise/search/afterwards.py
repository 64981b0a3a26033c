"""What has to hold of the causes together: none superfluous, each with its signature, ties named."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

from fieldtool.criticise.effects.base import Effect
from fieldtool.criticise.search.fit import Fitted, fit
from fieldtool.criticise.search.hypothesis import Hypothesis
from fieldtool.criticise.search.judge import axis_power, difference, explained_torque
from fieldtool.criticise.search.prepare import Prepared
from fieldtool.criticise.search.rules import ALIKE_T, Tried
from fieldtool.criticise.search.significance import compared
from fieldtool.criticise.where.views import views_of

SHOWN = 0.3
"""Share of what an effect explains, that the view which it must show has to explain."""
FEW_STEPS = 6

Reasons = dict[object, tuple[Effect, str]]


@dataclass(frozen=True)
class Accepted:
    """A cause with a name, and its rivals that do as well (while searching: that may)."""

    tried: Tried
    ties: tuple[Tried, ...] = ()


def place_of(hypothesis: Hypothesis, effect: Effect) -> int:
    """Return where an effect stands in a hypothesis."""
    keys = [e.key for e in hypothesis.effects]
    return len(keys) - 1 - keys[::-1].index(effect.key)


def pruned(
    prepared: Prepared, current: Fitted, accepted: Sequence[Accepted], rejected: Reasons
) -> tuple[Fitted, list[Accepted]]:
    """Take each cause out again; what is not missed goes.  Gains are those beside all others."""
    kept = list(accepted)
    simulator = prepared.simulator
    while kept:
        parts = simulator.parts(current.hypothesis, "unseen")
        judged = []
        for a in kept:
            effect = a.tried.effect
            less = fit(
                simulator,
                current.hypothesis.without(place_of(current.hypothesis, effect)),
                steps=FEW_STEPS,
            )
            before = simulator.parts(less.hypothesis, "unseen")
            gain = compared(before, parts)
            torque = explained_torque(before, parts, effect.axis)
            why = "" if gain.t >= ALIKE_T else "is not missed once the others are there"
            judged.append((replace(a, tried=replace(a.tried, gain=gain, torque=torque)), less, why))
        worst = min(judged, key=lambda j: j[0].tried.gain.t)
        reason = worst[2]
        if not reason:
            for one in judged:
                reason = unsigned(prepared, current.hypothesis, one[0].tried.effect)
                if reason:
                    worst = one
                    break
        if not reason:
            return current, [a for a, _, _ in judged]
        effect = worst[0].tried.effect
        rejected[effect.key] = (effect, reason)
        kept = [a for a in kept if a.tried.effect.key != effect.key]
        current = worst[1]
    return current, kept


def unsigned(prepared: Prepared, hypothesis: Hypothesis, effect: Effect) -> str:
    """Say so where the error without an effect does not look as the effect must; else empty."""
    if not effect.seen_by:
        return ""
    place = place_of(hypothesis, effect)
    less = replace(
        hypothesis,
        effects=hypothesis.effects[:place] + hypothesis.effects[place + 1 :],
        values=hypothesis.values[:place] + hypothesis.values[place + 1 :],
    )
    power = [
        sum(
            axis_power(prepared.simulator.parts(h, role), effect.axis) for role in ("fit", "unseen")
        )
        for h in (less, hypothesis)
    ]
    explains = max(0.0, 1.0 - power[1] / max(power[0], 1e-300))
    views = views_of(prepared.context(less), effect.axis, effect.seen_by)
    best = max((v.share for v in views), default=0.0)
    if best < SHOWN * explains:
        return f"its signature is not there: the error does not show what {effect.name} must leave"
    return ""


def tied(
    prepared: Prepared, current: Fitted, accepted: Sequence[Accepted]
) -> tuple[Fitted, list[Accepted]]:
    """Put each rival in its cause's place, all else fitted beside; what does as well is a tie.

    Of a delay and what mimics it the delay is named first; else what does best.
    """
    out: list[Accepted] = []
    named = {a.tried.effect.key for a in accepted}
    for a in accepted:
        first, ties = a.tried, list[Tried]()
        for rival in a.ties:
            if rival.effect.key in named:
                continue
            swapped = current.hypothesis.without(place_of(current.hypothesis, first.effect))
            swapped = swapped.with_effect(rival.effect)
            values = rival.fitted.hypothesis.values[rival.place]
            swapped = replace(swapped, values=(*swapped.values[:-1], values))
            fitted = fit(prepared.simulator, swapped)
            gain = difference(prepared.simulator, fitted, current)
            if gain.t >= ALIKE_T:
                continue
            if gain.before <= gain.after and first.effect.name != "measurement_delay":
                ties.append(replace(first, fitted=current))
                first, current = replace(rival, fitted=fitted), fitted
            else:
                ties.append(replace(rival, fitted=fitted))
        out.append(Accepted(first, tuple(ties)))
    return current, out
