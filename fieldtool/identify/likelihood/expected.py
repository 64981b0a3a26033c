"""The accuracy to expect of a measurement that has not been made yet, from its information matrix.

A line where the torques' phasors are T tells G T with the equation error's covariance C (see
``joint_data``); its information on the parameters p is 2 Re (dG/dp T)^H C^-1 (dG/dp T).  The inverse
of the sum over all lines is the Cramer-Rao bound: no unbiased way to the parameters does better.
Valid for small errors and noise that is independent from sample to sample.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fieldtool.identify.likelihood.parameters import Parameter, machine_parameters, parameter_values
from fieldtool.identify.likelihood.refine import machine_response, response_derivatives
from fieldtool.records.model import MachineModel

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]


@dataclass(frozen=True, eq=False)
class Excitation:
    """Phasors that the motors will have in one experiment."""

    omega: FloatArray
    """Shape (L,), rad/s."""
    torque: ComplexArray
    """Shape (L, M), N m or N, peak."""
    samples: int
    """That the mean of its periods rests on: periods times samples a period."""


@dataclass(frozen=True, eq=False)
class Noise:
    """Standard deviation of single samples."""

    torque: FloatArray
    """Shape (M,), N m or N."""
    position: FloatArray
    """Shape (M,), rad or m."""


@dataclass(frozen=True, eq=False)
class Expected:
    """How well each parameter will be known."""

    parameters: tuple[Parameter, ...]
    values: FloatArray
    """Shape (P,), SI, of the model that the forecast rests on."""
    std: FloatArray
    """Shape (P,), SI; infinite where the plan says nothing."""
    worth: tuple[FloatArray, ...]
    """For each experiment, shape (L,): the share of all information that each line brings,
    counted in parameters; they sum to P."""

    def relative(self, kind: str) -> float:
        """Largest relative standard error of masses, springs, dampers or couplings; 0 if none.

        A coupling counts relative to its value.
        """
        chosen = [k for k, p in enumerate(self.parameters) if p.kind == kind and self.values[k]]
        if not chosen:
            return 0.0
        return float(np.max(self.std[chosen] / np.abs(self.values[chosen])))


def expected_accuracy(
    model: MachineModel,
    experiments: Sequence[Excitation],
    noise: Noise,
    *,
    fit_delay: bool = True,
    fit_friction: bool = True,
) -> Expected:
    """Return the standard errors that an unbiased fit can reach at best.

    Parameters
    ----------
    model
        The machine as far as it is known.  Without dampers, their errors are those of none.
    experiments
        What will be excited.
    noise
        Of single samples.
    fit_delay, fit_friction
        Whether these are unknown too, as in the refinement.

    Raises
    ------
    ValueError
        If there is no experiment.
    """
    if not experiments:
        raise ValueError("an accuracy needs at least one experiment")
    omega = np.unique(np.concatenate([e.omega for e in experiments]))
    scaled = _Scaled.of(model, omega, fit_delay, fit_friction)
    lines = [scaled.information(e, noise) for e in experiments]
    total = np.sum([line.sum(axis=0) for line in lines], axis=0)
    covariance = _inverse(total)
    return Expected(
        scaled.parameters,
        scaled.values,
        np.sqrt(np.maximum(np.diag(covariance), 0.0)) * np.abs(scaled.steps),
        tuple(_worth(line, covariance) for line in lines),
    )


@dataclass(frozen=True, eq=False)
class InputInformation:
    """What each input of a unit tells, each alone."""

    parameters: tuple[Parameter, ...]
    values: FloatArray
    """Shape (P,), SI."""
    steps: FloatArray
    """Shape (P,), SI: the units in which the rows count the parameters."""
    rows: FloatArray
    """Shape (L, N, R, P): the information of input n at line l is the sum over R of the products of
    two columns."""


def input_information(
    model: MachineModel, omega: FloatArray, torque: ComplexArray, samples: int, noise: Noise
) -> InputInformation:
    """Return the information of inputs at lines: that of a plan is the sum, each times its power.

    Parameters
    ----------
    model
        The machine as far as it is known.
    omega
        Shape (L,), rad/s, rising.
    torque
        Phasors of the motors' torques that a unit of input n causes, shape (L, M, N), N m or N, peak.
    samples
        That the mean of the periods rests on.
    noise
        Of single samples.
    """
    scaled = _Scaled.of(model, omega, fit_delay=True, fit_friction=True)
    white = scaled.white(np.arange(omega.size), torque, samples, noise)
    rows = np.concatenate([white.real, white.imag], axis=1).transpose(0, 2, 1, 3)
    return InputInformation(scaled.parameters, scaled.values, scaled.steps, rows)


@dataclass(frozen=True, eq=False)
class _Scaled:
    """A machine's response at some frequencies, and its derivatives by scaled parameters."""

    omega: FloatArray
    parameters: tuple[Parameter, ...]
    values: FloatArray
    steps: FloatArray
    response: ComplexArray
    derivatives: ComplexArray
    """(F, M, M, P)."""

    @classmethod
    def of(
        cls, model: MachineModel, omega: FloatArray, fit_delay: bool, fit_friction: bool
    ) -> "_Scaled":
        left_out = {"load_friction"}
        left_out |= set() if fit_delay else {"delay"}
        left_out |= set() if fit_friction else {"viscous_friction"}
        parameters = tuple(p for p in machine_parameters(model, omega) if p.kind not in left_out)
        delays = np.zeros(len(model.axes))
        values = parameter_values(model, parameters, list(delays))
        steps = np.array(
            [v if p.logarithmic and v else p.scale for p, v in zip(parameters, values, strict=True)]
        )
        derivatives = response_derivatives(model, omega, delays, parameters) * steps
        response = machine_response(model, omega)
        return cls(omega, parameters, values, steps, response, derivatives)

    def white(
        self, place: NDArray[np.intp], torque: ComplexArray, samples: int, noise: Noise
    ) -> ComplexArray:
        """Derivatives of what torques (R, M, N) move at frequencies, over its noise: (R, M, N, P)."""
        mean = 4.0 / samples  # E|2/N sum n exp(-jwt)|**2 of unit noise
        g = self.response[place]
        covariance = (g * noise.torque**2) @ g.conj().transpose(0, 2, 1) + np.diag(
            noise.position**2
        )
        std = np.sqrt(np.einsum("lkk->lk", covariance).real)
        lower = np.linalg.cholesky(covariance / (std[:, :, None] * std[:, None, :]))
        moved = np.einsum("lijp,ljn->linp", self.derivatives[place], torque)
        rows = (moved / std[:, :, None, None]).reshape(*std.shape, -1)
        white: ComplexArray = np.linalg.solve(lower, rows) * np.sqrt(2.0 / mean)
        return white.reshape(moved.shape)

    def information(self, experiment: Excitation, noise: Noise) -> FloatArray:
        """Information of each line on the scaled parameters, shape (L, P, P)."""
        place = np.searchsorted(self.omega, experiment.omega)
        torque = experiment.torque[:, :, None]
        white = self.white(place, torque, experiment.samples, noise)[:, :, 0, :]
        information: FloatArray = np.einsum("lip,liq->lpq", white.conj(), white).real
        return information


def _inverse(information: FloatArray) -> FloatArray:
    """Covariance; infinite variance where the information is nothing but rounding."""
    scale = np.sqrt(np.maximum(np.diag(information), 1e-300))
    values, vectors = np.linalg.eigh(information / np.outer(scale, scale))
    known = values > 1e-13 * values[-1]
    inverse = (vectors[:, known] / values[known]) @ vectors[:, known].T
    covariance: FloatArray = inverse / np.outer(scale, scale)
    lost = np.any(np.abs(vectors[:, ~known]) > 1e-3, axis=1)
    covariance[lost, lost] = np.inf
    return covariance


def _worth(information: FloatArray, covariance: FloatArray) -> FloatArray:
    """Trace of each line's share of the whole, shape (L,) (Fedorov, theory of optimal designs)."""
    finite = np.where(np.isfinite(covariance), covariance, 0.0)
    worth: FloatArray = np.einsum("lpq,qp->l", information, finite)
    return worth
