"""What goes with the position: gravity, cogging, errors of the encoder."""

from dataclasses import replace

import numpy as np

from fieldtool.criticise.effects.base import Context, Effect, FloatArray, Parameter, Values
from fieldtool.criticise.simulate.motion import FIRST, SECOND, Motion, differentiate

PEAKS = 3
"""Highest peaks over the orders that are tried."""
FINEST = 6
"""Orders tried per reciprocal of the travel."""
FEWEST_WAVES = 1.5
"""Waves within the travel from which an order can be told."""
FEW_WAVES = (0.5, 0.75, 1.0)
"""Waves within the travel that are tried besides, where gravity could be meant as well."""
MOST_ORDERS = 4000
WAVING, STEEPEST = 0.05, 0.4
"""Largest error of an encoder over the travel, and the slope of its sine and cosine each: with 1 or
more of both together, whose order may rise besides, a position would be told twice."""
BINS = 8
"""Bins of the position per wave of the highest order."""


class Gravity(Effect):
    """An unbalanced weight on a rotary axis."""

    name = "gravity"
    exact = True
    equation = "tau = sine sin(q) + cosine cos(q)"
    source = "the torque of a weight on an arm; Khalil and Dombre, Modeling of Robots, 2002"
    signature = "torque that goes with the position, once a turn, at any speed"
    contrary = "growth with the speed; dependence on the direction"
    shows = ("position", "own motion")

    def torque(self, motion: Motion, values: Values) -> FloatArray | None:
        """At the motor."""
        q = motion.position[:, self.axis]
        return np.asarray(values["sine"] * np.sin(q) + values["cosine"] * np.cos(q))

    def plain(self, values: Values) -> dict[str, tuple[float, str, tuple[str, ...]]]:
        """Return amplitude and the position at which the weight hangs."""
        unit = self.parameters[0].unit
        both = ("sine", "cosine")
        phase = float(np.arctan2(values["cosine"], values["sine"]))
        size = float(np.hypot(values["sine"], values["cosine"]))
        return {"torque": (size, unit, both), "phase": (phase, "rad", both)}


class Cogging(Effect):
    """A torque that waves with the position, at any speed."""

    name = "cogging"
    equation = "tau = sine sin(order q) + cosine cos(order q)"
    source = "Hanselman, Brushless Motors, 2012 (cogging); order tracking as in vibration analysis"
    signature = "torque at one order of the position, the same at all speeds"
    contrary = "growth with the speed"
    shows = ("position",)

    def torque(self, motion: Motion, values: Values) -> FloatArray | None:
        """At the motor."""
        phase = values["order"] * motion.position[:, self.axis]
        return np.asarray(values["sine"] * np.sin(phase) + values["cosine"] * np.cos(phase))

    def plain(self, values: Values) -> dict[str, tuple[float, str, tuple[str, ...]]]:
        """Return amplitude, order, pitch and phase."""
        unit, both = self.parameters[0].unit, ("sine", "cosine")
        return {
            "amplitude": (float(np.hypot(values["sine"], values["cosine"])), unit, both),
            "order": (values["order"], self.parameters[2].unit, ("order",)),
            "pitch": (2 * np.pi / values["order"], _length(self.parameters[2].unit), ("order",)),
            "phase": (float(np.arctan2(values["cosine"], values["sine"])), "rad", both),
        }


class EncoderError(Effect):
    """A measured position that waves about the true one with the position."""

    name = "encoder_error"
    equation = "measured = q + sine sin(order q) + cosine cos(order q)"
    source = "eccentricity and interpolation errors; Ellis, Control System Design Guide, 2012"
    signature = "torque at one order of the position that grows with the square of the speed"
    contrary = "the same torque at all speeds"

    def motion(self, motion: Motion, values: Values) -> Motion:
        """Take the error off the measured position."""
        position = motion.position.copy()
        phase = values["order"] * motion.position[:, self.axis]
        position[:, self.axis] -= values["sine"] * np.sin(phase) + values["cosine"] * np.cos(phase)
        return replace(
            motion,
            position=position,
            velocity=differentiate(position, FIRST, motion.step),
            acceleration=differentiate(position, SECOND, motion.step**2),
        )

    def plain(self, values: Values) -> dict[str, tuple[float, str, tuple[str, ...]]]:
        """Return amplitude, order and phase."""
        unit, both = self.parameters[0].unit, ("sine", "cosine")
        return {
            "amplitude": (float(np.hypot(values["sine"], values["cosine"])), unit, both),
            "order": (values["order"], self.parameters[2].unit, ("order",)),
            "phase": (float(np.arctan2(values["cosine"], values["sine"])), "rad", both),
        }


