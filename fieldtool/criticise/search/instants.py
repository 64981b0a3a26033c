"""When something changed: the time of a step is no number that derivatives lead to, so it is tried."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from fieldtool.criticise.search.fit import Fitted, fit
from fieldtool.criticise.search.hypothesis import Hypothesis, Simulator

FloatArray = NDArray[np.float64]
PARTS = 20
"""Instants of an experiment that are tried, and again around the best of them to either side."""
AGAIN = 3
"""Times at most that the rest is fitted beside a better instant."""


def timed(simulator: Simulator, fitted: Fitted, place: int) -> Fitted:
    """Return a fit with the instant of one effect at which least is left, where that is another.

    Parameters
    ----------
    simulator : Simulator
    fitted : Fitted
    place : int
        Of an effect with a number named ``time``, s.
    """
    seen = {lines.span.experiment for lines in simulator.lines if lines.span.role == "fit"}
    for _ in range(AGAIN):
        if not np.isfinite(fitted.cost):
            break
        now = fitted.hypothesis.values[place]["time"]
        around = [
            m
            for name, m in simulator.motions.items()
            if name in seen and m.clock[0] <= now <= m.clock[-1]
        ]
        if not around:
            break
        best = (fitted.cost, now)
        step = (around[0].clock[-1] - around[0].clock[0]) / PARTS
        coarse = [m.clock[0] + step * np.arange(PARTS) for m in around]
        best = min(best, _least(simulator, fitted, place, np.concatenate(coarse)))
        # What a changed spring rings with has a minimum every half cycle.
        fine = best[1] + step * np.linspace(-1.0, 1.0, 2 * PARTS + 1)
        best = min(best, _least(simulator, fitted, place, fine))
        if not best[0] < fitted.cost:
            break
        better = fit(simulator, _moved(fitted.hypothesis, place, best[1]))
        if not better.cost < fitted.cost:
            break
        fitted = better
    return fitted


def _least(
    simulator: Simulator, fitted: Fitted, place: int, times: FloatArray
) -> tuple[float, float]:
    """Return the least cost and its instant, all other numbers as they are."""
    tried = [(float(t), _moved(fitted.hypothesis, place, float(t))) for t in times]
    return min((float(np.sum(simulator.residual(h, "fit") ** 2)), t) for t, h in tried)


def _moved(hypothesis: Hypothesis, place: int, time: float) -> Hypothesis:
    values = list(hypothesis.values)
    values[place] = {**values[place], "time": time}
    return replace(hypothesis, values=tuple(values))
