"""What stands between the torque that acts and the torque that the drive reports, and delays."""

from dataclasses import replace

import numpy as np
from scipy.ndimage import maximum_filter, median_filter
from scipy.signal import lfilter

from fieldtool.criticise.effects.base import Context, Effect, FloatArray, Parameter, Values
from fieldtool.criticise.simulate.motion import FIRST, Motion, differentiate

LONGEST = 0.02
"""s: no delay or lag of a drive is longer."""
SHORTEST = 0.02
"""Of a cycle: a shorter delay or lag is none."""
FEWEST_CYCLES = 8.0
"""Of a disturbance within the shortest experiment."""
STANDS_OUT = 12.0
"""Power of a line over the median of those around it, from which it is tried as a disturbance."""
AROUND = 12
OFF_HARMONICS = 0.6
"""Lines from the harmonics of the excitation within which nothing is called a disturbance."""
BENDS = 0.2
"""Of the largest torque: what bends over a wider range than this is no limit."""
CLIPPED = (0.95, 0.85, 0.7, 0.5)
"""Start values of the limit over the largest torque."""


class TorqueScale(Effect):
    """A torque that is reported larger or smaller than it is."""

    name = "torque_scale"
    exact = True
    equation = "reported = true / scale"
    source = "torque constant of the motor; Krause, Analysis of Electric Machinery, 2002"
    signature = "all of an axis' masses, springs and dampers off by one factor, its neighbours' not"
    contrary = "one mass or spring alone that is off"

    def reported(self, torque: FloatArray, motion: Motion, values: Values) -> FloatArray:
        """Divide by the scale."""
        return torque / values["scale"]


class TorqueLag(Effect):
    """A torque that follows what the drive reports only after a first-order lag."""

    name = "torque_lag"
    exact = True
    equation = "true + time true' = reported"
    source = "current loop as a first-order lag; Leonhard, Control of Electrical Drives, 2001"
    signature = "phase that falls and a gain that falls with the frequency; linear"
    contrary = "a delay, whose gain is one at all frequencies; harmonics"
    shows = ("own motion",)

    def implausible(self, values: Values, context: Context) -> str:
        """Refuse what is small beside a cycle, as of a delay."""
        return _unnoticed(values["time"], context)

    def reported(self, torque: FloatArray, motion: Motion, values: Values) -> FloatArray:
        """Report what has to be asked for; a negative time: the report itself lags."""
        time = values["time"]
        if time >= 0.0:
            return torque + time * differentiate(torque, FIRST, motion.step)
        pole = float(np.exp(motion.step / time))
        # A straight line between samples through a first-order lag, exactly.
        late = 1.0 + (1.0 - pole) * time / motion.step
        early = 1.0 - pole - late
        out: FloatArray = lfilter([late, early], [1.0, -pole], torque - torque[0]) + torque[0]
        return out


class MeasurementDelay(Effect):
    """A position that is measured later than the torque of the same row."""

    name = "measurement_delay"
    exact = True
    equation = "measured(t) = q(t - delay)"
    source = "sampling and transmission; Franklin, Powell, Workman, Digital Control, 1998"
    signature = "a phase in proportion to the frequency, with a gain of one; linear"
    contrary = "harmonics; dependence on amplitude or direction"
    shows = ("own motion",)
    fits = 0.5  # everything that is sampled has one, whatever else is wrong

    def implausible(self, values: Values, context: Context) -> str:
        """Refuse what is small beside a cycle: nobody knows the moments of samples that well."""
        return _unnoticed(values["delay"], context)

    def motion(self, motion: Motion, values: Values) -> Motion:
        """Shift the motion of the axis to when it was, by Lagrange interpolation."""
        shift = values["delay"] / motion.step
        return replace(
            motion,
            position=_shifted(motion.position, self.axis, shift),
            velocity=_shifted(motion.velocity, self.axis, shift),
            acceleration=_shifted(motion.acceleration, self.axis, shift),
            smooth_position=_shifted(motion.smooth_position, self.axis, shift),
            smooth_velocity=_shifted(motion.smooth_velocity, self.axis, shift),
        )


