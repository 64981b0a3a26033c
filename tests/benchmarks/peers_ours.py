"""Our own ways to a machine, and plain least squares on the same parameters."""

from dataclasses import replace

import numpy as np
from peers_data import Case, ComplexArray, FloatArray, vibration_poles
from peers_found import Found, Method
from scipy.optimize import least_squares

from fieldtool.errors import IdentificationError
from fieldtool.identify.chain import identify_chain
from fieldtool.identify.chains.block_reduction import reduce_blocks
from fieldtool.identify.chains.modal_chain import reduce_modes
from fieldtool.identify.likelihood.parameters import (
    Parameter,
    machine_parameters,
    parameter_values,
    with_values,
)
from fieldtool.identify.likelihood.refine import machine_response, refine, response_derivatives
from fieldtool.identify.modes.fit import fit_modes
from fieldtool.identify.modes.model import ModalModel
from fieldtool.identify.multisine.identify import identify_joint
from fieldtool.records.model import AxisModel, Coupling, Estimate, MachineModel

WRONG = 0.3
"""Relative error of every number of a wrong start, either sign."""
EVALUATIONS = 300


def _modal(case: Case) -> ModalModel:
    return fit_modes(case.data, case.modes, fit_friction=True, fit_delay=True)


def _poles(modal: ModalModel) -> ComplexArray:
    poles: ComplexArray = modal.omega * (-modal.zeta + 1j * np.sqrt(1.0 - modal.zeta**2))
    return poles


def _of_model(model: MachineModel, why: str = "") -> Found:
    dip = np.nan
    if len(model.axes) == 1:
        held = np.linalg.eigvals(
            np.linalg.solve(model.mass_matrix[1:, 1:], model.stiffness_matrix[1:, 1:])
        )
        dip = float(np.sqrt(held.real.min()) / (2 * np.pi))
    return Found(vibration_poles(model), model, why, dip)


def one_axis_reduction(case: Case) -> Found:
    """Fit of the modes, then the paper's reduction of one axis at a time."""
    modal = _modal(case)
    try:
        return Found(_poles(modal), reduce_modes(modal, case.masses).model)
    except IdentificationError as error:
        return Found(_poles(modal), None, str(error).split(";")[0])


def block_reduction(case: Case) -> Found:
    """Fit of the modes, then block order reduction."""
    modal = _modal(case)
    try:
        return Found(_poles(modal), reduce_blocks(modal, case.masses).model)
    except IdentificationError as error:
        return Found(_poles(modal), None, str(error).split(";")[0])


def refined(case: Case) -> Found:
    """Fit of the modes, block order reduction, maximum likelihood with the full covariance."""
    modal = _modal(case)
    try:
        start = reduce_blocks(modal, case.masses).model
        fitted = refine(_no_loads(start), case.data, fit_delay=True, fit_friction=True)
    except IdentificationError as error:
        return Found(_poles(modal), None, str(error).split(";")[0])
    return _of_model(fitted.model, _misfit(fitted.chi2 / fitted.degrees_of_freedom))


def workflow(case: Case) -> Found:
    """What ``fieldtool identify`` does with the recording, its response included."""
    if case.recording is None:
        return Found(np.zeros(0, complex), None, "has no recording")
    if len(case.masses) == 1:
        chain = identify_chain(case.recording, next(iter(case.masses.values())))
        return _of_model(chain.model)
    kinds = {axis.name: axis.kind for axis in case.recording.axes}
    return _of_model(identify_joint(case.recording, case.masses, kinds).model)


def refined_from(start: MachineModel) -> Method:
    """Our maximum likelihood fit, from a start that is wrong."""

    def method(case: Case) -> Found:
        loads = len(case.masses) == 1
        try:
            fitted = refine(
                start, case.data, fit_delay=True, fit_friction=True, fit_load_friction=loads
            )
        except IdentificationError as error:
            return Found(np.zeros(0, complex), None, str(error).split(";")[0])
        return _of_model(fitted.model, _misfit(fitted.chi2 / fitted.degrees_of_freedom))

    return method


