"""Fit a machine to the spectra of whole records, whatever the excitation was.

For every experiment and line k of the spectra (1/N times the discrete Fourier transform)::

    Theta(k) - G(w_k) T(k) + G0(w_k) sum_p c_p S_p(k) - D(z_k) x_e = e(k)
    Cov e = C_theta + G C_tau G^H

The machine (G, which is G0 with its delay, and D), and the sizes c_p of torques whose course in time
is known, such as Coulomb friction, are fitted; the states x_e, unknown and linear, are eliminated
(variable projection).  Both positions and torques are noisy: this is the maximum likelihood of errors
in variables with known variances.  Torque disturbances of a stiff loop count as noise of the torque,
because the loop turns them into torque and not into motion.

Valid for linear machines and lines well below half the sample rate; a held torque shows as a delay
of half a sample.  The standard errors are those of the given variances, enlarged where the misfit is
larger (``chi2`` above its degrees of freedom).
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fieldtool.errors import IdentificationError, NotEnoughDataError
from fieldtool.identify.likelihood.least_squares import Fit, fit, standard_errors
from fieldtool.identify.likelihood.parameters import (
    Parameter,
    machine_parameters,
    parameter_values,
    with_values,
)
from fieldtool.identify.likelihood.refine import (
    FURTHEST,
    UNKNOWN_ABOVE,
    RefinedModel,
    Unknown,
)
from fieldtool.identify.moves.record_spectra import Spectra, TorquePart
from fieldtool.identify.moves.record_system import RecordSystem
from fieldtool.records.model import Estimate, MachineModel

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
__all__ = ["Spectra", "TorquePart", "TorqueResidual", "refine_spectra", "torque_residuals"]
KINDS_ON_WISH = ("delay", "viscous_friction", "load_friction")
"""Kinds of parameters that keep their start unless asked for."""
STRETCHES = 24
"""Stretches of time into which records are cut for robust standard errors."""


@dataclass(frozen=True, eq=False)
class TorqueResidual:
    """What is left of the torque at the most likely machine."""

    omega: FloatArray
    """(F,), rad/s."""
    residual: ComplexArray
    """(E, F, M): needed less measured torque, N m, N or A."""
    from_position: FloatArray
    """(E, F, M): the variance that the noise of the position alone gives it."""


def refine_spectra(
    start: MachineModel,
    spectra: Spectra | Sequence[Spectra],
    *,
    fixed: Collection[str] = (),
    priors: Mapping[str, Estimate] | None = None,
    fit_delay: bool = False,
    fit_friction: bool = False,
    fit_load_friction: bool = False,
    delays: Sequence[float] | None = None,
    robust: bool = False,
    shifts: Sequence[Mapping[str, float]] = (),
) -> RefinedModel:
    """Fit a machine's parameters, and the sizes of known torques, to spectra of whole records.

    Parameters
    ----------
    start : MachineModel
        Where to begin; its chain lengths and its list of couplings are kept.
    spectra : Spectra, or several
        Records of one length each, same axes in the same order.
    fixed, priors, fit_delay, fit_friction, fit_load_friction, delays
        As for ``refine``; the names of torque parts count as well.
    robust : bool
        Take the standard errors from what the misfit does to the parameters in one stretch of time
        after the other, instead of the given variances alone; never smaller than these.  Honest
        also where the misfit is neither white nor steady, such as friction at reversals.
    shifts : mappings of name to float, optional
        For each of the things that are not known besides: how far values move, all together, with one
        standard error of it; enlarges the covariance.

    Returns
    -------
    RefinedModel
        Fitted parts stand among the names; Coulomb friction and offset also as effect
        ``coulomb_friction`` of the model (parameters ``torque`` and ``offset``).

    Raises
    ------
    ValueError
        If axes do not fit or a name is unknown.
    NotEnoughDataError
        If there are fewer measured numbers than parameters and states.
    IdentificationError
        If the fit ends at a mass matrix that no machine can have.
    """
    blocks = (spectra,) if isinstance(spectra, Spectra) else tuple(spectra)
    wanted = dict(zip(KINDS_ON_WISH, (fit_delay, fit_friction, fit_load_friction), strict=True))
    kept = {kind for kind, yes in wanted.items() if not yes}
    problem = _Problem.build(start, blocks, set(fixed), dict(priors or {}), kept, delays)
    states = 2 * start.mass_matrix.shape[0] * sum(block.position.shape[0] for block in blocks)
    if sum(block.count for block in blocks) + len(problem.priors) < problem.free.size + states:
        raise NotEnoughDataError(
            f"{sum(block.count for block in blocks)} measured numbers can not give "
            f"{problem.free.size} parameters and {states} numbers for the machine's state; "
            "measure longer"
        )
    solution = fit(problem.residuals, problem.jacobian, np.zeros(problem.free.size), (0.0,))
    return problem.result(solution, states, robust, shifts)


def torque_residuals(
    found: RefinedModel, spectra: Spectra | Sequence[Spectra]
) -> tuple[TorqueResidual, ...]:
    """Return what the fit leaves, in terms of torque, for each of the spectra.

    Sensible where the response matrix can be inverted, which it can at all lines of a machine with
    some damping.
    """
    blocks = (spectra,) if isinstance(spectra, Spectra) else tuple(spectra)
    sizes = dict(zip(found.names, found.values.tolist(), strict=True))
    delays = np.array([delay.value for delay in found.delays])
    return tuple(_torque_residual(found.model, delays, block, sizes) for block in blocks)


def _torque_residual(
    model: MachineModel, delays: FloatArray, block: Spectra, sizes: Mapping[str, float]
) -> TorqueResidual:
    full = {part.name: sizes.get(part.name, part.start) for part in block.parts}
    system = RecordSystem(block, model, delays, full)
    inverse = np.linalg.inv(system.response)
    residual = np.einsum("fij,efj->efi", inverse, system.errors)
    noise = np.einsum("fij,efj->efi", np.abs(inverse) ** 2, block.position_variance)
    return TorqueResidual(block.omega, residual, noise)


def _scores(
    block: Spectra, jacobian: FloatArray, residuals: FloatArray, stretches: int
) -> FloatArray:
    """Gradient of half the misfit by stretches of time, (E * stretches, P); its sum is J' r."""
    count, lines, axes = block.position.shape
    columns = np.column_stack([jacobian, residuals]).reshape(count, -1, jacobian.shape[1] + 1)
    half = lines * axes
    values = columns[:, :half] + 1j * columns[:, half : 2 * half]
    spectrum = np.zeros((count, lines + 1, axes, columns.shape[2]), complex)
    spectrum[:, 1:] = values.reshape(count, lines, axes, -1)
    if block.mean_torque is not None:
        spectrum[:, 0] = -np.sqrt(2.0) * columns[:, 2 * half :]
    length = 2 * lines + 2
    course = np.fft.irfft(spectrum, length, axis=1)
    product = course[..., :-1] * course[..., -1:] * (length / 2.0)
    edges = np.linspace(0, length, stretches + 1).astype(int)[:-1]
    summed = np.add.reduceat(product.sum(axis=2), edges, axis=1)
    return summed.reshape(-1, jacobian.shape[1])


