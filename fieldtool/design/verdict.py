"""Whether what new parameters do on the machine is good enough to leave them in the drives.

Three questions, each with a tolerance that is stated: are the margins kept, is it no worse than with the
old parameters, is it what was predicted.  All figures of a comparison come from the same trial.
"""

from dataclasses import dataclass
from math import isfinite, isnan
from typing import Any

import numpy as np

from fieldtool.design.figures import StepFigures, strays
from fieldtool.design.measured import AxisFigures, Sensitivity
from fieldtool.design.predict import finite
from fieldtool.design.tuning import BOUND
from fieldtool.records.model import FloatArray

MARGIN = 1.05
"""Times the bound that a measured peak of sensitivity may have: what its measurement is good for."""
SLOWER = 1.05
"""Times the settling time with the old parameters that the new one may take."""
CYCLES = 3.0
"""Cycles of the bus by which times may differ besides: no time is known better."""
RINGS = 1.5
"""Times the old vibration, overshoot and following error, or those that an identified model predicts,
that the new ones may have; half the band about the target counts as nothing."""
LEAST_PEAK = 0.5
"""No loop's sensitivity stays below it over a band that reaches far above its bandwidth (Bode's
integral): where it seems to, the torque that was told did not follow the excitation."""
RUBS = 1.1
"""Times the loop's own peak from which a predicted one is made by dry friction in a small excitation."""
PEAK_OFF = 0.2
"""Share by which a measured peak of sensitivity may be off the predicted one."""
CURVE_OFF = 0.35
"""Natural logarithm by which the middle one of all lines' sensitivities may be off: a factor of 1.4."""
GAINED, FEWEST = (0.2, 0.7), 3
"""Sensitivities between which a loop's gain shows (above noise, below where all loops come to 1), and
lines there that are enough: the middle one of their logarithms is the gain of the loop that is off."""
PEAK_DOUBT, TIME_DOUBT = 0.1, 0.15
"""Shares by which a peak, and a settling time, are off their prediction at most as a rule: else it is
said."""
TIME_OFF, MOVE_OFF = 0.3, 0.05
"""Shares of the predicted settling time, and of the move's own time, by which settling may be off."""


STEP_POINTS, SETTLED = 200, 1.6
"""Of a step that is kept as numbers; and times its settling time until which it is kept."""


@dataclass(frozen=True, eq=False)
class Step:
    """How the motor follows a step of its reference, by the model, without feed-forward."""

    figures: StepFigures
    time: FloatArray
    """s, shape (n,)."""
    position: FloatArray
    """Over the step's height, shape (n,)."""

    def as_dict(self) -> dict[str, Any]:
        """Figures (infinite: null), and the course at STEP_POINTS times until it has settled."""
        settled = self.figures.settling_time
        seen = SETTLED * settled if isfinite(settled) else float(self.time[-1])
        time = np.linspace(0.0, min(max(seen, float(self.time[1])), self.time[-1]), STEP_POINTS)
        position = np.interp(time, self.time, self.position)
        figures: dict[str, Any] = finite(self.figures.as_dict())
        return {
            **figures,
            "time": [float(f"{t:.6g}") for t in time],
            "position": [float(f"{p:.6g}") for p in position],
        }


@dataclass(frozen=True, eq=False)
class Comparison:
    """One axis before, as predicted, and after; all on one scale."""

    axis: str
    unit: str
    """Of positions."""
    distance: float
    """Of the move."""
    duration: float
    """s, of the move's reference."""
    band: float
    before: AxisFigures | None
    """None where it was not measured."""
    predicted: AxisFigures | None
    """None where there is no model to predict from."""
    after: AxisFigures | None
    """None where the trial did not come that far."""
    sensitivity_before: Sensitivity | None = None
    sensitivity_predicted: Sensitivity | None = None
    """At the lines of the measured one."""
    sensitivity_after: Sensitivity | None = None
    loop_peak: float | None = None
    """Of sensitivity, by the model without dry friction: what the new loop itself is worth; None: not
    known."""
    step_before: Step | None = None
    """With the old parameters; None where the machine would not be stable."""
    step_predicted: Step | None = None
    """With the new ones."""

    @property
    def rubs(self) -> bool:
        """Whether dry friction, not the loop, makes the peak that is predicted of the small excitation.

        An axis that friction holds creeps, and its slowest lines say so: nothing of them is the loop's.
        """
        peak = None if self.predicted is None else self.predicted.sensitivity_peak
        return bool(peak and self.loop_peak and peak > RUBS * self.loop_peak)

    def as_dict(self) -> dict[str, Any]:
        """Plain values."""
        figures = {
            name: figure.as_dict() if (figure := getattr(self, name)) else None
            for name in ("before", "predicted", "after")
        }
        curves = {
            name: curve.as_dict() if (curve := getattr(self, f"sensitivity_{name}")) else None
            for name in ("before", "predicted", "after")
        }
        move = {"distance": self.distance, "duration": self.duration, "band": self.band}
        return {
            "axis": self.axis,
            "unit": self.unit,
            "move": move,
            **figures,
            "sensitivity": curves,
            "step": {
                name: step.as_dict() if step is not None else None
                for name, step in (("before", self.step_before), ("predicted", self.step_predicted))
            },
        }


