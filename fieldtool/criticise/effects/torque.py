"""What stands between the torque that acts and the torque that the drive reports, and delays."""

from dataclasses import replace

import numpy as np
from scipy.signal import lfilter

from fieldtool.criticise.effects.base import (
    Context,
    Effect,
    FloatArray,
    Mark,
    Parameter,
    Values,
)
from fieldtool.criticise.simulate.motion import FIRST, SECOND, Motion, differentiate

LONGEST = 0.02
"""s: no delay or lag of a drive is longer."""
SHORTEST = 0.02
"""Of a cycle: a shorter delay or lag is none."""
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


class TimeSpread(Effect):
    """What the second moment of an impulse response does: a gain that changes with frequency squared.

    It has no name of its own.  Whatever is linear and late has a mean time, which is a phase in
    proportion to the frequency, and a spread about it: none for a delay, as large as the mean for a lag
    of first order.
    """

    name = "time_spread"
    equation = "reported = true + square true''"
    source = "moments of an impulse response; Astrom and Hagglund, Advanced PID Control, 2006"
    signature = "a gain that changes with the square of the frequency; linear"
    contrary = "a phase"

    def reported(self, torque: FloatArray, motion: Motion, values: Values) -> FloatArray:
        """Add to the torque its curvature."""
        return torque + values["square"] * differentiate(torque, SECOND, motion.step**2)

    @classmethod
    def of(cls, axis: int) -> "TimeSpread":
        """Return none at all of it, to be fitted."""
        most = LONGEST**2
        return cls(axis, (Parameter("square", "s2", 0.0, -most, most, 1e-8, linear=True),))


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

    def marks(self, values: Values, context: Context) -> tuple[Mark, ...]:
        """A gain that falls."""
        return (
            Mark(
                "measurement_delay",
                "a gain that falls with the square of the frequency as that of a lag must",
                "square",
                0.5 * values["time"] ** 2,
                TimeSpread.of(self.axis),
            ),
        )

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

    def marks(self, values: Values, context: Context) -> tuple[Mark, ...]:
        """A gain that stays."""
        return (
            Mark(
                "torque_lag",
                "a gain of one at the frequencies at which that of a lag would have fallen",
                "square",
                -0.5 * values["delay"] ** 2,
                TimeSpread.of(self.axis),
            ),
        )

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
        if not largest > 0.0:
            continue  # a drive that reports nothing reaches no limit
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
