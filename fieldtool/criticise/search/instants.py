"""When something changed: the time of a step is no number that derivatives lead to, so it is tried."""

from dataclasses import replace

import numpy as np

from fieldtool.criticise.search.fit import Fitted, fit
from fieldtool.criticise.search.hypothesis import Hypothesis, Simulator

PARTS = 20
"""Instants of an experiment that are tried."""
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
        tried = [
            _moved(fitted.hypothesis, place, float(t))
            for m in around
            for t in np.linspace(m.clock[0], m.clock[-1], PARTS + 1)[:-1]
        ]
        costs = [float(np.sum(simulator.residual(h, "fit") ** 2)) for h in tried]
        if not costs or not min(costs) < fitted.cost:
            break
        better = fit(simulator, tried[int(np.argmin(costs))])
        if not better.cost < fitted.cost:
            break
        fitted = better
    return fitted


def _moved(hypothesis: Hypothesis, place: int, time: float) -> Hypothesis:
    values = list(hypothesis.values)
    values[place] = {**values[place], "time": time}
    return replace(hypothesis, values=tuple(values))
