"""What compares a trial's drives with what was written: learns from the old ones, judges the new."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from drives.canopen_drive import CanopenGroup
from fieldtool.design.servo import Servo
from fieldtool.experiment.axes import Axes, torque_limits
from fieldtool.experiment.verification.identity import IdentityWatch
from fieldtool.experiment.verification.learned import LEAST_SEEN, Learned
from fieldtool.experiment.verification.trial import Tried
from fieldtool.experiment.verification.watch import Guards
from fieldtool.experiment.verification.work import WorkRecord, WorkWatch
from fieldtool.workflow.preparation import without_feed_forward
from fieldtool.workflow.trial_loops import drive_loop

MOST_MISSING = 10.0
"""Times the usual that work may be missing with the old parameters; beyond it a person is told."""


class TrialGuards:
    """The guards of both trials of one write.

    Parameters
    ----------
    group
        Of the machine.
    axes
        Names, limits, counts, inertias.
    cycle_time
        Seconds.
    warn
        Is told which drives can not be judged, a sentence each.
    """

    def __init__(
        self, group: CanopenGroup, axes: Axes, cycle_time: float, warn: Callable[[str], None]
    ) -> None:
        self._group, self._axes, self._step, self._warn = group, axes, cycle_time, warn
        self._works = WorkRecord()
        self.missing = np.inf
        """Work that was missing with the old parameters, over what is usual; infinite: not known yet."""
        self._identity: IdentityWatch | None = None
        self._learned: Learned | None = None

    def of(self, servos: Sequence[Servo], old: Tried | None) -> Guards:
        """Return guards that compare torques with these controllers.

        While the old parameters act (``old`` is None) they only learn.
        """
        drives = self._group.drives
        quanta = np.array([abs(drive.scaling.torque) for drive in drives])
        units = [drive.torque_unit for drive in drives]
        loops = [drive_loop(*pair) for pair in zip(drives, servos, strict=True)]
        self._identity = IdentityWatch(loops, self._step, quanta, self._learned, units)
        if self._learned is None or old is None:
            return Guards(self._identity, self._works)
        for drive, why in zip(drives, self._identity.why_not, strict=True):
            if why:
                self._warn(
                    f"{drive.axis}: whether the controller in its drive is the one that was written can "
                    f"not be told from its torque: {why}. Swings, ways and torques are watched as ever."
                )
        axes = self._axes
        limits = torque_limits(axes.limits)
        inertia = np.zeros(limits.size) if axes.inertia is None else axes.inertia
        known = old.rest, axes.counts, limits, quanta, inertia / self._step**2, axes.units
        self.missing = missing = self._works.most(WorkWatch(*known, unsure=old.unsure))
        if missing > MOST_MISSING:
            self._warn(
                "whether motors push the way that they are asked to is hardly told: with the old "
                f"parameters {missing:.3g} times as much work was missing as is usual. Swings, ways and "
                "torques are watched as ever."
            )
        watch = WorkWatch(*known, min(missing, MOST_MISSING), old.unsure)
        return Guards(self._identity, watch)

    def without_feed_forward(self, servos: Sequence[Servo]) -> None:
        """Go on with controllers whose feed-forward is switched off, where it can be."""
        if self._identity is not None:
            pairs = zip(self._group.drives, servos, strict=True)
            bare = ((d, replace(s, loop=without_feed_forward(d, s.loop))) for d, s in pairs)
            self._identity.use([drive_loop(*pair) for pair in bare])

    def learn(self) -> None:
        """A trial has ended: what was seen of the old parameters is what is usual."""
        if self._identity is None:
            return
        if self._learned is None:
            self._learned = self._identity.learned()
        elif self._identity.seen < LEAST_SEEN:
            self._warn(
                f"late cycles left {100 * self._identity.seen:.0f} % of the trial to compare torques "
                "with what the new parameters make of target and position: whether the controllers are "
                "those that were written is hardly told. Swings, ways and torques were watched as ever."
            )
