"""The apparent mass at low frequency: what the whole axis weighs, freed of its friction.

Below its modes a machine is one mass m.  The measured ratio torque / position, the dynamic
stiffness, then reads -m w^2 + j w c for a viscous friction c, and a Coulomb friction's fundamental,
in phase with the velocity, adds to the imaginary part as well::

    m(w) = Re(tau / theta) / (-w^2) = m + a w^2 + b w^4 + ...

The higher terms come from the elasticity (for one spring, m2 w^2 / wz^2 with wz the antiresonance).

Valid for: frequencies below about half the lowest antiresonance, no spring to ground, position and
torque of one instant; a delay T turns friction and mass into each other by w T.
Sensitivity: gravity on a tilting axis, or a position controller's sticking, appear as a spring and
as -k / w^2 in m(w); then the fit needs a high degree and says so by its scatter.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fieldtool.errors import NotEnoughDataError

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
_MAX_DEGREE = 3


@dataclass(frozen=True, eq=False)
class LowFrequencyMass:
    """Apparent mass extrapolated to zero frequency."""

    mass: float
    """kg or kg m2."""
    std: float
    """Its standard error; raised where the points scatter more than their own errors say, and by
    what one more term of the polynomial would change."""
    degree: int
    """Degree of the polynomial in w^2."""
    scatter: float
    """Root of chi-square per degree of freedom: about 1 where errors and polynomial are right."""
    frequencies: FloatArray
    """(F,), Hz."""
    apparent_mass: FloatArray
    """(F,): Re(tau / theta) / (-w^2)."""
    apparent_std: FloatArray
    """(F,): its standard error."""
    friction_share: FloatArray
    """(F,): Im(tau / theta) over |tau / theta|; 0 where there is no friction, 1 where all is."""


def dynamic_stiffness_low(
    frequencies: FloatArray,
    position: ComplexArray,
    torque: ComplexArray,
    std: FloatArray,
    degree: int | None = None,
) -> LowFrequencyMass:
    """Extrapolate the apparent mass to zero frequency by a weighted polynomial in w^2.

    Parameters
    ----------
    frequencies
        (F,), Hz, all below the lowest antiresonance.
    position, torque
        (F,), phasors of one axis.  With ``torque`` all ones, ``position`` may be a response.
    std
        (F,): standard error of real and of imaginary part of position / torque (as in
        :class:`~fieldtool.frf.response.FrequencyResponse`), above 0.
    degree
        Of the polynomial; None takes the lowest (up to 3) whose next term is not significant.

    Raises
    ------
    NotEnoughDataError
        If there are fewer frequencies than coefficients, or the mass comes out not positive.
    ValueError
        If an error is not positive or shapes differ.
    """
    shapes = {frequencies.shape, position.shape, torque.shape, std.shape}
    if len(shapes) != 1 or frequencies.ndim != 1:
        raise ValueError(f"frequencies, phasors and std must have one shape (F,), got {shapes}")
    if not np.all(std > 0):
        raise ValueError("std must be above 0 at every frequency")
    needed = (degree or 0) + 1
    if frequencies.size < needed:
        raise NotEnoughDataError(
            f"{frequencies.size} frequencies are too few to extrapolate the mass with a polynomial "
            f"of degree {needed - 1}: at least {needed} are needed."
        )
    stiffness = torque / position
    omega2 = (2 * np.pi * frequencies) ** 2
    mass = -stiffness.real / omega2
    mass_std = std * np.abs(stiffness) ** 2 / omega2
    chosen = _lowest_degree(omega2, mass, mass_std) if degree is None else degree
    coefficients, errors, scatter = _polynomial(omega2, mass, mass_std, chosen)
    if coefficients[0] <= 0:
        raise NotEnoughDataError(
            f"the mass at low frequency comes out as {coefficients[0]:.4g} +- {errors[0]:.2g}, not "
            "positive: torque and position disagree in sign, or noise hides the mass. Check the "
            "sign of the torque, or use a larger amplitude."
        )
    return LowFrequencyMass(
        mass=float(coefficients[0]),
        std=_std_at_zero(omega2, mass, mass_std, chosen),
        degree=chosen,
        scatter=scatter,
        frequencies=frequencies,
        apparent_mass=mass,
        apparent_std=mass_std,
        friction_share=stiffness.imag / np.abs(stiffness),
    )


def _lowest_degree(omega2: FloatArray, mass: FloatArray, std: FloatArray) -> int:
    """Degree whose next two terms are within their errors (2.5 of them, raised by scatter)."""
    top = min(_MAX_DEGREE, omega2.size - 2)
    for degree in range(top):
        following = range(degree + 1, min(degree + 2, top) + 1)
        fits = [_polynomial(omega2, mass, std, d) for d in following]
        if all(abs(c[-1]) <= 2.5 * e[-1] * max(s, 1.0) for c, e, s in fits):
            return degree
    return max(top, 0)


def _std_at_zero(omega2: FloatArray, values: FloatArray, std: FloatArray, degree: int) -> float:
    """Error at zero: the fit's, raised by scatter, and what one more term would change."""
    coefficients, errors, scatter = _polynomial(omega2, values, std, degree)
    cut_off = 0.0
    if omega2.size > degree + 2:
        cut_off = float(_polynomial(omega2, values, std, degree + 1)[0][0] - coefficients[0])
    return float(np.hypot(errors[0] * max(scatter, 1.0), cut_off))


