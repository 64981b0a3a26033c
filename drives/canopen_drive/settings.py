"""What a drive is set to, read before anything moves: nothing is written."""

from dataclasses import dataclass
from math import isfinite

from drives import objects
from drives.canopen_drive.drive import CanopenDrive
from drives.cia402 import STATUS_INTERNAL_LIMIT, STATUS_WARNING
from drives.objects import ObjectInfo

SAMPLES = 10
"""Readings of the torque at rest."""
PER_MILLE = 1000.0
_NO_LIMIT = 2**31 - 1
"""A position limit at the end of its type is no limit."""


@dataclass(frozen=True)
class DriveSettings:
    """Settings of one drive, in SI where they have a scale; None where it has no such object."""

    position: float
    """Actual position, rad or m."""
    torque: tuple[float, ...]
    """Actual torque while the drive is disabled, some readings, N m or N."""
    count: float
    """One position unit, rad or m."""
    rated_torque: float
    """N m or N."""
    warning: bool
    """Bit 7 of the statusword."""
    internal_limit: bool
    """Bit 11 of the statusword."""
    travel: tuple[float, float] | None = None
    """Software position limits 0x607D, rad or m; None also where they are not in use."""
    velocity: float | None = None
    """Max profile velocity 0x607F, rad/s or m/s."""
    acceleration: float | None = None
    """Max acceleration 0x60C5, rad/s2 or m/s2; only where velocities count in position units/s."""
    max_torque: float | None = None
    """0x6072, N m or N."""
    following_error: float | None = None
    """Window 0x6065, rad or m; None also where it is off (the type's largest value)."""
    consumer_heartbeat: int | None = None
    """0x1016:01."""
    abort_connection: int | None = None
    """0x6007."""
    error_behaviour: int | None = None
    """0x1029:01."""
    quick_stop: int | None = None
    """0x605A."""


def read_settings(drive: CanopenDrive) -> DriveSettings:
    """Read what a drive is set to; its identity and scales are known already.

    Raises
    ------
    SdoError
        If an object that every drive has can not be read.
    """
    scale = drive.scaling
    status = drive.read_int(objects.STATUSWORD)
    torques = tuple(drive.read_int(objects.TORQUE_ACTUAL) * scale.torque for _ in range(SAMPLES))
    in_position_units = drive.profile.velocity == "position units/s"
    maximum = _optional(drive, objects.MAX_TORQUE)
    return DriveSettings(
        position=drive.read_position(),
        torque=torques,
        count=scale.position,
        rated_torque=drive.rated_torque,
        warning=bool(status & STATUS_WARNING),
        internal_limit=bool(status & STATUS_INTERNAL_LIMIT),
        travel=_travel(drive),
        velocity=_scaled(_optional(drive, objects.MAX_PROFILE_VELOCITY), scale.velocity),
        acceleration=_scaled(
            _optional(drive, objects.MAX_ACCELERATION),
            scale.position if in_position_units else None,
        ),
        max_torque=_scaled(maximum, scale.torque),
        following_error=following_error_window(drive),
        consumer_heartbeat=drive.read_optional(objects.CONSUMER_HEARTBEAT),
        abort_connection=drive.read_optional(objects.ABORT_CONNECTION),
        error_behaviour=drive.read_optional(objects.ERROR_BEHAVIOUR),
        quick_stop=drive.read_optional(objects.QUICK_STOP_OPTION),
    )


def following_error_window(drive: CanopenDrive) -> float | None:
    """Return the drive's own window 0x6065, rad or m; None where it has none, or it is off.

    Beyond it a drive stops by itself, with an emergency.
    """
    window = _optional(drive, objects.FOLLOWING_ERROR_WINDOW)
    return None if window == 0xFFFFFFFF else _scaled(window, drive.scaling.position)


def _optional(drive: CanopenDrive, info: ObjectInfo) -> int | None:
    """Read an object with the type of the drive's own EDS, which may differ from the standard's."""
    return drive.read_optional(drive.info(info.address) or info)


def _scaled(value: int | None, factor: float | None) -> float | None:
    if value is None or factor is None or not isfinite(factor):
        return None
    return value * factor


def _travel(drive: CanopenDrive) -> tuple[float, float] | None:
    low = _optional(drive, objects.SOFTWARE_LIMIT_LOW)
    high = _optional(drive, objects.SOFTWARE_LIMIT_HIGH)
    if low is None or high is None or low >= high:
        return None  # CiA 402: both 0, or exchanged, means that they are off
    if low <= -_NO_LIMIT and high >= _NO_LIMIT:
        return None
    return low * drive.scaling.position, high * drive.scaling.position
