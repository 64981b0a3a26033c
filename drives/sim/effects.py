"""Parts that can be added to the plain chains of masses and springs, named as in ``model.yaml``.

There are two ways for a part to act, and they meet the plant at two places:

- A *linear* part changes the matrices of M q'' + C q' + K q = f before anything moves; it has the
  shape of :class:`LinearEffect` and costs nothing while the plant is stepped.
- A part with a bend or a memory (dry friction, a gap) can not stand in a matrix.  It is a
  generalised force f on single masses, evaluated once an inner step and held over it; that is why
  :meth:`drives.sim.plant.Plant.discretise` gives the input matrix of *every* mass.
"""

from dataclasses import dataclass
from math import isfinite
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]


class LinearEffect(Protocol):
    """What the plant asks of a part that stands in its matrices."""

    def damping(self, size: int) -> FloatArray:
        """What the part adds to C of a plant with ``size`` masses, shape (size, size)."""
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
