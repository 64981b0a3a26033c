"""Friction between single masses and ground: viscous, dry, and of bristles.

Dry friction with one torque for both directions is exact sticking (:mod:`drives.sim.stick_slip`).
Friction that falls with the speed, or differs between directions, is that of elastic bristles::

    z' = v - sigma0 |v| z / g(v),    f = sigma0 z + sigma1 z'

whose mean deflection z follows a sliding torque g(v).  The bristles are as stiff as the inner step
allows, so a mass that sticks moves by a fraction of an encoder count.
Source: Canudas de Wit, Olsson, Astrom, Lischinsky, IEEE Trans. Automatic Control 40, 1995, p. 419.
"""

from dataclasses import dataclass
from math import isfinite, sqrt

import numpy as np

from drives.sim.effects.shapes import (
    Element,
    ElementKind,
    FloatArray,
    Location,
    Site,
    check_location,
    check_number,
)

_BRISTLE_STIFFNESS = 0.02
"""Of the mass per inner step squared: presliding at 180 Hz with 8 kHz."""
_BRISTLE_DAMPING = 0.5
"""Damping ratio of a mass on its bristles."""


@dataclass(frozen=True)
class ViscousFriction:
    """A force against the velocity of one mass, -coefficient * q'; model name viscous_friction.

    Valid for: bearings and seals in oil, well above breakaway.

    Raises
    ------
    ValueError
        If the coefficient is negative or not finite, or the mass has no valid number.
    """

    mass: int
    """Number of the mass among all masses of the plant, from 0."""
    coefficient: float
    """N s/m or N m s/rad, at least 0."""

    def __post_init__(self) -> None:
        if self.mass < 0:
            raise ValueError(f"viscous friction: mass {self.mass} does not exist; count from 0")
        if not (isfinite(self.coefficient) and self.coefficient >= 0.0):
            raise ValueError(
                f"viscous friction at mass {self.mass}: coefficient {self.coefficient} N m s/rad "
                "(N s/m) must be finite and at least 0"
            )

    def damping(self, size: int) -> FloatArray:
        """One entry on the diagonal."""
        matrix = np.zeros((size, size))
        matrix[self.mass, self.mass] = self.coefficient
        return matrix


@dataclass(frozen=True)
class CoulombFriction:
    """Dry friction between one mass of a chain and ground; model name coulomb_friction.

    Sliding, the mass feels -torque * sign(q').  At standstill the friction is what keeps it there,
    as long as that is at most the same torque; then the mass breaks away.

    Valid for: slideways, seals and gears whose friction depends neither on speed nor on how long
    they stood; breakaway is not above sliding friction.

    Raises
    ------
    ValueError
        If the torque is negative or not finite, or the location is none.
    """

    torque: float
    """N m (rotary) or N (linear), at least 0; 0 is no friction."""
    location: Location = "motor"

    def __post_init__(self) -> None:
        check_location("coulomb friction", self.location)
        if not (isfinite(self.torque) and self.torque >= 0.0):
            raise ValueError(
                f"coulomb friction at the {self.location}: torque {self.torque} N m (N) must be "
                "finite and at least 0"
            )


@dataclass(frozen=True)
class StribeckFriction:
    """Dry friction that is larger at low speed; model name stribeck_friction.

    Sliding steadily, the mass feels g(v) = torque + (breakaway - torque) exp(-(v / velocity)^2).

    Valid for: greased gears and slideways at the edge of full lubrication.

    Raises
    ------
    ValueError
        If a value is not physical.
    """

    torque: float
    """N m (or N) at high speed, above 0."""
    breakaway: float
    """N m (or N) at standstill, at least ``torque``."""
    velocity: float
    """rad/s (or m/s) at which the surplus has fallen to 1/e, above 0."""
    location: Location = "motor"

    def __post_init__(self) -> None:
        check_location("stribeck friction", self.location)
        check_number("stribeck friction", "torque", self.torque, "N m (N)", 1e-12)
        check_number("stribeck friction", "breakaway", self.breakaway, "N m (N)", self.torque)
        check_number("stribeck friction", "velocity", self.velocity, "rad/s (m/s)", 1e-9)

    def elements(self, site: Site) -> tuple[Element, ...]:
        """One set of bristles."""
        return _bristles(
            site,
            self.location,
            self.torque,
            self.torque,
            self.breakaway / self.torque,
            self.velocity,
        )


@dataclass(frozen=True)
class AsymmetricFriction:
    """Dry friction that differs between directions; model name asymmetric_friction.

    Valid for: inclined or preloaded slideways, worm gears, one-sided seals.

    Raises
    ------
    ValueError
        If a value is not physical.
    """

    forward: float
    """N m (or N) while the mass moves in the positive direction, above 0."""
    backward: float
    """N m (or N) in the other one, above 0."""
    location: Location = "motor"

    def __post_init__(self) -> None:
        check_location("asymmetric friction", self.location)
        check_number("asymmetric friction", "forward", self.forward, "N m (N)", 1e-12)
        check_number("asymmetric friction", "backward", self.backward, "N m (N)", 1e-12)

    def elements(self, site: Site) -> tuple[Element, ...]:
        """One set of bristles."""
        return _bristles(site, self.location, self.forward, self.backward, 1.0, 1.0)


def _bristles(
    site: Site,
    location: Location,
    forward: float,
    backward: float,
    surplus: float,
    velocity: float,
) -> tuple[Element, ...]:
    inertia = site.inertia(location)
    stiffness = _BRISTLE_STIFFNESS * inertia / site.step**2
    damping = 2.0 * _BRISTLE_DAMPING * sqrt(stiffness * inertia)
    values = (forward, backward, surplus, velocity, stiffness, damping)
    return (Element(ElementKind.BRISTLES, site.mass(location), -1, values),)
