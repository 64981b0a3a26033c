"""Effects of a model as parts of a simulated machine: the same names, other formulas and numbers.

A model's effects are those that explain data, a simulated machine's those that move it.  Where both
laws differ, the simulated part is the one that does the same at small motions; what has no part,
or whose numbers the model does not hold, is left out with a sentence.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from math import hypot, pi, sqrt
from typing import Any

Part = dict[str, Any]
STEP = 1.0 / 8000.0
"""s: inner step of the simulated drives; delays are whole numbers of it."""
LARGEST_LOSS = 0.5
"""Loss factor up to which structural damping can be simulated."""


@dataclass
class Rebuilt:
    """What the effects of one model come to."""

    parts: dict[str, list[Part]] = field(default_factory=dict)
    """By axis."""
    between: list[Part] = field(default_factory=list)
    """What joins two axes."""
    viscous: dict[str, float] = field(default_factory=dict)
    """Viscous friction at the motor to add, by axis."""
    springs: dict[tuple[str, int], float] = field(default_factory=dict)
    """Factor of a spring, by axis and number from 0."""
    left_out: list[str] = field(default_factory=list)
    """One sentence for each thing that the simulated machine does not have, or has otherwise."""


@dataclass(frozen=True)
class Given:
    """One effect of a model, and the chain that it is in."""

    axis: str
    location: str
    linear: bool
    values: Mapping[str, float]
    springs: tuple[float, ...]
    rigid: bool
    """Whether the chain has one mass: motor and load are the same."""

    @property
    def joint(self) -> int:
        """Number of the spring from the motor, from 1."""
        words = self.location.split()
        return int(words[1]) if len(words) == 2 and words[1].isdigit() else 1

    @property
    def end(self) -> str:
        """``motor`` or ``load``."""
        return "load" if self.location == "load" and not self.rigid else "motor"


Chains = Mapping[str, tuple[str, tuple[float, ...]]]
"""Kind and springs of each axis."""


def rebuilt(effects: tuple[Mapping[str, Any], ...], chains: Chains) -> Rebuilt:
    """Turn a model's effects into parts of a simulated machine.

    Parameters
    ----------
    effects
        As ``model.yaml`` has them.
    chains
        Kind and springs of each axis.
    """
    out = Rebuilt()
    for effect in effects:
        name, axis = str(effect["effect"]), effect.get("axis")
        values = {k: _value(v) for k, v in effect["parameters"].items()}
        if not isinstance(axis, str):
            _between(out, effect, tuple(axis or ()), values)
            continue
        kind, springs = chains[axis]
        given = Given(
            axis,
            str(effect.get("location") or "motor"),
            kind == "linear",
            values,
            springs,
            not springs,
        )
        make = MAKERS.get(name)
        if make is None:
            out.left_out.append(f"{name} of {axis}: no simulated part does it.")
            continue
        try:
            make(out, given)
        except KeyError as missing:
            out.left_out.append(f"{name} of {axis}: the model does not hold its {missing.args[0]}.")
    return out


def _value(number: Any) -> float:
    return float(number["value"] if isinstance(number, Mapping) else number)


def _between(
    out: Rebuilt, effect: Mapping[str, Any], axes: tuple[str, ...], values: Mapping[str, float]
) -> None:
    name = str(effect["effect"])
    if name == "coupling_spring" and values.get("stiffness", 0.0) > 0:
        out.between.append({"effect": name, "axes": list(axes), "stiffness": values["stiffness"]})
    elif name == "coupling_inertia" and "inertia" in values:
        part = {
            "effect": name,
            "axes": list(axes),
            "inertia": values["inertia"],
            "location": "motor" if effect.get("location") == "motor" else "load",
        }
        out.between.append(part)
    else:
        out.left_out.append(f"{name} of {' - '.join(axes)}: no simulated part does it.")


def _add(out: Rebuilt, given: Given, name: str, **numbers: Any) -> None:
    out.parts.setdefault(given.axis, []).append({"effect": name, **numbers})


def _coulomb(out: Rebuilt, g: Given) -> None:
    if "stiffness" in g.values and "torque" not in g.values:
        out.left_out.append(
            f"coulomb_friction of {g.axis}: a spring to ground (friction that has not broken "
            "away) has no simulated part."
        )
    elif g.values["torque"] > 0:
        _add(out, g, "coulomb_friction", torque=g.values["torque"], location=g.end)


def _stribeck(out: Rebuilt, g: Given) -> None:
    v = g.values
    _add(
        out, g, "stribeck_friction", torque=max(v["torque"], 1e-9),
        breakaway=max(v["breakaway"], v["torque"], 1e-9), velocity=v["velocity"], location=g.end,
    )  # fmt: skip


def _asymmetric(out: Rebuilt, g: Given) -> None:
    v = g.values
    forward, backward = v["coulomb_positive"], v["coulomb_negative"]
    wet = (v["viscous_positive"], v["viscous_negative"])
    _add(
        out, g, "asymmetric_friction", coulomb_positive=max(forward, 1e-9),
        coulomb_negative=max(backward, 1e-9), location=g.end,
    )  # fmt: skip
    mean = sum(wet) / 2
    out.viscous[g.axis] = out.viscous.get(g.axis, 0.0) + max(mean, 0.0)
    if abs(wet[0] - wet[1]) > 0.02 * max(abs(w) for w in wet):
        out.left_out.append(
            f"asymmetric_friction of {g.axis}: its viscous part differs between the directions "
            f"({wet[0]:.3g} and {wet[1]:.3g}); the simulated one has their mean."
        )


def _backlash(out: Rebuilt, g: Given) -> None:
    # the model's dead zone gives back what it takes
    play = g.values["gap"] if "gap" in g.values else 2 * g.values["half_gap"]
    if play > 0:
        _add(out, g, "backlash", gap=play, restitution=1.0, joint=g.joint)


def _hardening(out: Rebuilt, g: Given) -> None:
    # k s sinh(d / s) = k d + k d^3 / (6 s^2) + ...
    k = g.springs[g.joint - 1]
    if g.values["cubic"] > 0:
        _add(out, g, "hardening_spring", stretch=sqrt(k / (6 * g.values["cubic"])), joint=g.joint)


def _softening(out: Rebuilt, g: Given) -> None:
    # k s tanh(d / s) = k d - k d^3 / (3 s^2) + ...
    k = g.springs[g.joint - 1]
    if g.values["cubic"] < 0:
        _add(out, g, "softening_spring", stretch=sqrt(k / (-3 * g.values["cubic"])), joint=g.joint)


def _structural(out: Rebuilt, g: Given) -> None:
    loss = g.values["loss_factor"]
    if loss > LARGEST_LOSS:
        out.left_out.append(
            f"structural_damping of {g.axis}: its loss factor {loss:.3g} is more than can be simulated; "
            f"{LARGEST_LOSS:g} was taken."
        )
    if loss > 0:
        _add(out, g, "structural_damping", loss_factor=min(loss, LARGEST_LOSS), joint=g.joint)


def _gravity(out: Rebuilt, g: Given) -> None:
    # the model's torque is that of an arm: T sin(q + phase), seen at the motor
    _add(out, g, "gravity", torque=g.values["torque"], angle=g.values["phase"], location=g.end)


def _cogging(out: Rebuilt, g: Given) -> None:
    periods = g.values["order"] / (2 * pi) if g.linear else g.values["order"]
    _add(
        out, g, "cogging", amplitude=g.values["amplitude"], periods=periods, phase=g.values["phase"],
        sharpness=0.0,
    )  # fmt: skip


def _encoder(out: Rebuilt, g: Given) -> None:
    # two tracks with offsets show A sin(p - order q); the model has A sin(order q + phase)
    periods = g.values["order"] / (2 * pi) if g.linear else g.values["order"]
    _add(
        out, g, "encoder_error", amplitude=g.values["amplitude"], periods=periods,
        phase=pi - g.values["phase"],
    )  # fmt: skip


def _scale(out: Rebuilt, g: Given) -> None:
    _add(out, g, "torque_scale", scale=g.values["scale"])


def _lag(out: Rebuilt, g: Given) -> None:
    if g.values["time"] > 0:
        _add(out, g, "torque_lag", time=g.values["time"])
    else:
        out.left_out.append(
            f"torque_lag of {g.axis}: a report that lags the torque has no simulated part."
        )


def _delay(out: Rebuilt, g: Given) -> None:
    delay = g.values["delay"]
    if delay >= STEP / 2:
        _add(out, g, "measurement_delay", delay=delay)
    elif delay <= -STEP / 2:
        out.left_out.append(
            f"measurement_delay of {g.axis}: a position that is measured {-delay:.2g} s earlier "
            "than the torque has no simulated part."
        )


def _extra(out: Rebuilt, g: Given) -> None:
    v = g.values
    _add(
        out, g, "extra_mode", mass=v["mass"], frequency=v["frequency"],
        damping_ratio=max(v["damping_ratio"], 0.0), location=g.end,
    )  # fmt: skip


def _disturbance(out: Rebuilt, g: Given) -> None:
    v = g.values
    size = v["amplitude"] if "amplitude" in v else hypot(v["sine"], v["cosine"])
    _add(out, g, "periodic_disturbance", torque=size, frequency=v["frequency"], location=g.end)


def _changed(out: Rebuilt, g: Given) -> None:
    factor = 1.0 + g.values["change"]
    out.springs[g.axis, g.joint - 1] = factor
    out.left_out.append(
        f"stiffness_change of {g.axis}: the simulated machine is the one after the change: spring "
        f"{g.joint} is {factor:.3g} times as stiff from the start."
    )


def _saturation(out: Rebuilt, g: Given) -> None:
    _add(out, g, "torque_saturation", limit=g.values["limit"])


MAKERS: dict[str, Callable[[Rebuilt, Given], None]] = {
    "coulomb_friction": _coulomb,
    "stribeck_friction": _stribeck,
    "asymmetric_friction": _asymmetric,
    "backlash": _backlash,
    "hardening_spring": _hardening,
    "softening_spring": _softening,
    "structural_damping": _structural,
    "gravity": _gravity,
    "cogging": _cogging,
    "encoder_error": _encoder,
    "torque_scale": _scale,
    "torque_lag": _lag,
    "measurement_delay": _delay,
    "extra_mode": _extra,
    "periodic_disturbance": _disturbance,
    "stiffness_change": _changed,
    "torque_saturation": _saturation,
}
"""By the name that files use; viscous friction and couplings are part of the chains."""
