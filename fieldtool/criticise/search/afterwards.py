"""What has to hold of the causes together: none superfluous, each with its signature, ties named."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from fieldtool.criticise.effects.base import Effect
from fieldtool.criticise.effects.friction import friction_candidates
from fieldtool.criticise.search.fit import EXACTLY, Fitted, fit
from fieldtool.criticise.search.hypothesis import Hypothesis
from fieldtool.criticise.search.instants import tried_unseen
from fieldtool.criticise.search.judge import (
    at_noise,
    difference,
    explained_share,
    explained_torque,
    moved,
    relative_errors,
)
from fieldtool.criticise.search.machine import Variable
from fieldtool.criticise.search.prepare import Prepared
from fieldtool.criticise.search.rules import (
    ALIKE_T,
    BESIDE_NOISE,
    LEAST_TORQUE,
    LEFT,
    LESS_MOVED,
    STAYED,
    Tried,
    related,
    tolerance,
)
from fieldtool.criticise.search.significance import compared
from fieldtool.criticise.where.sentences import relative_noise
from fieldtool.criticise.where.views import views_of

SHOWN = 0.3
"""Share of what an effect explains, that the view which it must show has to explain."""
NEARLY_ALL = 0.95
"""Share of what is left on unseen data, from which an effect is its own signature."""
FEW_STEPS = 6
MOST_OF_IT = 0.5
"""Share of what is wrong of an axis, noise taken off, that its causes explain together at least."""
SHOWN_STILL = 0.2
"""Share of what a cause leaves, that looks as it must look itself, from which its form is another."""
FRICTION = ("speed", "direction")
FALSE_ZERO = 3.0
"""Standard errors with which a torque's zero is known, from which it is not likely."""
OFF_ZERO = 3.0
"""Standard errors of a torque's zero, from which friction may differ between the directions instead."""
DIRECTIONS = ("coulomb_friction", "asymmetric_friction")

Reasons = dict[object, tuple[Effect, str]]


@dataclass(frozen=True)
class Accepted:
    """A cause with a name, and its rivals that do as well (while searching: that may)."""

    tried: Tried
    ties: tuple[Tried, ...] = ()


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
                current.hypothesis.without(current.hypothesis.place_of(effect)),
                steps=FEW_STEPS,
            )
            before = simulator.parts(less.hypothesis, "unseen")
            gain = compared(before, parts).best_of(
                tried_unseen(simulator, current.hypothesis, effect)
            )
            torque = explained_torque(before, parts, effect.axis)
            why = "" if gain.t >= ALIKE_T else "is not missed once the others are there"
            if torque < LEAST_TORQUE:
                why = "lowers no error on unseen data once the others are there"
            share = explained_share(before, parts, _axes_of(effect))
            beside = replace(
                a.tried, gain=gain, torque=torque, share=share, at_noise=at_noise(parts)
            )
            judged.append((replace(a, tried=beside), less, why))
        worst = min(judged, key=lambda j: j[0].tried.gain.t)
        reason = worst[2]
        if not reason:
            for one in judged:
                tried = one[0].tried
                reason = unsigned(prepared, current.hypothesis, tried.effect, tried.share)
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


def _axes_of(effect: Effect) -> list[int]:
    return [effect.axis] if effect.other is None else [effect.axis, effect.other]


def unsigned(prepared: Prepared, hypothesis: Hypothesis, effect: Effect, share: float) -> str:
    """Say so where the error without an effect does not look as the effect must; else empty.

    What explains nearly all that was left on unseen data, ``share`` of it, needs no other sign: views
    are smooth in frequency, and a delay of an elastic axis is not.
    """
    if not effect.seen_by or share >= NEARLY_ALL:
        return ""
    place = hypothesis.place_of(effect)
    less = replace(
        hypothesis,
        effects=hypothesis.effects[:place] + hypothesis.effects[place + 1 :],
        values=hypothesis.values[:place] + hypothesis.values[place + 1 :],
    )
    # Both shares are of the same errors, all rows counted alike: noise does not weigh them.
    contexts = [prepared.context(h) for h in (less, hypothesis)]
    power = [sum(float(np.sum(e[:, effect.axis] ** 2)) for e in c.errors) for c in contexts]
    explains = max(0.0, 1.0 - power[1] / max(power[0], 1e-300))
    views = views_of(contexts[0], effect.axis, effect.seen_by)
    best = max((v.share for v in views), default=0.0)
    if best < SHOWN * explains:
        return f"its signature is not there: the error does not show what {effect.name} must leave"
    return ""


