"""What a drive allows a design to use: its parameters, their steps and ranges, timing, encoder."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from math import inf, isfinite, nan

from drives.units import Kind, unit_on
from fieldtool.design.servo import Servo, Timing, servo_from_parameters

GAINS = ("position_p", "velocity_p", "velocity_i")
PID = ("pid_p", "pid_i", "pid_d")
FILTERS = (1, 2)
CAUTIOUS = Timing()
UNITS = {
    "position_p": "1/s",
    "velocity_p": "N m s/rad",
    "velocity_i": "N m/rad",
    "inertia_ff": "kg m2",
    "velocity_filter": "Hz",
    **{f"filter{k}_frequency": "Hz" for k in FILTERS},
}
"""Of parameters on rotary axes; those that are not named have none."""


@dataclass(frozen=True)
class Hold:
    """How a drive holds one number: physical = scale * held ** power, held between two bounds."""

    scale: float = 1.0
    power: int = 1
    whole: bool = False
    """Whether only whole numbers are held."""
    low: float = -inf
    high: float = inf
    """Bounds of what is held."""
    minimum: float = -inf
    maximum: float = inf
    """Bounds of the physical value."""

    def nearest(self, value: float) -> float:
        """Return the physical value next to one that is wanted, within all bounds."""
        value = min(max(value, self.minimum), self.maximum)
        if self.power < 0 and value == 0:
            return 0.0
        held = (value / self.scale) ** self.power
        if self.whole:
            held = float(round(held))
        held = min(max(held, self.low), self.high)
        if self.power < 0 and held == 0:
            return 0.0
        return self.scale * held**self.power

    @property
    def bounds(self) -> tuple[float, float]:
        """Smallest and largest physical value."""
        low, high = (
            (self.scale * self.low, self.scale * self.high) if self.power > 0 else (-inf, inf)
        )
        return max(low, self.minimum), min(high, self.maximum)


@dataclass(frozen=True)
class DriveSide:
    """One axis' drive, as the design sees it."""

    axis: str
    tunable: frozenset[str] | None = None
    """Names of the parameters that the drive has; None: every one that a design can want."""
    timing: Timing = CAUTIOUS
    torque_limit: float = inf
    """N m or N."""
    resolution: float = nan
    """One step of the encoder, rad or m; NaN: not known."""
    holds: Mapping[str, Hold] = field(default_factory=dict)
    """By parameter; one that is not named holds any number."""
    present: Mapping[str, float] | None = None
    """What the drive holds now, by parameter, SI; None where it can not be read."""
    unreadable: str = ""
    """Why not, in words."""
    kind: Kind = "rotary"

    def words(self, name: str, value: float) -> str:
        """Return a parameter's value with its unit."""
        return f"{value:.4g} {unit_on(self.kind, UNITS.get(name, ''))}".strip()

    def has(self, name: str) -> bool:
        """Whether the drive has a parameter."""
        return self.tunable is None or name in self.tunable

    @property
    def filters(self) -> tuple[int, ...]:
        """Numbers of the torque filters that can be set."""
        needed = ("type", "frequency", "pole_damping")
        return tuple(k for k in FILTERS if all(self.has(f"filter{k}_{n}") for n in needed))

    @property
    def missing(self) -> tuple[str, ...]:
        """Gains that a design has and the drive can not be told: for a person to enter."""
        return tuple(name for name in GAINS if not self.has(name))

    def held(self, parameters: Mapping[str, float]) -> dict[str, float]:
        """Return parameters as the drive will hold them.

        Those of a drive whose loop is one PID come back as the cascade that the rounded PID is.
        """
        rounded = {
            name: self.holds[name].nearest(value) if name in self.holds else value
            for name, value in parameters.items()
        }
        if not all(name in self.holds for name in PID):
            return rounded
        kp, kv, ki = (parameters[name] for name in GAINS)
        wanted = dict(zip(PID, (kv * kp + ki, ki * kp, kv), strict=True))
        p, i, d = (self.holds[name].nearest(value) for name, value in wanted.items())
        hold = self.holds["pid_i"]
        while i > 0 and p * p < 4 * i * d:  # no cascade is that: less integral is one
            i = max(hold.nearest(min(i - hold.scale, 0.999 * i)), 0.0)
        root = max(p * p - 4 * i * d, 0.0) ** 0.5
        larger = (p + root) / 2
        return rounded | dict(zip(GAINS, (larger / d, d, p - larger), strict=True))

    def out_of_range(self, parameters: Mapping[str, float]) -> list[str]:
        """Return what does not fit into the drive, a phrase each."""
        return [
            f"{name} {self.words(name, parameters[name])} (the drive holds {low:.4g} to "
            f"{self.words(name, high)})"
            for name, hold in self.holds.items()
            if name in parameters
            for low, high in [hold.bounds]
            if not low <= parameters[name] <= high
        ]

    def largest(self, parameters: Mapping[str, float]) -> list[str]:
        """Return gains and inertia fed forward that are the most that the drive holds, a phrase each."""
        return [
            f"{name} {self.words(name, parameters[name])}"
            for name in (*GAINS, "inertia_ff")
            if name in parameters and name in self.holds
            if parameters[name] >= (1 - 1e-6) * self.holds[name].bounds[1]
        ]

    def servo(self, parameters: Mapping[str, float]) -> Servo:
        """Return the controller that parameters make of this drive.

        What the drive can not be told keeps the value that it has now.
        """
        kept = {k: v for k, v in (self.present or {}).items() if k not in parameters}
        return servo_from_parameters({**kept, **parameters}, self.timing)

    @property
    def present_servo(self) -> Servo | None:
        """The controller as it is now; None where it can not be read."""
        present = self.present
        if present is None or any(n not in present for n in GAINS):
            return None
        if not all(isfinite(present[n]) for n in GAINS):
            return None
        return servo_from_parameters(present, self.timing)
