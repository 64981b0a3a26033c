"""What a drive allows a design to use: its parameters, their steps and ranges, timing, encoder."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from math import inf, isclose, isfinite, nan, prod

from drives.units import Kind, unit_on
from fieldtool.design.rule import DesignError
from fieldtool.design.servo import Servo, Timing, servo_from_parameters

GAINS = ("position_p", "velocity_p", "velocity_i")
PID = ("pid_p", "pid_i", "pid_d")
ABOVE_ZERO = ("position_p", "velocity_p", "pid_p", "pid_d")
"""Gains that no loop goes without: what rounds to 0 is one step of the drive's."""
FEED_FORWARD = ("velocity_ff", "viscous_ff", "inertia_ff")
"""That a design chooses."""
FILTERS = (1, 2)
CAUTIOUS = Timing()
UNITS = {
    "position_p": "1/s",
    "velocity_p": "N m s/rad",
    "velocity_i": "N m/rad",
    "pid_p": "N m/rad",
    "pid_i": "N m/(rad s)",
    "pid_d": "N m s/rad",
    "inertia_ff": "kg m2",
    "viscous_ff": "N m s/rad",
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
    times: Mapping[str, int] = field(default_factory=dict)
    """Parameters before it that the scale goes with, with their powers."""

    def beside(self, others: Mapping[str, float]) -> "Hold":
        """Return how it is held while those parameters are so; anything where one is not known or 0."""
        if not self.times:
            return self
        if any(not others.get(name) for name in self.times):
            return Hold()
        scale = self.scale * prod(others[name] ** power for name, power in self.times.items())
        return replace(self, scale=scale, times={}) if isfinite(scale) and scale > 0 else Hold()

    def nearest(self, value: float) -> float:
        """Return the physical value next to one that is wanted, within all bounds.

        Where no whole number is within the bounds of the physical value, one beside them.
        """
        value = self._inside(value)
        if self.power < 0 and value == 0:
            return 0.0
        held = (value / self.scale) ** self.power
        near = (float(round(held) + k) for k in (0, -1, 1)) if self.whole else [held]
        values = [self._physical(min(max(one, self.low), self.high)) for one in near]
        for one in values:
            if isclose(one, self._inside(one), rel_tol=1e-9):
                return self._inside(one)  # rounding up must not leave the range
        return values[0]

    def above_zero(self, value: float) -> float:
        """Return the same, but one step of the drive where that is 0."""
        found = self.nearest(value)
        return found if found > 0 or not self.whole else self.nearest(self.scale)

    def _physical(self, held: float) -> float:
        if self.power < 0 and held == 0:
            return 0.0
        return self.scale * held**self.power

    def _inside(self, value: float) -> float:
        return min(max(value, self.minimum), self.maximum)

    @property
    def bounds(self) -> tuple[float, float]:
        """Smallest and largest physical value."""
        if self.power < 0:
            return self.minimum, self.maximum
        low = max(self.scale * self.low, self.minimum)
        high = min(self.scale * self.high, self.maximum)
        if not self.whole:
            return low, high
        return (
            self.nearest(low) if isfinite(low) else low,
            self.nearest(high) if isfinite(high) else high,
        )


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
    """By parameter, those that others' scales go with first; one that is not named holds any number."""
    present: Mapping[str, float] | None = None
    """What the drive holds now, by parameter, SI; None where it can not be read."""
    unreadable: str = ""
    """Why not, in words."""
    kind: Kind = "rotary"
    is_pid: bool = False
    """Whether the drive's loop is one PID, also where it is not known how it holds some of it."""
    unused: Mapping[str, float | None] = field(default_factory=dict)
    """Feed-forward that no design chooses and no prediction has: what the drive holds, in its own units;
    None: not known.  It stays as it is."""
    by_hand: bool = False
    """Whether no gain of the drive can be written, whatever parameters it has."""

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
    def notches(self) -> bool:
        """Whether each of those can be a notch; else they are low-passes alone."""
        return all(self.has(f"filter{k}_zero_damping") for k in self.filters)

    @property
    def missing(self) -> tuple[str, ...]:
        """Gains that a design has and the drive can not be told: for a person to enter."""
        return tuple(name for name in GAINS if self.by_hand or not self.has(name))

    def hold_of(self, name: str) -> Hold | None:
        """Return how the drive holds a parameter beside the present ones; None: any number.

        A PID's D is the velocity's P.
        """
        whole = name == "velocity_p" and self.is_pid
        hold = self.holds.get("pid_d" if whole else name)
        return None if hold is None else hold.beside(self.present or {})

    def _holds_beside(self, told: Mapping[str, float]) -> dict[str, Hold]:
        """Return how the drive holds the parameters that it is told, together."""
        others = {**(self.present or {}), **told}
        return {name: hold.beside(others) for name, hold in self.holds.items() if name in told}

    def check_gains(self) -> None:
        """Refuse a drive that holds nothing above 0 of a gain that no loop goes without.

        Raises
        ------
        DesignError
            If it is one.
        """
        for name in ABOVE_ZERO:
            hold = self.holds.get(name, Hold()).beside(self.present or {})
            if not hold.bounds[1] > 0:
                raise DesignError(
                    f"{self.axis}: its drive holds no {name} above 0, so there is no loop to design; "
                    "nothing is written. Choose other units or ranges in the drive."
                )

    def held(self, parameters: Mapping[str, float]) -> dict[str, float]:
        """Return parameters as the drive will hold them, each beside what those before it became.

        Those of a drive whose loop is one PID come back as the cascade that the rounded PID is.

        Raises
        ------
        DesignError
            If the PIDs that such a drive can hold are no cascade, or it holds no gains above 0.
        """
        self.check_gains()
        rounded = self._told(parameters)
        for name in self.holds:
            if name in rounded:
                hold = self._holds_beside(rounded)[name]
                near = hold.above_zero if name in ABOVE_ZERO else hold.nearest
                rounded[name] = near(rounded[name])
        if not all(name in rounded for name in PID):
            return rounded
        hold = self._holds_beside(rounded).get("pid_i", Hold())
        p, i, d = (rounded.pop(name) for name in PID)
        i = self._integral(hold, p, i, d)
        root = max(p * p - 4 * i * d, 0.0) ** 0.5
        larger = (p + root) / 2
        return rounded | dict(zip(GAINS, (larger / d, d, p - larger), strict=True))

    def _integral(self, hold: Hold, p: float, i: float, d: float) -> float:
        """Return I, or less of it where a PID with this I is no cascade: P^2 >= 4 I D."""
        if p * p >= 4 * i * d:
            return i
        most = 0.999 * p * p / (4 * d)
        for wanted in (most, most - hold.scale):  # rounded up it may be too much
            less = hold.nearest(max(wanted, 0.0))
            if p * p >= 4 * less * d:
                return less
        raise DesignError(
            f"{self.axis}: the least I that its drive holds ({self.words('pid_i', less)}) is too much "
            f"for P {self.words('pid_p', p)} and D {self.words('pid_d', d)}: no position P and "
            "velocity PI are that PID. Nothing is written. Choose other units or ranges in the drive."
        )

    def _told(self, parameters: Mapping[str, float]) -> dict[str, float]:
        """Return parameters with the PID that the drive is told in place of the cascade's gains."""
        if not self.is_pid or any(name not in parameters for name in GAINS):
            return dict(parameters)
        kp, kv, ki = (parameters[name] for name in GAINS)
        others = {name: value for name, value in parameters.items() if name not in GAINS}
        return others | dict(zip(PID, (kv * kp + ki, ki * kp, kv), strict=True))

    def out_of_range(self, parameters: Mapping[str, float]) -> list[str]:
        """Return what does not fit into the drive, a phrase each."""
        told = self._told(parameters)
        return [
            f"{name} {self.words(name, told[name])} (the drive holds {low:.4g} to "
            f"{self.words(name, high)})"
            for name, hold in self._holds_beside(told).items()
            for low, high in [hold.bounds]
            if not low <= told[name] <= high
        ]

    def largest(self, parameters: Mapping[str, float]) -> list[str]:
        """Return gains and feed-forward that are the most that the drive holds, a phrase each."""
        told = self._told(parameters)
        holds = self._holds_beside(told)
        return [
            f"{name} {self.words(name, told[name])}"
            for name in (*GAINS, *PID, "viscous_ff", "inertia_ff")
            if name in holds
            if told[name] >= (1 - 1e-6) * holds[name].bounds[1]
        ]

    def smallest(self, parameters: Mapping[str, float]) -> list[str]:
        """Return gains of one step of the drive, the least that make a loop, a phrase each."""
        told = self._told(parameters)
        holds = self._holds_beside(told)
        return [
            f"{name} {self.words(name, told[name])}"
            for name in ABOVE_ZERO
            if name in holds and holds[name].whole
            if told[name] <= (1 + 1e-6) * holds[name].above_zero(0.0)
        ]

    def servo(self, parameters: Mapping[str, float]) -> Servo:
        """Return the controller that parameters make of this drive.

        What the drive can not be told keeps the value that it has now; a PID feeds the whole velocity
        forward.
        """
        values = {**(self.present or {}), **parameters}
        if self.is_pid:
            values["velocity_ff"] = 1.0
        return servo_from_parameters(values, self.timing)

    @property
    def present_servo(self) -> Servo | None:
        """The controller as it is now; None where it can not be read."""
        present = self.present
        if present is None or any(n not in present for n in GAINS):
            return None
        if not all(isfinite(present[n]) for n in GAINS):
            return None
        return self.servo({})