class TorqueSaturation(Effect):
    """A torque that stays at a limit while the drive reports more."""

    name = "torque_saturation"
    equation = (
        "abs(true) = min(abs(reported), limit), its corner rounded: "
        "limit - rounding ln(1 + exp((limit - abs(reported)) / rounding))"
    )
    source = (
        "limit of the drive: Hippe, Windup in Control, 2006; iron that saturates bends before: "
        "Krause, Analysis of Electric Machinery, 2002"
    )
    signature = "an error only where the reported torque is large, of its sign; odd harmonics"
    contrary = "an error at small torques"
    fits = 0.8  # how round the corner is differs from motor to motor
    shows = ("large torque",)

    def reported(self, torque: FloatArray, motion: Motion, values: Values) -> FloatArray:
        """Add what the drive reported beyond the limit."""
        asked = motion.torque[:, self.axis]
        size, width = np.abs(asked), max(values["rounding"], 1e-6 * values["limit"])
        given = values["limit"] - width * np.logaddexp(0.0, (values["limit"] - size) / width)
        # At rest nothing is given: what the rounded corner lacks there is the same everywhere.
        none = values["limit"] - width * np.logaddexp(0.0, values["limit"] / width)
        return np.asarray(torque + np.sign(asked) * (size - given + none))


class PeriodicDisturbance(Effect):
    """A torque of one frequency in time, whatever the axis does."""

    name = "periodic_disturbance"
    equation = (
        "tau = amplitude sin(2 pi frequency t + phase), a phase of its own in each experiment"
    )
    source = "a neighbour's drive, a pump, the mains; Bodson, Adaptive Algorithms, 2005"
    signature = "one line of the spectrum at the same frequency in all experiments"
    contrary = "a frequency that goes with the speed or the period of the excitation"
    spreads = True

    def unknown(self, motion: Motion, values: Values) -> tuple[FloatArray, ...]:
        """Return sine and cosine, of unknown size."""
        phase = 2 * np.pi * values["frequency"] * motion.clock
        return np.sin(phase), np.cos(phase)


def _unnoticed(time: float, context: Context) -> str:
    step = context.motions[0].step
    if abs(time) >= SHORTEST * step:
        return ""
    return f"it would be {1e6 * time:.1f} us, less than samples are exact to"


def torque_candidates(context: Context) -> list[Effect]:
    """Return what may be wrong with the report of the torque, and with its time."""
    out: list[Effect] = []
    for axis in range(len(context.axes)):
        time = {"unit": "s", "start": 0.0, "scale": 2e-4, "linear": True}
        largest = context.largest_torque(axis)
        out += [
            MeasurementDelay(axis, (Parameter("delay", low=-LONGEST / 4, high=LONGEST, **time),)),  # type: ignore[arg-type]
            TorqueLag(axis, (Parameter("time", low=-LONGEST, high=LONGEST, **time),)),  # type: ignore[arg-type]
        ]
        if len(context.axes) > 1:
            out.append(TorqueScale(axis, (Parameter("scale", "1", 1.0, 0.2, 5.0, 0.02),)))
        out += [
            TorqueSaturation(
                axis,
                (
                    Parameter(
                        "limit",
                        context.torque_unit(axis),
                        share * largest,
                        0.3 * largest,
                        1.05 * largest,
                        0.02 * largest,
                    ),
                    Parameter(
                        "rounding",
                        context.torque_unit(axis),
                        0.03 * largest,
                        0.0,
                        BENDS * largest,
                        0.02 * largest,
                    ),
                ),
            )
            for share in CLIPPED
        ]
    return out


