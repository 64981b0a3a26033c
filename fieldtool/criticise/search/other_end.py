"""A further mass at the other end of its chain that moves the motor in the same way.

With the motor held, a chain of masses beyond it has modes w_i, of which each takes part in the motor's
motion with a mass r_i**2.  A mass hung on the motor is one mode more; a mass hung on the last mass is
one link more.  Both are the same to the motor, but for damping: Foster's form of a driving-point
stiffness and Cauer's.  A fit that stands at one does not find the other by small steps.
Source: Gladwell, Inverse Problems in Vibration, 2nd ed., 2004, chapter 4 (chains from two spectra).
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigh, hessenberg

from fieldtool.criticise.search.hypothesis import Hypothesis
from fieldtool.criticise.search.modes import started

FloatArray = NDArray[np.float64]


def at_other_end(fitted: Hypothesis) -> Hypothesis | None:
    """Return what a hypothesis, whose last effect is a further mass, says with it at the other end.

    It is alike to the motor without damping and with the other axes held; None where the chain has no
    other end, or the couplings that the other axes ask for are more than the masses there bear.
    """
    mode = fitted.effects[-1]
    values, names = fitted.values[-1], fitted.machine.names
    axis = fitted.machine.model.names[mode.axis]
    links = sum(name.startswith(f"{axis}.spring") for name in names)
    if not links or values["mass"] <= 0.0:
        return None
    places = [
        [names.index(f"{axis}.{kind}{k + first}") for k in range(links)]
        for kind, first in (("mass", 2), ("spring", 1))
    ]
    masses, springs = (fitted.base[at] for at in places)
    mass, stiffness = values["mass"], values["mass"] * (2 * np.pi * values["frequency"]) ** 2
    if mode.location == "motor":
        rates, shares = _modes(masses, springs)
        masses, springs = _chain(np.append(rates, stiffness / mass), np.append(shares, mass))
        masses, mass, springs, stiffness = masses[:-1], masses[-1], springs[:-1], springs[-1]
    else:
        rates, shares = _modes(np.append(masses, mass), np.append(springs, stiffness))
        chains = [_chain(np.delete(rates, k), np.delete(shares, k)) for k in range(rates.size)]
        usual = [fitted.machine.start[at] for at in places]
        # Any of the modes may be that of the further mass: the one is, that leaves the chain as it was.
        k = int(np.argmin([np.sum(np.log(np.divide(chain, usual)) ** 2) for chain in chains]))
        (masses, springs), mass, stiffness = chains[k], shares[k], shares[k] * rates[k]
    base = fitted.base.copy()
    base[places[0]], base[places[1]] = masses, springs
    if not (mass > 0.0 and stiffness > 0.0 and fitted.machine.physical(base)):
        return None
    frequency = float(np.sqrt(stiffness / mass) / (2 * np.pi))
    hung = started(
        replace(mode, location="load" if mode.location == "motor" else "motor", number=0),
        float(mass), frequency, values["damping_ratio"],
    )  # fmt: skip
    less = replace(fitted, base=base, effects=fitted.effects[:-1], values=fitted.values[:-1])
    grown = less.with_effect(hung)
    own = {**grown.values[-1], "mass": hung.parameters[0].scale}
    return replace(grown, values=(*grown.values[:-1], own))


def _modes(masses: FloatArray, springs: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return a held chain's circular frequencies squared, rad2/s2, and how much mass each mode moves."""
    stiffness = np.diag(springs + np.append(springs[1:], 0.0))
    stiffness -= np.diag(springs[1:], 1) + np.diag(springs[1:], -1)
    rates, shapes = eigh(stiffness, np.diag(masses))
    return np.asarray(rates), np.asarray((masses @ shapes) ** 2)


def _chain(rates: FloatArray, shares: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return masses and springs of the one chain with these modes, the first spring on the motor."""
    rigid = np.sqrt(shares)
    border = rates * rigid
    size = rates.size + 1
    whole = np.zeros((size, size))
    whole[0, 1:] = whole[1:, 0] = border
    whole[1:, 1:] = np.diag(rates)
    links, turn = hessenberg(whole, calc_q=True)
    masses = (turn[1:, 1:].T @ rigid) ** 2
    between = np.abs(np.diag(links, 1))[1:] * np.sqrt(masses[1:] * masses[:-1])
    return np.asarray(masses), np.append(shares @ rates, between)
