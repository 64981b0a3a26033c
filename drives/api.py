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
    sag: float | None = None
    """How far it may sink when its drive is enabled and its brake opens; None: no farther than any
    axis that stands."""


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
    torque_offset: FloatArray | None = None
    """Torque offset that took effect at each SYNC and was held until the next one, as sent: rounded
    to the drive's units, shape (n, M), N m or N.  It acts after the SYNC, and torque and position of
    the same row are sampled before: they show it from the next row on.  None if none was streamed."""

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
        _joined_offsets(captures),
    )


def _joined_offsets(captures: Sequence[Capture]) -> FloatArray | None:
    """Return all offsets; a capture without any had offsets of 0, if another one has some."""
    if all(c.torque_offset is None for c in captures):
        return None
    return np.concatenate(
        [np.zeros_like(c.torque) if c.torque_offset is None else c.torque_offset for c in captures]
    )


@dataclass(frozen=True, eq=False)
class Targets:
    """A block of targets with a torque added to what the drives' own loops ask for.

    Raises
    ------
    ValueError
        If the two have different shapes.
    """

    position: FloatArray
    """Target positions, shape (n, M), rad or m."""
    torque_offset: FloatArray
    """Torque offsets, shape (n, M), N m or N; 0 for axes whose drive has none."""

    def __post_init__(self) -> None:
        if self.position.ndim != 2 or self.position.shape != self.torque_offset.shape:
            raise ValueError(
                "targets need positions and torque offsets of one shape (n, M), got "
                f"{self.position.shape} and {self.torque_offset.shape}"
            )


Source = Callable[[Capture | None], FloatArray | Targets | None]
"""Gives the next block of targets, shape (n, M), rad or m, seeing what the block before did (None
at the start); None ends the stream.  Columns of floating axes are not used.  A block may be
``Targets`` in a motion that streams torque offsets; a plain array has offsets of 0."""


@dataclass(frozen=True)
class Alarm:
    """Why a motion has to end at once."""

    sentence: str
    """For a person: axis, value, unit, limit."""
    axis: str
    """Name of the axis that shows it most."""
    power_off: frozenset[str]
    """Axes whose own loops make it: a quick stop would leave them closed, so their power is cut."""
    held_up: float = 0.0
    """Seconds by which the host began a cycle of moving targets late shortly before, which alone may
    have made it; else 0."""


class MotionWatch(Protocol):
    """Looks at all axes in every cycle in which one is enabled, whatever moves them."""

    @property
    def trusts_loops(self) -> bool:
        """Whether a quick stop may be left to the drives' loops; else a safety stop cuts all power."""

    @property
    def most_late(self) -> float:
        """Seconds by which the present cycle may begin late where targets move; after more, all axes are
        stopped.
        """

    def take(
        self,
        position: Sequence[float],
        torque: Sequence[float],
        target: Sequence[float],
        offset: Sequence[float],
        *,
        fresh: bool,
        late: float,
    ) -> Alarm | None:
        """Take the sample of one SYNC; return why the motion has to end, or None.

        Parameters
        ----------
        position, torque
            As the drives sampled them at the SYNC, M values each, SI.
        target, offset
            Position targets and torque offsets that took effect at it, as sent, M values each, SI.
        fresh
            Whether the SYNC was in time and every drive answered it; else a sample may be an old one.
        late
            Seconds by which the SYNC came later than a cycle after the one before; below 0: sooner.
        """


class Onlooker(Protocol):
    """Takes what axes do block by block while they move; must neither wait nor raise."""

    def begin(self, cycle_time: float) -> None:
        """A motion begins."""

    def take(self, capture: "Capture") -> None:
        """A block of it."""


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

        Torque offsets end with the stream: where the last one was not 0, one more cycle, which is
        in no capture, holds the last positions with offsets of 0.

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
