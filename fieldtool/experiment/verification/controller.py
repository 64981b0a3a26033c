"""What torque a drive's controller gives, cycle by cycle, from reference and position alone.

The plant is not in it: whatever the machine does, a drive that holds these parameters answers the
position that it measures with this torque.  A cycle of the bus holds several periods h of the loops::

    v  = low-pass( (q(t) - q(t - h)) / h )
    e  = position_p (r - q) + velocity_ff r' - v
    f  = viscous_ff r' + inertia_ff r''
    torque = lag( filters( velocity_p e + velocity_i sum(e h) + f + offset ) )

All of it is linear, so one cycle is one matrix: from the state at a SYNC, the references of three
SYNCs, the torque offset and the positions of four SYNCs (a cubic lies through them, slopes by central
differences: Catmull and Rom, 1974) to the state at the next SYNC.  The reference goes straight from
target to target and arrives one cycle after its SYNC.

Valid while no limit acts in the drive, and for motion well below half the bus' rate.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import exp, inf, pi, tan

import numpy as np

from fieldtool.records.closed_loop import AxisLoop, Biquad
from fieldtool.records.model import FloatArray

REFERENCES, POSITIONS = 3, 4
INPUTS = REFERENCES + 1 + POSITIONS
PARTS = 5
"""Of a torque: by reference what position gain, velocity gain and feed-forward of torque (with the
offset) make; by position what position gain and velocity gain make."""
FROM_REFERENCE, FROM_POSITION = slice(0, 3), slice(3, 5)
BY_VELOCITY = 4
LATE = 2
"""Cycles from a SYNC to the one after which its torque is foretold, less one that is the newest."""


@dataclass(frozen=True)
class DriveLoop:
    """One drive's controller, and how well its times are known; SI."""

    loop: AxisLoop
    velocity_filter: float = inf
    """First-order low-pass on the measured velocity, Hz; infinite: none."""
    period: float = 0.5e-3
    """s, of position and velocity loop."""
    lag: float = 1e-3
    """s, from the loops' torque reference to the torque that is told."""
    unsure: float = 0.0
    """s, by which its torque may come earlier or later than this says."""
    unsure_targets: float = 0.0
    """s, by which its reference may besides: where it is not known how it goes from target to target."""
    unsure_velocity: float = 0.0
    """s, by which its velocity may be late besides: where its period is not known."""
    noise: float = 0.0
    """RMS of the torque that the steps of its encoder make, N m or N."""
    count: float = 0.0
    """Largest torque that one step of its encoder makes, N m or N."""
    why_not: str = ""
    """Why nobody can say what its torque should be; empty where one can."""


class ExpectedTorque:
    """Follows several axes' controllers SYNC by SYNC; its PARTS are kept apart.

    Parameters
    ----------
    loops
        One an axis.
    step
        Cycle time, s.
    """

    def __init__(self, loops: Sequence[DriveLoop], step: float) -> None:
        blocks = [_parted(loop, step) for loop in loops]
        size, m = sum(a.shape[0] for a, _ in blocks), len(blocks)
        self._a, b = np.zeros((size, size)), np.zeros((PARTS, size, m, INPUTS))
        self._out = np.zeros(m, dtype=np.int64)
        place = 0
        for k, (a, parts) in enumerate(blocks):
            rows = slice(place, place + a.shape[0])
            self._a[rows, rows], b[:, rows, k] = a, parts
            place += a.shape[0]
            self._out[k] = place - 1
        self._b = b.reshape(PARTS * size, -1)
        self._state = np.zeros((PARTS, size))

    def restart(self) -> None:
        """All axes stand where the signals' origin is."""
        self._state[:] = 0.0

    def advance(self, references: FloatArray, position: FloatArray) -> FloatArray:
        """Return the parts of the torques of all axes at the end of a cycle, shape (PARTS, M).

        Parameters
        ----------
        references
            Targets that took effect at the SYNC before last, the last one, and that with which the
            cycle begins; then the torque offset of that SYNC; shape (M, 4).  From the origin.
        position
            At the SYNC before the cycle, at both its ends, and at the one after it, shape (M, 4).
        """
        given = np.concatenate([references, position], axis=1)
        self._state = self._state @ self._a.T + (self._b @ given.ravel()).reshape(PARTS, -1)
        torque: FloatArray = self._state[:, self._out]
        return torque


def locked_torque(loop: DriveLoop, path: FloatArray, step: float) -> FloatArray:
    """Return the torque by a path of the reference while the axis does not move, shape of the path.

    Parameters
    ----------
    loop
        Of the axis.
    path
        Targets from where it stands, shape (n,), rad or m.
    step
        Cycle time, s.
    """
    expected, still = ExpectedTorque((loop,), step), np.zeros((1, POSITIONS))
    padded = np.concatenate([np.zeros(REFERENCES - 1), path])
    torque = np.zeros(path.size)
    for n in range(path.size - 1):
        row = np.array([[*padded[n : n + REFERENCES], 0.0]])
        torque[n + 1] = expected.advance(row, still)[:, 0].sum()
    return torque


