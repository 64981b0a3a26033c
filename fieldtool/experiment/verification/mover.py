"""Enabled axes that are watched in every cycle, and that were seen to stand still first."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np

from drives.api import Capture, FloatArray, Motion, MotionWatch, Source
from drives.errors import StoppedError
from fieldtool.experiment.axes import Mover, until_still
from fieldtool.experiment.verification.slices import slices
from fieldtool.experiment.verification.watch import TrialWatch

HOLD_TIME = 0.5
"""Seconds in which all axes stand still before anything else is asked of them."""
ENABLED_TIME = 0.03
"""Seconds in which torques may still answer to targets that followed positions until the enabling."""
RISE_TIME = 0.5
"""Seconds in which axes go to where an excitation begins."""


class WatchedMover:
    """Gives enabled axes that were seen to stand still first, with a watch that looks at every cycle.

    Axes that may sag are given the time to do so; ``sags`` is how far, shape (M,), and within ``quiet``
    they stand.
    """

    def __init__(
        self,
        group: Mover,
        watch: TrialWatch,
        rests: list[Capture],
        cut_off: Callable[[Capture, str], None],
        sags: FloatArray,
        quiet: FloatArray,
    ) -> None:
        self._sags, self._quiet = sags, quiet
        self._group, self._watch, self._rests, self._cut_off = group, watch, rests, cut_off
        self.held = np.zeros(0)
        """Targets at which the axes of the motion were seen to stand, shape (M,): going on from there is
        no jolt, which it would be from where they are."""
        self.sinks: list[Capture] = []
        """What axes did before that as they were enabled, where some may sag."""

    @contextmanager
    def motion(
        self,
        cycle_time: float,
        free: tuple[str, ...] = (),
        torque_offset: bool = False,
        watch: MotionWatch | None = None,
    ) -> Iterator[Motion]:
        """Enable all axes, and see them stand still for a while before they are handed on."""
        if watch is not None:
            raise ValueError("these axes have a watch already")
        self._watch.begin()
        with self._group.motion(cycle_time, free, torque_offset, self._watch) as motion:
            start = motion.position
            self._watch.hold(start, enabling=True)
            self.held = start
            rows = max(2, round(ENABLED_TIME / cycle_time))
            enabled = self.follow(motion, np.tile(start, (rows, 1)))
            stands = start
            if np.any(self._sags > 0):
                self._watch.hold(start, sinking=True)
                sinks = until_still(motion, start, self._quiet, rows)
                self.sinks += [enabled, self._stream(motion, sinks)]
                stands = np.where(self._sags > 0, motion.position, start)
            self._watch.hold(start, stands)
            still = np.tile(start, (max(2, round(HOLD_TIME / cycle_time)), 1))
            self._rests.append(self.follow(motion, still))
            yield motion

    def follow(self, motion: Motion, targets: FloatArray) -> Capture:
        """Follow targets, shape (n, M); what was captured of it is kept if it is stopped."""
        return self._stream(motion, slices(targets, motion.cycle_time))

    def _stream(self, motion: Motion, source: Source) -> Capture:
        try:
            return motion.stream(source)
        except StoppedError as error:
            if isinstance(error.capture, Capture) and error.capture.rows > 1:
                self._cut_off(error.capture, str(error))
            raise


class ExcitedMover:
    """A mover that allows swings once the axes have stood still.

    ``start``, ``room``, ``torque``: where the axes began, how far they may go from there, and how far
    their torques from those at rest, (M,) each.
    """

    def __init__(
        self,
        mover: WatchedMover,
        watch: TrialWatch,
        start: FloatArray,
        room: FloatArray,
        torque: FloatArray,
    ) -> None:
        self._mover, self._watch, self._torque = mover, watch, torque
        self._start, self._room = start, room

    @contextmanager
    def motion(
        self,
        cycle_time: float,
        free: tuple[str, ...] = (),
        torque_offset: bool = False,
        watch: MotionWatch | None = None,
    ) -> Iterator[Motion]:
        """Enable all axes, see them stand still, and bring them to where they began."""
        with self._mover.motion(cycle_time, free, torque_offset, watch) as motion:
            ends = (
                np.minimum(self._start, self._mover.held),
                np.maximum(self._start, self._mover.held),
            )
            self._watch.move(small=False)
            self._watch.swings.excite(ends[0] - self._room, ends[1] + self._room, self._torque)
            u = np.arange(1, round(RISE_TIME / cycle_time) + 1) * cycle_time / RISE_TIME
            rises = u**3 * (10 - 15 * u + 6 * u * u)
            way = self._mover.held + np.outer(rises, self._start - self._mover.held)
            self._mover.follow(motion, way)
            yield _Standing(motion, way[-1])


class _Standing:
    """A motion whose axes are taken to be where they were told to stand: from there on is no jolt."""

    def __init__(self, motion: Motion, at: FloatArray) -> None:
        self.cycle_time, self.position = motion.cycle_time, at
        self.stream = motion.stream