@dataclass(frozen=True, eq=False)
class _Problem:
    """The fit in scaled units: x = 0 is the start, and 1 a relative change of 1."""

    start: MachineModel
    blocks: tuple[Spectra, ...]
    parameters: tuple[Parameter, ...]
    parts: tuple[str, ...]
    initial: FloatArray
    scales: FloatArray
    """Of what is not fitted by its logarithm; NaN for what is."""
    free: NDArray[np.intp]
    priors: tuple[tuple[int, Estimate], ...]
    """Position among the free parameters, and what is known."""

    @classmethod
    def build(
        cls,
        start: MachineModel,
        blocks: tuple[Spectra, ...],
        fixed: set[str],
        priors: dict[str, Estimate],
        kept_kinds: set[str],
        delays: Sequence[float] | None,
    ) -> "_Problem":
        for block in blocks:
            if block.names != start.names:
                raise ValueError(f"the data have axes {block.names}, the model has {start.names}")
        start = _with_dampers(start)
        parameters = machine_parameters(start, np.concatenate([b.omega for b in blocks]))
        listed = {part.name: part for block in blocks for part in block.parts}
        names = [*(p.name for p in parameters), *listed]
        for name in (*fixed, *priors):
            if name not in names:
                raise ValueError(f"no parameter {name!r}; there are {', '.join(names)}")
        kept = fixed | {p.name for p in parameters if p.kind in kept_kinds}
        free = np.array([k for k, name in enumerate(names) if name not in kept], dtype=np.intp)
        initial = np.append(
            parameter_values(start, parameters, list(delays or [0.0] * len(start.axes))),
            [part.start for part in listed.values()],
        )
        torques = [
            max(float(np.abs(b.torque[:, :, part.axis]).max()) for b in blocks)
            for part in listed.values()
        ]
        own = [np.nan if p.logarithmic else p.scale for p in parameters]
        known = tuple(
            (int(np.flatnonzero(free == names.index(name))[0]), estimate)
            for name, estimate in priors.items()
            if name not in kept
        )
        for where, estimate in known:
            name = names[free[where]]
            if not estimate.std > 0.0:
                raise ValueError(f"prior of {name} needs a positive standard error")
            if np.isnan([*own, *torques][free[where]]) and not estimate.value > 0.0:
                raise ValueError(f"prior of {name} must be positive, got {estimate.value}")
        scales = np.array([*own, *torques])
        return cls(start, blocks, parameters, tuple(listed), initial, scales, free, known)

    @property
    def names(self) -> tuple[str, ...]:
        return (*(p.name for p in self.parameters), *self.parts)

    def values(self, x: FloatArray) -> FloatArray:
        """All parameters in SI."""
        values, scales = self.initial.copy(), self.scales[self.free]
        grown = values[self.free] * np.exp(np.clip(x, -FURTHEST, FURTHEST))
        shifted = values[self.free] + x * scales
        values[self.free] = np.where(np.isnan(scales), grown, shifted)
        return values

    def steps(self, values: FloatArray) -> FloatArray:
        """D value / d x of the free parameters."""
        scales = self.scales[self.free]
        return np.where(np.isnan(scales), values[self.free], scales)

    def systems(self, values: FloatArray) -> list[RecordSystem]:
        count = len(self.parameters)
        model, delays = with_values(self.start, self.parameters, values[:count])
        sizes = dict(zip(self.parts, values[count:].tolist(), strict=True))
        return [RecordSystem(block, model, delays, sizes) for block in self.blocks]

    def residuals(self, x: FloatArray, _floor: float) -> FloatArray:
        values = self.values(x)
        measured = [system.residuals() for system in self.systems(values)]
        return np.concatenate([*measured, self._prior_residuals(values)])

    def jacobian(self, x: FloatArray, _floor: float) -> FloatArray:
        values = self.values(x)
        count = len(self.parameters)
        fitted = [self.parameters[k] for k in self.free if k < count]
        parts = [self.parts[k - count] for k in self.free if k >= count]
        rows = []
        for system in self.systems(values):
            columns = system.machine_columns(fitted)
            columns += [system.part_column(name) for name in parts]
            rows.append(np.column_stack(columns))
        measured = np.concatenate(rows) * self.steps(values)
        known = np.zeros((len(self.priors), self.free.size))
        for row, (where, estimate) in enumerate(self.priors):
            scale = self.scales[self.free[where]]
            known[row, where] = (estimate.value if np.isnan(scale) else scale) / estimate.std
        return np.vstack([measured, known])

    def _prior_residuals(self, values: FloatArray) -> FloatArray:
        rows = []
        for where, estimate in self.priors:
            value, scale = values[self.free[where]], self.scales[self.free[where]]
            if np.isnan(scale):
                rows.append(np.log(value / estimate.value) * estimate.value / estimate.std)
            else:
                rows.append((value - estimate.value) / estimate.std)
        return np.array(rows)

    def result(
        self, solution: Fit, states: int, robust: bool, shifts: Sequence[Mapping[str, float]]
    ) -> RefinedModel:
        values, count = self.values(solution.x), len(self.parameters)
        steps = self.steps(values)
        solution = replace(solution, eliminated=states)
        covariance = solution.covariance()
        if robust:
            covariance = self._robust(solution, covariance)
        covariance = covariance * np.outer(steps, steps)
        for shift in shifts:
            moved = np.array([shift.get(self.names[k], 0.0) for k in self.free])
            covariance = covariance + np.outer(moved, moved)
        std = np.full(values.size, np.nan)
        std[self.free] = standard_errors(covariance)
        model, _ = with_values(self.start, self.parameters, values[:count], std[:count])
        if np.linalg.eigvalsh(model.mass_matrix)[0] <= 0.0:
            raise IdentificationError(
                "the fit ends at couplings larger than the last masses allow; check the signs of "
                "torque and position on each axis, and start from a model closer to the machine"
            )
        estimates = [Estimate(float(v), float(s)) for v, s in zip(values, std, strict=True)]
        by_name = dict(zip(self.names, estimates, strict=True))
        names = tuple(self.names[k] for k in self.free)
        return RefinedModel(
            replace(model, effects=(*model.effects, *_effects(model, by_name, self.parts))),
            tuple(by_name[f"{name}.delay"] for name in model.names),
            names,
            values[self.free],
            covariance,
            solution.chi2,
            solution.degrees_of_freedom,
            self._unknown(names, values[self.free], standard_errors(covariance)),
        )

    def _robust(self, solution: Fit, covariance: FloatArray) -> FloatArray:
        """Covariance from the scatter of the gradient over stretches of time (scaled units)."""
        if not np.all(np.isfinite(covariance)):
            return covariance
        rows = self.residuals(solution.x, 0.0)
        total = sum(block.rows for block in self.blocks)
        first, scores = 0, []
        for block in self.blocks:
            size = block.count
            stretches = max(1, round(STRETCHES * block.rows / total))
            part = slice(first, first + size)
            scores.append(_scores(block, solution.jacobian[part], rows[part], stretches))
            first += size
        scattered = np.concatenate(scores)
        count = scattered.shape[0]
        middle = scattered.T @ scattered * (count / (count - 1))
        middle += solution.jacobian[first:].T @ solution.jacobian[first:]
        narrow = covariance / max(1.0, solution.excess)
        wide = narrow @ middle @ narrow
        ratio = np.sqrt(np.maximum(1.0, np.diag(covariance) / np.diag(wide)))
        result: FloatArray = wide * np.outer(ratio, ratio)
        return result

    def _unknown(
        self, names: tuple[str, ...], values: FloatArray, std: FloatArray
    ) -> tuple[Unknown, ...]:
        lines = np.concatenate([block.omega for block in self.blocks]) / (2 * np.pi)
        band = f"{lines.min():.2g} to {lines.max():.3g} Hz"
        found = []
        for name, value, error, scale in zip(
            names, values, std, self.scales[self.free], strict=True
        ):
            relative = error / abs(value) if value else np.inf
            if np.isnan(scale) and not relative <= UNKNOWN_ABOVE:
                reason = (
                    f"{name} is {value:.3g} with a relative error of {relative:.2g}: what was "
                    f"recorded, from {band}, excites nothing that shows it"
                )
                found.append(Unknown((name,), float(relative), reason))
        return tuple(found)