def position_candidates(context: Context) -> list[Effect]:
    """Return gravity, and waves at the orders at which the error has them."""
    out: list[Effect] = []
    for axis, info in enumerate(context.axes):
        unit, size, travel = (
            context.torque_unit(axis),
            context.torque_size(axis),
            context.travel(axis),
        )
        if travel <= 0.0:
            continue

        def wave(name: str, most: float, unit: str) -> Parameter:
            return Parameter(name, unit, 0.0, -most, most, 0.01 * most, linear=True)

        if info.kind == "rotary":
            most = 30.0 * size
            out.append(Gravity(axis, (wave("sine", most, unit), wave("cosine", most, unit))))
        per = "rad/m" if info.kind == "linear" else "1/turn"
        for kind, length, most in (
            (Cogging, unit, 5 * size),
            (EncoderError, info.position_unit, WAVING * travel),
        ):
            orders = waves(context, axis, kind is EncoderError)
            if info.kind == "rotary" and travel > 0.0:
                orders = [*orders, *(o for w in FEW_WAVES if (o := 2 * np.pi * w / travel) > 1.5)]
            for order in orders:
                low, high = (0.7, 1.4) if order * travel > 2 * np.pi * FEWEST_WAVES else (0.6, 1.6)
                low, high = low * order, high * order
                number = Parameter("order", per, order, low, high, 0.1 * 2 * np.pi / travel)
                reach = min(most, STEEPEST / order) if kind is EncoderError else most
                pair = (wave("sine", reach, length), wave("cosine", reach, length))
                out.append(kind(axis, (*pair, number)))
    return out


def waves(context: Context, axis: int, accelerated: bool) -> list[float]:
    """Orders, 1/rad or 1/m, at which a wave over the position explains most of the error."""
    travel, fastest = context.travel(axis), context.fastest(axis)
    if travel <= 0.0:
        return []
    lowest = 2 * np.pi * FEWEST_WAVES / travel
    finest = MOST_ORDERS / FINEST * 2 * np.pi / travel
    highest = min(2 * np.pi * context.top / max(0.1 * fastest, 1e-12), finest)
    if context.axes[axis].kind == "rotary":
        lowest = max(lowest, 1.5) if not accelerated else max(lowest, 0.9)
    if highest <= lowest:
        return []
    # Errors are gathered in narrow bins of the position; their spectrum is that over the position.
    bins = 1 << int(np.ceil(np.log2(BINS * highest * travel / (2 * np.pi))))
    padded = FINEST * bins
    power = np.zeros(padded // 2 + 1)
    for motion, error in zip(context.motions, context.errors, strict=True):
        q, target = motion.position[:, axis], error[:, axis]
        if accelerated:
            # What an error of the position leaves is its second derivative: v^2 times the wave.
            target = target * motion.smooth_velocity[:, axis] ** 2
        place = np.clip((q - q.min()) / travel * bins, 0, bins - 1).astype(np.intp)
        gathered = np.bincount(place, weights=target, minlength=bins)
        power += np.abs(np.fft.rfft(gathered, padded)) ** 2 / q.size
    orders = np.arange(power.size) * 2 * np.pi / travel * bins / padded
    inside = (orders >= lowest) & (orders <= highest)
    orders, power = orders[inside], power[inside]
    chosen: list[float] = []
    for k in np.argsort(power)[::-1]:
        if len(chosen) == PEAKS:
            break
        if all(abs(orders[k] - c) > 2 * 2 * np.pi / travel for c in chosen):
            chosen.append(float(orders[k]))
    return chosen


def _length(per: str) -> str:
    return "rad" if per == "1/turn" else "m"