def tied(
    prepared: Prepared,
    current: Fitted,
    accepted: Sequence[Accepted],
    without: frozenset[str] = frozenset(),
) -> tuple[Fitted, list[Accepted]]:
    """Put each rival in its cause's place, all else fitted beside; what does as well is a tie.

    Of a delay and what mimics it the delay is named first; else what does best.
    """
    if "asymmetric_friction" not in without:
        current, accepted = with_directions(prepared, current, accepted)
    simulator, out = prepared.simulator, list[Accepted]()
    named = {a.tried.effect.key for a in accepted}
    for a in accepted:
        first, ties = a.tried, [t for t in a.ties if _of_directions(a.tried, t)]
        for rival in a.ties:
            if rival.effect.key in named or rival in ties:
                continue
            swapped = current.hypothesis.without(current.hypothesis.place_of(first.effect))
            swapped = swapped.with_effect(rival.effect)
            values = rival.fitted.hypothesis.values[rival.place]
            swapped = replace(swapped, values=(*swapped.values[:-1], values))
            if len(rival.fitted.hypothesis.effects) == len(swapped.effects):
                swapped = replace(swapped, base=rival.fitted.hypothesis.base)
            fitted = fit(prepared.simulator, swapped)
            clean = any(
                at_noise(simulator.parts(f.hypothesis, "unseen")) for f in (fitted, current)
            )
            sure = clean and first.effect.exact and rival.effect.exact
            enough = tolerance(first.gain, sure)
            worse = difference(prepared.simulator, fitted, current)
            if worse.t >= ALIKE_T and worse.before - worse.after > enough:
                continue
            ahead = replace(first.gain, after=worse.before)
            behind = difference(prepared.simulator, current, fitted)
            lost = behind.t >= ALIKE_T and behind.before - behind.after > tolerance(ahead, sure)
            if lost and first.effect.name == "measurement_delay":
                # It went first while other causes were not known, and is not as good beside them.
                first, current = replace(rival, fitted=fitted, gain=ahead), fitted
                continue
            delayed = (
                rival.effect.name == "measurement_delay" and rival.effect.axis == first.effect.axis
            )
            if delayed or (
                first.effect.name != "measurement_delay"
                and _preferred(prepared, fitted, current, enough)
            ):
                ties.append(replace(first, fitted=current))
                first, current = replace(rival, fitted=fitted), fitted
            else:
                ties.append(replace(rival, fitted=fitted))
        out.append(Accepted(first, tuple(ties)))
    return current, out


def _of_directions(one: Tried, other: Tried) -> bool:
    """Whether two are friction on a false zero, and friction that differs between the directions."""
    names = {one.effect.name, other.effect.name}
    return names == set(DIRECTIONS) and one.effect.axis == other.effect.axis


def _preferred(prepared: Prepared, rival: Fitted, first: Fitted, enough: float) -> bool:
    """Whether a rival stands before the first: clearly better, or as good and the machine as it was."""
    there, here = (moved(f, prepared.accepted) for f in (rival, first))
    if max(there, here) > STAYED and not here / LESS_MOVED < there < here * LESS_MOVED:
        return there < here
    better = difference(prepared.simulator, first, rival)
    return better.t >= ALIKE_T and better.before - better.after > enough


def with_directions(
    prepared: Prepared, current: Fitted, accepted: Sequence[Accepted]
) -> tuple[Fitted, list[Accepted]]:
    """Add friction that differs between the directions, as a rival of dry friction on a false zero.

    Friction F+ forward and F- backward is dry friction of (F+ + F-) / 2 and a constant (F+ - F-) / 2.
    """
    out: list[Accepted] = []
    for a in accepted:
        effect = a.tried.effect
        name = f"{prepared.recording.names[effect.axis]}.offset"
        known = effect.name == "coulomb_friction" and effect.location == "motor"
        if not known or name not in current.names:
            out.append(a)
            continue
        k = current.names.index(name)
        off = float(current.values[k])
        kinds = friction_candidates(prepared.context(current.hypothesis))
        rival = next(e for e in kinds if e.name == "asymmetric_friction" and e.axis == effect.axis)
        if abs(off) < OFF_ZERO * current.std[k]:
            out.append(a)
            continue
        place = current.hypothesis.place_of(effect)
        values, machine = current.hypothesis.values[place], current.hypothesis.machine
        names = prepared.recording.names[effect.axis]
        wet = dict(zip(machine.names, current.hypothesis.base, strict=True))
        swapped = current.hypothesis.without(place).with_effect(rival)
        start = {
            "coulomb_positive": values["torque"] + off,
            "coulomb_negative": values["torque"] - off,
            "viscous_positive": wet.get(f"{names}.viscous_friction", 0.0),
            "viscous_negative": wet.get(f"{names}.viscous_friction", 0.0),
            "presliding": values["presliding"],
            "rounding": values["rounding"],
        }
        base = swapped.base.copy()
        base[machine.names.index(name)] = 0.0
        swapped = replace(swapped, base=base, values=(*swapped.values[:-1], start))
        fitted = fit(prepared.simulator, swapped, enough=EXACTLY)
        worse = difference(prepared.simulator, fitted, current)
        lost = worse.t >= ALIKE_T and worse.before - worse.after > tolerance(a.tried.gain)
        if lost or rival.implausible(
            fitted.hypothesis.values[-1], prepared.context(fitted.hypothesis)
        ):
            out.append(a)
            continue
        other = replace(a.tried, effect=rival, fitted=fitted)
        if _rather_directions(off, machine.variables[machine.names.index(name)], values["torque"]):
            out.append(Accepted(other, (replace(a.tried, fitted=current), *a.ties)))
            current = fitted
        else:
            out.append(Accepted(a.tried, (other, *a.ties)))
    return current, out


