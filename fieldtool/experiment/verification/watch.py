"""All that watches a trial in every cycle, behind one door: swings, the controllers, the work."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from drives.api import Alarm, FloatArray
from fieldtool.experiment.verification.brakes import Brakes
from fieldtool.experiment.verification.identity import IdentityWatch
from fieldtool.experiment.verification.oscillation import OscillationWatch
from fieldtool.experiment.verification.work import WorkRecord, WorkWatch


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
    """

    def __init__(
        self,
        names: Sequence[str],
        swings: OscillationWatch,
        guards: Guards,
        brakes: Brakes | None = None,
    ) -> None:
        self._names, self.swings, self._guards = tuple(names), swings, guards
        self._brakes = brakes
        self._small = True
        self.most_late = np.inf
        """Seconds by which the present cycle may begin late where targets move."""

    @property
    def trusts_loops(self) -> bool:
        """Whether a quick stop may be left to the drives' loops."""
        return self.swings.trusts_loops

    def begin(self) -> None:
        """Another motion begins: its axes stand still where they are first seen."""
        self.swings.begin()
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
        alarm = self.swings.take(position, torque, smooth)
        if alarm is not None:
            return alarm
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
