"""What a drive's own units are worth: the part of a drive profile that leads to SI."""

from typing import Literal

from drives.objects import DataType, ObjectAddress
from drives.profile.values import UNKNOWN, Address, Part, Positive, Seconds, Unknown

VelocityUnit = Literal["position units/s", "rpm", "0.001 rpm", "0x60A9", "counts * 512 / 1875"]
"""Of 0x606C and 0x60FF.  ``0x60A9``: the drive says so itself, in that object.  The last one is
rpm * 512 * increments per revolution / 1875, which some makers call DEC."""


class PositionScale(Part):
    """Position units per motor revolution: two objects of the drive, or the machine profile."""

    counts: Address | Literal["machine"] = ObjectAddress(0x608F, 1)
    """Object that holds increments; ``machine``: ``encoder_counts_per_rev`` of the axis."""
    revolutions: Address | None = ObjectAddress(0x608F, 2)
    """Object that holds the motor revolutions for them; none: one revolution."""


class TorqueScale(Part):
    """What 1000 in the torque objects 0x6071, 0x6077 and 0x60B2 is."""

    per_mille_of: Address = ObjectAddress(0x6076)
    """Object that holds the rated torque, or a rated current."""
    unit: Literal["N m", "A"] = "N m"
    """What that object holds; N on linear axes."""
    scale: Positive | Unknown = 0.001
    """Rated torque or current = value times scale."""
    constant: Address | Literal["machine"] | None = None
    """Torque constant of a current: an object, or ``torque_constant`` of the axis."""
    constant_scale: Positive = 1.0
    """N m/A per unit of that object."""
    computed: bool | Unknown = False
    """Whether the drive computes the object itself and refuses to have it written."""


class Quantity(Part):
    """A number in the drive that units of parameters depend on, such as its torque constant."""

    object: Address
    type: DataType
    scale: Positive | Unknown
    unit: str


class SyncRules(Part):
    """What a drive asks of the time from SYNC to SYNC."""

    shortest: Seconds | Unknown = UNKNOWN
    longest: Seconds | Unknown = UNKNOWN
    multiple: Seconds | Unknown = UNKNOWN
    """Cycle times are whole multiples of it."""
    missing: str = UNKNOWN
    """What the drive does when a SYNC does not come, in words."""
