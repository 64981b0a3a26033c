"""Machines that are as likely as the model: from its standard errors, within what chains can be."""

from collections.abc import Mapping
from dataclasses import replace
from math import exp, isnan, sqrt
from typing import Any

import numpy as np

from fieldtool.design.machine import is_machine, spring_of
from fieldtool.records.model import Correlation, Estimate, MachineModel

FURTHEST = 2.5
"""Standard errors beyond which nothing is drawn."""
LEAST_MASS, LEAST_SPRING, LEAST_DAMPER = 0.01, 0.01, 0.1
"""Relative errors that are reckoned with at least: a machine is never the model to a thousandth."""
UNKNOWN_MASS, UNKNOWN_SPRING, UNKNOWN_DAMPER = 0.05, 0.05, 0.3
"""Relative errors where the model has none."""
GAP_SHARE = 0.3
"""Of a spring with backlash: how stiff it is for motions a little larger than the gap."""
BENT = 0.2
"""Relative change of a spring that hardens or softens."""
MOST_KNOWN = 2.0
"""Relative error that is reckoned with at most: beyond it nothing but the order of size is known."""
TRIES = 50


def samples_of(model: MachineModel, count: int, rng: np.random.Generator) -> list[MachineModel]:
    """Return ``count`` models drawn from a model's standard errors.

    Errors hang together as the model's correlation says, and are independent where it says nothing.
    Of a number of infinite error nothing but the order of size is known.
    Masses and springs are drawn in their logarithm, so that none becomes negative; couplings so
    that the mass matrix, with its effects, stays positive definite.
    """
    return [_drawn(model, rng) for _ in range(count)]


def corners_of(model: MachineModel) -> list[MachineModel]:
    """Return what effects that are not linear make of a model for some motions.

    ``backlash``: the spring is softer for motions about as large as the gap (its describing
    function).  ``hardening_spring``, ``softening_spring``: a fifth stiffer or softer.
    ``measurement_delay``: in the loop as well as in what the host gets, and not.
    """
    out = []
    for effect in model.effects:
        kind = effect.get("effect")
        if kind == "backlash":
            out.append(_with_spring(model, effect, GAP_SHARE))
        elif kind == "hardening_spring":
            out.append(_with_spring(model, effect, 1 + BENT))
        elif kind == "softening_spring":
            out.append(_with_spring(model, effect, 1 - BENT))
    return out


def _with_spring(model: MachineModel, effect: Mapping[str, Any], factor: float) -> MachineModel:
    axis, k = spring_of(model, effect)
    chain = model.axes[axis]
    if not chain.springs:
        return model
    springs = list(chain.springs)
    springs[k] = replace(springs[k], value=springs[k].value * factor)
    axes = list(model.axes)
    axes[axis] = replace(chain, springs=tuple(springs))
    return replace(model, axes=tuple(axes))


def _drawn(model: MachineModel, rng: np.random.Generator) -> MachineModel:
    for _ in range(TRIES):
        drawn = model.with_numbers(_numbers(model, rng))
        if is_machine(drawn):
            return drawn
    return model


def _numbers(model: MachineModel, rng: np.random.Generator) -> dict[str, Estimate]:
    """Draw every number of a model; those that are 0 stay."""
    numbers = {name: one for name, one in model.numbers.items() if one.value != 0.0}
    normal = {name: _normal(rng) for name in numbers}
    if model.correlation is not None:
        normal |= _together(model.correlation, rng)
    out = {}
    for name, one in numbers.items():
        least, unknown = _floors(name)
        known = unknown if isnan(one.std) else min(one.std / abs(one.value), MOST_KNOWN)
        besides = sqrt(max(least**2 - known**2, 0.0))
        off = known * normal[name] + besides * _normal(rng)
        factor = 1 + off if name.startswith("coupling") else exp(off)
        out[name] = replace(one, value=one.value * factor)
    return out


def _floors(name: str) -> tuple[float, float]:
    """Return the least relative error of a number, and that where the model does not tell."""
    if ".spring[" in name:
        return LEAST_SPRING, UNKNOWN_SPRING
    if ".mass[" in name or name.startswith("coupling"):
        return LEAST_MASS, UNKNOWN_MASS
    return LEAST_DAMPER, UNKNOWN_DAMPER


def _together(correlation: Correlation, rng: np.random.Generator) -> dict[str, float]:
    """Draw normal numbers with these correlations."""
    values, vectors = np.linalg.eigh(correlation.matrix)
    roots = np.sqrt(np.maximum(values, 0.0))  # rounded numbers may leave it a little below 0
    drawn = vectors @ (roots * np.array([_normal(rng) for _ in values]))
    return dict(zip(correlation.names, drawn.tolist(), strict=True))


def _normal(rng: np.random.Generator) -> float:
    return float(np.clip(rng.standard_normal(), -FURTHEST, FURTHEST))
