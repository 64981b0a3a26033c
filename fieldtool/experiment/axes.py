"""What experiments know of axes: names, limits, centres; bringing them to rest; keeping raw data."""

from collections.abc import Callable, Iterable
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from drives.api import AxisLimits, Capture, FloatArray, Motion, MotionWatch, Source
from drives.canopen_drive.interrupts import uninterrupted
from fieldtool.experiment.stepped.plan import smooth_move
from fieldtool.records.recording import Experiment

MOVE_SHARE = 0.25
"""Share of the velocity and acceleration limits that positioning moves use."""
STILL, STILL_TIME, STILL_TIMEOUT = 1e-4, 0.5, 20.0
"""An axis stands that moves less than this share of its travel in so many seconds; waited for at
most the last, seconds."""
Keep = Callable[[Experiment], None]
"""Gets an experiment's raw data as soon as it has ended, also when it was cut short."""


class Mover(Protocol):
    """Gives enabled axes: ``CanopenGroup`` does."""

    def motion(
        self,
        cycle_time: float,
        free: tuple[str, ...] = (),
        torque_offset: bool = False,
        watch: MotionWatch | None = None,
    ) -> AbstractContextManager[Motion]:
        """Enable all axes; those in ``free`` float; torque offsets can be streamed if asked for."""


def torque_limits(limits: Iterable[AxisLimits]) -> FloatArray:
    """Return the limits of all torques, shape (M,), N m or N."""
    return np.array([one.torque for one in limits])


@dataclass(frozen=True)
class Axes:
    """What the runner has to know of the axes."""

    names: tuple[str, ...]
    limits: tuple[AxisLimits, ...]
    centre: FloatArray
    units: tuple[str, ...] = ()
    """Of positions, for messages."""
    resolution: FloatArray | None = None
    """One count of each axis' encoder, shape (M,), rad or m; None where it is fine enough."""

    inertia: FloatArray | None = None
    """Of each axis by the prior model, all its masses, shape (M,), kg m2 or kg; None: not known."""
    stiffness: FloatArray | None = None
    """Torque that each loop asks for at once when its target leaves it, shape (M,), N m/rad or N/m;
    None: not known."""
    pace: FloatArray | None = None
    """1/s, position_p of each loop without feed-forward, shape (M,): an axis comes to its target as
    exp(-pace t); None: not known."""
    torque_offsets: tuple[bool, ...] = ()
    """Which drives take torque offsets with their targets; none where it is empty."""

    @property
    def counts(self) -> FloatArray:
        """One count of each encoder, shape (M,), rad or m; 0 where it was not given."""
        return np.zeros(len(self.names)) if self.resolution is None else self.resolution

    def unit(self, k: int) -> str:
        """Return the unit of an axis' positions, for messages; empty where it was not given."""
        return self.units[k] if self.units else ""

    @property
    def sags(self) -> FloatArray:
        """How far each axis may sink as it is enabled, shape (M,), rad or m; 0 where none is given."""
        return np.array([one.sag or 0.0 for one in self.limits])

    @property
    def room(self) -> FloatArray:
        """From the centre to the nearer end of the travel, shape (M,)."""
        return np.array(
            [
                min(c - limits.travel[0], limits.travel[1] - c)
                for c, limits in zip(self.centre, self.limits, strict=True)
            ]
        )


def bring_to_centre(motion: Motion, axes: Axes) -> None:
    """Bring every axis to its centre, all at the same time, and wait until nothing swings."""
    start = motion.position
    paths = [
        positioning_move(axes, k, float(axes.centre[k] - start[k]), motion.cycle_time)
        for k in range(len(axes.names))
    ]
    n = max(path.size for path in paths)
    way = np.empty((n, len(paths)))
    for k, path in enumerate(paths):
        way[:, k] = start[k] + np.concatenate([path, np.full(n - path.size, path[-1])])
    _follow_until_still(motion, axes, way)


def come_to_rest(motion: Motion, axes: Axes, targets: FloatArray) -> None:
    """Hold every axis at its target, shape (M,), until nothing swings: what coasts would go on."""
    _follow_until_still(motion, axes, targets[None, :])


def _follow_until_still(motion: Motion, axes: Axes, way: FloatArray) -> None:
    hold = np.tile(way[-1], (max(2, round(STILL_TIME / motion.cycle_time)), 1))
    travel = np.array([limits.travel[1] - limits.travel[0] for limits in axes.limits])
    held = 0

    def source(before: Capture | None) -> FloatArray | None:
        nonlocal held
        if before is None:
            return way
        moved = np.ptp(before.position, axis=0)
        if held and (np.all(moved < STILL * travel) or held * STILL_TIME > STILL_TIMEOUT):
            return None
        held += 1
        return hold

    motion.stream(source)


def positioning_move(axes: Axes, k: int, distance: float, step: float) -> FloatArray:
    """Return an axis' rest-to-rest move at MOVE_SHARE of its limits, as displacements."""
    limits = axes.limits[k]
    return smooth_move(
        distance, MOVE_SHARE * limits.velocity, MOVE_SHARE * limits.acceleration, step
    )


class Standstill:
    """Tells whether axes have stood for STILL_TIME, wherever that is, or STILL_TIMEOUT is up.

    Parameters
    ----------
    at
        Where they are now, shape (M,), rad or m.
    quiet
        From where each was it may go less than this while it stands, shape (M,).
    step
        Seconds from SYNC to SYNC.
    """

    def __init__(self, at: FloatArray, quiet: FloatArray, step: float) -> None:
        self._mark, self._quiet = at, quiet
        self._waited = self._still = 0
        self._rows, self._most = round(STILL_TIME / step), round(STILL_TIMEOUT / step)

    def take(self, at: FloatArray, rows: int) -> bool:
        """Take where they are, shape (M,), so many cycles later; return whether the wait is over."""
        self._waited += rows
        self._still += rows
        if np.any(np.abs(at - self._mark) >= self._quiet):
            self._mark, self._still = at, 0
        return self._still >= self._rows or self._waited >= self._most


def until_still(
    motion: Motion,
    targets: FloatArray,
    quiet: FloatArray,
    rows: int,
    judge: Callable[[FloatArray], None] = lambda _: None,
) -> Source:
    """Return a source that holds all axes at their targets, shape (M,), until those that sag stand.

    ``quiet`` as for :class:`Standstill`; ``judge`` is given where all axes are, shape (M,), every so
    many cycles, and raises if one goes astray.
    """
    standstill = Standstill(motion.position, quiet, motion.cycle_time)

    def source(before: Capture | None) -> FloatArray | None:
        if before is not None:
            judge(before.position[-1])
            if standstill.take(before.position[-1], rows):
                return None
        return np.tile(targets, (rows, 1))

    return source


def sample_times(rows: int, step: float) -> FloatArray:
    """Return the times of so many SYNCs from 0, shape (rows,), s."""
    times: FloatArray = np.arange(rows, dtype=np.float64) * step
    return times


def keep_all(experiments: Iterable[Experiment], keep: Keep) -> None:
    """Keep all that was recorded, once the drives are off; a stop waits until the last is kept."""
    with uninterrupted():
        for experiment in experiments:
            keep(experiment)


def keep_whatever_happens(
    experiments: Iterable[Experiment], keep: Keep, cause: BaseException
) -> None:
    """Keep what was recorded before an error; that error counts, not one of the disk or the memory."""
    try:
        keep_all(experiments, keep)
    except Exception as error:
        why = str(error) or type(error).__name__
        cause.add_note(f"what was recorded last could not be kept: {why}")
