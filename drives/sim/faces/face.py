"""What a maker's drive looks like from the bus: objects, units, gains, and its own ways.

The firmware behind it stays the same cascade in SI.  A face converts with the maker's formulas,
written down here by hands of their own; the host converts by its profile.  Where the two do not
agree, a gain comes out wrong and the machine moves otherwise.

What faces do not imitate is said in each of them, and in ``Face.not_imitated``.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Protocol

from drives.sim.dictionary import Key, Value
from drives.sim.entries import OBJECTS, Entry, ObjectEntry
from drives.sim.servo_kernel import Parameter

Read = Callable[[int, int], Value]
"""Reads the drive's own dictionary."""


@dataclass(frozen=True)
class Motor:
    """What a face has to know of one drive's motor and encoder."""

    rated_torque: float
    """N m (or N)."""
    peak_torque: float
    torque_constant: float
    """N m/A (or N/A)."""
    counts_per_rev: int
    """Encoder increments a revolution."""
    counts_per_unit: float
    """Encoder counts per rad (or m)."""
    gains: Mapping[str, float]
    """Start values by the firmware's names, SI."""

    @property
    def turn(self) -> float:
        """Rad (or m) of a motor revolution."""
        return self.counts_per_rev / self.counts_per_unit


class Loops(Protocol):
    """How the objects of one drive are its firmware's parameters."""

    @property
    def keys(self) -> tuple[Key, ...]:
        """Objects that act on the loops."""

    @property
    def locked(self) -> tuple[Key, ...]:
        """Those that may be written only while the power stage is off."""

    def factory(self) -> dict[Key, Value]:
        """Values of the objects for the motor's start gains.

        Raises
        ------
        ValueError
            If a name is not known or a value out of its object's range.
        """

    def settings(self, read: Read) -> dict[Parameter, float]:
        """Firmware parameters for what the objects hold now, SI."""


class FixedLoops:
    """Gains that no object reaches: those that the drive was given by other means."""

    keys: tuple[Key, ...] = ()
    locked: tuple[Key, ...] = ()

    def __init__(self, motor: Motor) -> None:
        self._settings = start_settings(motor.gains)

    def factory(self) -> dict[Key, Value]:
        """No object holds a gain."""
        return {}

    def settings(self, read: Read) -> dict[Parameter, float]:  # noqa: ARG002
        """Return the gains that the drive began with."""
        return dict(self._settings)


def start_settings(gains: Mapping[str, float]) -> dict[Parameter, float]:
    """Return start gains by the firmware's parameters; raise ValueError for a name it lacks."""
    known = {parameter.name.lower(): parameter for parameter in Parameter}
    for name in gains:
        if name not in known:
            raise ValueError(f"the simulated drive has no gain {name!r}; it has {', '.join(known)}")
    return {known[name]: float(value) for name, value in gains.items()}


@dataclass(frozen=True)
class Lock:
    """A password in front of some objects."""

    password_key: Key
    level_key: Key
    password: bytes
    keys: frozenset[Key]


def _no_values(_motor: Motor) -> dict[Key, Value]:
    return {}


def counts_units(motor: Motor) -> tuple[float, float]:
    """Velocities in counts/s, accelerations in counts/s2."""
    return 1 / motor.counts_per_unit, 1 / motor.counts_per_unit


def rpm_units(motor: Motor) -> tuple[float, float]:
    """Velocities in revolutions a minute, accelerations in rpm/s."""
    return motor.turn / 60, motor.turn / 60


@dataclass(frozen=True)
class Face:
    """One kind of drive."""

    name: str
    loops: Callable[[Motor], Loops]
    objects: tuple[ObjectEntry, ...] = OBJECTS
    hidden: frozenset[Key] = frozenset()
    """Entries that the firmware works with and the drive does not show."""
    eds: bytes = b""
    """What object 0x1021 gives, where there is one."""
    units: Callable[[Motor], tuple[float, float]] = counts_units
    """Rad/s per velocity unit, and rad/s2 per acceleration unit."""
    values: Callable[[Motor], dict[Key, Value]] = _no_values
    """Objects that tell of motor and encoder."""
    read_only: frozenset[Key] = frozenset()
    """Entries that the drive refuses to have written, whatever its EDS says."""
    latches: Mapping[Key, int] = field(default_factory=lambda: MappingProxyType({}))
    """Objects whose bits act when they are written, and read as 0."""
    fault_after_lost_heartbeat: bool = False
    """A lost heartbeat is a fault whatever 0x6007 says; a fault reset works only after a reset of
    the communication."""
    lock: Lock | None = None
    not_imitated: tuple[str, ...] = ()

    @property
    def shown(self) -> tuple[ObjectEntry, ...]:
        """Its objects as others see them."""
        visible = (
            replace(o, entries=tuple(e for e in o.entries if e.key not in self.hidden))
            for o in self.objects
        )
        return tuple(o for o in visible if o.entries)

    @property
    def entries(self) -> dict[Key, Entry]:
        """Every entry, hidden ones too, by index and sub-index."""
        return {e.key: e for o in self.objects for e in o.entries}
