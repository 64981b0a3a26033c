"""Machines that are as likely as the model: from its standard errors, within what chains can be."""

from collections.abc import Mapping
from dataclasses import replace
from math import isfinite
from typing import Any

import numpy as np

from fieldtool.design.machine import spring_of
from fieldtool.records.model import AxisModel, Coupling, Estimate, MachineModel

FURTHEST = 2.5
"""Standard errors beyond which nothing is drawn."""
LEAST_MASS, LEAST_SPRING, LEAST_DAMPER = 0.01, 0.01, 0.1
"""Relative errors that are reckoned with at least: a machine is never the model to a thousandth."""
UNKNOWN_MASS, UNKNOWN_SPRING, UNKNOWN_DAMPER = 0.05, 0.05, 0.3
"""Relative errors where the model does not tell."""
GAP_SHARE = 0.3
"""Of a spring with backlash: how stiff it is for motions a little larger than the gap."""
BENT = 0.2
"""Relative change of a spring that hardens or softens."""
TRIES = 50


def samples_of(model: MachineModel, count: int, rng: np.random.Generator) -> list[MachineModel]:
    """Return ``count`` models drawn from a model's standard errors.

    Masses and springs are drawn in their logarithm, so that none becomes negative; couplings so
    that the mass matrix stays positive definite.  Errors are taken as independent, which is on the
    safe side: the model does not keep their covariance.
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
        drawn = replace(
            model,
            axes=tuple(_axis(axis, rng) for axis in model.axes),
            couplings=tuple(_coupling(c, rng) for c in model.couplings),
        )
        if np.linalg.eigvalsh(drawn.mass_matrix)[0] > 0:
            return drawn
    return model


def _axis(axis: AxisModel, rng: np.random.Generator) -> AxisModel:
    def scaled(values: tuple[Estimate, ...], least: float, unknown: float) -> tuple[Estimate, ...]:
        return tuple(_scaled(one, least, unknown, rng) for one in values)

    return replace(
        axis,
        masses=scaled(axis.masses, LEAST_MASS, UNKNOWN_MASS),
        springs=scaled(axis.springs, LEAST_SPRING, UNKNOWN_SPRING),
        dampers=scaled(axis.dampers, LEAST_DAMPER, UNKNOWN_DAMPER),
        viscous_friction=_scaled(axis.viscous_friction, LEAST_DAMPER, UNKNOWN_DAMPER, rng),
        load_friction=_scaled(axis.load_friction, LEAST_DAMPER, UNKNOWN_DAMPER, rng),
    )


def _scaled(one: Estimate, least: float, unknown: float, rng: np.random.Generator) -> Estimate:
    if one.value == 0.0:
        return one
    relative = max(one.std / abs(one.value), least) if isfinite(one.std) else unknown
    return replace(one, value=one.value * float(np.exp(relative * _normal(rng))))


def _coupling(one: Coupling, rng: np.random.Generator) -> Coupling:
    std = one.std if isfinite(one.std) else UNKNOWN_MASS * abs(one.value)
    std = max(std, LEAST_MASS * abs(one.value))
    return replace(one, value=one.value + std * _normal(rng))


def _normal(rng: np.random.Generator) -> float:
    return float(np.clip(rng.standard_normal(), -FURTHEST, FURTHEST))
