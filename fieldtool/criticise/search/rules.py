"""When an effect may be given a name: the rules, and the words for why one was rejected."""

from dataclasses import dataclass

from fieldtool.criticise.effects.base import Context, Effect
from fieldtool.criticise.search.fit import Fitted
from fieldtool.criticise.search.significance import Comparison

CHANCE = 1e-3
"""Largest probability of the gain by chance; dozens of candidates are tried."""
MOST, CHANCE_OF_MOST = 0.7, 0.02
"""Who explains so much of what is left may be less sure: where sines are stepped, the error changes so
slowly that few values of it are independent, and none of many candidates explains most by chance."""
LEAST_SHARE = 0.04
"""Of what is not explained yet (power, noise taken off): what one cause explains at least."""
LEAST_SHARE_KNOWN = 0.15
"""The same where the noise is known from repeated periods."""
LEAST_TORQUE = 1e-3
"""RMS of what a cause explains over that of the torque, below which it does not matter."""
LEAST_TORQUE_UNSURE = 5e-3
"""The same where the noise is not known: what is so small may be of anything."""
BEYOND_NOISE = 1.5
"""Power of an axis' error over the noise, from which there is something to explain."""
LEAST_SHARE_MORE = 0.4
"""The same for a further cause on an axis that has one: the form of the first may be wrong."""
RELATED = 0.1
"""A further effect of a family explains at least this of what the first one explained (RMS)."""
KNOWN_WELL = 0.33
"""Largest relative standard error of the number that says how strong a cause is."""
ALIKE_T = 2.0
"""Rivals whose difference on unseen data is below this many standard errors are a tie."""
ALIKE_SHARE = 0.025
"""Of what is explained: forms of effects are not so sure that less would tell rivals apart."""
ALIKE_LEFT = 0.5
"""Of what the better of two rivals leaves: who leaves so much more is no rival, however little it is."""
BESIDE_NOISE, LEFT = 2.25, 5e-3
"""Power over that of noise, and RMS beyond it over that of the torque, from which something is left."""
ALIKE_LEFT_SURE = 0.05
"""As :data:`ALIKE_LEFT`, where both forms are exact and no more than noise is left."""
STAYED, LESS_MOVED = 1e-3, 4.0
"""Sum of squares of the machine's relative changes that says nothing; ratio of two that does."""
FAMILIES = (
    frozenset({"viscous_friction", "coulomb_friction", "stribeck_friction", "asymmetric_friction"}),
    frozenset({"backlash", "hardening_spring", "softening_spring", "structural_damping",
               "stiffness_change"}),
    frozenset({"measurement_delay", "torque_lag"}),
    frozenset({"cogging", "encoder_error", "gravity"}),
)  # fmt: skip
FREE_OF_BOUNDS = ("presliding", "rounding", "frequency", "time", "contact_damper")
"""Numbers whose bounds are where the search begins, not what is physical."""
STRENGTH = {
    "viscous_friction": ("coefficient",),
    "coulomb_friction": ("torque",),
    "stribeck_friction": ("extra",),
    "asymmetric_friction": ("coulomb_positive", "coulomb_negative", "viscous_positive",
                            "viscous_negative"),
    "backlash": ("half_gap",),
    "hardening_spring": ("cubic",),
    "softening_spring": ("cubic",),
    "structural_damping": ("loss_factor",),
    "gravity": ("sine", "cosine"),
    "cogging": ("sine", "cosine"),
    "torque_scale": ("scale",),
    "torque_lag": ("time",),
    "measurement_delay": ("delay",),
    "encoder_error": ("sine", "cosine"),
    "extra_mode": ("mass",),
    "coupling_spring": ("stiffness",),
    "coupling_inertia": ("inertia",),
    "periodic_disturbance": (),
    "stiffness_change": ("change",),
    "torque_saturation": ("limit",),
}  # fmt: skip
"""The numbers of which at least one has to be known well."""


CONTRASTS = {
    "asymmetric_friction": (
        ("coulomb_positive", "coulomb_negative"), ("viscous_positive", "viscous_negative"),
    ),
}  # fmt: skip
"""Pairs of numbers of which at least one has to differ for sure."""


