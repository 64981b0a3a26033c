"""What a drive's handling of cyclic targets adds to the torque where it is sampled.

Position targets: a drive that goes straight from target to target bends its reference at every
SYNC.  At the SYNCs the reference r lies on the wanted sine, between them it lies (w^2 r / 2) t
(T - t) below it, on average (w T)^2 r / 12.  The axis follows the average, but the loop's torque
shows the bends, and is sampled always at the same place: just after a bend, by the lag d of the
torque.  So

    velocity_p position_p r (w T)^2 / 12 share

has to be taken off the sampled phasor.  If the lag were a pure delay, the share would be
1 - 6 p (1 - p) with p = d / T; of a low-pass with the time constant d

    1 - 3 a / pi coth(pi / a) + 3 a^2 / pi^2,     a = 2 pi p

A current loop behind the drive's own cycle is something between: the mean is taken, and half the
difference is how well it is known (:func:`bends_seen`); a fit may find it.  At T = 4 ms and 8 Hz the
folded part is 0.2 % of the product of gains and reference; masses and springs come out 0.13 % too
large without it.

Source of the sums over all images: Gradshteyn and Ryzhik, 1.443 and 1.421.

Valid for: T short against the velocity loop's response (velocity_p T well below the motor's mass),
no low-pass near the SYNC rate, d below T.

A drive that can not be kept from feeding the reference's velocity forward, as one whose loop is a PID
with D on the error, adds velocity_p times a staircase: the slope of the straight line from target to
target.  That is a torque held from SYNC to SYNC.

Torque offsets are held from SYNC to SYNC; see :func:`held_offset`.
"""

import numpy as np

from fieldtool.frf.phasors import ComplexArray, FloatArray
from fieldtool.records.recorded import Experiment, Recording, Segment

LINEAR_TARGETS = "linear_targets"
"""Key of a recording's source: ``AXIS=LAG`` of the axes whose drives interpolate linearly, LAG the
torque's lag in s, with blanks between; ``AXIS=LAG/SHARE`` where the drive feeds that share of the
reference's velocity forward."""
LEAST_UNSURE = 0.05
"""Of the bends: error of the share that is seen where there is hardly a lag."""
STAIR_UNSURE = 0.02
"""Of a stair's step: error of what is seen of it."""


def folded_torque(
    recording: Recording, experiment: Experiment, segment: Segment, axis: int
) -> complex:
    """Return the part of an axis' sampled torque phasor that is folded images, N m or N.

    0 where the recording does not say that the drive interpolates linearly, or lacks the controller
    or the reference.
    """
    reference = experiment.position_reference
    if reference is None or recording.axes[axis].name not in lags(recording):
        return 0j
    rows = slice(segment.start, segment.stop)
    omega = 2 * np.pi * segment.frequency
    time = experiment.time[rows] - experiment.time[segment.start]
    target = reference[rows, axis] - reference[rows, axis].mean()
    phasors = np.zeros((1, len(recording.axes)), dtype=np.complex128)
    phasors[0, axis] = 2 / target.size * complex(np.exp(-1j * omega * time) @ target)
    return complex(folded_phasors(recording, np.array([segment.frequency]), phasors)[0, axis])


def folded_phasors(
    recording: Recording, frequencies: FloatArray, reference: ComplexArray
) -> ComplexArray:
    """Return the part of sampled torque phasors that is folded images, for all axes at once.

    Parameters
    ----------
    recording
        Says which drives interpolate linearly, and their controllers.
    frequencies
        (L,), Hz.
    reference
        (L, M): phasors of the position references as recorded, rad or m; 0 where there is none.

    Returns
    -------
    ndarray
        (L, M), N m or N: to be taken off the torque's phasors; 0 for axes that the recording says
        nothing of.
    """
    period = recording.sample_period
    omega = 2 * np.pi * frequencies
    folded = np.zeros(reference.shape, dtype=np.complex128)
    for axis, information in enumerate(recording.axes):
        lag, controller = lags(recording).get(information.name), information.controller
        if lag is None or controller is None:
            continue
        # A target sent with one SYNC is reached at the next one.
        reached = reference[:, axis] * np.exp(-1j * omega * period)
        lost = (omega * period) ** 2 / 12 * _seen(lag / period)[0]
        folded[:, axis] = controller.velocity_p * controller.position_p * reached * lost
        share = shares(recording)[information.name]
        if share:
            slope = reference[:, axis] * (1 - np.exp(-1j * omega * period)) / period
            stair = (share * controller.velocity_p * slope)[:, None]
            sampled = period - min(lag, period)
            folded[:, axis] -= held_offset(frequencies, stair, period, sampled)[:, 0]
    return folded


