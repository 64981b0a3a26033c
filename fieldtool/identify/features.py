"""What an elastic axis shows its motor: resonances, antiresonances, damping, inertia ratio.

All follow from the fitted parameters; their standard errors by linear propagation of the fit's
covariance.  They hold whatever unit the torque is measured in.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.linalg import eig, eigh

from fieldtool.identify.likelihood.least_squares import propagate, standard_errors
from fieldtool.identify.likelihood.parameters import (
    machine_parameters,
    parameter_values,
    with_values,
)
from fieldtool.identify.likelihood.refine import RefinedModel
from fieldtool.records.model import Estimate, FloatArray, MachineModel

STEP = 1e-5
"""Relative step of the derivatives."""


@dataclass(frozen=True)
class ChainFeatures:
    """Of one elastic axis that stands alone."""

    resonances: tuple[Estimate, ...]
    """Hz, undamped, rising."""
    antiresonances: tuple[Estimate, ...]
    """Hz, undamped, rising."""
    damping_ratios: tuple[Estimate, ...]
    """Of the resonances."""
    inertia_ratio: Estimate
    """Last mass over first mass."""


def chain_features(fitted: RefinedModel) -> ChainFeatures:
    """Return the features of a fitted single axis, with standard errors.

    Raises
    ------
    ValueError
        If the machine has more than one axis: its resonances then belong to no axis alone.
    """
    names = fitted.model.names
    if len(names) != 1:
        raise ValueError(f"features are those of one axis, the model has {', '.join(names)}")
    return ChainFeatures(
        _estimates(fitted, _resonances),
        _estimates(fitted, _antiresonances),
        _estimates(fitted, _damping_ratios),
        _estimates(fitted, _inertia_ratio)[0],
    )


def _estimates(
    fitted: RefinedModel, feature: Callable[[MachineModel], FloatArray]
) -> tuple[Estimate, ...]:
    values = feature(fitted.model)
    jacobian = np.zeros((values.size, fitted.values.size))
    for k, value in enumerate(fitted.values):
        step = STEP * max(abs(float(value)), 1e-12)
        jacobian[:, k] = (feature(_moved(fitted, k, step)) - values) / step
    errors = standard_errors(propagate(jacobian, fitted.covariance))
    return tuple(Estimate(float(v), float(e)) for v, e in zip(values, errors, strict=True))


def _moved(fitted: RefinedModel, k: int, step: float) -> MachineModel:
    """Return the fitted machine with one fitted parameter changed."""
    listed = machine_parameters(fitted.model, np.ones(1))
    values = parameter_values(fitted.model, listed, [d.value for d in fitted.delays])
    place = next(i for i, p in enumerate(listed) if p.name == fitted.names[k])
    values[place] += step
    return with_values(fitted.model, listed, values)[0]


def _resonances(model: MachineModel) -> FloatArray:
    values = eigh(model.stiffness_matrix, model.mass_matrix, eigvals_only=True)
    result: FloatArray = np.sqrt(np.abs(values[1:])) / (2 * np.pi)
    return result


def _antiresonances(model: MachineModel) -> FloatArray:
    values = eigh(model.stiffness_matrix[1:, 1:], model.mass_matrix[1:, 1:], eigvals_only=True)
    result: FloatArray = np.sqrt(values) / (2 * np.pi)
    return result


def _damping_ratios(model: MachineModel) -> FloatArray:
    mass, n = model.mass_matrix, model.mass_matrix.shape[0]
    zero, one = np.zeros((n, n)), np.eye(n)
    a = np.block([[zero, one], [-model.stiffness_matrix, -model.damping_matrix]])
    b = np.block([[one, zero], [zero, mass]])
    poles = eig(a, b, right=False)
    upper = poles[poles.imag > 1e-6 * np.abs(poles).max()]
    upper = upper[np.argsort(np.abs(upper))]
    result: FloatArray = -upper.real / np.abs(upper)
    return result


def _inertia_ratio(model: MachineModel) -> FloatArray:
    masses = model.axes[0].masses
    return np.array([masses[-1].value / masses[0].value])