def _parted(drive: DriveLoop, step: float) -> tuple[FloatArray, FloatArray]:
    """Return A of one cycle, and B of each part, shape (PARTS, size, INPUTS)."""
    a, whole = _cycle_matrix(drive, step)
    loop = replace(drive.loop, position_p=0.0)
    _, without = _cycle_matrix(replace(drive, loop=loop), step)
    offsets = np.zeros_like(whole)
    offsets[:, REFERENCES] = whole[:, REFERENCES]
    bare = replace(loop, viscous_ff=0.0, inertia_ff=0.0)
    _, velocity = _cycle_matrix(replace(drive, loop=bare), step)
    by_reference = np.arange(INPUTS) <= REFERENCES
    velocity = velocity - offsets
    parts = np.stack([whole - without, velocity, without - velocity] * 2)[:PARTS]
    parts[FROM_REFERENCE] *= by_reference
    parts[FROM_POSITION] *= ~by_reference
    return a, parts


def _cycle_matrix(drive: DriveLoop, step: float) -> tuple[FloatArray, FloatArray]:
    """Return A and B of one cycle: x[n + 1] = A x[n] + B u, found by sending unit vectors through it."""
    size = 4 + 2 * len(drive.loop.filters)
    columns = np.eye(size + INPUTS)
    after = _through_cycle(drive, step, columns[:size].copy(), columns[size:])
    return after[:, :size], after[:, size:]


def _through_cycle(drive: DriveLoop, step: float, x: FloatArray, u: FloatArray) -> FloatArray:
    """Return states after one cycle; rows of ``x``: position, velocity, integral, filters, torque."""
    count = max(1, round(step / drive.period))
    h = step / count
    loop = drive.loop
    passed = 1.0 if drive.velocity_filter == inf else 1 - exp(-2 * pi * drive.velocity_filter * h)
    lag = drive.lag - h / 2  # the torque is held, which is half a period late by itself
    decay = exp(-h / lag) if lag > 0 else 0.0
    filters = [_sampled(biquad, h) for biquad in loop.filters]
    before, last, target = u[:REFERENCES]
    offset, positions = u[REFERENCES], u[REFERENCES + 1 :]
    speed, acceleration = (target - last) / step, (target - 2 * last + before) / step**2
    for k in range(count):
        share = k / count
        position = _between(positions, share)
        x[1] += passed * ((position - x[0]) / h - x[1])
        x[0] = position
        reference = last + (target - last) * share
        error = loop.position_p * (reference - position) + loop.velocity_ff * speed - x[1]
        fed = loop.viscous_ff * speed + loop.inertia_ff * acceleration
        torque = loop.velocity_p * error + x[2] + fed + offset
        x[2] += loop.velocity_i * h * error
        for j, (b0, b1, b2, a1, a2) in enumerate(filters):
            one, two = 3 + 2 * j, 4 + 2 * j
            out = b0 * torque + x[one]
            x[one] = b1 * torque - a1 * out + x[two]
            x[two] = b2 * torque - a2 * out
            torque = out
        x[-1] = torque + decay * (x[-1] - torque)
    return x


def _between(q: FloatArray, share: float) -> FloatArray:
    """Return positions at a share of the way from the second to the third of four samples."""
    s = share
    weights = (
        (-s + 2 * s * s - s**3) / 2,
        (2 - 5 * s * s + 3 * s**3) / 2,
        (s + 4 * s * s - 3 * s**3) / 2,
        (-s * s + s**3) / 2,
    )
    return np.asarray(sum(w * one for w, one in zip(weights, q, strict=True)))


def _sampled(biquad: Biquad, h: float) -> tuple[float, float, float, float, float]:
    """Return b0, b1, b2, a1, a2 of a filter sampled every ``h``: bilinear, exact at its own corner.

    A corner too near half the rate can not be sampled: the filter passes all.
    """
    (n2, n1, n0), (d1, d0) = biquad.numerator, biquad.denominator
    half = d0**0.5 * h / 2
    if not 0 < half < 1.4:
        return 1.0, 0.0, 0.0, 0.0, 0.0
    c = d0**0.5 / tan(half)
    a0 = c * c + d1 * c + d0
    return (
        (n2 * c * c + n1 * c + n0) / a0,
        2 * (n0 - n2 * c * c) / a0,
        (n2 * c * c - n1 * c + n0) / a0,
        2 * (d0 - c * c) / a0,
        (c * c - d1 * c + d0) / a0,
    )
