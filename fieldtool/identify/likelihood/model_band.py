"""How well a fitted machine's response is known: the standard error of its size at any frequency."""

import numpy as np
from numpy.typing import NDArray

from fieldtool.identify.likelihood.parameters import machine_parameters
from fieldtool.identify.likelihood.refine import (
    RefinedModel,
    machine_response,
    response_derivatives,
)

FloatArray = NDArray[np.float64]


def relative_std(fitted: RefinedModel, omega: FloatArray) -> FloatArray:
    """Return the standard error of ln |G|, shape (F, M, M), by linear propagation.

    Parameters
    ----------
    fitted
        With the covariance of its parameters; those that the data do not tell at all are left out.
    omega
        Shape (F,), rad/s, positive.
    """
    by_name = {p.name: p for p in machine_parameters(fitted.model, omega)}
    known = np.isfinite(np.diag(fitted.covariance))
    chosen = [by_name[n] for n, k in zip(fitted.names, known, strict=True) if k]
    covariance = fitted.covariance[np.ix_(known, known)]
    delays = fitted.delay_values
    response = machine_response(fitted.model, omega, delays)
    derivatives = response_derivatives(fitted.model, omega, delays, chosen)
    growth = np.real(derivatives * np.conj(response)[..., None]) / np.abs(response)[..., None] ** 2
    variance = np.einsum("fijp,pq,fijq->fij", growth, covariance, growth, optimize=True)
    result: FloatArray = np.sqrt(np.maximum(variance, 0.0))
    return result
