"""What each candidate could gain, by its linear part: cheap, so that only the best are fitted."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fieldtool.criticise.effects.base import Effect
from fieldtool.criticise.search.fit import machine_derivatives
from fieldtool.criticise.search.hypothesis import Hypothesis, Simulator
from fieldtool.criticise.search.instants import instants
from fieldtool.criticise.search.modes import best_mode

FloatArray = NDArray[np.float64]
MOST_OF_IT = (0.0, 2.0)
"""Bounds of how much of a start value's torque the data may ask for."""
SOONER = (1 / 8, 1 / 16, 1 / 32)
"""Of an experiment: how far from where it was tried a change may be."""
WORTH = 0.003
"""Share of the error that a change explains, from which its time is looked for."""
EXPLAINED = 0.5
"""Share of the error that the best candidate is expected to explain, from which they are not."""
LINEAR = 0.6
"""Share of the time that derivatives take, where changes are simulated after them."""
SMALLEST_PART = 0.02
"""Of a start value, that is left of it at least."""


@dataclass(frozen=True, eq=False)
class Screened:
    """One candidate with better start values."""

    effect: Effect
    start: dict[str, float]
    gain: float
    """Expected fall of the sum of squares of the weighted errors that may be seen."""


@dataclass(frozen=True, eq=False)
class Tangent:
    """A hypothesis and its derivatives."""

    hypothesis: Hypothesis
    residual: FloatArray
    of_machine: FloatArray
    """(rows, V), per scale of each variable."""
    basis: FloatArray
    """Orthonormal, spans what the machine's numbers can do; with rows for what is known of them."""
    side: FloatArray
    """The residual with the same rows, outside of the basis."""


def tangent(simulator: Simulator, hypothesis: Hypothesis) -> Tangent:
    """Linearise a hypothesis about its values."""
    r = simulator.residual(hypothesis, "fit")
    jacobian = machine_derivatives(simulator, hypothesis)
    on = np.array([name not in hypothesis.off for name in hypothesis.machine.names])
    known = np.array([1.0 / v.known for v in hypothesis.machine.variables])
    rows = np.vstack([jacobian[:, on], np.diag(known[on])])
    size = np.linalg.norm(rows, axis=0)
    size[size == 0.0] = 1.0
    basis, triangle = np.linalg.qr(rows / size)
    basis = basis[:, np.abs(np.diag(triangle)) > 1e-10]
    side = np.concatenate([r, np.zeros(int(on.sum()))])
    side = side - basis @ (basis.T @ side)
    return Tangent(hypothesis, r, jacobian, basis, side)


def screened(
    simulator: Simulator,
    at: Tangent,
    candidates: Sequence[Effect],
    advance: Callable[[float], None],
) -> list[Screened]:
    """Return the candidates by falling gain, for each place of each effect the best start only."""
    best: dict[object, Screened] = {}
    for k, candidate in enumerate(candidates):
        advance(LINEAR * k / max(len(candidates), 1))
        effect = candidate
        if effect.name == "extra_mode":
            effect = best_mode(simulator, at.hypothesis, at.side, at.basis, effect)
        one = _screen(simulator, at, effect)
        if one is not None and (effect.key not in best or one.gain > best[effect.key].gain):
            best[effect.key] = one
    for key, one in best.items():
        if one.effect.name == "stiffness_change":
            best[key] = _in_time(simulator, at, one)
    cost = float(at.side @ at.side)
    if all(b.gain < EXPLAINED * cost for b in best.values()):
        for k, (key, one) in enumerate(best.items()):
            advance(LINEAR + (1.0 - LINEAR) * k / len(best))
            best[key] = _far(simulator, at, one)
    return sorted(best.values(), key=lambda s: -s.gain)


def _in_time(simulator: Simulator, at: Tangent, one: Screened) -> Screened:
    """Return the same change sooner or later, where more is gained."""
    longest = max(m.rows * m.step for m in simulator.motions.values())
    if one.gain < WORTH * float(at.side @ at.side):
        return one
    for reach in SOONER:
        times = [one.start["time"] + sign * reach * longest for sign in (-1.0, 1.0)]
        for time in times:
            parameters = tuple(
                replace(p, start=p.clipped(time)) if p.name == "time" else p
                for p in one.effect.parameters
            )
            moved = _screen(simulator, at, replace(one.effect, parameters=parameters))
            if moved is not None and moved.gain > one.gain:
                one = moved
    return one


