"""What a trial watches controllers by: as their parameters say, and how well they are known."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from drives.api import AxisLimits
from drives.canopen_drive import CanopenDrive
from drives.errors import DrivesError, UserStopError
from drives.parameters import read_parameters
from drives.profile import UNKNOWN
from drives.profile.drive import CASCADE_PARAMETERS
from fieldtool.design.servo import CAUTIOUS_LAG, CAUTIOUS_PERIOD, Servo
from fieldtool.experiment.verification.controller import DriveLoop, locked_torque
from fieldtool.records.model import FloatArray

UNSURE_LAG, UNSURE_CYCLES = 0.1, 0.05
"""Shares of a torque's lag that is known, and of a cycle, by which torques may be earlier or later."""
SHORTEST_PERIOD = 0.0625e-3
"""s, of loops whose period is not known, for the torque that the encoder's steps make, which grows as
the period shrinks.  Velocity loops of 16 kHz are about the quickest; what still quicker ones make of a
step is spread over the current loop's lag, which is hardly shorter."""
QUARTER = 0.005
"""s: a first answer speeds up for so long, slows down and comes back for twice as long, and stops."""
ANSWER, MOST_ANSWER, CLEAR = 0.05, 0.3, 10.0
"""Shares of the torque limit that a first answer is to take at least and at most; and times the RMS of
what the encoder's steps make."""
FEWEST_CYCLES = 4
MOST_WAY, MOST_ERROR, MOST_VELOCITY = 0.02, 0.25, 0.8
"""Shares of the move, of the following error limit, and of the velocity limit that a first answer may
take."""


def drive_loop(drive: CanopenDrive, servo: Servo) -> DriveLoop:
    """Return the controller that a drive should be, and how well its times are known."""
    profile, timing = drive.profile, servo.timing
    known = bool(profile.torque_lag) and profile.loop_period != UNKNOWN
    unsure = UNSURE_CYCLES * timing.cycle + (
        UNSURE_LAG * timing.lag if known else max(timing.lag, CAUTIOUS_LAG)
    )
    count, quick = abs(drive.scaling.position), servo
    if profile.loop_period == UNKNOWN:
        quick = replace(servo, timing=replace(timing, period=SHORTEST_PERIOD))
    return DriveLoop(
        servo.loop,
        servo.velocity_filter,
        timing.period or CAUTIOUS_PERIOD,
        timing.lag,
        unsure,
        0.0 if profile.interpolation == "linear" else timing.cycle,
        0.0 if profile.loop_period != UNKNOWN else CAUTIOUS_PERIOD / 2,
        quick.torque_noise(count),
        quick.count_torque(count),
        _why_not_told(drive),
    )


def _why_not_told(drive: CanopenDrive) -> str:
    """Return why a drive's parameters do not say what its torque should be; empty where they do."""
    if drive.profile.structure == "unknown":
        return (
            f"how the loops of such a drive are built is not known (profile {drive.profile.name})"
        )
    try:
        told = drive.conversion().as_cascade(read_parameters(drive))
    except UserStopError:
        raise
    except DrivesError as error:
        return str(error)
    lacking = [name for name in CASCADE_PARAMETERS if name not in told]
    if lacking:
        return f"{', '.join(lacking)} can not be read from the drive in SI units"
    return ""


def first_answer(
    loops: Sequence[DriveLoop],
    counts: float,
    limits: AxisLimits,
    distance: float,
    cycle: float,
) -> FloatArray:
    """Return a path of some counts to and fro that no loop answers with much torque, shape (n,).

    Its second differences are whole counts: plus, minus, minus, plus, a quarter each, so that rounding
    to counts changes nothing of it.  Empty where one count a cycle squared is too much already.

    Parameters
    ----------
    loops
        That it will meet.
    counts
        One count of the encoder, rad or m.
    limits
        Of the axis: torque, following error, velocity.
    distance
        Of the move that comes later, rad or m.
    cycle
        s.
    """
    n = max(FEWEST_CYCLES, round(QUARTER / cycle))
    bent = np.repeat([1.0, -1.0, -1.0, 1.0], n)
    path = counts * np.concatenate([[0.0, 0.0], np.cumsum(np.cumsum(bent))])
    padded = np.concatenate([path, np.zeros(2 * n)])
    most = max(float(np.abs(locked_torque(loop, padded, cycle)).max()) for loop in loops)
    noise = max(loop.noise for loop in loops)
    wanted = min(max(ANSWER * limits.torque, CLEAR * noise), MOST_ANSWER * limits.torque)
    fastest = float(np.abs(np.diff(path)).max()) / cycle
    room = min(
        MOST_ERROR * limits.following_error / path.max(), MOST_VELOCITY * limits.velocity / fastest
    )
    times = np.floor(min(wanted / max(most, 1e-300), MOST_WAY * abs(distance) / path.max(), room))
    if times < 1:
        far = path.max() > 10 * MOST_WAY * abs(distance)
        if most > MOST_ANSWER * limits.torque or far or room < 1:
            return np.zeros(0)
        times = 1.0
    answer: FloatArray = np.copysign(times, distance) * path
    return answer


def answer_torque(loops: Sequence[DriveLoop], answer: FloatArray, cycle: float) -> float:
    """Return how far a first answer makes the torque swing, peak to peak, while the axis stays."""
    if not answer.size:
        return 0.0
    padded = np.concatenate([answer, np.zeros(answer.size // 2)])
    return max(float(np.ptp(locked_torque(loop, padded, cycle))) for loop in loops)
