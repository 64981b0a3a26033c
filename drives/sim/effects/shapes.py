"""What the plant and the drives ask of a part, and the checks that all parts share."""

from dataclasses import dataclass
from enum import IntEnum
from math import inf, isfinite
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
Location = Literal["motor", "load"]
"""First or last mass of a chain; on a rigid axis they are one."""
LOCATIONS = ("motor", "load")


class ElementKind(IntEnum):
    """Kinds of elements, and their values in order; the compiled loop knows them by number."""

    BRISTLES = 0
    """Sliding torque forwards, backwards, breakaway over sliding, Stribeck velocity, bristle
    stiffness, bristle damping.  Memory: bristle deflection."""
    GAP = 1
    """Half gap, spring and damper that the matrices have, share of the contact force that an impact's
    closing velocity adds.  Memory: in contact, largest closing velocity of this contact."""
    HARDENING = 2
    """Spring in the matrices, stretch."""
    SOFTENING = 3
    """Spring in the matrices, stretch."""
    MAXWELL = 4
    """Spring, relaxation time.  Memory: force, velocity of the step before."""
    SPRING_STEP = 5
    """Change of the spring, time when it begins, time that it takes."""
    PENDULUM = 6
    """Torque at the horizontal, cosine and sine of the angle from hanging down at position 0."""
    CONSTANT = 7
    """Force."""
    MAGNETS = 8
    """Largest torque, detents per rad (or m) times 2 pi, phase, sharpness."""
    ROTOR = 9
    """Amplitude, rad/s, phase.  Memory: cosine and sine."""


ELEMENT_VALUES, ELEMENT_MEMORY = 6, 2
"""Most values, and most numbers remembered, of an element."""


@dataclass(frozen=True)
class Element:
    """One force between two masses, or between a mass and ground."""

    kind: ElementKind
    first: int
    """Number of the mass that it acts on."""
    second: int
    """Number of the other one; -1 is ground."""
    values: tuple[float, ...]
    """As :class:`ElementKind` lists them, SI."""


@dataclass(frozen=True)
class Site:
    """The chain that a part is built into."""

    first: int
    """Number of the chain's first mass."""
    masses: tuple[float, ...]
    springs: tuple[float, ...]
    dampers: tuple[float, ...]
    step: float
    """Inner step, s."""

    def mass(self, location: Location) -> int:
        """Number of the first or last mass."""
        return self.first if location == "motor" else self.first + len(self.masses) - 1

    def inertia(self, location: Location) -> float:
        """The first or last mass, kg or kg m2."""
        return self.masses[0 if location == "motor" else -1]


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


class BentEffect(Protocol):
    """What the plant asks of a part with a bend or a memory."""

    def elements(self, site: Site) -> tuple[Element, ...]:
        """The forces that it is made of."""
        ...


class ServoEffect(Protocol):
    """What a drive asks of a part that sits in its motor, its current loop or its measurements."""

    @property
    def name(self) -> str:
        """Name of the effect, as in ``model.yaml``."""
        ...


def check_location(effect: str, location: str) -> None:
    """Raise ValueError unless it is motor or load."""
    if location not in LOCATIONS:
        raise ValueError(
            f"{effect}: location {location!r} must be motor (first mass of the chain) or load (last "
            "mass)"
        )


def check_number(
    effect: str, name: str, value: float, unit: str, low: float = -inf, high: float = inf
) -> None:
    """Raise ValueError unless the value is finite and within low and high, both included."""
    if not (isfinite(value) and low <= value <= high):
        bounds = " and ".join(
            [f"at least {low:g}"] * (low > -inf) + [f"at most {high:g}"] * (high < inf)
        )
        raise ValueError(
            f"{effect}: {name} is {value} {unit}; it must be finite{' and ' if bounds else ''}{bounds}"
        )
