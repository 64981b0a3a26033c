"""When something changed: the time of a step is no number that derivatives lead to, so it is tried."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from fieldtool.criticise.effects.base import Effect
from fieldtool.criticise.evidence.spans import Role
from fieldtool.criticise.search.fit import Fitted, fit
from fieldtool.criticise.search.hypothesis import Hypothesis, Simulator
from fieldtool.criticise.simulate.motion import Motion

FloatArray = NDArray[np.float64]
TIMED = "stiffness_change"
"""The effect that begins at an instant, its number ``time``, s."""
PARTS = 20
"""Instants of an experiment that are tried, and again around the best of them to either side."""
MOST = 16
"""Instants that are tried of a whole recording."""
AGAIN = 3
"""Times at most that the rest is fitted beside a better instant."""


def instants(simulator: Simulator) -> list[float]:
    """Return instants, s, of which no two are alike to the rows of role ``fit``.

    Three within each experiment that is seen, and one in each gap between two of them; MOST of all.
    """
    seen = _seen(simulator)
    within = [m.clock[0] + s * (m.clock[-1] - m.clock[0]) for m in seen for s in (0.25, 0.5, 0.75)]
    times = sorted(float(t) for t in [*within, *(m.clock[0] for m in seen[1:])])
    return times if len(times) <= MOST else [times[k * len(times) // MOST] for k in range(MOST)]


def timed(simulator: Simulator, fitted: Fitted) -> Fitted:
    """Return a fit with the instant of its last effect at which least is left, where that is another.

    Effects without an instant are left as they are.
    """
    place = len(fitted.hypothesis.effects) - 1
    if fitted.hypothesis.effects[place].name != TIMED:
        return fitted
    return _between(simulator, _within(simulator, fitted, place), place)


def _within(simulator: Simulator, fitted: Fitted, place: int) -> Fitted:
    """Return the fit with the best instant of the experiment in which it is; by what is seen."""
    seen = _seen(simulator)
    for _ in range(AGAIN):
        if not np.isfinite(fitted.cost):
            break
        now = fitted.hypothesis.values[place]["time"]
        around = [m for m in seen if m.clock[0] <= now <= m.clock[-1]]
        if not around:
            break
        best = _best(simulator, fitted, place, around, ("fit",))
        if not best[0] < fitted.cost:
            break
        better = fit(simulator, _moved(fitted.hypothesis, place, best[1]))
        if not better.cost < fitted.cost:
            break
        fitted = better
    return fitted


def tried_unseen(simulator: Simulator, hypothesis: Hypothesis, effect: Effect) -> int:
    """Return among how many instants unseen data chose that of an effect: 1 if they did not."""
    if effect.name != TIMED:
        return 1
    now = hypothesis.values[hypothesis.place_of(effect)]["time"]
    between = len(_no_matter(simulator, now))
    return between * PARTS + 2 * PARTS + 2 if between else 1


def _between(simulator: Simulator, fitted: Fitted, place: int) -> Fitted:
    """Return the fit with an instant that lies between what was seen where all data have it.

    It is no matter to the fit.
    """
    if not np.isfinite(fitted.cost):
        return fitted
    between = _no_matter(simulator, fitted.hypothesis.values[place]["time"])
    if not between:
        return fitted
    _, now = _best(simulator, fitted, place, between, ("fit", "unseen"))
    return replace(fitted, hypothesis=_moved(fitted.hypothesis, place, now))


def _no_matter(simulator: Simulator, now: float) -> list[Motion]:
    """Return the motions within which an instant is no matter to the fit, and may lie as well as now."""
    seen = _seen(simulator)
    compared = [
        (m.clock[lines.span.start], m.clock[lines.span.stop - 1])
        for lines in simulator.lines
        if lines.span.role == "fit"
        for m in [simulator.motions[lines.span.experiment]]
    ]
    # A change at the very end or beginning of what is seen is as one beyond it.
    edge = max((m.clock[-1] - m.clock[0] for m in seen), default=0.0) / PARTS
    first = max((stop for _, stop in compared if stop - edge <= now), default=-np.inf)
    last = min((start for start, _ in compared if start + edge >= now), default=np.inf)
    if any(first < start and stop < last for start, stop in compared):
        return []
    return [m for m in simulator.motions.values() if first < m.clock[0] and m.clock[-1] < last]


def _seen(simulator: Simulator) -> list[Motion]:
    """Return the motions of which any rows are of role ``fit``, as time goes."""
    names = {lines.span.experiment for lines in simulator.lines if lines.span.role == "fit"}
    return sorted(
        (m for name, m in simulator.motions.items() if name in names), key=lambda m: m.clock[0]
    )


def _best(
    simulator: Simulator, fitted: Fitted, place: int, around: list[Motion], roles: Sequence[Role]
) -> tuple[float, float]:
    """Return the least cost and its instant, of all in some motions and now."""
    now = fitted.hypothesis.values[place]["time"]
    coarse = [np.linspace(m.clock[0], m.clock[-1], PARTS, endpoint=False) for m in around]
    step = max((m.clock[-1] - m.clock[0]) / PARTS for m in around)
    best = _least(simulator, fitted, place, np.concatenate([[now], *coarse]), roles)
    # What a changed spring rings with has a minimum every half cycle.
    fine = best[1] + step * np.linspace(-1.0, 1.0, 2 * PARTS + 1)
    return min(best, _least(simulator, fitted, place, fine, roles))


def _least(
    simulator: Simulator, fitted: Fitted, place: int, times: FloatArray, roles: Sequence[Role]
) -> tuple[float, float]:
    """Return the least cost and its instant, all other numbers as they are."""
    tried = [(float(t), _moved(fitted.hypothesis, place, float(t))) for t in times]
    return min(
        (sum(float(np.sum(simulator.residual(h, role) ** 2)) for role in roles), t)
        for t, h in tried
    )


def _moved(hypothesis: Hypothesis, place: int, time: float) -> Hypothesis:
    values = list(hypothesis.values)
    values[place] = {**values[place], "time": time}
    return replace(hypothesis, values=tuple(values))
