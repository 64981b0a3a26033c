"""Turn correlated complex errors into independent ones of standard error 1."""

import numpy as np
from numpy.typing import NDArray

ComplexArray = NDArray[np.complex128]
LOAD = 1e-12
"""Added to the diagonal of correlations, so that elements that are one and the same do no harm."""


def whitening(covariance: ComplexArray) -> ComplexArray:
    """Return matrices W with W C W^H = 2, so that real and imaginary parts have variance 1.

    Parameters
    ----------
    covariance : array, shape (n, k, k)
        C = E[e e^H], positive semi-definite, no element without error.
    """
    std = np.sqrt(np.einsum("fkk->fk", covariance).real)
    scaled = covariance / (std[:, :, None] * std[:, None, :])
    lower = np.linalg.cholesky(scaled + LOAD * np.eye(covariance.shape[1]))
    result: ComplexArray = np.sqrt(2.0) * np.linalg.inv(lower) / std[:, None, :]
    return result
