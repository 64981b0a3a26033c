"""Fit masses, springs, dampers and couplings themselves to measured frequency responses.

    G(w) = E' (K + j w C - w**2 M)**-1 E diag(exp(-j w d))

with E picking the motors and d a delay per axis between torque command and measured position.
Maximum likelihood: every measured value counts by its own noise.  Masses, springs and dampers are
fitted by their logarithms, so they stay positive.

Valid for linear machines: friction other than viscous, backlash and the like show as a misfit
larger than the noise (chi2 well above its degrees of freedom), and then enlarge the standard
errors, but are not modelled.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from math import inf, sqrt

import numpy as np
from numpy.typing import NDArray

from fieldtool.errors import IdentificationError, NotEnoughDataError
from fieldtool.identify.likelihood.joint_data import JointSpectra
from fieldtool.identify.likelihood.least_squares import GENTLE_START, Fit, fit, standard_errors
from fieldtool.identify.likelihood.parameters import (
    Parameter,
    machine_parameters,
    parameter_values,
    with_values,
)
from fieldtool.identify.likelihood.record_data import RecordData
from fieldtool.identify.likelihood.response_data import ResponseMatrix
from fieldtool.records.model import Estimate, MachineModel

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
Measured = ResponseMatrix | JointSpectra | RecordData
FURTHEST = 12.0
"""Natural logarithm of the largest change from the start that a fit may try."""
UNKNOWN_ABOVE = 0.5
"""Relative standard error above which the data do not tell a parameter."""


@dataclass(frozen=True)
class Unknown:
    """Something that the data do not tell."""

    parameters: tuple[str, ...]
    relative_std: float
    reason: str
    """One sentence."""


@dataclass(frozen=True, eq=False)
class RefinedModel:
    """The most likely machine, and how well it is known."""

    model: MachineModel
    """With standard errors."""
    delays: tuple[Estimate, ...]
    """Per axis, s."""
    names: tuple[str, ...]
    """Fitted parameters, e.g. ``x.mass[1]``, ``x.spring[1]``, ``x.damper[1]``,
    ``x.viscous_friction``, ``x.delay``, ``coupling[x,y]``."""
    values: FloatArray
    """Shape (P,), SI."""
    covariance: FloatArray
    """Of the values, shape (P, P), SI; infinite variance where the data say nothing."""
    chi2: float
    """Sum of squared residuals in standard errors, priors included."""
    degrees_of_freedom: int
    unknown: tuple[Unknown, ...]
    """What the data cannot tell."""

    @property
    def delay_values(self) -> FloatArray:
        """Delays without their errors, shape (M,), s."""
        return np.array([delay.value for delay in self.delays])

    @property
    def correlation(self) -> FloatArray:
        """Of the fitted parameters, shape (P, P)."""
        std = standard_errors(self.covariance)
        result: FloatArray = self.covariance / np.outer(std, std)
        return result


def machine_response(
    model: MachineModel, omega: FloatArray, delays: FloatArray | None = None
) -> ComplexArray:
    """G(w) of a machine, shape (F, M, M), position per torque.

    Parameters
    ----------
    model : MachineModel
    omega : array, shape (F,)
        rad/s, positive.
    delays : array, shape (M,), optional
        s.
    """
    at_motors = _displacements(model, omega)[:, model.first_masses, :]
    return at_motors if delays is None else at_motors * _delay(omega, delays)


def refine(
    start: MachineModel,
    data: Measured,
    *,
    fixed: Collection[str] = (),
    priors: Mapping[str, Estimate] | None = None,
    fit_delay: bool = False,
    fit_friction: bool = False,
    fit_load_friction: bool = False,
    delays: Collection[float] | None = None,
) -> RefinedModel:
    """Fit a machine's parameters to frequency responses, or to spectra of positions and torques.

    Parameters
    ----------
    start : MachineModel
        Where to begin, e.g. from order reduction.  Its chain lengths and its list of couplings
        are kept.  Without dampers, 1 % of critical is the start.
    data : ResponseMatrix, JointSpectra or RecordData
        Same axes in the same order.  Spectra of whole records need a start that is near: they are
        fitted by their own noise from the first step.
    fixed : names
        Parameters that keep their start value.
    priors : mapping of name to Estimate, optional
        What is known besides, counted as one more measurement each (log-normal for masses, springs
        and dampers).
    fit_delay, fit_friction, fit_load_friction : bool
        Whether delays, viscous friction at the motors, and at the last masses are fitted, or keep
        their start.
    delays : one number per axis, optional
        Start, s; zero otherwise.

    Raises
    ------
    ValueError
        If axes do not fit or a name is unknown.
    NotEnoughDataError
        If there are fewer measured numbers than parameters.
    IdentificationError
        If a mass or spring of the start is not positive, or the fit ends at a mass matrix that no
        machine can have.
    """
    if data.names != start.names:
        raise ValueError(f"the data have axes {data.names}, the model has {start.names}")
    for axis in start.axes:
        if not all(0.0 < each.value < inf for each in (*axis.masses, *axis.springs)):
            raise IdentificationError(
                f"the fit can not begin: {axis.name} has masses "
                f"{', '.join(f'{m.value:.3g}' for m in axis.masses)} and springs "
                f"{', '.join(f'{s.value:.3g}' for s in axis.springs) or 'none'} to start from, which "
                "must be positive; give a prior model, or the numbers of masses (--masses)"
            )
    fitted = {
        "delay": fit_delay,
        "viscous_friction": fit_friction,
        "load_friction": fit_load_friction,
    }
    kept = {kind for kind, wanted in fitted.items() if not wanted}
    whole = data if isinstance(data, RecordData) else _ByResponse(data)
    problem = _Problem.build(start, whole, set(fixed), dict(priors or {}), kept, delays)
    if data.count + len(problem.priors) < len(problem.free):
        raise NotEnoughDataError(
            f"{data.count} measured numbers can not give {len(problem.free)} parameters; "
            "measure more frequencies or fix some parameters"
        )
    floors = (0.0,) if isinstance(data, RecordData) else GENTLE_START
    solution = fit(problem.residuals, problem.jacobian, np.zeros(len(problem.free)), floors)
    return problem.result(replace(solution, eliminated=whole.eliminated(start)))


@dataclass(frozen=True, eq=False)
class _ByResponse:
    """Data that see of a machine nothing but its response matrix."""

    data: ResponseMatrix | JointSpectra

    @property
    def omega(self) -> FloatArray:
        return self.data.omega

    def eliminated(self, _model: MachineModel) -> int:
        return 0

    def residuals(self, model: MachineModel, delays: FloatArray, floor: float) -> FloatArray:
        return self.data.residuals(machine_response(model, self.data.omega, delays), floor)

    def jacobian(
        self,
        model: MachineModel,
        delays: FloatArray,
        parameters: Sequence[Parameter],
        floor: float,
    ) -> FloatArray:
        derivatives = response_derivatives(model, self.data.omega, delays, parameters)
        return self.data.jacobian(derivatives, floor)


@dataclass(frozen=True, eq=False)
class _Problem:
    """The fit in scaled units: x = 0 is the start, and 1 a relative change of 1."""

    start: MachineModel
    data: _ByResponse | RecordData
    parameters: tuple[Parameter, ...]
    initial: FloatArray
    free: NDArray[np.intp]
    priors: tuple[tuple[int, Estimate], ...]
    """Position among the free parameters, and what is known."""

    @classmethod
    def build(
        cls,
        start: MachineModel,
        data: _ByResponse | RecordData,
        fixed: set[str],
        priors: dict[str, Estimate],
        kept_kinds: set[str],
        delays: Collection[float] | None,
    ) -> "_Problem":
        start = _with_dampers(start)
        parameters = machine_parameters(start, data.omega)
        names = [p.name for p in parameters]
        for name in (*fixed, *priors):
            if name not in names:
                raise ValueError(f"no parameter {name!r}; there are {', '.join(names)}")
        kept = fixed | {p.name for p in parameters if p.kind in kept_kinds}
        free = np.array([k for k, n in enumerate(names) if n not in kept], dtype=np.intp)
        initial = parameter_values(start, parameters, list(delays or [0.0] * len(start.axes)))
        known = tuple(
            (int(np.flatnonzero(free == names.index(name))[0]), estimate)
            for name, estimate in priors.items()
            if name not in kept
        )
        for where, estimate in known:
            if parameters[free[where]].logarithmic and not estimate.value > 0.0:
                raise ValueError(
                    f"prior of {names[free[where]]} must be positive, got {estimate.value}"
                )
            if not estimate.std > 0.0:
                raise ValueError(f"prior of {names[free[where]]} needs a positive standard error")
        return cls(start, data, parameters, initial, free, known)

    def values(self, x: FloatArray) -> FloatArray:
        """All parameters in SI."""
        values = self.initial.copy()
        for k, change in zip(self.free, x, strict=True):
            p = self.parameters[k]
            values[k] = (
                values[k] * np.exp(np.clip(change, -FURTHEST, FURTHEST))
                if p.logarithmic
                else values[k] + change * p.scale
            )
        return values

    def steps(self, values: FloatArray) -> FloatArray:
        """D value / d x of the free parameters."""
        return np.array(
            [
                values[k] if self.parameters[k].logarithmic else self.parameters[k].scale
                for k in self.free
            ]
        )

    def residuals(self, x: FloatArray, floor: float) -> FloatArray:
        values = self.values(x)
        model, delays = with_values(self.start, self.parameters, values)
        measured = self.data.residuals(model, delays, floor)
        return np.concatenate([measured, self._prior_residuals(values)])

    def jacobian(self, x: FloatArray, floor: float) -> FloatArray:
        values = self.values(x)
        model, delays = with_values(self.start, self.parameters, values)
        parameters = [self.parameters[k] for k in self.free]
        measured = self.data.jacobian(model, delays, parameters, floor) * self.steps(values)
        rows = np.zeros((len(self.priors), self.free.size))
        for row, (where, estimate) in enumerate(self.priors):
            p = parameters[where]
            rows[row, where] = (
                estimate.value / estimate.std if p.logarithmic else p.scale / estimate.std
            )
        return np.vstack([measured, rows])

    def _prior_residuals(self, values: FloatArray) -> FloatArray:
        rows = []
        for where, estimate in self.priors:
            value = values[self.free[where]]
            if self.parameters[self.free[where]].logarithmic:
                rows.append(np.log(value / estimate.value) * estimate.value / estimate.std)
            else:
                rows.append((value - estimate.value) / estimate.std)
        return np.array(rows)

    def result(self, solution: Fit) -> RefinedModel:
        values = self.values(solution.x)
        steps = self.steps(values)
        scaled = solution.covariance(solution.felt_excess)
        covariance = scaled * np.outer(steps, steps)
        std = np.full(values.size, np.nan)
        std[self.free] = standard_errors(covariance)
        model, _ = with_values(self.start, self.parameters, values, std)
        if np.linalg.eigvalsh(model.mass_matrix)[0] <= 0.0:
            raise IdentificationError(
                "the fit ends at couplings larger than the last masses allow; check the signs of "
                "torque and position on each axis, and start from a model closer to the machine"
            )
        delays = tuple(
            Estimate(float(values[k]), float(std[k]))
            for k, p in enumerate(self.parameters)
            if p.kind == "delay"
        )
        names = tuple(self.parameters[k].name for k in self.free)
        return RefinedModel(
            model,
            delays,
            names,
            values[self.free],
            covariance,
            solution.chi2,
            solution.degrees_of_freedom,
            self._unknown(solution, values[self.free], standard_errors(covariance)),
        )

    def _unknown(self, solution: Fit, values: FloatArray, std: FloatArray) -> tuple[Unknown, ...]:
        parameters = [self.parameters[k] for k in self.free]
        found = [
            u for p, v, s in zip(parameters, values, std, strict=True) if (u := _open(p, v, s))
        ]
        logarithmic = np.array([p.logarithmic for p in parameters])
        return (*found, *_open_directions(solution, parameters, logarithmic))


def _open(parameter: Parameter, value: float, std: float) -> Unknown | None:
    """Say what one badly known parameter means."""
    relative = std / abs(value) if value else inf
    if relative <= UNKNOWN_ABOVE or parameter.kind in (
        "delay",
        "viscous_friction",
        "load_friction",
    ):
        return None
    if parameter.kind == "coupling":
        reason = f"{parameter.name} can not be told from none: {value:.3g} +- {std:.2g}"
    elif parameter.kind == "damper":
        reason = (
            f"{parameter.name} is {value:.3g} +- {std:.2g}: no line is close enough to a "
            "resonance, or the noise there is too large, to see its damping"
        )
    else:
        reason = (
            f"{parameter.name} is {value:.3g} with a relative error of {relative:.2g}: the mode "
            "that shows it lies outside the measured band or is hidden in noise"
        )
    return Unknown((parameter.name,), float(relative), reason)


def _open_directions(
    solution: Fit, parameters: list[Parameter], logarithmic: NDArray[np.bool_]
) -> list[Unknown]:
    """Combinations that can change by half or more together without a visible misfit."""
    _, singular, rows = np.linalg.svd(solution.triangle, full_matrices=False)
    found = []
    for s, row in zip(singular, rows, strict=True):
        relative = sqrt(solution.felt_excess) / float(s) if s > 0.0 else inf
        involved = np.flatnonzero((np.abs(row) > 0.3) & logarithmic)
        if relative > UNKNOWN_ABOVE and involved.size > 1:
            names = tuple(parameters[k].name for k in involved)
            amount = f"{relative:.2g} of their values" if relative < inf else "any amount"
            found.append(
                Unknown(
                    names,
                    float(relative),
                    f"{', '.join(names)} can change together (by {amount}) "
                    "without a misfit beyond the noise: only combinations of them are known; fix "
                    "one, or give what is known of it",
                )
            )
    return found


def _with_dampers(model: MachineModel) -> MachineModel:
    """Put 1 % of critical where dampers are not known."""
    axes = []
    for axis in model.axes:
        if axis.springs and not (axis.dampers and all(d.value > 0.0 for d in axis.dampers)):
            given = axis.dampers or (Estimate(0.0),) * len(axis.springs)
            pairs = zip(axis.springs, axis.masses[:-1], axis.masses[1:], given, strict=True)
            axes.append(
                replace(
                    axis,
                    dampers=tuple(
                        d
                        if d.value > 0.0
                        else Estimate(0.02 * float(np.sqrt(k.value / (1 / a.value + 1 / b.value))))
                        for k, a, b, d in pairs
                    ),
                )
            )
        else:
            axes.append(axis)
    return replace(model, axes=tuple(axes))


def _delay(omega: FloatArray, delays: FloatArray) -> ComplexArray:
    """Factors on columns, shape (F, 1, M)."""
    factors: ComplexArray = np.exp(-1j * np.outer(omega, delays))[:, None, :]
    return factors


def _displacements(model: MachineModel, omega: FloatArray) -> ComplexArray:
    """All masses' motion per motor torque, shape (F, n, M)."""
    w = omega[:, None, None]
    dynamic = model.stiffness_matrix + 1j * w * model.damping_matrix - w**2 * model.mass_matrix
    torques = np.zeros((dynamic.shape[1], len(model.axes)), complex)
    torques[model.first_masses, np.arange(len(model.axes))] = 1.0
    result: ComplexArray = np.linalg.solve(
        dynamic, np.broadcast_to(torques, (omega.size, *torques.shape))
    )
    return result


