"""What one object of a drive holds, and when two values of it are the same."""

from dataclasses import dataclass
from typing import Any, Protocol

from drives.api import Drive
from drives.cia402 import PowerState
from drives.objects import ObjectAddress, ObjectInfo
from drives.profile import AxisProfile, DriveProfile

Raw = int | float | str
"""A value in the drive's own type and unit."""


class ParameterDrive(Drive, Protocol):
    """What reading, writing and storing parameters needs of a drive; ``CanopenDrive`` has it all."""

    @property
    def profile(self) -> DriveProfile:
        """What is known of this kind of drive."""

    @property
    def axis_profile(self) -> AxisProfile:
        """What the machine profile says of the axis."""

    @property
    def left_changed(self) -> bool:
        """Whether something that was set for a time could not be put back."""

    @property
    def boots(self) -> int:
        """Boot-up messages of it that nobody had asked for: what was not stored in it is lost then."""

    @property
    def begins_anew(self) -> bool:
        """Whether it was switched on with this bus: nothing of an earlier session is in it."""

    def read(self, info: ObjectInfo, timeout: float | None = None) -> Raw:
        """Read an object; raise DrivesError where that fails."""

    def write(self, info: ObjectInfo, value: float | str, timeout: float | None = None) -> None:
        """Write an object; raise DrivesError where that fails."""

    def read_int(self, info: ObjectInfo) -> int:
        """Read an object that holds a whole number; raise DrivesError where that fails."""

    def read_optional(self, info: ObjectInfo) -> int | None:
        """Read an object that some drives lack; None if this one does."""

    def answers(self) -> bool:
        """Whether the drive answers at all."""

    def info(self, address: ObjectAddress) -> ObjectInfo | None:
        """What the drive's EDS says of an object."""

    def wait(self, seconds: float) -> None:
        """Let time pass on the drive's bus."""

    def wakes(self, patience: float) -> bool:
        """Whether it answers within so many seconds."""

    def restart(self, patience: float) -> bool:
        """Restart it as a power cycle would; whether it is back within so many seconds."""

    def to_pre_operational(self) -> None:
        """Lead it to NMT pre-operational."""

    def power_state(self) -> PowerState:
        """Power state that the drive shows."""


@dataclass(frozen=True)
class HeldObject:
    """What one object of a drive held."""

    info: ObjectInfo
    value: Raw


def same(info: ObjectInfo, one: Raw, other: Raw) -> bool:
    """Whether two values are one in the drive's own type.

    Numbers are rounded to the type first, so that 0.1 is what a REAL32 holds of it.  Zero and minus
    zero are the same; a value that the type can not hold, such as NaN, is like no other.
    """
    try:
        return info.decode(info.encode(one)) == info.decode(info.encode(other))
    except ValueError:
        return False


def checked_value(info: ObjectInfo, value: Any) -> Raw:
    """Return a value that came from a file, if the object's type holds it exactly as it stands.

    Raises
    ------
    ValueError
        If it does not: another kind of value, out of range, not finite.
    """
    kinds: dict[str, tuple[type, ...]] = {"BOOLEAN": (bool,), "VISIBLE_STRING": (str,)}
    fits = isinstance(value, kinds.get(info.type, (int, float)))
    if not fits or (isinstance(value, bool) and info.type != "BOOLEAN"):
        raise ValueError(f"object {info.address}: {value!r} is no {info.type}")
    raw: Raw = value
    try:
        info.encode(raw)
    except ValueError as error:
        raise ValueError(f"object {info.address}: {error}") from None
    return raw