def _effects(
    model: MachineModel, found: Mapping[str, Estimate], parts: Sequence[str]
) -> list[Mapping[str, Any]]:
    """Coulomb friction and offset of each axis that has any, as ``model.yaml`` has them."""
    effects: list[Mapping[str, Any]] = []
    for axis in model.axes:
        unit = "N m" if axis.kind == "rotary" else "N"
        named = {"torque": f"{axis.name}.coulomb_friction", "offset": f"{axis.name}.torque_offset"}
        parameters = {
            what: {"value": found[name].value, "std": found[name].std, "unit": unit}
            for what, name in named.items()
            if name in parts
        }
        if parameters:
            effects.append(
                {"effect": "coulomb_friction", "axis": axis.name, "parameters": parameters}
            )
    return effects


def _with_dampers(model: MachineModel) -> MachineModel:
    """Put 1 % of critical where dampers are not known."""
    axes = []
    for axis in model.axes:
        given = axis.dampers or (Estimate(0.0),) * len(axis.springs)
        pairs = zip(axis.springs, axis.masses[:-1], axis.masses[1:], given, strict=True)
        dampers = tuple(
            d
            if d.value > 0.0
            else Estimate(0.02 * float(np.sqrt(k.value / (1 / a.value + 1 / b.value))))
            for k, a, b, d in pairs
        )
        axes.append(replace(axis, dampers=dampers))
    return replace(model, axes=tuple(axes))
