"""What one drive's units are worth: read from the drive as its profile says, or refused."""

from dataclasses import dataclass
from typing import Protocol

from drives import objects
from drives.errors import NotSupportedError
from drives.objects import ObjectAddress, ObjectInfo
from drives.profile import AxisProfile, DriveProfile, TorqueScale
from drives.units import AxisScaling, position_factor, velocity_factor

FEWEST_COUNTS = 16
"""Increments a revolution below which nobody told the drive its encoder: a new one says 1/1."""


class Asked(Protocol):
    """What has to be known of a drive, and asked of it."""

    profile: DriveProfile

    @property
    def axis(self) -> str:
        """Name of the axis."""

    @property
    def axis_profile(self) -> AxisProfile:
        """What the machine profile says of the axis."""

    def read_optional(self, info: ObjectInfo) -> int | None:
        """Return an object's value, None if the drive has no such object."""


@dataclass(frozen=True)
class Scaled:
    """What a drive's units are worth, and what that was derived from."""

    axis: AxisScaling
    rated_torque: float
    """N m or N that 1000 per mille of torque are."""
    counts_per_rev: float
    """Position units per motor revolution."""


def read_scaling(drive: Asked) -> Scaled:
    """Read what the drive's position, velocity and torque units are worth.

    Raises
    ------
    NotSupportedError
        If one of them is not known to the profile, or zero or missing in the drive: without them no
        number from this drive means anything.
    """
    rated = _rated_torque(drive)
    counts, revolutions = _resolution(drive)
    try:
        position = position_factor(
            drive.axis_profile.kind, counts, revolutions, drive.axis_profile.feed
        )
    except ValueError as error:
        raise NotSupportedError(f"{drive.axis}: position has no scale: {error}.") from None
    velocity = _velocity(drive, position, counts / revolutions)
    return Scaled(AxisScaling(position, velocity, rated / 1000), rated, counts / revolutions)


def _rated_torque(drive: Asked) -> float:
    scale = drive.profile.torque
    if isinstance(scale, str) or isinstance(scale.scale, str):
        raise NotSupportedError(
            f"{drive.axis}: drive profile {drive.profile.name} does not know what the drive's torque "
            "units are worth (`torque`), so nothing can be measured. Enter it in a profile of your own."
        )
    address = scale.per_mille_of
    what = "rated current" if scale.unit == "A" else "motor rated torque"
    rated = drive.read_optional(ObjectInfo(address, "UNSIGNED32", what))
    if not rated or rated < 0:
        raise NotSupportedError(
            f"{drive.axis}: {what} {address.short} is "
            f"{'missing' if rated is None else 'zero' if not rated else f'negative ({rated})'}, so "
            "torques have no scale. Enter the motor's data in the drive first."
        )
    value = rated * scale.scale
    return value if scale.unit == "N m" else value * _torque_constant(drive, scale)


def _torque_constant(drive: Asked, scale: TorqueScale) -> float:
    if isinstance(scale.constant, ObjectAddress):
        info = ObjectInfo(scale.constant, "UNSIGNED32", "torque constant")
        value = drive.read_optional(info)
        if value and value > 0:
            return value * scale.constant_scale
        raise NotSupportedError(
            f"{drive.axis}: torque constant {scale.constant.short} is "
            f"{'missing' if value is None else value}, so torques have no scale. Enter the motor's data "
            "in the drive first."
        )
    constant, address = drive.axis_profile.torque_constant, scale.per_mille_of
    if constant is None:
        raise NotSupportedError(
            f"{drive.axis}: the drive's torques are per mille of the rated current "
            f"{address.short}. Give the motor's `torque_constant` (N m/A) at the axis in the machine "
            "profile."
        )
    return constant


def _resolution(drive: Asked) -> tuple[int, int]:
    """Return increments, and the motor revolutions that they are for."""
    given, scale = drive.axis_profile.encoder_counts_per_rev, drive.profile.position
    told: int | None = None
    revolutions = 1
    place = "an object of the drive"
    if not isinstance(scale, str) and isinstance(scale.counts, ObjectAddress):
        place = f"object {scale.counts.short}"
        told = drive.read_optional(ObjectInfo(scale.counts, "UNSIGNED32", "encoder increments"))
        if told is not None and scale.revolutions is not None:
            info = ObjectInfo(scale.revolutions, "UNSIGNED32", "motor revolutions")
            revolutions = drive.read_optional(info) or 1
    _refuse_user_units(drive, told or given or 0, revolutions)
    if told is None or told < FEWEST_COUNTS * revolutions:
        if given is not None:
            return given, 1
        raise NotSupportedError(
            f"{drive.axis}: position has no scale: {place} "
            f"{'does not exist' if told is None else f'says {told}/{revolutions} increments'}. Enter "
            "the encoder in the drive, or give `encoder_counts_per_rev` at the axis in the machine "
            "profile."
        )
    if given is not None and given * revolutions != told:
        raise NotSupportedError(
            f"{drive.axis}: {place} says {told}/{revolutions} increments a revolution, the machine "
            f"profile {given} (`encoder_counts_per_rev`). Correct the one that is wrong."
        )
    return told, revolutions


def _velocity(drive: Asked, position: float, counts: float) -> float:
    """Return rad/s per velocity unit; NaN where nobody knows, since nothing moves by it."""
    unit = drive.profile.velocity
    if unit == "unknown":
        return float("nan")
    coded = None
    if unit == "0x60A9":
        coded = drive.read_optional(objects.VELOCITY_UNIT)
    try:
        return velocity_factor(unit, position, counts, coded)
    except ValueError as error:
        raise NotSupportedError(f"{drive.axis}: velocity has no scale: {error}.") from None


def _refuse_user_units(drive: Asked, counts: int, revolutions: int) -> None:
    """Refuse a drive whose positions are not those of its motor, while its torques are.

    A gear (0x6091) or a feed constant (0x6092) puts positions on another side than torques; masses
    would then be wrong by the ratio, and limits would be those of something else.
    """
    motor = drive.read_optional(objects.GEAR_MOTOR) or 1
    shaft = drive.read_optional(objects.GEAR_SHAFT) or 1
    if motor != shaft:
        raise NotSupportedError(
            f"{drive.axis}: the drive's gear ratio 0x6091 is {motor}/{shaft}, so its positions are "
            "those behind the gear and its torques those of the motor. Set it to 1/1 for "
            "commissioning, and give limits and masses as the motor sees them."
        )
    feed = drive.read_optional(objects.FEED_CONSTANT)
    per = drive.read_optional(objects.FEED_REVOLUTIONS) or 1
    if feed and feed * revolutions != counts * per:
        raise NotSupportedError(
            f"{drive.axis}: the drive's feed constant 0x6092 is {feed}/{per} position units a "
            f"revolution, its encoder has {counts}/{revolutions}. Positions would have two scales; set "
            "the feed constant to the encoder's increments for commissioning."
        )
