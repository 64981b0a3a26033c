"""What a simulated drive is made of and what can be set in it: hardware, ranges, factory values."""

from dataclasses import dataclass
from math import inf, isfinite

from drives.sim.biquad import FilterType
from drives.sim.servo_kernel import Parameter

_STANDSTILL_COUNTS = 2.0
"""Counts an inner step that pass for standstill unless a threshold is set."""


@dataclass(frozen=True)
class DriveHardware:
    """What can not be changed in a drive.

    Raises
    ------
    ValueError
        If a value is not physical.
    """

    rated_torque: float
    """N m, above 0: 1000 in the torque objects."""
    torque_noise: float
    """Standard deviation of the torque *measurement*, N m; the motor does not feel it."""
    counts_per_unit: float
    """Encoder counts per rad (or m), above 0."""
    current_bandwidth: float = 1000.0
    """Of the current loop, Hz, above 0."""
    peak_torque: float = inf
    """N m, above 0: never exceeded, whatever the torque limit says."""

    def __post_init__(self) -> None:
        for name, unit in (
            ("rated_torque", "N m"),
            ("counts_per_unit", "counts/rad"),
            ("current_bandwidth", "Hz"),
        ):
            value = getattr(self, name)
            if not (isfinite(value) and value > 0.0):
                raise ValueError(f"{name} is {value} {unit}; it must be finite and above 0")
        if not self.peak_torque > 0.0:
            raise ValueError(f"peak_torque is {self.peak_torque} N m; it must be above 0")
        if not (isfinite(self.torque_noise) and self.torque_noise >= 0.0):
            raise ValueError(
                f"torque_noise is {self.torque_noise} N m; it must be finite and at least 0"
            )


@dataclass(frozen=True)
class ParameterRange:
    """Values a parameter may have, both ends included."""

    low: float
    high: float
    unit: str


def ranges(rate: float) -> dict[Parameter, ParameterRange]:
    """What every parameter may be in a loop that runs at ``rate``, Hz."""
    filter_type = ParameterRange(0.0, float(max(FilterType)), "(0 off, 1 notch, 2 low-pass)")
    filter_frequency = ParameterRange(0.1, 0.49 * rate, "Hz")
    zero_damping, pole_damping = ParameterRange(0.0, 10.0, ""), ParameterRange(1e-3, 10.0, "")
    return {
        Parameter.POSITION_P: ParameterRange(0.0, 1e5, "1/s"),
        Parameter.VELOCITY_P: ParameterRange(0.0, 1e9, "N m s/rad"),
        Parameter.VELOCITY_I: ParameterRange(0.0, 1e12, "N m/rad"),
        Parameter.VELOCITY_FF: ParameterRange(0.0, 1.0, "of the reference's velocity"),
        Parameter.INERTIA_FF: ParameterRange(0.0, 1e9, "kg m2"),
        Parameter.VELOCITY_FILTER: ParameterRange(0.1, inf, "Hz"),
        Parameter.FILTER1_TYPE: filter_type,
        Parameter.FILTER1_FREQUENCY: filter_frequency,
        Parameter.FILTER1_ZERO_DAMPING: zero_damping,
        Parameter.FILTER1_POLE_DAMPING: pole_damping,
        Parameter.FILTER2_TYPE: filter_type,
        Parameter.FILTER2_FREQUENCY: filter_frequency,
        Parameter.FILTER2_ZERO_DAMPING: zero_damping,
        Parameter.FILTER2_POLE_DAMPING: pole_damping,
        Parameter.TORQUE_LIMIT: ParameterRange(0.0, inf, "N m"),
        Parameter.FOLLOWING_ERROR_WINDOW: ParameterRange(0.0, inf, "rad"),
        Parameter.FOLLOWING_ERROR_TIMEOUT: ParameterRange(0.0, 1e6, "s"),
        Parameter.VELOCITY_OFFSET: ParameterRange(-1e9, 1e9, "rad/s"),
        Parameter.TORQUE_OFFSET: ParameterRange(-1e9, 1e9, "N m"),
        Parameter.TORQUE_SLOPE: ParameterRange(0.0, inf, "N m/s"),
        Parameter.MAX_VELOCITY: ParameterRange(0.0, inf, "rad/s"),
        Parameter.POSITION_MIN: ParameterRange(-inf, inf, "rad"),
        Parameter.POSITION_MAX: ParameterRange(-inf, inf, "rad"),
        Parameter.VELOCITY_THRESHOLD: ParameterRange(0.0, inf, "rad/s"),
        Parameter.VELOCITY_THRESHOLD_TIME: ParameterRange(0.0, 1e6, "s"),
        Parameter.VISCOUS_FF: ParameterRange(0.0, 1e9, "N m s/rad"),
    }


def factory_values(hardware: DriveHardware, rate: float) -> dict[Parameter, float]:
    """What a new drive holds; its gains are 0, so one that nobody has tuned does not move."""
    return {
        Parameter.POSITION_P: 0.0,
        Parameter.VELOCITY_P: 0.0,
        Parameter.VELOCITY_I: 0.0,
        Parameter.VELOCITY_FF: 1.0,
        Parameter.INERTIA_FF: 0.0,
        Parameter.VELOCITY_FILTER: inf,
        Parameter.FILTER1_TYPE: FilterType.OFF,
        Parameter.FILTER1_FREQUENCY: 0.1 * rate,
        Parameter.FILTER1_ZERO_DAMPING: 0.05,
        Parameter.FILTER1_POLE_DAMPING: 0.5,
        Parameter.FILTER2_TYPE: FilterType.OFF,
        Parameter.FILTER2_FREQUENCY: 0.1 * rate,
        Parameter.FILTER2_ZERO_DAMPING: 0.05,
        Parameter.FILTER2_POLE_DAMPING: 0.5,
        Parameter.TORQUE_LIMIT: hardware.peak_torque,
        Parameter.FOLLOWING_ERROR_WINDOW: inf,
        Parameter.FOLLOWING_ERROR_TIMEOUT: 0.01,
        Parameter.VELOCITY_OFFSET: 0.0,
        Parameter.TORQUE_OFFSET: 0.0,
        Parameter.TORQUE_SLOPE: inf,
        Parameter.MAX_VELOCITY: inf,
        Parameter.POSITION_MIN: -inf,
        Parameter.POSITION_MAX: inf,
        Parameter.VELOCITY_THRESHOLD: _STANDSTILL_COUNTS * rate / hardware.counts_per_unit,
        Parameter.VELOCITY_THRESHOLD_TIME: 0.01,
        Parameter.VISCOUS_FF: 0.0,
    }
