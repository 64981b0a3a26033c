"""Matrices of a machine to be simulated, and the elements of it that are not linear.

Degrees of freedom run chain after chain, motor side first, as in
:mod:`fieldtool.records.model`; masses that effects add come after them.
"""

from dataclasses import dataclass, field, replace
from enum import IntEnum
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from fieldtool.records.model import MachineModel

FloatArray = NDArray[np.float64]


class Law(IntEnum):
    """The force with which an element pulls its ends together: elongation s, rate s', time t."""

    CUBIC = 1
    """p0 s**3."""
    GAP = 2
    """Makes of the spring p0 and the damper p1 a gap of half p2: nothing while p = abs(s) - p2 < 0, and
    p0 p + (p1 + p3) p' else, never pulling."""
    STEP = 3
    """p0 s from the time p1 on."""
    DRY = 4
    """p0 tanh(s' / p1)."""
    SOFT = 5
    """Makes of the spring p1 one of p1 s / sqrt(1 - 2 p0 s**2 / p1), p0 < 0: + p0 s**3 at first."""


@dataclass(frozen=True)
class Element:
    """A force between two masses, or between a mass and ground, beside the linear ones."""

    law: Law
    first: int
    second: int
    """-1 is ground."""
    values: tuple[float, float, float, float]
    """p0, p1, p2, p3."""


@dataclass(frozen=True)
class Relaxation:
    """A spring and a damper in series between two masses: a Maxwell branch."""

    first: int
    second: int
    stiffness: float
    """N m/rad or N/m."""
    time: float
    """Damper over spring, s."""


@dataclass(frozen=True, eq=False)
class Structure:
    """M q'' + C q' + K q = torque + elements + branches."""

    mass: FloatArray
    """(n, n)."""
    damping: FloatArray
    stiffness: FloatArray
    motors: NDArray[np.intp]
    """(M,): degree of freedom of each motor."""
    ends: NDArray[np.intp]
    """(M,): of each chain's last mass."""
    elements: tuple[Element, ...] = ()
    branches: tuple[Relaxation, ...] = field(default=())

    @classmethod
    def of(cls, model: MachineModel) -> "Structure":
        """Return the matrices of a model, without its effects."""
        return cls(
            model.mass_matrix,
            model.damping_matrix,
            model.stiffness_matrix,
            model.first_masses,
            model.last_masses,
        )

    @cached_property
    def key(self) -> bytes:
        """What tells it from every structure that behaves in another way."""
        matrices = (self.mass, self.damping, self.stiffness)
        numbers = b"".join(m.tobytes() for m in matrices)
        return numbers + repr((self.elements, self.branches)).encode()

    def between(self, begin: float, end: float) -> "Structure":
        """Return the structure as it is from one time to another: other steps are no elements."""
        left, stiffness = [], self.stiffness
        for e in self.elements:
            if e.law is not Law.STEP or begin < e.values[1] <= end:
                left.append(e)
            elif e.values[1] <= begin:
                stiffness = stiffness.copy()
                pair = np.ix_([e.first, e.second], [e.first, e.second])
                stiffness[pair] += e.values[0] * np.array([[1.0, -1.0], [-1.0, 1.0]])
        if len(left) == len(self.elements):
            return self
        return replace(self, stiffness=stiffness, elements=tuple(left))

    @cached_property
    def hidden(self) -> NDArray[np.intp]:
        """Degrees of freedom whose motion nobody measures, (H,)."""
        return np.setdiff1d(np.arange(self.mass.shape[0]), self.motors).astype(np.intp)

    def with_elements(self, *elements: Element) -> "Structure":
        """Return the structure with further elements."""
        return replace(self, elements=(*self.elements, *elements))

    def with_mass(self, at: int, mass: float, stiffness: float, damping: float) -> "Structure":
        """Return the structure with one more mass, on a spring and damper at a degree of freedom."""
        size = self.mass.shape[0]
        grown = [np.zeros((size + 1, size + 1)) for _ in range(3)]
        for matrix, old in zip(grown, (self.mass, self.damping, self.stiffness), strict=True):
            matrix[:size, :size] = old
        grown[0][size, size] = mass
        pair = np.ix_([at, size], [at, size])
        ones = np.array([[1.0, -1.0], [-1.0, 1.0]])
        grown[1][pair] += damping * ones
        grown[2][pair] += stiffness * ones
        return replace(self, mass=grown[0], damping=grown[1], stiffness=grown[2])
