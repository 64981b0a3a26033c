"""What joins two axes besides the couplings that the model has."""

from dataclasses import replace
from itertools import combinations

import numpy as np

from fieldtool.criticise.effects.base import Context, Effect, Parameter, Values
from fieldtool.criticise.simulate.structure import Structure


class CouplingSpring(Effect):
    """A spring between the last masses of two axes."""

    name = "coupling_spring"
    exact = True
    equation = "tau_a = stiffness (q_a - q_b)"
    source = "linear elasticity between two bodies; Hovland, Berglund, Hanssen (chains of masses)"
    signature = "torque of one axis that goes with the other's position, strongest at low frequency"
    contrary = "growth with the square of the frequency"

    def structure(self, structure: Structure, values: Values) -> Structure:
        """Add to the stiffness."""
        stiffness = structure.stiffness.copy()
        a, b = (int(structure.ends[k]) for k in (self.axis, self.other or 0))
        stiffness[np.ix_([a, b], [a, b])] += values["stiffness"] * np.array([[1, -1], [-1, 1]])
        return replace(structure, stiffness=stiffness)


class CouplingInertia(Effect):
    """A common inertia of the last masses of two axes, or of the motors."""

    name = "coupling_inertia"
    exact = True
    equation = "tau_a = inertia q_b''"
    source = "Hovland, Berglund, Hanssen, equation 10 (off-diagonal masses)"
    signature = "torque of one axis that goes with the other's acceleration"
    contrary = "a part that goes with the other's position"

    def structure(self, structure: Structure, values: Values) -> Structure:
        """Add to the mass matrix."""
        mass = structure.mass.copy()
        places = structure.motors if self.location == "motor" else structure.ends
        a, b = (int(places[k]) for k in (self.axis, self.other or 0))
        mass[a, b] += values["inertia"]
        mass[b, a] += values["inertia"]
        return replace(structure, mass=mass)


def coupling_candidates(context: Context) -> list[Effect]:
    """Return both for every pair of axes; the last masses' inertia only where the model has none."""
    out: list[Effect] = []
    held = {frozenset(c.axes) for c in context.model.couplings}
    for a, b in combinations(range(len(context.axes)), 2):
        size = min(context.torque_size(a), context.torque_size(b))
        stiff = size / max(context.travel(a), context.travel(b), 1e-12)
        unit = context.per(a, "")
        spring = Parameter("stiffness", unit, 0.0, 0.0, 1e3 * stiff, 0.05 * stiff, linear=True)
        out.append(CouplingSpring(a, (spring,), "load", other=b))
        chains = context.model.axes[a].masses, context.model.axes[b].masses
        places = {"load": -1}
        if max(map(len, chains)) > 1:
            places["motor"] = 0
        if frozenset((context.axes[a].name, context.axes[b].name)) in held:
            del places["load"]
        unit = "kg" if context.axes[a].kind == "linear" else "kg m2"
        for place, at in places.items():
            limit = 0.95 * float(np.sqrt(chains[0][at].value * chains[1][at].value))
            inertia = Parameter("inertia", unit, 0.0, -limit, limit, 0.02 * limit, linear=True)
            out.append(CouplingInertia(a, (inertia,), place, other=b))
    return out