def response_derivatives(
    model: MachineModel,
    omega: FloatArray,
    delays: FloatArray,
    parameters: Collection[Parameter],
) -> ComplexArray:
    """D G / d parameter (SI), shape (F, M, M, P): -X' dZ X with Z the dynamic stiffness, X = Z**-1 E."""
    moved = _displacements(model, omega)
    w = omega[:, None, None]
    delayed = _delay(omega, delays)
    response = moved[:, model.first_masses, :]
    derivatives = np.zeros((omega.size, len(model.axes), len(model.axes), len(parameters)), complex)

    def outer(a: ComplexArray, b: ComplexArray) -> ComplexArray:
        product: ComplexArray = a[:, :, None] * b[:, None, :]
        return product

    for k, p in enumerate(parameters):
        if p.kind == "delay":
            derivatives[:, :, p.dofs[0], k] = (-1j * w * response * delayed)[:, :, p.dofs[0]]
            continue
        a = moved[:, p.dofs[0], :]
        b = moved[:, p.dofs[-1], :]
        if p.kind == "mass":
            change = w**2 * outer(a, a)
        elif p.kind == "coupling":
            change = w**2 * (outer(a, b) + outer(b, a))
        elif p.kind == "spring":
            change = -outer(a - b, a - b)
        elif p.kind == "damper":
            change = -1j * w * outer(a - b, a - b)
        else:
            change = -1j * w * outer(a, a)
        derivatives[..., k] = change * delayed
    return derivatives
