"""Whether a loop was unstable: when a limit stopped the axes, or by what the pilot has shown.

The experiments' own watch judges each block, from the excitation's beginning on, and is careful: nobody
wants to lose a measurement to a false alarm.  After a stop nothing is to be lost any more, and the whole
record shows whether an oscillation had grown by itself.  A loop that is not stable may also swing up
before the first experiment, while the axes wait for rest.
"""

from collections.abc import Sequence

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from drives.api import Capture
from drives.errors import SafetyStopError, StoppedError
from fieldtool.errors import LoopUnstableError, NotEnoughDataError
from fieldtool.experiment.axes import Axes, Keep, keep_whatever_happens, sample_times
from fieldtool.experiment.forecast import Setting
from fieldtool.experiment.multisine.growth import GrowthWatch
from fieldtool.records.model import FloatArray
from fieldtool.records.recording import Experiment

LAGS = (0.02, 0.05, 0.12, 0.3, 0.75)
"""Seconds: the watch looks at differences over these, which shows oscillations of 0.3 to 30 Hz."""
AT_LIMIT = 0.9
"""Of a limit: excitation is planned to stay well below."""
LAST = 0.5
"""Seconds before the stop, in which a limit was reached; the shortest record of a swing."""
SWINGS = 2
"""Periods of it in that time, at least."""
ONE_FREQUENCY = 0.8
"""Share of its power about one frequency."""
FASTEST = 1e-5
"""Seconds in which no motion of a machine grows by a factor of e."""
SAME_ROWS = 20
"""So many rows in a row that are the same in two records are the same rows."""


def judge_stop(
    error: StoppedError,
    kept: Sequence[Experiment],
    following: str,
    axes: Axes,
    step: float,
    keep: Keep,
) -> None:
    """Keep what was recorded between experiments, and say so if an unstable loop led to the stop.

    Parameters
    ----------
    error
        What stopped the axes, with what was recorded until then.
    kept
        Experiments that were kept already.
    following
        Name of the experiment that was to come, if it was before one; empty after the last.
    axes
        Names and limits.
    step
        Cycle time, s.
    keep
        Gets the raw data.

    Raises
    ------
    LoopUnstableError
        If a limit stopped the axes, and an oscillation grew by itself until then.
    """
    capture = error.capture
    if not isinstance(capture, Capture) or capture.rows < 2:
        return
    within = next((one.name for one in reversed(kept) if _holds(capture, one)), None)
    unstable = None
    if isinstance(error, SafetyStopError) and not getattr(error, "__notes__", ()):
        unstable = _unstable(capture, within, following, axes, step)
    if within is None:
        way = _way(capture, following, step, str(unstable or error))
        keep_whatever_happens([way], keep, unstable or error)
    if unstable is not None:
        unstable.add_note(f"what stopped the axes: {error}")
        raise unstable from error


def check_loops(setting: Setting) -> None:
    """Refuse to go on with loops that are unstable with the model that the pilot has shown.

    The pilot may be too short and too weak for an oscillation to grow up to a limit.

    Raises
    ------
    LoopUnstableError
        Naming the axis whose motor takes most part in what grows.
    NotEnoughDataError
        If it would grow faster than any loop's motion can: then the pilot's model is no machine's.
    """
    loop = setting.closed_loop(())
    if loop.stable:
        return
    values, vectors = np.linalg.eig(loop.system_matrix())
    worst = int(np.argmax(values.real))
    rate, omega = float(values[worst].real), abs(float(values[worst].imag))
    name = setting.model.names[int(np.argmax(np.abs(vectors[setting.model.first_masses, worst])))]
    if rate * FASTEST > 1:
        raise NotEnoughDataError(
            f"{name}: the pilot did not show its masses and springs: by what it found a motion would "
            f"grow by a factor of e in {1 / rate:.2g} s, which no machine does. All axes are disabled, "
            "and the raw data are kept. Does the axis have as many masses as its profile says? If so, "
            "measure with the classic plan (--plan classic)."
        )
    grows = f"an oscillation at {omega / (2 * np.pi):.3g} Hz" if omega else "a motion"
    raise LoopUnstableError(
        f"{name}: its loop is unstable: by what the pilot has shown of the masses and springs, {grows} "
        f"grows by a factor of e in {1 / max(rate, 1e-9):.2g} s. All axes are disabled, and the raw "
        "data are kept. Lower the drive's gains (velocity_i, then position_p and velocity_p) and "
        "measure again.",
        axis=name,
        frequency=omega / (2 * np.pi),
    )