def _far(simulator: Simulator, at: Tangent, one: Screened) -> Screened:
    """Return a start that is too far off for derivatives, simulated, where more is gained."""
    grown = at.hypothesis.with_effect(one.effect)
    cost = float(at.side @ at.side)
    for start in one.effect.far(instants(simulator)):
        r = simulator.residual(replace(grown, values=(*grown.values[:-1], start)), "fit")
        gain = cost - float(r @ r)
        if gain > one.gain:  # what is not finite is not larger
            one = replace(one, start=start, gain=gain)
    return one


def _screen(simulator: Simulator, at: Tangent, effect: Effect) -> Screened | None:
    grown = at.hypothesis.with_effect(effect)
    place = len(grown.effects) - 1
    start = dict(grown.values[place])
    if effect.unknown(next(iter(simulator.motions.values())), start):
        r = simulator.residual(grown, "fit")
        gain = float(at.residual @ at.residual - r @ r)
        return Screened(effect, start, gain)
    linear = [p for p in effect.parameters if p.linear]
    # What an effect replaces is taken out of the residual it starts from.
    r = simulator.residual(grown, "fit") if grown.off != at.hypothesis.off or len(
        grown.effects
    ) <= len(at.hypothesis.effects) else at.residual  # fmt: skip
    columns, low, high = [], [], []
    for p in linear:
        values = [dict(v) for v in grown.values]
        # A spring that softens is no spring on the other side of 0.
        step = p.scale if p.clipped(p.scale) > 0.0 else -p.scale
        values[place][p.name] = step
        moved = Hypothesis(grown.machine, grown.base, grown.effects, tuple(values))
        columns.append((simulator.residual(moved, "fit") - r) / step)
        low.append(p.low)
        high.append(p.high)
    if not linear:
        column = simulator.residual(grown, "fit") - at.residual
        lowest, highest = MOST_OF_IT
        if effect.name == "torque_scale":
            p = effect.parameters[0]
            start[p.name] = p.start + 0.1 * p.scale
            moved = Hypothesis(
                grown.machine, grown.base, grown.effects, (*grown.values[:-1], start)
            )
            column = (simulator.residual(moved, "fit") - at.residual) / (0.1 * p.scale)
            lowest, highest = -0.5, 0.5
        columns, low, high = [column], [lowest], [highest]
    if not all(np.all(np.isfinite(c)) for c in columns):
        return None
    return _solved(at, effect, start, r, np.column_stack(columns), np.array(low), np.array(high))


def _solved(
    at: Tangent,
    effect: Effect,
    start: dict[str, float],
    r: FloatArray,
    columns: FloatArray,
    low: FloatArray,
    high: FloatArray,
) -> Screened | None:
    """Solve for the linear numbers beside the machine's; what leaves its bounds stays on them."""
    more = at.basis.shape[0] - r.size
    rows = np.vstack([columns, np.zeros((more, columns.shape[1]))])
    rows -= at.basis @ (at.basis.T @ rows)
    side = np.concatenate([r, np.zeros(more)])
    side -= at.basis @ (at.basis.T @ side)
    size = np.linalg.norm(rows, axis=0)
    active = size > 1e-9 * max(float(np.linalg.norm(columns)), 1e-300)
    values = np.zeros(columns.shape[1])
    for _ in range(columns.shape[1]):
        if not active.any():
            return None
        solved = -np.linalg.lstsq(rows[:, active] / size[active], side, rcond=1e-10)[0]
        values[:] = 0.0
        values[active] = solved / size[active]
        outside = (values < low) | (values > high)
        if not outside.any():
            break
        active &= ~outside
    values = np.clip(values, low, high)
    left = side + rows @ values
    # The gain is counted from what was there, with what the effect replaces still in place.
    gain = float(at.side @ at.side - left @ left)
    linear = [p.name for p in effect.parameters if p.linear]
    start = dict(start)
    if linear:
        start |= dict(zip(linear, values.tolist(), strict=True))
    elif effect.name == "torque_scale":
        start[effect.parameters[0].name] = 1.0 + float(values[0])
    elif effect.name == "backlash":
        # A gap small against the motion takes a torque away that grows with it.
        start["half_gap"] *= max(float(values[0]), SMALLEST_PART)
    return Screened(effect, start, gain)