def _polynomial(
    omega2: FloatArray, mass: FloatArray, std: FloatArray, degree: int
) -> tuple[FloatArray, FloatArray, float]:
    """Return coefficients, their standard errors and the scatter of a weighted fit."""
    scale = omega2.max()
    A = np.vander(omega2 / scale, degree + 1, increasing=True) / std[:, None]
    Q, R = np.linalg.qr(A)
    inverse = np.linalg.inv(R)
    scaled = inverse @ (Q.T @ (mass / std))
    left = mass / std - A @ scaled
    freedom = omega2.size - degree - 1
    scatter = float(np.sqrt(left @ left / freedom)) if freedom > 0 else 1.0
    units = scale ** -np.arange(degree + 1.0)
    return scaled * units, np.linalg.norm(inverse, axis=1) * units, scatter


@dataclass(frozen=True, eq=False)
class LowFrequencyGain:
    """A real gain, acceleration per torque, extrapolated to zero frequency."""

    gain: float
    """1/kg or 1/(kg m2); of either sign."""
    std: float
    """Its standard error; raised where the points scatter more than their own errors say, and by
    what one more term of the polynomial would change."""
    degree: int
    """Degree of the polynomial in w^2."""
    scatter: float
    """Root of chi-square per degree of freedom."""
    frequencies: FloatArray
    """(F,), Hz."""
    values: FloatArray
    """(F,): the gain at each frequency."""
    errors: FloatArray
    """(F,): its standard error."""


def low_frequency_gain(
    frequencies: FloatArray, values: FloatArray, std: FloatArray, what: str
) -> LowFrequencyGain:
    """Extrapolate a gain to zero frequency by a weighted polynomial in w^2.

    Parameters
    ----------
    frequencies
        (F,), Hz, all below the lowest mode of the axes that move.
    values, std
        (F,): acceleration per torque and its standard error.
    what
        The gain's name, for messages.

    Raises
    ------
    NotEnoughDataError
        If there are fewer than three frequencies.
    ValueError
        If an error is not positive.
    """
    if not np.all(std > 0):
        raise ValueError(f"{what}: std must be above 0 at every frequency")
    if frequencies.size < 3:
        raise NotEnoughDataError(
            f"{what}: {frequencies.size} settled frequencies are too few to extrapolate to zero; at "
            "least 3 are needed. Measure again with a larger amplitude or a longer settling time."
        )
    omega2 = (2 * np.pi * frequencies) ** 2
    degree = _lowest_degree(omega2, values, std)
    coefficients, _, scatter = _polynomial(omega2, values, std, degree)
    return LowFrequencyGain(
        float(coefficients[0]),
        _std_at_zero(omega2, values, std, degree),
        degree,
        scatter,
        frequencies,
        values,
        std,
    )