def _rather_directions(off: float, zero: Variable, friction: float) -> bool:
    """Whether a constant torque is more likely of friction's directions than of a false zero.

    A false zero is normal with the standard error that zeros have; what directions make of it is
    anything up to the friction itself.  Both densities are compared.
    """
    known = zero.scale * zero.known
    odds = np.log(max(2.0 * friction / (known * np.sqrt(2.0 * np.pi)), 1e-300))
    return abs(off) > known and 0.5 * (off / known) ** 2 > odds


def convincing(
    prepared: Prepared,
    before: Fitted,
    current: Fitted,
    accepted: Sequence[Accepted],
    rejected: Reasons,
) -> tuple[Fitted, list[Accepted]]:
    """Give no name on an axis where its causes leave what they should explain.

    Whatever is left there would bend their numbers, and may be what they stand in for.  All causes
    together explain most of what is wrong; and what their forms should, or what they leave does at
    least not look as one of them must look itself.
    """
    kept = list(accepted)
    first = prepared.simulator.parts(before.hypothesis, "unseen")
    there = relative_errors(first)
    for axis in range(there.size):
        noise = relative_noise(first, axis)
        alone = [a for a in kept if a.tried.effect.axis == axis and a.tried.effect.other is None]
        if noise is None or there[axis] <= noise**2 or not alone:
            continue
        last = prepared.simulator.parts(current.hypothesis, "unseen")
        left, level = relative_errors(last)[axis], relative_noise(last, axis) or noise
        share = (there[axis] - left) / (there[axis] - noise**2)
        others = [a for a in kept if axis in _axes_of(a.tried.effect) and a not in alone]
        effects = [a.tried.effect for a in (*alone, *others)]
        poor = share < float(np.prod([e.fits for e in effects]))
        poor = poor and left > BESIDE_NOISE * level**2 and left - level**2 > LEFT**2
        poor = poor and any(_looks(prepared, current, e) for e in effects)
        poor = poor or (len(effects) == 1 and _asks_for_zero(prepared, current, effects[0]))
        if share >= MOST_OF_IT and not poor:
            continue
        for a in alone:
            effect = a.tried.effect
            why = (
                f"explains no more than {100 * max(share, 0.0):.0f} % of what is wrong of its axis"
            )
            rejected[effect.key] = (effect, why)
            kept.remove(a)
            less = current.hypothesis.without(current.hypothesis.place_of(effect))
            current = fit(prepared.simulator, less)
    return current, kept


def _asks_for_zero(prepared: Prepared, current: Fitted, effect: Effect) -> bool:
    """Whether dry friction needs a zero of the torque that is not likely: its directions may differ."""
    if effect.name != DIRECTIONS[0] or effect.location != "motor":
        return False
    machine = current.hypothesis.machine
    name = f"{prepared.recording.names[effect.axis]}.offset"
    k = machine.names.index(name)
    zero = machine.variables[k]
    return abs(float(current.hypothesis.base[k])) > FALSE_ZERO * zero.scale * zero.known


def _looks(prepared: Prepared, current: Fitted, effect: Effect) -> bool:
    """Whether what is left beside a cause looks as it must look itself; an exact form leaves nothing."""
    if effect.exact or not effect.seen_by:
        return True
    # Friction of another form than that of the cause shows in the other one of its views.
    shown = FRICTION if related(effect.name, "viscous_friction") else effect.seen_by
    views = views_of(prepared.context(current.hypothesis), effect.axis, shown)
    return max((v.share for v in views), default=0.0) >= SHOWN_STILL


def unharmful(
    prepared: Prepared,
    before: Fitted,
    current: Fitted,
    accepted: Sequence[Accepted],
    rejected: Reasons,
) -> tuple[Fitted, list[Accepted]]:
    """Take causes out, the least first, until the error on unseen data is not larger than before."""
    kept = list(accepted)
    allowed = relative_errors(prepared.simulator.parts(before.hypothesis, "unseen")).sum()
    while kept:
        reached = relative_errors(prepared.simulator.parts(current.hypothesis, "unseen")).sum()
        if reached < allowed:
            break
        least = min(kept, key=lambda a: a.tried.gain.t)
        effect = least.tried.effect
        rejected[effect.key] = (effect, "the error on unseen data would be larger with it")
        kept.remove(least)
        place = current.hypothesis.place_of(effect)
        current = fit(prepared.simulator, current.hypothesis.without(place))
    return current, kept
