"""The inputs that tell most of a machine within limits: a convex design on the information matrix.

The information of a plan is linear in the powers of its inputs, and so is the power with which it
moves each axis.  Sought are the powers with the least sum over the parameters of (standard error over
the error that is wanted) squared, with no axis beyond its limits.

Source: Pronzato and Pazman, Design of Experiments in Nonlinear Models, chapter 5 (A-optimal design);
Mehra, Optimal input signals for parameter estimation in dynamic systems, IEEE Trans. Automatic
Control 19 (1974) 753.
"""

from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

FloatArray = NDArray[np.float64]
KNOWN = 1.0
"""Information that is there before: each scaled parameter within about its own size."""
SHARP = (16, 80)
"""The norm of such order of the used shares takes the place of the largest; one after the other."""
RANGE = 7.0
"""Natural logarithm of the largest change of a power from the even start."""
WORK = 1.5e10
"""Multiplications at most, for each order of the norm."""
FEWEST_STEPS, MOST_STEPS = 15, 150


def best_powers(rows: FloatArray, weights: FloatArray, loads: FloatArray) -> FloatArray:
    """Return the powers of inputs that tell most.

    Parameters
    ----------
    rows
        Of N inputs, shape (N, R, P): the information of a unit of power of input n on the scaled
        parameters is the sum over R of the products of two columns.
    weights
        One over the wanted standard errors of the scaled parameters, shape (P,); 0 for those that do
        not count.
    loads
        What a unit of power of each input takes of each limit's square, shape (C, N); each input
        takes something.

    Returns
    -------
    ndarray
        Shape (N,), with the largest of ``loads @ powers`` equal to 1.
    """
    N, R, P = rows.shape
    flat = rows.reshape(N * R, P)
    largest = loads.max(axis=0)

    def error(x: FloatArray, sharp: int) -> tuple[float, FloatArray]:
        """Logarithm of what is made small, powers scaled to the limits, and its slope."""
        free = np.exp(x)
        use = loads @ free
        top = float(use.max())
        level = top * float(np.sum((use / top) ** sharp)) ** (1 / sharp)
        p, use = free / level, use / level
        covariance = _covariance(flat * np.sqrt(np.repeat(p, R))[:, None])
        std = np.sqrt(np.diag(covariance))
        value = float(np.sum(weights * std))
        seen = (flat @ (covariance * np.sqrt(0.5 * weights / std))).reshape(N, -1)
        slope = -np.einsum("nq,nq->n", seen, seen) * p / value
        pressed = (use ** (sharp - 1) @ loads) * p
        return np.log(value), slope - np.sum(slope) * pressed

    start = -np.log(N * largest)
    bounds = [(v - RANGE, v + RANGE) for v in start]
    steps = int(np.clip(WORK / (2.0 * N * R * P * P), FEWEST_STEPS, MOST_STEPS))
    x = start
    for sharp in SHARP:
        found = minimize(
            partial(error, sharp=sharp),
            x,
            jac=True,
            method="L-BFGS-B",
            bounds=bounds,
            options={"maxiter": steps, "maxcor": 20},
        )
        x = found.x
    powers: FloatArray = np.exp(x)
    within: FloatArray = powers / float(np.max(loads @ powers))
    return within


def weighted_error(rows: FloatArray, weights: FloatArray, powers: FloatArray) -> float:
    """Return what :func:`best_powers` makes small, for inputs of these powers, (N,)."""
    N, R, P = rows.shape
    covariance = _covariance((rows * np.sqrt(powers)[:, None, None]).reshape(N * R, P))
    return float(np.sum(weights * np.sqrt(np.diag(covariance))))


def _covariance(rows: FloatArray) -> FloatArray:
    """Inverse of the information of rows (., P), with that which is there before."""
    information = rows.T @ rows + KNOWN * np.eye(rows.shape[1])
    scale = np.sqrt(np.diag(information))
    inverse: FloatArray = np.linalg.inv(information / np.outer(scale, scale))
    covariance: FloatArray = inverse / np.outer(scale, scale)
    return covariance
