"""Parts that can be added to the plain chains of masses and springs, named as in ``model.yaml``.

There are three ways for a part to act, and each meets the plant at a place of its own:

- A *linear* part changes the matrices of M q'' + C q' + K q = f before anything moves; it has the
  shape of :class:`LinearEffect` and costs nothing while the plant is stepped.
- A *holding* part (dry friction) takes a mass out of the motion while it sticks and is a constant
  force on it while it slides.  It has the shape of :class:`HoldingEffect`; a plant with one is
  stepped piece by piece, each piece exact (:mod:`drives.sim.stick_slip`).
- A part with a bend (a gap, a hardening spring) is a generalised force f on single masses,
  evaluated once an inner step and held over it; that is why
  :meth:`drives.sim.plant.Plant.discretise` gives the input matrix of *every* mass.

A part of a chain says where it sits by its ``location``; the plant numbers the masses.
"""

from dataclasses import dataclass
from math import isfinite
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
Location = Literal["motor", "load"]
"""First or last mass of a chain; on a rigid axis they are one."""


class LinearEffect(Protocol):
    """What the plant asks of a part that stands in its matrices."""

    def damping(self, size: int) -> FloatArray:
        """What the part adds to C of a plant with ``size`` masses, shape (size, size)."""
        ...


class HoldingEffect(Protocol):
    """What the plant asks of a part that can hold a mass still."""

    @property
    def location(self) -> Location:
        """Which mass of its chain it holds."""
        ...

    @property
    def torque(self) -> float:
        """Largest torque (or force) that it holds against and that acts while the mass slides."""
        ...


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
        if self.location not in ("motor", "load"):
            raise ValueError(
                f"coulomb friction: location {self.location!r} must be motor (first mass of the "
                "chain) or load (last mass)"
            )
        if not (isfinite(self.torque) and self.torque >= 0.0):
            raise ValueError(
                f"coulomb friction at the {self.location}: torque {self.torque} N m (N) must be "
                "finite and at least 0"
            )


ChainEffect = CoulombFriction
"""Every part that a chain can be given; a union once there are more."""
