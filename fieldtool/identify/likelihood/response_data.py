"""Measured frequency responses, as the fits take them."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, cached_property

import numpy as np
from numpy.typing import NDArray

from fieldtool.errors import NotEnoughDataError
from fieldtool.frf.response import FrequencyResponse
from fieldtool.identify.likelihood.whitening import whitening

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]


@dataclass(frozen=True, eq=False)
class ResponseMatrix:
    """Position per torque between all motors, all other torques zero, with its noise."""

    names: tuple[str, ...]
    """Axes, in order."""
    omega: FloatArray
    """Shape (F,), rad/s, positive."""
    response: ComplexArray
    """G, shape (F, M, M), rad/(N m) or m/N; G[f, i, j] is theta_i / tau_j; NaN where not
    measured."""
    std: FloatArray
    """Standard error of the complex value, shape (F, M, M), unit of G: the square root of the
    mean of |error|**2, shared evenly by real and imaginary part; NaN where not measured."""
    covariance: ComplexArray | None = None
    """Of the errors of the elements, row after row, shape (F, M*M, M*M): E[e e^H]; None where they
    are independent.  With it every line has all its elements or none."""

    def __post_init__(self) -> None:
        size, axes = self.omega.size, len(self.names)
        if self.omega.ndim != 1 or np.any(~(self.omega > 0.0)):
            raise ValueError("frequencies must be a list of positive numbers in rad/s")
        for what, array in (("response", self.response), ("std", self.std)):
            if array.shape != (size, axes, axes):
                raise ValueError(
                    f"{what} must have shape {(size, axes, axes)} "
                    f"(frequencies, axes, axes), got {array.shape}"
                )
        if self.covariance is not None:
            self._check_covariance(self.covariance)
        seen = np.any(self.measured, axis=0)
        for k, name in enumerate(self.names):
            if not (seen[k].any() or seen[:, k].any()):
                raise NotEnoughDataError(f"axis {name}: no frequency response was measured")
            there = self.measured[:, k, k]
            if there.any() and not np.any(self.response[there, k, k]):
                raise NotEnoughDataError(
                    f"axis {name}: its position does not answer its torque at any frequency: nothing "
                    "moved. Is the axis blocked, or is the column of its position the right one?"
                )
        if np.any(~(self.std[self.measured] > 0.0)):
            f, i, j = np.argwhere(self.measured & ~(self.std > 0.0))[0]
            raise ValueError(
                f"the standard error of {self.names[i]} over {self.names[j]} at "
                f"{self.omega[f] / (2 * np.pi):.6g} Hz is {self.std[f, i, j]:.3g}, it must be "
                "positive; measure more periods, or give an estimate of the noise"
            )

    @property
    def measured(self) -> NDArray[np.bool_]:
        """Where there is a value, shape (F, M, M)."""
        return np.array(np.isfinite(self.response), dtype=np.bool_)

    @property
    def pairs(self) -> NDArray[np.bool_]:
        """Pairs (i, j) with data in either direction, shape (M, M), symmetric."""
        seen = np.any(self.measured, axis=0)
        return np.array(seen | seen.T, dtype=np.bool_)

    @property
    def count(self) -> int:
        """Number of real numbers measured."""
        return 2 * int(np.count_nonzero(self.measured))

    def residuals(self, model: ComplexArray, floor: float = 0.0) -> FloatArray:
        """Model minus measurement, whitened: uncorrelated, standard error 1; real then imaginary.

        Parameters
        ----------
        model : array, shape (F, M, M)
            G of the model.
        floor : float
            Relative error added to the noise, to start a fit gently (:meth:`errors`).
        """
        difference = model - self.response
        if self.covariance is None:
            white: ComplexArray = difference[self.measured] * self.weights(floor)
        else:
            lines, whiten = self._lines, self._whitening(floor)
            flat = difference[lines].reshape(lines.size, -1)
            white = np.einsum("fab,fb->fa", whiten, flat).ravel()
        return np.concatenate([white.real, white.imag])

    def jacobian(self, derivatives: ComplexArray, floor: float = 0.0) -> FloatArray:
        """Derivatives of :meth:`residuals` from those of G, shape (F, M, M, P)."""
        if self.covariance is None:
            weighted: ComplexArray = derivatives[self.measured] * self.weights(floor)[:, None]
        else:
            lines, whiten = self._lines, self._whitening(floor)
            count = derivatives.shape[-1]
            flat = derivatives[lines].reshape(lines.size, -1, count)
            weighted = np.matmul(whiten, flat).reshape(-1, count)
        return np.concatenate([weighted.real, weighted.imag])

    def weights(self, floor: float = 0.0) -> FloatArray:
        """Inverse standard errors of the parts of each measured value, shape (measured,)."""
        weights: FloatArray = np.sqrt(2.0) / self.errors(floor)[self.measured]
        return weights

    @cached_property
    def _lines(self) -> NDArray[np.intp]:
        """Lines with values."""
        return np.flatnonzero(self.measured[:, 0, 0])

    @cached_property
    def _whitening(self) -> Callable[[float], ComplexArray]:
        """Matrices W with W C W^H = 2 by floor, shape (lines, M*M, M*M); each kept."""
        return cache(self._whitened)

    def _whitened(self, floor: float) -> ComplexArray:
        if self.covariance is None:
            raise ValueError("errors are independent: there is nothing to whiten")
        covariance = self.covariance[self._lines]
        size = covariance.shape[1]
        if floor:
            variance = np.einsum("fkk->fk", covariance).real
            added = self.errors(floor)[self._lines].reshape(-1, size) ** 2 - variance
            covariance = covariance + np.eye(size) * added[:, :, None]
        return whitening(covariance)

    def _check_covariance(self, covariance: ComplexArray) -> None:
        size, axes = self.omega.size, len(self.names)
        shape = (size, axes * axes, axes * axes)
        if covariance.shape != shape:
            raise ValueError(f"covariance must have shape {shape}, got {covariance.shape}")
        counted = np.count_nonzero(self.measured.reshape(size, -1), axis=1)
        if np.any((counted != 0) & (counted != axes * axes)):
            raise ValueError("with a covariance a line must have all its elements or none")

    def errors(self, floor: float) -> FloatArray:
        """Standard errors with `floor` times the size of the response added, shape (F, M, M).

        The size of pair (i, j) is the geometric mean of the largest responses of axes i and j at
        that frequency: a cross response that is far smaller counts as nearly zero.
        """
        if floor == 0.0:
            return self.std
        size = np.where(self.measured, np.abs(self.response), 0.0)
        largest = np.maximum(size.max(axis=1), size.max(axis=2))
        added = floor * np.sqrt(largest[:, :, None] * largest[:, None, :])
        result: FloatArray = np.hypot(self.std, added)
        return result


def matrix_of(response: FrequencyResponse, floor: float = 0.0) -> ResponseMatrix:
    """Return a response as the fits take it.

    Parameters
    ----------
    response
    floor
        Relative error of the method that is added to each value's noise; errors then count as
        independent.  Without it the covariance of the elements is kept.
    """
    std = np.hypot(response.complex_std, floor * np.abs(response.response))
    covariance = None if floor else response.covariance
    omega = 2 * np.pi * response.frequencies
    return ResponseMatrix(response.axes, omega, response.response, std, covariance)
