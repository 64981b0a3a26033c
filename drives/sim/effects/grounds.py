"""Forces from outside on single masses (gravity, magnets, rotors), and a mass that hangs on one."""

from dataclasses import dataclass
from math import cos, pi, sin

from scipy.special import iv

from drives.sim.effects.shapes import (
    Element,
    ElementKind,
    Location,
    Site,
    check_location,
    check_number,
)


@dataclass(frozen=True)
class Gravity:
    """Weight on one mass; model name gravity.

    On a rotary axis a weight on an arm: the torque is the vector product of arm and weight.  On a linear
    axis a constant force.  The axis has a brake at its motor, closed while the power stage is off.

    Raises
    ------
    ValueError
        If a value is not physical.
    """

    torque: float
    """N m with the arm horizontal, or N; the force on a linear axis is -torque.  Not 0."""
    angle: float | None = 0.0
    """Of the arm from hanging down at position 0, rad; None on a linear axis."""
    location: Location = "load"
    brake: float = 1e4
    """Torque of the brake over that of the weight, above 1."""

    def __post_init__(self) -> None:
        check_location("gravity", self.location)
        check_number("gravity", "torque", self.torque, "N m (N)")
        check_number("gravity", "brake", self.brake, "", 1.0)
        if self.angle is not None:
            check_number("gravity", "angle", self.angle, "rad")

    @property
    def brake_torque(self) -> float:
        """What the brake holds, N m or N."""
        return self.brake * abs(self.torque)

    def elements(self, site: Site) -> tuple[Element, ...]:
        """One pendulum or weight."""
        mass = site.mass(self.location)
        if self.angle is None:
            return (Element(ElementKind.CONSTANT, mass, -1, (-self.torque,)),)
        values = (self.torque, cos(self.angle), sin(self.angle))
        return (Element(ElementKind.PENDULUM, mass, -1, values),)


@dataclass(frozen=True)
class Cogging:
    """Torque that wants the motor in one of many places; model name cogging.

    The detents have the shape of exp(s cos x) sin x, scaled so that its first harmonic has the given
    amplitude; harmonics 2, 3 ... follow from the sharpness s.
    Source: the first harmonic is 2 I1(s) / s (Abramowitz, Stegun, 9.6.19).

    Raises
    ------
    ValueError
        If a value is not physical.
    """

    torque: float
    """Amplitude of the first harmonic, N m or N, above 0."""
    periods: float
    """Detents a revolution of a rotary axis, or a metre of a linear one, above 0."""
    phase: float = 0.0
    """rad at position 0."""
    sharpness: float = 0.3
    """0 to 3."""
    linear: bool = False

    def __post_init__(self) -> None:
        check_number("cogging", "torque", self.torque, "N m (N)", 1e-12)
        check_number("cogging", "periods", self.periods, "", 1e-6)
        check_number("cogging", "phase", self.phase, "rad")
        check_number("cogging", "sharpness", self.sharpness, "", 0.0, 3.0)

    def elements(self, site: Site) -> tuple[Element, ...]:
        """One ring of magnets at the motor."""
        s = max(self.sharpness, 1e-6)
        scale = self.torque * s / (2.0 * float(iv(1, s)))
        rate = 2.0 * pi * self.periods if self.linear else self.periods
        values = (scale, rate, self.phase, s)
        return (Element(ElementKind.MAGNETS, site.mass("motor"), -1, values),)


@dataclass(frozen=True)
class PeriodicDisturbance:
    """A force that goes round by itself, as of a fan or a pump; model name periodic_disturbance."""

    torque: float
    """Amplitude, N m or N, above 0."""
    frequency: float
    """Hz, above 0."""
    phase: float = 0.0
    """rad at time 0."""
    location: Location = "load"

    def __post_init__(self) -> None:
        check_location("periodic disturbance", self.location)
        check_number("periodic disturbance", "torque", self.torque, "N m (N)", 1e-12)
        check_number("periodic disturbance", "frequency", self.frequency, "Hz", 1e-6)
        check_number("periodic disturbance", "phase", self.phase, "rad")

    def elements(self, site: Site) -> tuple[Element, ...]:
        """One rotor."""
        values = (self.torque, 2.0 * pi * self.frequency, self.phase)
        return (Element(ElementKind.ROTOR, site.mass(self.location), -1, values),)


@dataclass(frozen=True)
class ExtraMode:
    """A mass on a spring that hangs on a mass of the chain; model name extra_mode.

    Valid for: cable carriers, covers, tools: whatever swings along and is no part of the chain.
    """

    inertia: float
    """kg m2 or kg, above 0."""
    frequency: float
    """Of the mass on its spring with the other end held, Hz, above 0."""
    damping: float = 0.02
    """Damping ratio of that, at least 0."""
    location: Location = "load"

    def __post_init__(self) -> None:
        check_location("extra mode", self.location)
        check_number("extra mode", "inertia", self.inertia, "kg m2 (kg)", 1e-12)
        check_number("extra mode", "frequency", self.frequency, "Hz", 1e-6)
        check_number("extra mode", "damping", self.damping, "", 0.0, 5.0)

    @property
    def spring(self) -> float:
        """N m/rad or N/m."""
        return float(self.inertia * (2.0 * pi * self.frequency) ** 2)

    @property
    def damper(self) -> float:
        """N m s/rad or N s/m."""
        return float(4.0 * pi * self.damping * self.frequency * self.inertia)
