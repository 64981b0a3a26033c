"""A torque of one frequency in time, and from where in the machine it comes."""

import numpy as np
from scipy.ndimage import maximum_filter, median_filter

from fieldtool.criticise.effects.base import Context, Effect, FloatArray, Parameter, Values
from fieldtool.criticise.simulate.inverse import passed_on
from fieldtool.criticise.simulate.motion import Motion
from fieldtool.criticise.simulate.structure import Structure

FEWEST_CYCLES = 8.0
"""Of a disturbance within the shortest experiment."""
STANDS_OUT = 12.0
"""Power of a line over the median of those around it, from which it is tried as a disturbance."""
AROUND = 12
OFF_HARMONICS = 0.6
"""Lines from the harmonics of the excitation within which nothing is called a disturbance."""


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
                source = _source(context, longest, f)
                known = any(e.axis == source and low < e.parameters[0].start < high for e in out)
                if not low < f < high or known:
                    continue
                number = Parameter("frequency", "Hz", f, low, high, 0.1 * width)
                out.append(PeriodicDisturbance(source, (number,)))
    return out


def _source(context: Context, motion: Motion, frequency: float) -> int:
    """Return the axis at whose motor or last mass a torque of one frequency acts.

    At a motor it shows in that axis alone; at a last mass, springs and couplings pass it on to all
    motors in sizes and phases that the machine's own masses and springs say.
    """
    error = context.errors[context.motions.index(motion)]
    turning = np.exp(-2j * np.pi * frequency * motion.clock) * np.hanning(motion.rows)
    seen = turning @ error
    if seen.size == 1:
        return 0
    noise = _around(error, motion.step, frequency)
    structure = Structure.of(context.model)
    patterns = [(k, np.eye(seen.size)[k]) for k in range(seen.size)]
    ends = passed_on(structure, 2 * np.pi * frequency)
    patterns += [
        (k, ends[:, k]) for k in range(seen.size) if structure.ends[k] != structure.motors[k]
    ]
    seen = seen / noise
    shares = [
        abs(np.vdot(p / noise, seen)) ** 2 / max(float(np.sum(np.abs(p / noise) ** 2)), 1e-300)
        for _, p in patterns
    ]
    return patterns[int(np.argmax(shares))][0]


def _around(error: FloatArray, step: float, frequency: float) -> FloatArray:
    """Size of the error's lines around a frequency, (M,)."""
    power = np.abs(np.fft.rfft(error * np.hanning(error.shape[0])[:, None], axis=0)) ** 2
    k = round(frequency * error.shape[0] * step)
    near = power[max(k - AROUND, 1) : k + AROUND + 1]
    return np.asarray(np.sqrt(np.maximum(np.median(near, axis=0), 1e-300)))


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