def related(one: str, other: str) -> bool:
    """Whether two effects are of one family, so that the form of one may look like the other."""
    return one == other or any({one, other} <= family for family in FAMILIES)


def tolerance(gain: Comparison, sure: bool = False) -> float:
    """Return by how much more a rival may leave than a cause of this gain, and be as good.

    ``sure``: the forms of both are exact, and what the better one leaves is noise.
    """
    explained = max(gain.before - gain.after, 0.0)
    return min(ALIKE_SHARE * explained, (ALIKE_LEFT_SURE if sure else ALIKE_LEFT) * gain.after)


NO_MORE = "explains no more of the unseen data than chance would"
"""Why most candidates get no name."""


@dataclass(frozen=True)
class Tried:
    """One candidate, fitted, and what it does on unseen data."""

    fitted: Fitted
    effect: Effect
    gain: Comparison
    share: float
    """Of the explainable power that was left before."""
    torque: float
    """RMS of what it explains over that of the axis' torque."""
    beyond: float
    """Power of the axis' error before, over that of the noise; infinite where it is not known."""

    at_noise: bool = False
    """Whether what is left on unseen data is known to be no more than noise."""

    def surely(self, other: "Tried") -> bool:
        """Whether small differences between two count: exact forms, and nothing else that is left."""
        return self.effect.exact and other.effect.exact and self.at_noise

    @property
    def place(self) -> int:
        """Index of the effect in the hypothesis."""
        return self.fitted.hypothesis.place_of(self.effect)


def why_not(tried: Tried, context: Context, known_noise: bool, level: float, further: bool) -> str:
    """Return why a candidate gets no name, in words; empty if it may have one.

    Parameters
    ----------
    tried : Tried
    context : Context
    known_noise : bool
        Whether the noise is known from repeated periods.
    level : float
        RMS over that of the torque of what related effects explain already.
    further : bool
        Whether the axis has a cause already.
    """
    if tried.gain.p > (CHANCE_OF_MOST if tried.share >= MOST else CHANCE):
        return NO_MORE
    if tried.beyond < BEYOND_NOISE and tried.effect.name != "periodic_disturbance":
        return "there is nothing beyond the noise that it could explain"
    least = LEAST_SHARE
    if known_noise:
        least = LEAST_SHARE_MORE if further else LEAST_SHARE_KNOWN
    if tried.share < least:
        return f"explains only {100 * tried.share:.1f} % of what is left on unseen data"
    if tried.torque < (LEAST_TORQUE if known_noise else LEAST_TORQUE_UNSURE):
        return f"explains {100 * tried.torque:.2g} % of the torque, which does not matter"
    if tried.torque < RELATED * level:
        return "explains no more than what the form of a related effect leaves"
    return _unphysical(tried, context)


def _unphysical(tried: Tried, context: Context) -> str:
    effect, values = tried.effect, tried.fitted.hypothesis.values[tried.place]
    numbers = tried.fitted.of_effect(tried.place)
    for p in effect.parameters:
        free = p.name in FREE_OF_BOUNDS and effect.name not in ("extra_mode", "torque_saturation")
        if p.scale <= 0.0 or free:
            continue
        close = 1e-6 * max(abs(p.high - p.low), 1e-300)
        at_zero = p.low == 0.0 and values[p.name] <= close
        if values[p.name] >= p.high - close or (values[p.name] <= p.low + close and not at_zero):
            number = f"{values[p.name]:.3g} {p.unit}"
            return f"its {p.name} would be at the edge of what is physical ({number})"
    strong = [n for n in STRENGTH[effect.name] if n in numbers]
    if strong:
        reference = 1.0 if effect.name == "torque_scale" else 0.0
        errors = [numbers[n][1] / max(abs(numbers[n][0] - reference), 1e-300) for n in strong]
        if not min(errors) <= KNOWN_WELL:
            return f"its {strong[0]} can not be told from none"
    alike = [
        (values[a] - values[b], tried.fitted.error_of(tried.place, {a: 1.0, b: -1.0}))
        for a, b in CONTRASTS.get(effect.name, ())
    ]
    if alike and all(error > KNOWN_WELL * abs(apart) for apart, error in alike):
        return "its directions can not be told from one another"
    return effect.implausible(values, context)