def bends(recording: Recording, experiment: Experiment) -> FloatArray:
    """Return what torques would show of the bends without lag, row by row, (n, M), N m or N.

    Times the share of :func:`bends_seen` it is the same as :func:`folded_phasors`, for motion that need
    not repeat: (w T)^2 times a sine is what its targets bend from one SYNC to the next.
    """
    reference = experiment.position_reference
    course = np.zeros(experiment.torque.shape)
    if reference is None:
        return course
    for axis, information in enumerate(recording.axes):
        controller = information.controller
        known = information.name in lags(recording) and controller is not None
        if controller is None or not known or np.any(np.isnan(reference[:, axis])):
            continue
        gain = controller.velocity_p * controller.position_p / 12
        course[2:, axis] = -gain * np.diff(reference[:, axis], 2)
    return course


def bends_seen(recording: Recording) -> tuple[FloatArray, FloatArray]:
    """Return the share of the bends that each axis' sampled torque shows, and its error, (M,) each.

    A stair that velocity feed-forward makes counts as bends too: its value is that of its middle, and
    is sampled (T - lag) after its begin, which a low-pass instead of a delay hardly changes.
    """
    period, found = recording.sample_period, np.zeros((2, len(recording.axes)))
    for axis, information in enumerate(recording.axes):
        lag, controller = lags(recording).get(information.name), information.controller
        if lag is None or controller is None or controller.position_p == 0.0:
            continue
        value, std = _seen(lag / period)
        steps = 12 * shares(recording)[information.name] / (controller.position_p * period)
        late = min(lag / period, 1.0) - 0.5
        found[:, axis] = value - steps * late, np.hypot(std, steps * STAIR_UNSURE)
    return found[0], found[1]


def _seen(lag: float) -> tuple[float, float]:
    """Share of the bends, and its error, for a lag in sample periods."""
    place = min(lag, 1.0)
    delay = 1 - 6 * place * (1 - place)
    a = 2 * np.pi * lag
    low_pass = 1 - 3 * a / (np.pi * np.tanh(np.pi / a)) + 3 * a**2 / np.pi**2 if a > 0 else 1.0
    return float(delay + low_pass) / 2, max(LEAST_UNSURE, abs(low_pass - delay) / 2)


def held_offset(
    frequencies: FloatArray, offset: ComplexArray, period: float, sampled: float, rows: int = 1
) -> ComplexArray:
    """Return what has to be added to sampled torque phasors because torque offsets are held.

    A torque offset sent once a SYNC is a staircase o(t): constant for T from the instant at which
    it takes effect.  Let the torque be sampled a time a after that instant (0 <= a <= T).  The
    sample then holds the stair's own value, so its phasor is that of the sent values,
    O exp(-j w rows T).  The staircase's component at w is that of its mean with the sine over one
    hold: a stair that begins at -a about the sample has

        (1 / T) integral from -a to T - a of exp(-j w t) dt = sinc(w T / 2) exp(-j w T / 2) exp(j w a)

    with sinc(x) = sin(x) / x.  The machine answers to the component, so the difference is added:
    O exp(-j w rows T) (sinc(w T / 2) exp(-j w (T / 2 - a)) - 1).  For a = T / 2 only the sinc is left.

    Parameters
    ----------
    frequencies
        (L,), Hz.
    offset
        (L, M): phasors of the offsets as recorded, N m or N; 0 where there is none.
    period
        T, s.
    sampled
        a, s.  With a lag d of the torque behind the SYNC, a sample taken at the SYNC sees the stair
        before it, so a = T - d, and the value counts one row more.
    rows
        From the row in which an offset is recorded to the row in whose torque it shows first.

    Returns
    -------
    ndarray
        (L, M), N m or N.

    Notes
    -----
    Valid for: a torque that follows the offset within a time short against T (d taken care of
    above), and the machine's images beyond the SYNC rate too small to matter.
    """
    omega = 2 * np.pi * frequencies[:, None]
    held = offset * np.exp(-1j * omega * rows * period)
    mean = np.sinc(omega * period / (2 * np.pi)) * np.exp(-1j * omega * (period / 2 - sampled))
    correction: ComplexArray = held * (mean - 1)
    return correction


def lags(recording: Recording) -> dict[str, float]:
    """Return the torque's lag, s, of the axes whose drives interpolate linearly, by name."""
    found = {}
    for item in str(recording.source.get(LINEAR_TARGETS, "")).split():
        name, _, numbers = item.rpartition("=")
        found[name] = float(numbers.partition("/")[0])
    return found


def shares(recording: Recording) -> dict[str, float]:
    """Return the share of the reference's velocity that those drives feed forward, by name."""
    found = {}
    for item in str(recording.source.get(LINEAR_TARGETS, "")).split():
        name, _, numbers = item.rpartition("=")
        found[name] = float(numbers.partition("/")[2] or 0.0)
    return found