def faults(
    one: Comparison, cycle: float, bound: float, *, believed: bool, softer: bool = False
) -> tuple[str, ...]:
    """Return what is wrong with an axis' new parameters, a sentence each; empty if nothing is.

    Parameters
    ----------
    one
        Of the axis.
    cycle
        Of the bus, s.
    bound
        That was designed for: of the peak of sensitivity.
    believed
        Whether the prediction rests on an identified model; where it does not, nothing is judged, and
        nothing excused, by it.
    softer
        Whether a softer machine was asked for: then an axis whose old parameters do not keep the bound
        may settle later, as predicted.
    """
    before, after = one.before, one.after
    if after is None:
        return (f"{one.axis}: was not measured with the new parameters",)
    found = _unmeasured(after, "new") + _margins(one, after, bound, believed, softer)
    if before is None:
        found.append(
            "was not measured with the old parameters, so nothing says that it is no worse"
        )
    else:
        peak = before.sensitivity_peak
        later = softer and believed and peak is not None and peak > MARGIN * bound
        found += _unmeasured(before, "old", sensitivity=False)
        found += _worse(one, before, after, np.inf if later else cycle, believed)
    if believed and one.predicted is None:
        found.append("nothing was predicted of it, so nothing says that it is as designed")
    elif believed and one.predicted is not None:
        found += _unlike(one, one.predicted, after, cycle)
    return tuple(f"{one.axis}: {text}" for text in found)


def _unmeasured(figures: AxisFigures, whose: str, *, sensitivity: bool = True) -> list[str]:
    """Return what is no number: nothing is left in the drives by what was not seen.

    That it did not settle is an infinite time, and a measurement.
    """
    names = {
        "settling time": isnan(figures.settling_time),
        "overshoot": not isfinite(figures.overshoot),
        "vibration": not isfinite(figures.vibration),
        "following error": not isfinite(figures.following_error),
        "torque": not isfinite(figures.peak_torque),
    }
    peak = figures.sensitivity_peak
    if sensitivity:
        names["sensitivity"] = peak is None or not isfinite(peak) or peak < LEAST_PEAK
    return [
        f"its {name} with the {whose} parameters was not measured, so they are not kept"
        if whose == "new"
        else f"its {name} with the {whose} parameters was not measured, so nothing can be compared"
        for name, lacks in names.items()
        if lacks
    ]


def _margins(
    one: Comparison, after: AxisFigures, bound: float, believed: bool, softer: bool
) -> list[str]:
    found = []
    if believed and one.rubs and one.predicted and one.predicted.sensitivity_peak:
        # what friction adds, as predicted, is no want of the loop's; never beyond what any loop may have
        bound = max(bound, min(one.predicted.sensitivity_peak, BOUND))
    if not np.isfinite(after.settling_time):
        found.append(
            f"does not settle: it is outside of ±{one.band:.3g} {one.unit} at the end of the record"
        )
    peak = after.sensitivity_peak
    if peak is not None and peak > MARGIN * bound:
        found.append(
            f"its peak of sensitivity is {peak:.3g} at {after.sensitivity_frequency:.3g} Hz, "
            f"{bound:.3g} was wanted and up to {MARGIN * bound:.3g} is taken"
            + ("" if softer else " (a design with --response soft keeps more margin)")
        )
    return found


def _worse(
    one: Comparison, before: AxisFigures, after: AxisFigures, cycle: float, believed: bool
) -> list[str]:
    found = []
    longest = SLOWER * before.settling_time + CYCLES * cycle
    if after.settling_time > longest and np.isfinite(after.settling_time):
        found.append(
            f"settles in {after.settling_time:.3g} s after its move, {before.settling_time:.3g} s with "
            f"the old parameters; {100 * (SLOWER - 1):.0f} % more is taken"
        )
    kinds = [("overshoots", "overshoot"), ("vibrates after its move", "vibration")]
    if believed:  # a design strays on purpose, and only a prediction tells how far
        kinds.append(("leaves its reference", "following_error"))
    for what, name in kinds:
        new, old = getattr(after, name), getattr(before, name)
        expected = getattr(one.predicted, name) if believed and one.predicted else 0.0
        if new > RINGS * max(old, expected) + one.band / 2:
            found.append(
                f"{what} by {new:.3g} {one.unit}, {old:.3g} {one.unit} with the old parameters"
            )
    return found


