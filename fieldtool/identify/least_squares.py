"""Maximum likelihood with known noise: the fit itself, its covariance and what it leaves open."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import LinAlgError, cho_factor, cho_solve
from scipy.optimize import least_squares

FloatArray = NDArray[np.float64]
Function = Callable[[FloatArray, float], FloatArray]
GENTLE_START = (0.3, 0.03, 0.0)
"""Relative errors added to the noise while the fit is still far off, one stage after another."""


@dataclass(frozen=True, eq=False)
class Fit:
    """The most likely parameters, in scaled units."""

    x: FloatArray
    """Shape (P,)."""
    jacobian: FloatArray
    """Of the residuals in standard errors, shape (measured, P)."""
    chi2: float
    """Sum of squared residuals; near its degrees of freedom if model and noise are right."""

    @property
    def degrees_of_freedom(self) -> int:
        """Measured numbers minus parameters, at least 1."""
        return max(int(self.jacobian.shape[0]) - int(self.x.size), 1)

    @property
    def excess(self) -> float:
        """Factor on variances where the misfit is larger than the noise explains, at least 1."""
        return max(1.0, self.chi2 / self.degrees_of_freedom)

    def covariance(self) -> FloatArray:
        """Of x, shape (P, P), enlarged by :attr:`excess`; infinite variance where nothing is known."""
        _, singular, rows = np.linalg.svd(self._scaled[0], full_matrices=False)
        known = singular > singular.max(initial=0.0) * self._smallest
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):  # of a fit gone astray
            inverse = rows[known].T / singular[known]
            covariance = inverse @ inverse.T
            lost = np.any(np.abs(rows[~known]) > 1e-6, axis=0)
            covariance[lost, lost] = np.inf
            scale = self._scaled[1]
            result: FloatArray = covariance / np.outer(scale, scale) * self.excess
        return result

    @property
    def _scaled(self) -> tuple[FloatArray, FloatArray]:
        scale = np.linalg.norm(self.jacobian, axis=0)
        scale[scale == 0.0] = 1.0
        return self.jacobian / scale, scale

    @property
    def _smallest(self) -> float:
        return float(max(self.jacobian.shape) * np.finfo(float).eps)


def propagate(jacobian: FloatArray, covariance: FloatArray) -> FloatArray:
    """Covariance of linear functions of parameters; infinite where one rests on an unknown one.

    Parameters
    ----------
    jacobian : array, shape (Q, P)
    covariance : array, shape (P, P)
        With infinite variances where nothing is known.
    """
    unknown = ~np.isfinite(np.diag(covariance))
    finite = np.where(np.isfinite(covariance), covariance, 0.0)
    result: FloatArray = jacobian @ finite @ jacobian.T
    lost = np.any(jacobian[:, unknown] != 0.0, axis=1)
    result[lost, lost] = np.inf
    return result


def standard_errors(covariance: FloatArray) -> FloatArray:
    """Square roots of the diagonal, shape (P,); rounding below 0 counts as 0."""
    errors: FloatArray = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    return errors


def damped_fit(
    residuals: Function,
    jacobian: Function,
    start: FloatArray,
    floors: Sequence[float] = GENTLE_START,
    evaluations: int = 200,
) -> Fit:
    """As :func:`fit`, by damped normal equations (Levenberg, Marquardt): many times faster.

    Its minimum is as exact; near a singular Jacobian it needs more steps.
    """
    x = np.array(start, dtype=np.float64)
    for floor in floors:
        exact = floor == 0.0
        limit = evaluations if exact else min(evaluations, 30)
        x, cost = _descend(residuals, jacobian, x, floor, limit, 1e-9 if exact else 1e-2)
    return Fit(x, jacobian(x, floors[-1]), cost)


def _descend(
    residuals: Function,
    jacobian: Function,
    x: FloatArray,
    floor: float,
    evaluations: int,
    tolerance: float,
) -> tuple[FloatArray, float]:
    """Return the parameters and their sum of squares."""
    r = residuals(x, floor)
    cost, damping, growth = float(r @ r), 1e-6, 4.0
    size = np.zeros(x.size)
    normal, gradient = np.zeros((x.size, x.size)), np.zeros(x.size)
    moved = True
    for _ in range(evaluations if x.size else 0):
        if moved:
            j = jacobian(x, floor)
            normal, gradient = j.T @ j, j.T @ r
            size = np.maximum(size, np.sqrt(np.diag(normal)))
            size[size == 0.0] = 1.0
        scaled = normal / np.outer(size, size) + damping * np.eye(x.size)
        try:
            step = -cho_solve(cho_factor(scaled), gradient / size) / size
        except LinAlgError:
            moved, damping, growth = False, max(damping, 1e-12) * growth, 2.0 * growth
            continue
        with np.errstate(all="ignore"):
            tried = residuals(x + step, floor)
            lower = float(tried @ tried)
        expected = -float(step @ (2.0 * gradient + normal @ step))
        if expected <= tolerance * cost:
            if np.isfinite(lower) and lower < cost:
                x, cost = x + step, lower
            break
        moved = bool(np.isfinite(lower) and lower < cost)
        if moved:
            gain = (cost - lower) / expected
            x, r, cost = x + step, tried, lower
            damping, growth = damping * max(0.05, 1.0 - (2.0 * gain - 1.0) ** 3), 4.0
            damping = max(damping, 1e-13)
        else:
            damping, growth = damping * growth, 2.0 * growth
        if damping > 1e12:
            break
    return x, cost


def fit(
    residuals: Function,
    jacobian: Function,
    start: FloatArray,
    floors: Sequence[float] = GENTLE_START,
    evaluations: int = 200,
) -> Fit:
    """Minimise the sum of squared residuals from `start`.

    Parameters
    ----------
    residuals, jacobian : function of (x, floor)
        Residuals in standard errors, with the relative error `floor` added to the noise.
    start : array, shape (P,)
    floors : sequence of float
        Stages; the last must be 0 for the likelihood itself.
    evaluations : int
        At most so many in each stage.
    """
    x = start
    for floor in floors:
        result = least_squares(
            residuals,
            x,
            jacobian,
            method="trf",
            x_scale="jac",
            ftol=1e-10 if floor == 0.0 else 1e-2,
            xtol=1e-12,
            gtol=1e-12,
            max_nfev=evaluations if floor == 0.0 else min(evaluations, 30),
            args=(floor,),
        )
        x = result.x
    return Fit(x, np.asarray(result.jac), float(2.0 * result.cost))
