"""What a maker's drive looks like from the bus: objects, units, gains, and its own ways.

The firmware behind it stays the same cascade in SI.  A face converts with the maker's formulas,
written down here by hands of their own; the host converts by its profile.  Where the two do not
agree, a gain comes out wrong and the machine moves otherwise.

What faces do not imitate is said in each of them, and in ``Face.not_imitated``.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from math import sqrt
from types import MappingProxyType
from typing import Protocol

from drives.sim.dictionary import Key, Value
from drives.sim.entries import OBJECTS, Entry, ObjectEntry
from drives.sim.memory import SAVE
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


def pid_of(outer: float, inner: float, reset: float) -> tuple[float, float, float]:
    """Return P, I and D of one PID that does as a cascade of position P and velocity P and I."""
    return outer * inner + reset, outer * reset, inner


def cascade_of(stiffness: float, windup: float, damping: float) -> dict[Parameter, float]:
    """Return the cascade with the whole reference velocity fed forward that is this PID."""
    settings = {Parameter.VELOCITY_FF: 1.0, Parameter.VELOCITY_P: damping}
    if damping > 0.0:
        # s^2 - (P/D) s + I/D = 0 has the two corner frequencies of the PID's zeros
        half = stiffness / damping / 2
        apart = sqrt(max(0.0, half * half - windup / damping))
        settings[Parameter.POSITION_P] = half + apart
        settings[Parameter.VELOCITY_I] = damping * (half - apart)
    else:
        settings[Parameter.POSITION_P] = settings[Parameter.VELOCITY_I] = 0.0
    return settings


@dataclass(frozen=True)
class Lock:
    """A password in front of some objects."""

    password_key: Key
    level_key: Key | None
    """Object that shows who the drive takes us for; none: it does not tell."""
    password: bytes
    keys: frozenset[Key]


@dataclass(frozen=True)
class Storing:
    """How the drive is told to store its parameters."""

    key: Key = (0x1010, 1)
    signature: int = SAVE
    disabled_only: bool = False
    """Whether it refuses while its power stage is on."""
    status: tuple[Key, int] | None = None
    """Object that shows whether it is done, and its value then."""


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
    waiting: Mapping[Key, Key] = field(default_factory=lambda: MappingProxyType({}))
    """Objects whose values act only once a latch is set: that latch."""
    storing: Storing = Storing()
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
