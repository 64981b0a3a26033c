"""What stands between the drive's numbers and the shaft: wrong scales, lags, delays, encoder errors."""

from dataclasses import dataclass
from math import pi
from typing import ClassVar

from drives.sim.effects.shapes import check_number


@dataclass(frozen=True)
class TorqueScale:
    """The motor gives this many times the torque that the drive reports; model name torque_scale.

    Valid for: a wrong torque constant or gear ratio in the drive, a hot motor's weaker magnets.
    """

    name: ClassVar[str] = "torque_scale"
    factor: float
    """Above 0."""

    def __post_init__(self) -> None:
        check_number(self.name, "factor", self.factor, "", 1e-6)


@dataclass(frozen=True)
class TorqueSaturation:
    """The motor's iron saturates: T / (1 + (T / torque)^6)^(1/6); model name torque_saturation."""

    name: ClassVar[str] = "torque_saturation"
    torque: float
    """N m or N that the motor never exceeds, above 0; at this reported torque it gives 0.89 of it."""

    def __post_init__(self) -> None:
        check_number(self.name, "torque", self.torque, "N m (N)", 1e-12)


@dataclass(frozen=True)
class TorqueLag:
    """The shaft's torque follows the reported one as current in a winding; model name torque_lag.

    i' = (u - i) / time, stepped exactly.
    """

    name: ClassVar[str] = "torque_lag"
    time: float
    """Time constant L/R, s, above 0."""

    def __post_init__(self) -> None:
        check_number(self.name, "time", self.time, "s", 1e-9, 10.0)


@dataclass(frozen=True)
class MeasurementDelay:
    """The position that the host gets is older than the torque; model name measurement_delay.

    A queue of whole inner steps between encoder and the drive's communication; the drive's own loops
    have the position at once.
    """

    name: ClassVar[str] = "measurement_delay"
    time: float
    """s, at least 0; rounded to inner steps."""

    def __post_init__(self) -> None:
        check_number(self.name, "time", self.time, "s", 0.0, 0.1)


@dataclass(frozen=True)
class EncoderError:
    """The encoder's sine and cosine tracks have offsets; model name encoder_error.

    The angle within a period is that of (cos x + o cos p, sin x + o sin p): for small o a sine of the
    position with the given amplitude and the same period.  The drive's loops see it, too.
    """

    name: ClassVar[str] = "encoder_error"
    amplitude: float
    """rad or m, above 0; less than a sixth of a period."""
    periods: float
    """A revolution, or a metre, above 0."""
    phase: float = 0.0
    """p, rad."""
    linear: bool = False

    def __post_init__(self) -> None:
        check_number(self.name, "periods", self.periods, "", 1e-6)
        check_number(self.name, "amplitude", self.amplitude, "rad (m)", 1e-15, 1.0 / self.periods)
        check_number(self.name, "phase", self.phase, "rad")

    @property
    def rate(self) -> float:
        """Rad of the track per rad (or m) of the shaft."""
        return 2.0 * pi * self.periods if self.linear else self.periods
