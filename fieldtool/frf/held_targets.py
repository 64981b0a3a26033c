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
target.  That is a torque held from SYNC to SYNC.  It is sampled (1/2 - d / T) T = c T after the middle
of its tread, so it shows S (c w T j - (c^2 / 2 + 1/24) (w T)^2) too little, S the phasor of the stair:
:func:`held_offset` to second order.  Of the inner sampling that is in the lag of everything that is
measured the stair has nothing, so c is not known better than ``STAIR_UNSURE``.

Where it is not known how a drive goes from target to target, its share of the bends may be that of
any lag, or nothing where it bends smoothly, and c anything that a lag below the period makes; the fit
of whole records finds what it really is (:class:`Fold`).

Torque offsets are held from SYNC to SYNC; see :func:`held_offset`.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from fieldtool.errors import NotEnoughDataError
from fieldtool.frf.phasors import ComplexArray, FloatArray
from fieldtool.records.recorded import Experiment, Recording, Segment

LINEAR_TARGETS = "linear_targets"
"""Key of a recording's source: ``AXIS=LAG`` of the axes whose drives interpolate linearly, LAG the
torque's lag in s, with blanks between; ``AXIS=LAG/SHARE`` where the drive feeds that share of the
reference's velocity forward; LAG is ``?`` where it is not known how the drive interpolates."""
LEAST_UNSURE = 0.05
"""Of the bends: error of the share that is seen where there is hardly a lag."""
STAIR_UNSURE = 0.1
"""Of a stair's c: inner sampling and current loop share the lag."""
BENDS_UNKNOWN = 0.0, 0.45
"""Share of the bends that is seen, and its error: mean and deviation over all lags up to a period."""
STAIR_UNKNOWN = 0.25, 0.25
"""A stair's c, and its error: the lag is a quarter of the period, give or take as much."""


@dataclass(frozen=True)
class Fold:
    """Something that an axis' sampled torque shows and that does not act, of a size to be found."""

    axis: int
    kind: Literal["bends", "stair"]
    gain: float
    """N m s/rad (N s/m) a s for bends, N m (N) a rad (m) of the reference's step for a stair."""
    size: float
    """Share of the bends, or a stair's c, as it was expected."""
    std: float
    """Error of that."""

    def course(self, reference: FloatArray, size: float) -> FloatArray:
        """What is shown, row by row, (n,), N m or N, for a motion that need not repeat.

        (w T)^2 times a sine is what its targets bend from one SYNC to the next.
        """
        return self._made_of(reference, size, size**2 / 2 + 1 / 24)

    def slope(self, reference: FloatArray, size: float) -> FloatArray:
        """Derivative of :meth:`course` by the size."""
        return self._made_of(reference, 1.0, size)

    def _made_of(self, reference: FloatArray, first: float, second: float) -> FloatArray:
        shown = np.zeros(reference.size)
        step = np.diff(reference)
        if self.kind == "bends":
            shown[2:] = -self.gain / 12 * first * np.diff(step)
        else:
            middle = (step[2:] - step[:-2]) / 2
            shown[3:] = -self.gain * (first * middle + second * np.diff(step, 2))
        return shown


def folds(recording: Recording) -> tuple[Fold, ...]:
    """Return what sampled torques show besides what acts: of each axis its bends and its stair."""
    period, found = recording.sample_period, []
    for axis, information in enumerate(recording.axes):
        handling, controller = handlings(recording).get(information.name), information.controller
        if handling is None or controller is None:
            continue
        if controller.position_p:
            gain = controller.velocity_p * controller.position_p
            found.append(Fold(axis, "bends", gain, *handling.bends(period)))
        if handling.share:
            gain = controller.velocity_p * handling.share / period
            found.append(Fold(axis, "stair", gain, *handling.stair(period)))
    return tuple(found)


def folded_torque(
    recording: Recording, experiment: Experiment, segment: Segment, axis: int
) -> complex:
    """Return the part of an axis' sampled torque phasor that is folded images, N m or N.

    0 where the recording does not say that the drive interpolates linearly, or lacks the controller
    or the reference.
    """
    reference = experiment.position_reference
    if reference is None or recording.axes[axis].name not in handlings(recording):
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
        handling, controller = handlings(recording).get(information.name), information.controller
        if handling is None or controller is None:
            continue
        # A target sent with one SYNC is reached at the next one.
        reached = reference[:, axis] * np.exp(-1j * omega * period)
        lost = (omega * period) ** 2 / 12 * handling.bends(period)[0]
        folded[:, axis] = controller.velocity_p * controller.position_p * reached * lost
        if handling.share:
            slope = reference[:, axis] * (1 - np.exp(-1j * omega * period)) / period
            stair = (handling.share * controller.velocity_p * slope)[:, None]
            sampled = period * (0.5 + handling.stair(period)[0])
            folded[:, axis] -= held_offset(frequencies, stair, period, sampled)[:, 0]
    return folded


@dataclass(frozen=True)
class Handling:
    """How a drive goes from one cyclic target to the next."""

    lag: float | None
    """Of the torque, s, where it goes straight; None where that is not known."""
    share: float = 0.0
    """Of the reference's velocity, fed forward."""

    def bends(self, period: float) -> tuple[float, float]:
        """Share of the bends that the sampled torque shows, and its error."""
        return BENDS_UNKNOWN if self.lag is None else _seen(self.lag / period)

    def stair(self, period: float) -> tuple[float, float]:
        """When a stair is sampled, in periods after the middle of its tread, and its error."""
        if self.lag is None:
            return STAIR_UNKNOWN
        return 0.5 - min(self.lag / period, 1.0), STAIR_UNSURE


def handlings(recording: Recording) -> dict[str, Handling]:
    """Return what the recording says of drives that go straight from target to target, or may.

    Raises
    ------
    NotEnoughDataError
        If it can not be read.
    """
    found = {}
    for item in str(recording.source.get(LINEAR_TARGETS, "")).split():
        name, _, numbers = item.rpartition("=")
        lag, _, share = numbers.partition("/")
        try:
            one = Handling(None if lag == "?" else float(lag), float(share or 0.0))
        except ValueError:
            one = Handling(-1.0)
        if not (0 <= (one.lag or 0.0) < np.inf and np.isfinite(one.share)):
            raise NotEnoughDataError(
                f"the recording's source, {LINEAR_TARGETS}: {item!r} is no AXIS=LAG or AXIS=LAG/SHARE "
                "with LAG in seconds, or ?. Put it right in recording.yaml, or leave it out."
            )
        found[name] = one
    return found


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
