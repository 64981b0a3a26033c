"""Test moves: what an axis is asked to do when its parameters are judged, predicted or measured."""

from dataclasses import dataclass
from math import isfinite

import numpy as np
from numpy.typing import NDArray

from fieldtool.records.model import FloatArray

TORQUE_SHARE = 0.5
"""Of the torque limit: what a typical move takes of it on a rigid axis; the loops need the rest."""
LIMIT_SHARE = 0.5
"""Of the limits of velocity and acceleration."""
TRAVEL_SHARE = 0.2
JERK_SHARE = 0.25
"""Of the time to speed up: how long the acceleration takes to build up."""
SHORTEST_JERK = 0.005
"""s: no drive's or controller's ramp of acceleration is shorter."""
BAND_SHARE = 0.01
"""Of the distance: within it the move has arrived."""


@dataclass(frozen=True)
class TestMove:
    """A move from rest to rest with bounded velocity, acceleration and jerk.

    Seven parts: acceleration up, held, down; velocity held; and the same mirrored.  Where the
    distance is too short for a limit, the parts that would hold it are left out.

    Raises
    ------
    ValueError
        If a bound is not above 0, the distance is 0, or one is no number.
    """

    __test__ = False

    axis: str
    distance: float
    """rad or m, with its sign."""
    velocity: float
    """rad/s or m/s, at most."""
    acceleration: float
    """rad/s2 or m/s2, at most."""
    jerk: float
    """rad/s3 or m/s3, at most."""
    band: float = 0.0
    """rad or m to both sides of the target within which the axis has arrived; 0: a hundredth of the
    distance."""
    start: float | None = None
    """rad or m: where the axis stands before, as its drive tells; None: not known."""

    def __post_init__(self) -> None:
        for name in ("velocity", "acceleration", "jerk"):
            value = getattr(self, name)
            if not (isfinite(value) and value > 0):
                raise ValueError(f"{self.axis}: {name} of a move must be above 0, got {value}")
        if not isfinite(self.distance) or self.distance == 0:
            raise ValueError(f"{self.axis}: the distance of a move is {self.distance}")
        if self.start is not None and not isfinite(self.start):
            raise ValueError(f"{self.axis}: a move that starts at {self.start}")
        if not (isfinite(self.band) and self.band >= 0):
            raise ValueError(f"{self.axis}: the band of a move is {self.band}")

    @property
    def settling_band(self) -> float:
        """Half the width of the band about the target, rad or m."""
        return self.band or BAND_SHARE * abs(self.distance)

    @property
    def parts(self) -> tuple[float, float, float]:
        """Seconds of rising acceleration, of held acceleration, of held velocity."""
        way, v, a, j = abs(self.distance), self.velocity, self.acceleration, self.jerk
        rise = min(a / j, (v / j) ** 0.5)
        held = max(v / a - rise, 0.0) if rise == a / j else 0.0
        if way >= v * (2 * rise + held):
            # velocity is reached: v = j rise (rise + held)
            return rise, held, way / v - (2 * rise + held)
        rise = min(rise, (way / (2 * j)) ** (1 / 3))
        # (rise + held) (2 rise + held) j rise = way
        b, c = 3 * rise, 2 * rise * rise - way / (j * rise)
        return rise, max((-b + (b * b - 4 * c) ** 0.5) / 2, 0.0), 0.0

    @property
    def duration(self) -> float:
        """Seconds from the beginning of the reference to its end."""
        rise, held, cruise = self.parts
        return 4 * rise + 2 * held + cruise

    def at(self, time: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return position, velocity and acceleration at times from the beginning, shape of ``time``.

        Before the beginning the move rests at 0, after its end at ``distance``.
        """
        rise, held, cruise = self.parts
        lasts = np.array([rise, held, rise, cruise, rise, held, rise])
        j = np.sign(self.distance) * self.jerk * np.array([1.0, 0, -1, 0, -1, 0, 1])
        begins = np.concatenate([[0.0], np.cumsum(lasts)[:-1]])
        p, v, a = np.zeros(7), np.zeros(7), np.zeros(7)
        for k in range(6):
            t = lasts[k]
            p[k + 1] = p[k] + t * (v[k] + t * (a[k] / 2 + t * j[k] / 6))
            v[k + 1] = v[k] + t * (a[k] + t * j[k] / 2)
            a[k + 1] = a[k] + t * j[k]
        part = np.clip(np.searchsorted(begins, time, side="right") - 1, 0, 6)
        t = np.clip(time, 0.0, self.duration) - begins[part]
        p, v, a, j = p[part], v[part], a[part], j[part]
        over: NDArray[np.bool_] = np.asarray(time >= self.duration)
        position = np.where(over, self.distance, p + t * (v + t * (a / 2 + t * j / 6)))
        still = over | (time < 0)
        velocity = np.where(still, 0.0, v + t * (a + t * j / 2))
        return position, velocity, np.where(still, 0.0, a + t * j)

    def reference(self, period: float) -> FloatArray:
        """Return the position reference every ``period`` seconds, from 0 to ``distance``, shape (n,).

        The last sample is the first one at or after the move's end.
        """
        count = int(np.ceil(self.duration / period - 1e-9)) + 1
        return self.at(np.arange(count, dtype=np.float64) * period)[0]


def typical_move(
    axis: str,
    travel: tuple[float, float],
    velocity: float,
    acceleration: float,
    torque: float,
    mass: float,
) -> TestMove:
    """Return a move that an axis with these limits is likely to make, where no profile names one.

    It takes at most half of the limits of velocity, acceleration and torque (of a rigid axis), and
    a fifth of the travel; acceleration builds up over a quarter of the time to speed up.

    Parameters
    ----------
    axis
        Name.
    travel
        Lowest and highest position, rad or m.
    velocity, acceleration, torque
        Limits of the axis, SI.
    mass
        All masses of the axis, kg m2 or kg.
    """
    a = min(LIMIT_SHARE * acceleration, TORQUE_SHARE * torque / mass)
    way = TRAVEL_SHARE * (travel[1] - travel[0])
    # half of the way to speed up and half to slow down, at most
    v = min(LIMIT_SHARE * velocity, (a * way / (1 + JERK_SHARE)) ** 0.5)
    rise = max(JERK_SHARE * v / a, SHORTEST_JERK)
    return TestMove(axis, way, v, a, a / rise)
