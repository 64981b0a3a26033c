"""Maximum likelihood with known noise: the fit itself, its covariance and what it leaves open."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import LinAlgError, cho_factor, cho_solve

FloatArray = NDArray[np.float64]
Function = Callable[[FloatArray, float], FloatArray]
FIRST_DAMPING = 1e-2
"""Relative to the columns' sizes: a bolder first step ends far away from a poor start."""
GENTLE_START = (0.3, 0.03, 0.0)
"""Relative errors added to the noise while the fit is still far off, one stage after another."""


@dataclass(frozen=True, eq=False)
class Fit:
    """The most likely parameters, in scaled units."""

    x: FloatArray
    """Shape (P,)."""
    jacobian: FloatArray
    """Of the residuals in standard errors, shape (measured, P)."""
    residuals: FloatArray
    """In standard errors, shape (measured,)."""
    eliminated: int = 0
    """Measured numbers that unknowns beside the parameters used up."""

    @property
    def chi2(self) -> float:
        """Sum of squared residuals; near its degrees of freedom if model and noise are right."""
        return float(self.residuals @ self.residuals)

    @property
    def degrees_of_freedom(self) -> int:
        """Measured numbers minus unknowns, at least 1."""
        return max(int(self.jacobian.shape[0]) - int(self.x.size) - self.eliminated, 1)

    @property
    def excess(self) -> float:
        """Factor on variances where the misfit is larger than the noise explains, at least 1."""
        return max(1.0, self.chi2 / self.degrees_of_freedom)

    @cached_property
    def felt_excess(self) -> float:
        """As :attr:`excess`, but that of the numbers that the parameters rest on, where it is larger.

        Each counts by its leverage, so that many that say little can not hide the others.
        """
        rows = self.jacobian.shape[0]
        scale = np.linalg.norm(self.triangle, axis=0)
        scale[scale == 0.0] = 1.0
        _, singular, turn = np.linalg.svd(self.triangle / scale, full_matrices=False)
        known = singular > singular.max(initial=0.0) * self._smallest
        if not np.any(known):
            return self.excess
        unit = (self.jacobian / scale) @ (turn[known].T / singular[known])
        leverage = np.minimum(np.einsum("rp,rp->r", unit, unit), 1.0)
        expected = float(leverage @ (1.0 - leverage)) * max(1.0 - self.eliminated / rows, 1e-9)
        counted = float(leverage @ self.residuals**2) / expected if expected > 0.0 else 0.0
        return max(self.excess, counted)

    def covariance(self, excess: float | None = None) -> FloatArray:
        """Of x, shape (P, P), enlarged by :attr:`excess` or as given; infinite where nothing is told."""
        enlarged = self.excess if excess is None else excess
        scale = np.linalg.norm(self.triangle, axis=0)
        scale[scale == 0.0] = 1.0
        _, singular, rows = np.linalg.svd(self.triangle / scale)
        known = singular > singular.max(initial=0.0) * self._smallest
        known = np.append(known, np.zeros(rows.shape[0] - known.size, dtype=np.bool_))
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):  # of a fit gone astray
            inverse = rows[known].T / singular[known[: singular.size]]
            covariance = inverse @ inverse.T
            lost = np.any(np.abs(rows[~known]) > 1e-6, axis=0)
            covariance[lost, lost] = np.inf
            result: FloatArray = covariance / np.outer(scale, scale) * enlarged
        return result

    @cached_property
    def triangle(self) -> FloatArray:
        """R of J = Q R, shape (P, P) (fewer rows where fewer are measured): all that J says of x."""
        return np.asarray(np.linalg.qr(self.jacobian, mode="r"), dtype=np.float64)

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
    tolerance: float = 1e-9,
) -> Fit:
    """As :func:`fit`, but content where a step would lower the sum of squares by this share of it."""
    x = np.array(start, dtype=np.float64)
    left = np.zeros(0)
    for floor in floors:
        exact = floor == 0.0
        limit = evaluations if exact else min(evaluations, 30)
        x, left = _descend(residuals, jacobian, x, floor, limit, tolerance if exact else 1e-2)
    return Fit(x, jacobian(x, floors[-1]), left)


def _descend(
    residuals: Function,
    jacobian: Function,
    x: FloatArray,
    floor: float,
    evaluations: int,
    tolerance: float,
) -> tuple[FloatArray, FloatArray]:
    """Return the parameters and the residuals there."""
    r = residuals(x, floor)
    cost, damping, growth = float(r @ r), FIRST_DAMPING, 4.0
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
                x, r = x + step, tried
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
    return x, r


def fit(
    residuals: Function,
    jacobian: Function,
    start: FloatArray,
    floors: Sequence[float] = GENTLE_START,
    evaluations: int = 200,
) -> Fit:
    """Minimise the sum of squared residuals from `start`.

    Damped normal equations (Levenberg, Marquardt) with columns of one size: many times faster than
    a decomposition of the Jacobian.  The gradient is exact, so the minimum is too; where parameters
    are all but open (relative accuracies 1e7 apart) it needs more steps.

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
    return damped_fit(residuals, jacobian, start, floors, evaluations, 1e-12)
