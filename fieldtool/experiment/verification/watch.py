"""All that watches a trial in every cycle, behind one door: swings, the controllers, the work."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from drives.api import Alarm, FloatArray
from fieldtool.experiment.verification.brakes import Brakes
from fieldtool.experiment.verification.identity import IdentityWatch
from fieldtool.experiment.verification.oscillation import OscillationWatch
from fieldtool.experiment.verification.work import WorkRecord, WorkWatch

DISTURBS, DISTURBS_LEAST, DISTURBED = 0.25, 0.002, 0.5
"""Share of a cycle, and seconds, by which one of moving targets may begin late and disturb nothing;
seconds in which an axis may swing for a later one.  Its reference stands, and then goes on at full
speed."""


@dataclass(frozen=True)
class Guards:
    """What else watches a trial besides the watch for swings; None: nobody does."""

    identity: IdentityWatch | None = None
    """Whether drives' torques are those of their controllers."""
    work: WorkWatch | WorkRecord | None = None
    """Whether motors push the way they are asked to; while the axes hold still and are nudged."""


class TrialWatch:
    """Lets each of the watches look at every cycle; a ``drives.api.MotionWatch``.

    ``brakes`` leaves out of the torques that may swing what drives do at late SYNCs; None: nobody does.
    ``cycle_time`` in s.
    """

    def __init__(
        self,
        names: Sequence[str],
        swings: OscillationWatch,
        guards: Guards,
        brakes: Brakes | None = None,
        cycle_time: float = 0.0,
    ) -> None:
        self._names, self.swings, self._guards = tuple(names), swings, guards
        self._brakes, self._step = brakes, cycle_time
        self._small = True
        self._target: list[float] | None = None
        self._held_up, self._since = 0.0, 0
        self.most_late = np.inf
        """Seconds by which the present cycle may begin late where targets move."""

    @property
    def trusts_loops(self) -> bool:
        """Whether a quick stop may be left to the drives' loops."""
        return self.swings.trusts_loops

    def begin(self) -> None:
        """Another motion begins: its axes stand still where they are first seen."""
        self.swings.begin()
        self._target, self._held_up = None, 0.0
        if self._brakes is not None:
            self._brakes.begin()
        self._small = True
        if self._guards.identity is not None:
            self._guards.identity.begin()
        if self._guards.work is not None:
            self._guards.work.begin()

    def hold(
        self,
        at: FloatArray,
        stands: FloatArray | None = None,
        *,
        enabling: bool = False,
        sinking: bool = False,
    ) -> None:
        """Allow no more than standing still; see :meth:`OscillationWatch.hold`."""
        self.swings.hold(at, stands, enabling=enabling, sinking=sinking)
        if self._guards.identity is not None:
            if enabling:
                self._guards.identity.begin()  # references are known from the enabling on
            self._guards.identity.stand(still=not enabling)

    def move(self, *, small: bool) -> None:
        """Say that targets move from now on; small motions leave gravity as it is."""
        if small and self._guards.work is not None:
            self._guards.work.begin(moves=True)
        self._small = small
        if self._guards.identity is not None:
            self._guards.identity.stand(still=False)

    def saw(self, cycles: int) -> bool:
        """Return whether controllers were compared in all of the last cycles; true where nobody does."""
        return self._guards.identity is None or self._guards.identity.unbroken >= cycles

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
        """Take one cycle; see ``drives.api.MotionWatch``."""
        smooth = torque if self._brakes is None else self._brakes.take(torque, target, late)
        self._note_late(target, late)
        alarm = self.swings.take(position, torque, smooth)
        if alarm is not None:
            # what is not where it may be is no matter of being late
            return alarm if self.swings.strays else replace(alarm, held_up=self._held_up)
        found: list[tuple[int, str]] = []
        guards = self._guards
        seen: tuple[Sequence[float], Sequence[float]] | None = position, torque
        if guards.identity is not None:
            found += guards.identity.take(position, torque, target, offset, fresh=fresh)
            seen = guards.identity.cleaned
        if guards.work is not None and self._small:
            if seen is not None:
                found += guards.work.take(*seen, fresh=fresh)
            elif not fresh:  # what it did meanwhile nobody saw
                guards.work.take(position, torque, fresh=False)
        if not found:
            return None
        k, text = found[0]
        return Alarm(
            f"{self._names[k]}: {text}; its power was cut and all axes were stopped.",
            self._names[k],
            frozenset(self._names[j] for j, _ in found),
        )

    def _note_late(self, target: Sequence[float], late: float) -> None:
        """Remember for DISTURBED by how much a cycle of moving targets was late."""
        moves = self._target is not None and list(target) != self._target
        self._target = list(target)
        self._since += 1
        if self._since * self._step > DISTURBED:
            self._held_up = 0.0
        if moves and late > max(DISTURBS * self._step, DISTURBS_LEAST):
            self._held_up, self._since = max(late, self._held_up), 0