def disturbance_candidates(context: Context) -> list[Effect]:
    """Return single frequencies at which the error stands out of those around it, in all experiments."""
    out: list[Effect] = []
    longest = max(context.motions, key=lambda m: m.rows)
    shortest = min(m.rows * m.step for m in context.motions)
    grid = np.fft.rfftfreq(longest.rows, longest.step)
    width = 1.0 / (longest.rows * longest.step)
    inside = (grid > FEWEST_CYCLES / shortest) & (grid < context.top)
    for fundamental, spacing in context.fundamentals:
        # On a harmonic of the excitation nobody can tell a disturbance from what was excited.
        off = np.abs(grid - fundamental * np.rint(grid / fundamental))
        inside &= off > OFF_HARMONICS * spacing
    if not inside.any():
        return out
    for axis in range(len(context.axes)):
        level = np.full(int(inside.sum()), np.inf)
        for motion, error in zip(context.motions, context.errors, strict=True):
            power = np.abs(np.fft.rfft(error[:, axis] * np.hanning(motion.rows))) ** 2
            floor = median_filter(power, size=2 * AROUND + 1, mode="nearest")
            ratio = power / np.maximum(floor, 1e-300)
            frequency = np.fft.rfftfreq(motion.rows, motion.step)
            # The peak may lie between two lines of a shorter experiment.
            ratio = maximum_filter(ratio, size=3, mode="nearest")
            level = np.minimum(level, np.interp(grid[inside], frequency, ratio))
        for k in np.argsort(level)[::-1][:2]:
            if level[k] > STANDS_OUT:
                f = _between_lines(longest.torque.shape[0], context, longest, axis, grid[inside][k])
                low, high = _off_harmonics(context, f, 1.5 * width)
                if not low < f < high or _passed_on(context, longest, axis, f):
                    continue
                number = Parameter("frequency", "Hz", f, low, high, 0.1 * width)
                out.append(PeriodicDisturbance(axis, (number,)))
    return out


def _passed_on(context: Context, motion: Motion, axis: int, frequency: float) -> bool:
    """Whether a line is stronger in another axis, from which couplings pass it on."""
    error = context.errors[context.motions.index(motion)]
    turning = np.exp(-2j * np.pi * frequency * motion.clock) * np.hanning(motion.rows)
    mass = np.sqrt([context.inertia(k) for k in range(error.shape[1])])
    size = np.abs(turning @ error) / mass
    return bool(size[axis] < size.max())


def _off_harmonics(context: Context, frequency: float, reach: float) -> tuple[float, float]:
    """Bounds about a frequency that no harmonic of the excitation is near to."""
    low, high = frequency - reach, frequency + reach
    for fundamental, spacing in context.fundamentals:
        below = fundamental * np.floor(frequency / fundamental)
        low = max(low, below + OFF_HARMONICS * spacing)
        high = min(high, below + fundamental - OFF_HARMONICS * spacing)
    return low, high


def _between_lines(rows: int, context: Context, longest: Motion, axis: int, peak: float) -> float:
    """Return where between two lines a peak lies, from a parabola through the logarithms."""
    error = context.errors[context.motions.index(longest)][:, axis]
    power = np.log(np.abs(np.fft.rfft(error * np.hanning(rows))) ** 2 + 1e-300)
    spacing = 1.0 / (rows * longest.step)
    k = int(np.clip(round(peak / spacing), 2, power.size - 3))
    k += int(np.argmax(power[k - 1 : k + 2])) - 1
    bend = power[k - 1] - 2 * power[k] + power[k + 1]
    shift = 0.5 * (power[k - 1] - power[k + 1]) / bend if bend < 0 else 0.0
    return float((k + np.clip(shift, -0.5, 0.5)) * spacing)


def _shifted(values: FloatArray, axis: int, shift: float) -> FloatArray:
    """Return the columns, that of ``axis`` read so many rows later (six-point Lagrange)."""
    whole = int(np.floor(shift))
    part = shift - whole
    nodes = np.arange(-2, 4)
    weights = [
        np.prod([(part - other) / (node - other) for other in nodes if other != node])
        for node in nodes
    ]
    out = values.copy()
    n = values.shape[0]
    rows = np.arange(n)
    column = np.zeros(n)
    for node, weight in zip(nodes, weights, strict=True):
        column += weight * values[np.clip(rows + whole + node, 0, n - 1), axis]
    out[:, axis] = column
    return out
