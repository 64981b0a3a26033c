"""What the tool needs of drives, in SI.  Real and simulated drives stand behind the same lines."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class AxisLimits:
    """What an axis may do, SI; watched in every cycle."""

    travel: tuple[float, float]
    velocity: float
    acceleration: float
    torque: float
    following_error: float


@dataclass(frozen=True)
class DriveIdentity:
    """What a drive says of itself: objects 0x1000, 0x1008, 0x100A, 0x1018."""

    device_type: int
    vendor_id: int
    product_code: int
    revision: int
    serial_number: int
    device_name: str
    firmware: str


@dataclass(frozen=True, eq=False)
class Capture:
    """What all axes did at the same SYNCs; n rows, M axes."""

    first_sync: int
    """Count of the first row's SYNC since the motion began."""
    position_reference: FloatArray
    """Target that took effect at each SYNC, shape (n, M), rad or m."""
    position: FloatArray
    """Actual position at each SYNC, shape (n, M), rad or m."""
    torque: FloatArray
    """Actual torque at each SYNC, shape (n, M), N m or N."""
    statusword: NDArray[np.uint16]
    """Object 0x6041 at each SYNC, shape (n, M)."""
    missing: tuple[int, ...] = ()
    """Rows in which a drive's PDO did not come; they repeat the row before."""

    @property
    def rows(self) -> int:
        """Number of SYNCs."""
        return int(self.position.shape[0])


def joined(captures: Sequence[Capture]) -> Capture:
    """Return consecutive captures as one; raise ValueError if there is none."""
    if not captures:
        raise ValueError("no capture to join")
    missing: list[int] = []
    offset = 0
    for capture in captures:
        missing += [offset + row for row in capture.missing]
        offset += capture.rows
    return Capture(
        captures[0].first_sync,
        np.concatenate([c.position_reference for c in captures]),
        np.concatenate([c.position for c in captures]),
        np.concatenate([c.torque for c in captures]),
        np.concatenate([c.statusword for c in captures]),
        tuple(missing),
    )


Source = Callable[[Capture | None], FloatArray | None]
"""Gives the next block of targets, shape (n, M), rad or m, seeing what the block before did (None
at the start); None ends the stream.  Columns of floating axes are not used."""


class Drive(Protocol):
    """One axis' drive."""

    @property
    def axis(self) -> str:
        """Name of the axis."""

    @property
    def node_id(self) -> int:
        """CANopen node id."""

    @property
    def identity(self) -> DriveIdentity:
        """What the drive says of itself."""

    @property
    def rated_torque(self) -> float:
        """N m or N: what 1000 per mille of torque are."""


class Motion(Protocol):
    """Enabled axes that hold their position, or float, until they are told otherwise."""

    @property
    def cycle_time(self) -> float:
        """Seconds from SYNC to SYNC."""

    @property
    def position(self) -> FloatArray:
        """Latest actual positions, shape (M,)."""

    def stream(self, source: Source) -> Capture:
        """Follow targets SYNC by SYNC and return what all axes did.

        Raises
        ------
        SafetyStopError
            If a limit is passed or a drive fails; all axes have been stopped and disabled, and
            what was recorded until then is in the error's ``capture``.
        UserStopError
            If the user asked to stop; likewise.
        """


class AxisGroup(Protocol):
    """The axes of one machine on one bus."""

    @property
    def drives(self) -> Sequence[Drive]:
        """One drive an axis, in the machine profile's order."""
