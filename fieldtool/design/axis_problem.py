"""One axis' part of the design: what a choice of its parameters costs, all other loops being closed.

With the others closed the axis is one loop with a plant p (motor) and l (last mass)::

    S = 1 / (1 + C p)        motor = p H r S        last mass = l H r S

and the sensitivity of another axis i, whose loop stays as it is, follows from a change of this one::

    S_i = 1 - C_i ( T_ii - T_ik C T_ki S )

T being the compliance with this loop open; what the others' moves do follows in the same way, and is
part of the cost: a stiff motor leaves the machine's vibrations to its neighbours.

All models that the design has to hold for are evaluated at once, as are all frequencies.
"""

from collections.abc import Sequence
from math import isfinite

import numpy as np

from fieldtool.design.axis_motion import AxisMotion, Fed
from fieldtool.design.grids import Bounds, Grids, closed_compliance, without
from fieldtool.design.margins import BANDWIDTH_LEVEL
from fieldtool.design.moves import TestMove
from fieldtool.design.servo import Sampled, Servo

STEEP = 30.0
"""Cost of a bound that is missed, in durations of the move per relative excess."""
UNSTABLE = 1e3
SOFT = 0.01
"""Weight of a compliance that is missed beside a margin: it is a wish."""


class AxisProblem:
    """What parameters of one axis cost, the loops of all others being given."""

    def __init__(
        self,
        grids: Grids,
        servos: Sequence[Servo],
        axis: int,
        moves: Sequence[TestMove],
        bounds: Bounds,
        fed: Fed,
    ) -> None:
        """Prepare.

        Parameters
        ----------
        grids
            Of all machines.
        servos
            All axes' controllers; together they are stable on every machine.
        axis
            The one that is varied.
        moves
            One an axis.
        bounds
            To be kept.
        fed
            What feed-forward of the axis may be chosen.
        """
        self.bounds, self.move = bounds, moves[axis]
        s = 1j * grids.omega
        gains = np.stack([servo.gain(s) for servo in servos], axis=-1)
        inner = closed_compliance(grids.motors, without(gains, axis))
        self._at = Sampled.of(s, servos[axis].timing)
        self._plant = inner[..., axis, axis]
        others = [i for i in range(len(servos)) if i != axis]
        self._own = [1 - gains[..., i] * inner[..., i, i] for i in others]
        self._cross = [gains[..., i] * inner[..., i, axis] * inner[..., axis, i] for i in others]
        self._reference = 1 + gains[..., axis] * self._plant
        self._far = grids.omega > bounds.top
        widths = bounds.bandwidths or (0.0,) * len(servos)
        held = [grids.omega[0] <= widths[i] * (1 + 1e-12) for i in (axis, *others)]
        self._held = [below if below.any() else None for below in held]
        self._motion = AxisMotion(grids, servos, axis, moves, bounds, fed)

    def cost(self, servo: Servo) -> float:
        """Return the cost of a controller, s; above UNSTABLE where the loop is not stable."""
        return self.figures(servo)[0]

    def figures(self, servo: Servo) -> tuple[float, float]:
        """Return cost, s, and the largest relative excess of a bound (negative: all are kept)."""
        gain, _, _ = self._at.gain(servo)
        opened = 1 + gain * self._plant
        ratio = opened / self._reference
        turned = np.angle(ratio[:, 1:] * np.conj(ratio[:, :-1])).sum(axis=1)
        inverse = 1 / opened
        own = np.abs(inverse)
        peak = float(own.max())
        if np.abs(turned).max() > 1.0 or not isfinite(peak):
            return UNSTABLE * (1 + min(peak, 1e3)), np.inf
        follow = gain * inverse
        cross = zip(self._own, self._cross, strict=True)
        sizes = [own, *(np.abs(a + b * follow) for a, b in cross)]
        excess = max(float(size.max()) for size in sizes) / self.bounds.sensitivity - 1
        for size, below in zip(sizes, self._held, strict=True):
            if below is not None:
                excess = max(excess, float(size[0][below].max()) / BANDWIDTH_LEVEL - 1)
        if isfinite(self.bounds.compliance):
            soft = float(np.abs(self._plant * inverse).max())
            excess = max(excess, SOFT * (soft / self.bounds.compliance - 1))
            excess = max(excess, soft / self.bounds.softest - 1)
        if self._far.any():
            far = np.abs(1 - inverse[self._far])
            excess = max(excess, float(far.max()) / self.bounds.far - 1)
        if isfinite(self.bounds.noise) and isfinite(self.bounds.resolution):
            noise = servo.torque_noise(self.bounds.resolution)
            excess = max(excess, noise / self.bounds.noise - 1)
        settled, torque = self._motion.figures(servo)
        excess = max(excess, torque / self._motion.most_torque - 1)
        return settled + STEEP * self.move.duration * max(excess, 0.0), excess

    def fed_forward(self, servo: Servo) -> Servo:
        """Return a controller with the feed-forward that fits its feedback best."""
        return self._motion.fed_forward(servo)
