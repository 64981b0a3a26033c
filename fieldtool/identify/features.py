"""What a two-mass axis shows its motor: antiresonance, resonance, inertia ratio, damping.

Motor inertia m1, load inertia m2, spring k with damper d, viscous
friction c at the motor and e at the load::

    antiresonance  w_a = sqrt(k / m2)                zeta_a = (d + e) / (2 sqrt(k m2))
    resonance      w_r = sqrt(k (1/m1 + 1/m2))       zeta_r = (d (1/m1 + 1/m2) + c s + e t) / (2 w_r)

with s = m2 / (m1 (m1 + m2)) and t = m1 / (m2 (m1 + m2)), the shares of friction that the vibration
feels (first order in c and e).
All but the damping's share of friction hold whatever unit the torque is measured in.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fieldtool.identify.least_squares import propagate, standard_errors
from fieldtool.identify.refine import RefinedModel
from fieldtool.records.model import AxisModel, Estimate

Values = NDArray[np.complex128]


@dataclass(frozen=True)
class DrivePointFeatures:
    """Of one axis with two masses."""

    axis: str
    antiresonance: Estimate
    """Hz, undamped."""
    resonance: Estimate
    """Hz, undamped, other axes free and not coupled."""
    inertia_ratio: Estimate
    """m2 / m1."""
    antiresonance_damping: Estimate
    """Damping ratio."""
    resonance_damping: Estimate
    """Damping ratio."""


def drive_point_features(refined: RefinedModel, axis: str | None = None) -> DrivePointFeatures:
    """Features of a two-mass axis with standard errors from the covariance of the fit.

    Parameters
    ----------
    refined : RefinedModel
    axis : str, optional
        Name of the axis; may be left out where there is only one.

    Raises
    ------
    ValueError
        If there is no such axis, it has not two masses, or it is coupled to another one.
    """
    model = refined.model
    if axis is None and len(model.axes) != 1:
        raise ValueError(f"name one of the axes {', '.join(model.names)}")
    chosen = model.axes[0] if axis is None else _named(model.axes, axis)
    if len(chosen.masses) != 2:
        raise ValueError(f"axis {chosen.name} has {len(chosen.masses)} masses, features need 2")
    if any(chosen.name in c.axes and c.value for c in model.couplings):
        raise ValueError(
            f"axis {chosen.name} is coupled to another: its resonances are not its own"
        )
    values, names = _values(chosen)
    return DrivePointFeatures(
        chosen.name, *(_estimate(f, values, names, refined) for f in _FORMULAS)
    )


def _named(axes: tuple[AxisModel, ...], name: str) -> AxisModel:
    for axis in axes:
        if axis.name == name:
            return axis
    raise ValueError(f"no axis {name}; there are {', '.join(a.name for a in axes)}")


def _values(axis: AxisModel) -> tuple[Values, tuple[str, ...]]:
    """m1, m2, k, d, c, e and their names."""
    damper = axis.dampers[0].value if axis.dampers else 0.0
    numbers = [*(m.value for m in axis.masses), axis.springs[0].value, damper]
    names = ("mass[1]", "mass[2]", "spring[1]", "damper[1]", "viscous_friction", "load_friction")
    frictions = [axis.viscous_friction.value, axis.load_friction.value]
    values = np.array([*numbers, *frictions], dtype=complex)
    return values, tuple(f"{axis.name}.{name}" for name in names)


def _antiresonance(v: Values) -> np.complex128:
    return np.complex128(np.sqrt(v[2] / v[1]) / (2.0 * np.pi))


def _resonance(v: Values) -> np.complex128:
    return np.complex128(np.sqrt(v[2] * (1.0 / v[0] + 1.0 / v[1])) / (2.0 * np.pi))


def _ratio(v: Values) -> np.complex128:
    return np.complex128(v[1] / v[0])


def _antiresonance_damping(v: Values) -> np.complex128:
    return np.complex128((v[3] + v[5]) / (2.0 * np.sqrt(v[2] * v[1])))


def _resonance_damping(v: Values) -> np.complex128:
    total = v[0] + v[1]
    frictions = v[4] * v[1] / (v[0] * total) + v[5] * v[0] / (v[1] * total)
    damping = v[3] * (1.0 / v[0] + 1.0 / v[1]) + frictions
    return np.complex128(damping / (2.0 * np.sqrt(v[2] * (1.0 / v[0] + 1.0 / v[1]))))


_FORMULAS = (_antiresonance, _resonance, _ratio, _antiresonance_damping, _resonance_damping)


def _estimate(
    formula: Callable[[Values], np.complex128],
    values: Values,
    names: tuple[str, ...],
    refined: RefinedModel,
) -> Estimate:
    """Value and standard error; derivatives by complex steps, exact to rounding."""
    gradient = np.zeros((1, len(refined.names)))
    for k, name in enumerate(names):
        if name in refined.names:
            step = 1e-30j * max(abs(values[k]), 1e-200)
            moved = values.copy()
            moved[k] += step
            gradient[0, refined.names.index(name)] = (formula(moved) / step.imag).imag
    std = standard_errors(propagate(gradient, refined.covariance))[0]
    return Estimate(float(formula(values).real), float(std))
