"""The model with its effects: what ``model.yaml`` gets."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from fieldtool.criticise.numbers import numbers_of
from fieldtool.criticise.search.search import Found
from fieldtool.records.model import Coupling, Estimate, MachineModel

PART_OF_THE_CHAIN = ("viscous_friction", "coupling_inertia")
"""Effects that the chains themselves have room for."""


def extended_model(found: Found, names: Sequence[str]) -> MachineModel:
    """Return masses, springs, dampers and couplings as fitted beside the causes, and the causes.

    Parameters
    ----------
    found : Found
    names : sequence of str
        Of the axes.
    """
    after = found.final
    hypothesis = after.hypothesis
    std = np.full(hypothesis.base.size, np.nan)
    for k, name in enumerate(hypothesis.machine.names):
        if name in after.names:
            std[k] = after.std[after.names.index(name)]
    model = hypothesis.machine.with_values(hypothesis.base, std)
    effects: list[dict[str, Any]] = []
    for effect in hypothesis.effects:
        numbers = numbers_of(after, effect)
        if effect.name == "viscous_friction":
            model = _with_viscous(model, effect.axis, effect.location, numbers["coefficient"])
            continue
        if effect.name == "coupling_inertia" and effect.location == "load":
            n = numbers["inertia"]
            pair = (names[effect.axis], names[effect.other or 0])
            added = Coupling(pair, n.value, n.std)
            model = replace(model, couplings=(*model.couplings, added))
            continue
        axis: Any = names[effect.axis]
        if effect.other is not None:
            axis = [names[effect.axis], names[effect.other]]
        effects.append(
            {
                "effect": effect.name,
                "axis": axis,
                "location": effect.location,
                "parameters": {k: n.as_dict() for k, n in numbers.items()},
            }
        )
    return replace(model, effects=tuple(effects))


def _with_viscous(model: MachineModel, axis: int, location: str, number: Any) -> MachineModel:
    axes, estimate = list(model.axes), Estimate(number.value, number.std)
    if location == "motor":
        axes[axis] = replace(axes[axis], viscous_friction=estimate)
    else:
        axes[axis] = replace(axes[axis], load_friction=estimate)
    return replace(model, axes=tuple(axes))
