"""Effects and shares in words."""

from collections.abc import Sequence
from math import isfinite

from fieldtool.criticise.criticism import Cause, Number

WORDS = {
    "viscous_friction": "viscous friction",
    "coulomb_friction": "dry friction",
    "stribeck_friction": "friction that is larger at low speed (Stribeck)",
    "asymmetric_friction": "friction that differs between the directions",
    "backlash": "backlash (play)",
    "hardening_spring": "a spring that hardens",
    "softening_spring": "a spring that softens",
    "structural_damping": "damping inside the material",
    "gravity": "gravity (an unbalanced weight)",
    "cogging": "cogging (torque that waves with the position)",
    "torque_scale": "a wrong scale of the torque",
    "torque_lag": "a torque that lags",
    "measurement_delay": "a position that is measured late",
    "encoder_error": "an error of the encoder",
    "extra_mode": "a further mass on a spring",
    "coupling_spring": "a spring between two axes",
    "coupling_inertia": "an inertia coupling between two axes",
    "periodic_disturbance": "a disturbance of one frequency",
    "stiffness_change": "a stiffness that changed during the measurement",
    "torque_saturation": "a torque that reaches a limit",
}


AT_ONCE = "at once"
"""Of a settling time of 0: the axis is in its band when its reference ends."""


def effect_words(effect: str) -> str:
    """Return the name of an effect as people say it."""
    return WORDS.get(effect, effect.replace("_", " "))


def axis_words(axis: str | tuple[str, str]) -> str:
    """Return one axis, or both."""
    return axis if isinstance(axis, str) else " - ".join(axis)


def cause_words(cause: Cause) -> str:
    """Return a cause in words: ``dry friction of arm (load)``."""
    return f"{effect_words(cause.effect)} of {cause.axis_words} ({cause.location})"


def number_words(name: str, number: Number) -> str:
    """Return a number with its 95 % interval."""
    known = f" ± {1.96 * number.std:.2g}" if isfinite(number.std) else " (error not known)"
    unit = "" if number.unit in ("", "1") else f" {number.unit}"
    return f"{name.replace('_', ' ')} {number.value:.4g}{known}{unit}"


def listed(words: Sequence[str]) -> str:
    """Return ``a, b and c``."""
    if len(words) < 2:
        return "".join(words)
    return f"{', '.join(words[:-1])} and {words[-1]}"


def percent(share: float | None) -> str:
    """Return a share as a percentage; words where it is not known."""
    if share is None:
        return "not known"
    return f"{100 * share:.0f} %" if abs(share) >= 0.1 else f"{100 * share:.2g} %"
