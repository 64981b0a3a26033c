"""How the simulated drive's objects relate to its firmware's parameters in SI."""

from dataclasses import dataclass
from math import inf

from drives.sim.dictionary import Key, Value
from drives.sim.entries import ENTRIES
from drives.sim.firmware import Parameter

_OFF = 2**32 - 1
"""Value of 0x6065 that switches the following error's supervision off (CiA 402)."""

GAINS: dict[Key, tuple[Parameter, float]] = {
    (0x2010, 1): (Parameter.POSITION_P, 1e-3),
    (0x2010, 2): (Parameter.VELOCITY_P, 1e-3),
    (0x2010, 3): (Parameter.VELOCITY_I, 1e-3),
    (0x2010, 4): (Parameter.VELOCITY_FF, 1e-3),
    (0x2010, 5): (Parameter.INERTIA_FF, 1e-6),
    (0x2010, 6): (Parameter.VELOCITY_FILTER, 1e-3),
    (0x2020, 1): (Parameter.FILTER1_TYPE, 1.0),
    (0x2020, 2): (Parameter.FILTER1_FREQUENCY, 1e-3),
    (0x2020, 3): (Parameter.FILTER1_ZERO_DAMPING, 1.0),
    (0x2020, 4): (Parameter.FILTER1_POLE_DAMPING, 1.0),
    (0x2021, 1): (Parameter.FILTER2_TYPE, 1.0),
    (0x2021, 2): (Parameter.FILTER2_FREQUENCY, 1e-3),
    (0x2021, 3): (Parameter.FILTER2_ZERO_DAMPING, 1.0),
    (0x2021, 4): (Parameter.FILTER2_POLE_DAMPING, 1.0),
}
"""Manufacturer objects: firmware parameter, and SI value per unit of the object."""

FILTER_KEYS = tuple(key for key in GAINS if key[0] in (0x2020, 0x2021))
"""May be written only while the power stage is off."""

GAIN_NAMES: dict[str, Key] = {parameter.name.lower(): key for key, (parameter, _) in GAINS.items()}
"""Names of the gains in machine profiles: their objects."""

LIMIT_KEYS: tuple[Key, ...] = (
    (0x6065, 0),
    (0x6066, 0),
    (0x6072, 0),
    (0x607D, 1),
    (0x607D, 2),
    (0x607F, 0),
    (0x6080, 0),
)
"""Standard objects that the firmware watches."""


@dataclass(frozen=True)
class Scales:
    """What one unit of the drive's objects is in SI."""

    counts_per_unit: float
    """Encoder counts per rad (or m)."""
    rated_torque: float
    """N m (or N)."""
    velocity_unit: float = 0.0
    """Rad/s (or m/s) per velocity unit; 0: counts/s."""
    acceleration_unit: float = 0.0
    """Rad/s2 (or m/s2) per acceleration unit; 0: counts/s2."""

    def velocity(self, units: float) -> float:
        """Rad/s (or m/s)."""
        return units * self.velocity_unit if self.velocity_unit else self.position(units)

    def acceleration(self, units: float) -> float:
        """Rad/s2 (or m/s2)."""
        return units * self.acceleration_unit if self.acceleration_unit else self.position(units)

    @property
    def velocity_units(self) -> float:
        """Velocity units per rad/s (or m/s)."""
        return 1 / self.velocity_unit if self.velocity_unit else self.counts_per_unit

    def position(self, counts: float) -> float:
        """Rad (or m); also rad/s of counts/s and so on."""
        return counts / self.counts_per_unit

    def torque(self, per_mille: float) -> float:
        """N m (or N)."""
        return per_mille * self.rated_torque / 1000.0

    def limit(self, key: Key, value: float) -> tuple[Parameter, float]:
        """Return the firmware parameter of one of ``LIMIT_KEYS`` and its SI value."""
        match key:
            case (0x6065, 0):
                window = inf if value == _OFF else self.position(value)
                return Parameter.FOLLOWING_ERROR_WINDOW, window
            case (0x6066, 0):
                return Parameter.FOLLOWING_ERROR_TIMEOUT, value / 1000.0
            case (0x6072, 0):
                return Parameter.TORQUE_LIMIT, self.torque(value)
            case (0x607D, 1):
                return Parameter.POSITION_MIN, self.position(value)
            case (0x607D, 2):
                return Parameter.POSITION_MAX, self.position(value)
            case _:
                return Parameter.MAX_VELOCITY, self.velocity(value)


def gain_objects(gains: dict[str, float]) -> dict[Key, Value]:
    """Return objects for gains given by name in SI.

    Raises
    ------
    ValueError
        If a name is not known or a value is out of its object's range.
    """
    objects: dict[Key, Value] = {}
    for name, value in gains.items():
        key = GAIN_NAMES.get(name)
        if key is None:
            known = ", ".join(GAIN_NAMES)
            raise ValueError(f"the simulated drive has no gain {name!r}; it has {known}")
        entry, scale = ENTRIES[key], GAINS[key][1]
        raw: float = value / scale if scale == 1.0 and "damping" in name else round(value / scale)
        low, high = entry.low or 0, entry.high if entry.high is not None else inf
        if not low <= raw <= high:
            raise ValueError(
                f"gain {name} = {value:g} is out of the simulated drive's range "
                f"{low * scale:g} to {high * scale:g}"
            )
        objects[key] = raw
    return objects
