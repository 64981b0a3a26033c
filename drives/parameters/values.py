"""What one object of a drive holds."""

from dataclasses import dataclass

from drives.objects import ObjectInfo

Raw = int | float | str
"""A value in the drive's own type and unit."""


@dataclass(frozen=True)
class HeldObject:
    """What one object of a drive held."""

    info: ObjectInfo
    value: Raw