def _misfit(excess: float) -> str:
    return f"misfit {np.sqrt(excess):.1f} times the noise" if excess > 2.0 else ""


def _no_loads(model: MachineModel) -> MachineModel:
    return replace(
        model, axes=tuple(replace(axis, load_friction=Estimate(0.0)) for axis in model.axes)
    )


def wrong_start(truth: MachineModel, seed: int) -> MachineModel:
    """Return the truth with every number 30 % too large or too small; end masses stay possible."""
    rng = np.random.default_rng(seed)

    def wrong(values: tuple[Estimate, ...]) -> tuple[Estimate, ...]:
        return tuple(Estimate(e.value * _factor(rng)) for e in values)

    while True:
        axes = tuple(
            AxisModel(a.name, a.kind, wrong(a.masses), wrong(a.springs), wrong(a.dampers))
            for a in truth.axes
        )
        couplings = tuple(Coupling(c.axes, c.value * _factor(rng)) for c in truth.couplings)
        start = MachineModel(axes, couplings)
        if np.linalg.eigvalsh(start.mass_matrix)[0] > 0.0:
            return start


def _factor(rng: np.random.Generator) -> float:
    return 1.0 + WRONG * float(rng.choice([-1.0, 1.0]))


def plain_least_squares(start: MachineModel, weighting: str) -> Method:
    """Scipy's least squares on masses, springs, dampers, couplings, friction and delays.

    Its parameters and derivatives are ours, to be fair; what differs is the sum of squares: of G
    (``response``), of -w**2 G (``acceleration``), or of G with each element in its own standard
    errors (``diagonal``), and that it begins at a wrong machine.
    """

    def method(case: Case) -> Found:
        loads = len(case.masses) == 1
        listed = machine_parameters(start, case.data.omega)
        free = [k for k, p in enumerate(listed) if loads or p.kind != "load_friction"]
        initial = parameter_values(start, listed, [0.0] * len(start.axes))
        weights = _weights(case, weighting)

        def machine(x: FloatArray) -> tuple[MachineModel, FloatArray, FloatArray]:
            values, steps = _moved(listed, free, initial, x)
            return *with_values(start, listed, values), steps

        def residuals(x: FloatArray) -> FloatArray:
            model, delays, _ = machine(x)
            error = machine_response(model, case.data.omega, delays) - case.data.response
            white = (weights * error).ravel()
            return np.concatenate([white.real, white.imag])

        def jacobian(x: FloatArray) -> FloatArray:
            model, delays, steps = machine(x)
            chosen = [listed[k] for k in free]
            moved = response_derivatives(model, case.data.omega, delays, chosen) * steps
            white = (weights[..., None] * moved).reshape(-1, len(free))
            return np.concatenate([white.real, white.imag])

        with np.errstate(all="ignore"):
            solved = least_squares(
                residuals, np.zeros(len(free)), jacobian, x_scale="jac", max_nfev=EVALUATIONS
            )
        why = "" if solved.success else f"not done after {EVALUATIONS} evaluations"
        return _of_model(machine(solved.x)[0], why)

    return method


def _moved(
    listed: tuple[Parameter, ...], free: list[int], initial: FloatArray, x: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """All values, and the derivatives of the free ones by x: logarithms where positive."""
    values, steps = initial.copy(), np.empty(len(free))
    for place, k in enumerate(free):
        if listed[k].logarithmic:
            values[k] *= np.exp(np.clip(x[place], -12.0, 12.0))
            steps[place] = values[k]
        else:
            values[k] += x[place] * listed[k].scale
            steps[place] = listed[k].scale
    return values, steps


def _weights(case: Case, weighting: str) -> FloatArray:
    data = case.data
    weights: FloatArray = np.sqrt(2.0) / data.std
    if weighting == "diagonal":
        return weights
    weights = np.ones(data.std.shape)
    if weighting == "acceleration":
        weights = weights * data.omega[:, None, None] ** 2
    result: FloatArray = weights / np.sqrt(np.mean(np.abs(weights * data.response) ** 2))
    return result
