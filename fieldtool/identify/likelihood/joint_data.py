"""Positions and torques themselves as the fits take them, however few experiments there are.

With all loops closed, each experiment holds Theta = G T at every line, whatever the controllers
do.  M independent experiments give G itself; fewer still say where a model is wrong, by the
equation error G T - Theta.  Its covariance is [G -I] C [G -I]^H with C that of (T, Theta): the
errors-in-variables likelihood of Pintelon and Schoukens, System Identification, section 8.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, cached_property

import numpy as np
from numpy.typing import NDArray

from fieldtool.errors import NotEnoughDataError
from fieldtool.frf.phasors import Phasors, equation_errors
from fieldtool.identify.likelihood.whitening import whitening

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
SAME = 1e-9
"""Relative distance up to which two frequencies count as one."""


@dataclass(frozen=True, eq=False)
class JointSpectra:
    """Phasors of R lines (those of all experiments one after the other) and their errors."""

    names: tuple[str, ...]
    """Axes, in order."""
    omega: FloatArray
    """Shape (F,), rad/s, rising: all frequencies, each once."""
    place: NDArray[np.intp]
    """Shape (R,): which frequency each line has."""
    position: ComplexArray
    """Shape (R, M), rad or m."""
    torque: ComplexArray
    """Shape (R, M), N m or N."""
    covariance: ComplexArray
    """Shape (R, M, M): E[e e^H] of the equation error, rad2 or m2."""

    @property
    def count(self) -> int:
        """Number of real numbers measured."""
        return 2 * int(self.position.size)

    def residuals(self, model: ComplexArray, floor: float = 0.0) -> FloatArray:
        """Equation error of a model's G, shape (F, M, M), whitened; real parts, imaginary parts.

        `floor` adds that share of the size of the positions to their errors.
        """
        error = np.einsum("rij,rj->ri", model[self.place], self.torque) - self.position
        white = np.einsum("rij,rj->ri", self._whitening(floor), error).ravel()
        return np.concatenate([white.real, white.imag])

    def jacobian(self, derivatives: ComplexArray, floor: float = 0.0) -> FloatArray:
        """Derivatives of :meth:`residuals` from those of G, shape (F, M, M, P)."""
        moved = np.einsum("rijp,rj->rip", derivatives[self.place], self.torque)
        white = np.matmul(self._whitening(floor), moved).reshape(-1, derivatives.shape[-1])
        return np.concatenate([white.real, white.imag])

    @cached_property
    def _whitening(self) -> Callable[[float], ComplexArray]:
        """Matrices W with W C W^H = 2 by floor: parts have variance 1, shape (R, M, M); each kept."""
        return cache(self._whitened)

    def _whitened(self, floor: float) -> ComplexArray:
        covariance = self.covariance
        if floor:
            size = np.linalg.norm(self.position, axis=1)
            covariance = covariance + (floor * size[:, None, None]) ** 2 * np.eye(len(self.names))
        return whitening(covariance)


def frequencies_of(phasors: Sequence[Phasors]) -> FloatArray:
    """All frequencies of some experiments, rad/s, rising, each once, shape (F,)."""
    every = 2 * np.pi * np.sort(np.concatenate([p.frequencies for p in phasors]))
    new = np.diff(every, prepend=-1.0) > SAME * every
    frequencies: FloatArray = every[new]
    return frequencies


def joint_spectra(phasors: Sequence[Phasors], response: ComplexArray) -> JointSpectra:
    """Put experiments together as one set of data.

    Parameters
    ----------
    phasors
        Of the same axes; covariance of every line positive definite.
    response
        G of the best model so far at :func:`frequencies_of` the experiments, shape (F, M, M): it
        carries the errors of the torque into the equation error, and need not be exact.

    Raises
    ------
    NotEnoughDataError
        If there is no experiment.
    """
    if not phasors:
        raise NotEnoughDataError("no experiment shows every axis' position and torque at a line")
    omega = frequencies_of(phasors)
    lines = 2 * np.pi * np.concatenate([p.frequencies for p in phasors])
    place = np.searchsorted(omega, lines * (1 + SAME), side="right") - 1
    errors = np.concatenate([p.covariance for p in phasors])
    return JointSpectra(
        phasors[0].axes,
        omega,
        place,
        np.concatenate([p.position for p in phasors]),
        np.concatenate([p.torque for p in phasors]),
        equation_errors(response[place], errors),
    )
