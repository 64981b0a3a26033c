"""Motion profile with a trapezoidal velocity: from any moving start to rest at a target.

Direction first: braking at once from v0 would end at the stopping point v0 |v0| / (2 b).  If the
target lies beyond it the profile goes on forwards, if it lies before it the axis has to come back.
Seen in that direction the profile is, where a part that is not needed has no duration::

    brake a motion the wrong way -> reach the peak speed -> hold it -> brake to rest
"""

from dataclasses import dataclass
from math import copysign, isfinite, sqrt

SEGMENTS = 4


@dataclass(frozen=True)
class Segment:
    """A piece with constant acceleration."""

    begin: float
    """s after the start of the profile."""
    position: float
    """At the begin, rad or m."""
    velocity: float
    """At the begin, rad/s or m/s."""
    acceleration: float
    """rad/s2 or m/s2."""


@dataclass(frozen=True)
class Trapezoid:
    """The whole profile."""

    segments: tuple[Segment, ...]
    """Always ``SEGMENTS`` of them, in order of time; some may have no duration."""
    duration: float
    """s until the axis rests at the target."""
    target: float
    """rad or m."""


def plan_trapezoid(
    position: float,
    velocity: float,
    target: float,
    speed: float,
    acceleration: float,
    deceleration: float,
) -> Trapezoid:
    """Plan the motion from (position, velocity) to rest at the target.

    Parameters
    ----------
    position, velocity
        Start, rad and rad/s (or m and m/s).
    target
        End, rad or m.
    speed, acceleration, deceleration
        Limits, rad/s and rad/s2 (or m/s and m/s2), above 0.  A start faster than ``speed`` is
        braked down to it; speed may be infinite.

    Raises
    ------
    ValueError
        If a limit is not above 0 or another value is not finite.
    """
    if not (speed > 0.0 and 0.0 < acceleration < float("inf") and isfinite(deceleration)):
        raise ValueError(_limits_message(speed, acceleration, deceleration))
    if deceleration <= 0.0:
        raise ValueError(_limits_message(speed, acceleration, deceleration))
    if not (isfinite(position) and isfinite(velocity) and isfinite(target)):
        raise ValueError(
            f"profile from {position} at velocity {velocity} to {target}: all three must be finite"
        )
    stop = velocity * abs(velocity) / (2.0 * deceleration)
    direction = copysign(1.0, target - position - stop)
    distance, start = direction * (target - position), direction * velocity
    parts: list[tuple[float, float]] = []  # duration, acceleration in the profile's direction
    back = max(0.0, -start)
    parts.append((back / deceleration, deceleration))
    distance += back * back / (2.0 * deceleration)
    start = max(0.0, start)
    if start > speed:
        peak = speed
        parts.append(((start - speed) / deceleration, -deceleration))
        distance -= (start * start - speed * speed) / (2.0 * deceleration)
    else:
        free = (2.0 * distance + start * start / acceleration) / (
            1.0 / acceleration + 1.0 / deceleration
        )
        peak = min(speed, sqrt(max(0.0, free)))
        peak = max(peak, start)  # equal up to rounding when it only has to brake
        parts.append(((peak - start) / acceleration, acceleration))
        distance -= (peak * peak - start * start) / (2.0 * acceleration)
    distance -= peak * peak / (2.0 * deceleration)
    parts.append((max(0.0, distance) / peak if peak > 0.0 else 0.0, 0.0))
    parts.append((peak / deceleration, -deceleration))
    return _joined(position, velocity, target, [(d, direction * a) for d, a in parts])


def _joined(
    position: float, velocity: float, target: float, parts: list[tuple[float, float]]
) -> Trapezoid:
    segments, begin = [], 0.0
    for duration, acceleration in parts:
        segments.append(Segment(begin, position, velocity, acceleration))
        position += (velocity + 0.5 * acceleration * duration) * duration
        velocity += acceleration * duration
        begin += duration
    return Trapezoid(tuple(segments), begin, target)


def _limits_message(speed: float, acceleration: float, deceleration: float) -> str:
    return (
        f"profile limits are speed {speed}, acceleration {acceleration}, deceleration "
        f"{deceleration}; all must be above 0 and the accelerations finite"
    )