def _way(capture: Capture, following: str, step: float, note: str) -> Experiment:
    return Experiment(
        name=f"way to {following}" if following else "rest at the end",
        kind="other",
        driven=(),
        free=(),
        period=None,
        time=sample_times(capture.rows, step),
        position=capture.position,
        torque=capture.torque,
        position_reference=capture.position_reference,
        statusword=capture.statusword,
        complete=False,
        note=note,
    )


def _holds(capture: Capture, experiment: Experiment) -> bool:
    """Whether an experiment's last rows are among the capture's."""
    rows = min(SAME_ROWS, experiment.samples)
    if capture.rows < rows:
        return False
    last = np.hstack([experiment.position, experiment.torque])[-rows:]
    windows = sliding_window_view(np.hstack([capture.position, capture.torque]), rows, axis=0)
    return bool(np.any(np.all(windows == last.T, axis=(1, 2))))


def _unstable(
    capture: Capture, within: str | None, following: str, axes: Axes, step: float
) -> LoopUnstableError | None:
    error = capture.position_reference - capture.position
    errors = np.array([limits.following_error for limits in axes.limits])
    torques = np.array([limits.torque for limits in axes.limits])
    last = slice(-max(2, round(LAST / step)), None)
    shares = np.hstack([error / errors, capture.torque / torques])
    if np.abs(shares[last]).max() < AT_LIMIT:
        return None
    frequency = _grown(error, capture.torque, errors, torques, step)
    if frequency is None and within is None:
        frequency = _swings_standing(shares, step)
    if frequency is None:
        return None
    nearest = int(np.argmax(np.abs(shares[last]).max(axis=0)))
    name = axes.names[nearest % len(axes.names)]
    between = f"before experiment {following}" if following else "after the last experiment"
    where = (
        f"in experiment {within}"
        if within
        else f"{between}, while all axes were told to stand still,"
    )
    return LoopUnstableError(
        f"{name}: its loop becomes unstable: {where} an oscillation at {frequency:.3g} Hz grew by "
        "itself until a limit stopped the axes. All are disabled, and the raw data are kept. Lower the "
        "drive's gains (velocity_i, then position_p and velocity_p) and measure again.",
        axis=name,
        frequency=frequency,
    )


def _grown(
    error: FloatArray, torque: FloatArray, errors: FloatArray, torques: FloatArray, step: float
) -> float | None:
    """Return the frequency of an oscillation that grew until the end of the record, Hz."""
    for lag in LAGS:
        watch = GrowthWatch(max(1, round(lag / step)), 0, errors, torques, None, step)
        growth = watch.take(error, torque)
        if growth is not None:
            return growth.frequency
    return None


def _swings_standing(shares: FloatArray, step: float) -> float | None:
    """Look at the last LAST seconds, and at twice as many until the whole record was seen."""
    rows = max(2, round(LAST / step))
    while True:
        frequency = _swinging(shares[-rows:], step)
        if frequency is not None or rows >= len(shares):
            return frequency
        rows *= 2


def _swinging(shares: FloatArray, step: float) -> float | None:
    """Return the frequency, Hz, of the largest of the swings (n, 2 M) if it does not die out.

    For axes that were told to stand still: what swings at a limit then is driven by its own loop.
    """
    flat = shares - shares.mean(axis=0)
    k = int(np.argmax(np.abs(flat).max(axis=0)))
    half = flat.shape[0] // 2
    if flat[half:, k].std() < flat[:half, k].std():
        return None
    power = np.abs(np.fft.rfft(flat[:, k] * np.hanning(flat.shape[0]))) ** 2
    peak = int(np.argmax(power))
    if peak < SWINGS or power[peak - 2 : peak + 3].sum() < ONE_FREQUENCY * power.sum():
        return None
    return float(peak / (flat.shape[0] * step))