def _unlike(one: Comparison, expected: AxisFigures, after: AxisFigures, cycle: float) -> list[str]:
    found = []
    latest = _latest(expected)
    allowed = TIME_OFF * latest + MOVE_OFF * one.duration + CYCLES * cycle
    if np.isfinite(after.settling_time) and after.settling_time - latest > allowed:
        found.append(
            f"settles in {after.settling_time:.3g} s after its move, {_predicted_time(expected)} was "
            f"predicted; {allowed:.2g} s more is taken"
        )
    wanted, peak = expected.sensitivity_peak, after.sensitivity_peak
    if wanted and peak and not one.rubs and not abs(peak / wanted - 1) <= PEAK_OFF:
        found.append(
            f"its peak of sensitivity is {peak:.3g}, {wanted:.3g} was predicted; "
            f"{100 * PEAK_OFF:.0f} % off is taken"
        )
    measured, predicted = one.sensitivity_after, one.sensitivity_predicted
    if measured is not None and predicted is not None:
        found += _gained(measured, predicted)
        with np.errstate(all="ignore"):
            apart = float(np.median(np.abs(np.log(measured.size / predicted.size))))
        if not apart <= CURVE_OFF:  # nor if it is no number
            found.append(
                f"its sensitivity is off the predicted one by a factor of {np.exp(apart):.2g} over its "
                f"frequencies; {np.exp(CURVE_OFF):.2g} is taken: its loop is not the one that was "
                "designed"
            )
    return found


def strayed(one: Comparison) -> tuple[str, ...]:
    """Return a sentence where an axis with new parameters that are kept strays farther than before."""
    before, after = one.before, one.after
    if before is None or after is None:
        return ()
    if not strays(after.following_error, before.following_error, one.band):
        return ()
    return (
        f"{one.axis}: on its move it is up to {after.following_error:.3g} {one.unit} off its reference, "
        f"{before.following_error:.3g} {one.unit} with the old parameters. Where the path counts for "
        "more than the arrival, bring the old ones back: `fieldtool restore` with the session's folder.",
    )


def doubts(one: Comparison, cycle: float) -> tuple[str, ...]:
    """Return what is off its prediction by more than is usual, though not by enough to be taken back.

    Parameters
    ----------
    one
        Of an axis whose new parameters are kept.
    cycle
        Of the bus, s.
    """
    expected, after = one.predicted, one.after
    if expected is None or after is None:
        return ()
    found = []
    wanted, peak = expected.sensitivity_peak, after.sensitivity_peak
    if wanted and peak and not one.rubs and abs(peak / wanted - 1) > PEAK_DOUBT:
        found.append(f"peak of sensitivity is {peak:.3g}, {wanted:.3g} was predicted")
    low, high = expected.settling_time, _latest(expected)
    settles, slack = after.settling_time, CYCLES * cycle
    if not (1 - TIME_DOUBT) * low - slack <= settles <= (1 + TIME_DOUBT) * high + slack:
        found.append(f"settling time is {settles:.3g} s, {_predicted_time(expected)} was predicted")
    return tuple(
        f"{one.axis}: its {text}: good enough to be kept, but more than the usual "
        f"{100 * PEAK_DOUBT:.0f} % (peak) or {100 * TIME_DOUBT:.0f} % (time) off. Measure anew if the "
        "machine was changed."
        for text in found
    )


def _latest(expected: AxisFigures) -> float:
    """Return the settling time if a swing that is predicted to touch the band's edge leaves it, s."""
    return max(expected.settling_time, expected.settling_latest or 0.0)


def _predicted_time(expected: AxisFigures) -> str:
    latest = _latest(expected)
    more = f" (up to {latest:.3g} s: a swing touches the edge of the band)"
    return f"{expected.settling_time:.3g} s" + (more if latest > expected.settling_time else "")


def _gained(measured: Sensitivity, predicted: Sensitivity) -> list[str]:
    """Return what the loop's gain says: below its bandwidth a sensitivity is one over it."""
    lines = (predicted.size > GAINED[0]) & (predicted.size < GAINED[1]) & (measured.size > 0)
    if np.count_nonzero(lines) < FEWEST:
        return []
    off = float(np.median(np.log(predicted.size[lines] / measured.size[lines])))
    if abs(off) <= CURVE_OFF:
        return []
    return [
        f"its loop has {np.exp(off):.2g} times the gain that was predicted, by its sensitivity below "
        f"{GAINED[1]:g}; a factor of {np.exp(CURVE_OFF):.2g} is taken: its masses are not the model's, "
        "or its loop is not the one that was designed"
    ]
