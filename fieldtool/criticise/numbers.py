"""The numbers of a cause, as they are reported, with standard errors."""

from collections.abc import Mapping, Sequence

import numpy as np

from fieldtool.criticise.criticism import Number
from fieldtool.criticise.effects.base import Effect
from fieldtool.criticise.search.fit import Fitted

WITH_ZERO = ("coulomb_positive", "coulomb_negative")
"""Numbers that are as wrong as the zero of the torque's measurement where no offset is fitted beside."""
UNDETERMINED = 3.0
"""Relative standard error from which it is said that a number is not known."""


def numbers_of(fitted: Fitted, effect: Effect) -> Mapping[str, Number]:
    """Return the numbers of a cause with standard errors, by first-order propagation."""
    place = fitted.hypothesis.place_of(effect)
    effect = fitted.hypothesis.effects[place]
    values = dict(fitted.hypothesis.values[place])
    lead = f"{place}:{effect.name}."
    index = {n.removeprefix(lead): k for k, n in enumerate(fitted.names) if n.startswith(lead)}
    out = {}
    for name, (value, unit, depends) in effect.plain(values).items():
        free = [d for d in depends if d in index]
        if not free:
            out[name] = Number(float(value), float("nan"), unit)
            continue
        gradient = []
        for d in free:
            step = 1e-4 * max(abs(values[d]), 1e-12)
            moved = effect.plain({**values, d: values[d] + step})[name][0]
            gradient.append((moved - value) / step)
        rows = [index[d] for d in free]
        g = np.array(gradient)
        variance = float(g @ fitted.covariance[np.ix_(rows, rows)] @ g)
        variance += _of_zero(fitted, effect, free)
        std = float(np.sqrt(max(variance, 0.0)))
        if not std < UNDETERMINED * max(abs(float(value)), 1e-300):
            std = float("nan")
        out[name] = Number(float(value), std, unit)
    return out


def _of_zero(fitted: Fitted, effect: Effect, free: Sequence[str]) -> float:
    """Return the variance that the zero of the torque's measurement adds where an effect contains it."""
    machine = fitted.hypothesis.machine
    name = f"{machine.model.names[effect.axis]}.offset"
    if "offset" not in effect.replaces or not set(free) & set(WITH_ZERO):
        return 0.0
    zero = machine.variables[machine.names.index(name)]
    return float(zero.scale * zero.known) ** 2
