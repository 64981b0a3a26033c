"""Springs that are not straight lines: a gap, a spring that hardens or softens, one that changes.

Also damping inside the material (structural damping), and a further mass on a spring.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from fieldtool.criticise.effects.base import Context, Effect, Parameter, Values
from fieldtool.criticise.simulate.structure import Element, Law, Relaxation, Structure

GAPS = (0.02, 0.2, 1.0, 4.0)
"""Start values of half the gap over the RMS of the elongation that rigid masses would ask for."""
LOSS = 0.05
"""Start value of the damper of a contact over the root of stiffness times mass."""
BRANCHES = 7
"""Maxwell branches that make damping nearly the same at all frequencies."""
FAR = (-0.3, -0.2, -0.13, -0.08, -0.05, -0.025, 0.025, 0.05, 0.1, 0.2)
"""Changes of a spring that are simulated: a resonance that moves by more than it is wide is not in any
derivative."""
FAR_BENT = (1e-4, 3e-4, 1e-3, 3e-3, 1e-2, 3e-2, 0.1)
"""The same of springs that harden or soften, over the most."""


class SpringEffect(Effect):
    """What sits in one spring of a chain; the location is ``spring 1`` to ``spring N - 1``."""

    def ends_of(self, structure: Structure) -> tuple[int, int]:
        """Degrees of freedom that the spring joins."""
        first = int(structure.motors[self.axis]) + int(self.location.split()[1]) - 1
        return first, first + 1

    def stiffness_of(self, structure: Structure) -> tuple[float, float]:
        """Stiffness and damping of the linear spring."""
        a, b = self.ends_of(structure)
        return -float(structure.stiffness[a, b]), -float(structure.damping[a, b])


class CubicSpring(SpringEffect):
    """A spring that is no straight line; ``cubic`` is its only number."""

    def far(self, instants: Sequence[float]) -> list[dict[str, float]]:
        """Return shares of the most."""
        (cubic,) = self.parameters
        return [{cubic.name: share * (cubic.low + cubic.high)} for share in FAR_BENT]


class HardeningSpring(CubicSpring):
    """Stiffer when it is stretched further."""

    name = "hardening_spring"
    equation = "tau = k s + cubic s^3, cubic > 0"
    source = "Duffing 1918; Nayfeh and Mook, Nonlinear Oscillations, 1979"
    signature = "resonances that rise with the amplitude; odd harmonics that grow with its cube"
    contrary = "even harmonics; a torque that follows the sign of the velocity"

    def structure(self, structure: Structure, values: Values) -> Structure:
        """Add the cubic part."""
        a, b = self.ends_of(structure)
        return structure.with_elements(Element(Law.CUBIC, a, b, (values["cubic"], 0.0, 0.0, 0.0)))


class SofteningSpring(CubicSpring):
    """Softer when it is stretched further, and never pushing away: a cubic alone runs away."""

    name = "softening_spring"
    equation = (
        "tau = k s / sqrt(1 - 2 cubic s^2 / k), cubic < 0: k s + cubic s^3 at small elongations"
    )
    source = "Nayfeh and Mook, Nonlinear Oscillations, 1979 (to the third order)"
    signature = "resonances that fall with the amplitude; odd harmonics that grow with its cube"
    contrary = "even harmonics; a torque that follows the sign of the velocity"

    def structure(self, structure: Structure, values: Values) -> Structure:
        """Take off what the spring lacks."""
        a, b = self.ends_of(structure)
        k, _ = self.stiffness_of(structure)
        return structure.with_elements(Element(Law.SOFT, a, b, (values["cubic"], k, 0.0, 0.0)))


class Backlash(SpringEffect):
    """A gap within which the spring does nothing."""

    name = "backlash"
    equation = (
        "tau = k p + (c + contact_damper) p' for p = abs(s) - half_gap > 0, never pulling; else 0"
    )
    source = "Nordin and Gutman, Automatica 38, 2002 (dead zone with a damped contact)"
    signature = "resonances that rise with the amplitude and fall steeply with small ones"
    contrary = "a torque while the axis moves at constant speed; growth with the amplitude"
    fits = 0.5  # contacts that bounce are sensitive to all that is small

    def structure(self, structure: Structure, values: Values) -> Structure:
        """Put the dead zone into the spring."""
        a, b = self.ends_of(structure)
        k, c = self.stiffness_of(structure)
        gap = (k, c, values["half_gap"], values["contact_damper"])
        return structure.with_elements(Element(Law.GAP, a, b, gap))

    def plain(self, values: Values) -> dict[str, tuple[float, str, tuple[str, ...]]]:
        """The whole gap, as it is usually stated."""
        unit = self.parameters[0].unit
        return {
            "half_gap": (values["half_gap"], unit, ("half_gap",)),
            "gap": (2 * values["half_gap"], unit, ("half_gap",)),
            "contact_damper": (
                values["contact_damper"],
                self.parameters[1].unit,
                ("contact_damper",),
            ),
        }


class StiffnessChange(SpringEffect):
    """A spring that is another one from some time on."""

    name = "stiffness_change"
    equation = "k (1 + change) from the time on"
    source = "a step of one parameter; Basseville and Nikiforov, Detection of Abrupt Changes, 1993"
    signature = "the model fits before and not after; all amplitudes and directions alike"
    contrary = "an error that is the same in early and late experiments"

    def structure(self, structure: Structure, values: Values) -> Structure:
        """Add what is gained from then on."""
        a, b = self.ends_of(structure)
        k, _ = self.stiffness_of(structure)
        step = (k * values["change"], values["time"], 0.0, 0.0)
        return structure.with_elements(Element(Law.STEP, a, b, step))

    def far(self, instants: Sequence[float]) -> list[dict[str, float]]:
        """Return changes at each instant."""
        return [{"change": change, "time": time} for time in instants for change in FAR]


class StructuralDamping(SpringEffect):
    """Losses inside the material, the same in each cycle however fast it is."""

    name = "structural_damping"
    equation = "k (1 + j loss_factor sign(w))"
    source = "Kimball and Lovell 1927; five Maxwell branches a decade and a half wide stand for it"
    signature = "resonances of all frequencies damped by the same loss factor; linear"
    contrary = "damping in proportion to the frequency; harmonics"
    relatives = ("viscous_friction",)

    def structure(self, structure: Structure, values: Values) -> Structure:
        """Add branches whose losses together are nearly constant over the band."""
        a, b = self.ends_of(structure)
        k, _ = self.stiffness_of(structure)
        spread = np.geomspace(values["low"], values["high"], BRANCHES)
        ratio = float(np.log(spread[1] / spread[0]))
        # Each branch loses k_i w T / (1 + (w T)^2); dense branches add up to k_i (pi / 2) / ln ratio.
        each = values["loss_factor"] * k * ratio / (np.pi / 2)
        branches = tuple(Relaxation(a, b, each, 1 / (2 * np.pi * f)) for f in spread)
        # The branches stiffen the spring above the middle; taken off, k is that at the middle.
        stiffness = structure.stiffness.copy()
        stiffness[np.ix_([a, b], [a, b])] -= BRANCHES / 2 * each * np.array([[1, -1], [-1, 1]])
        return replace(structure, stiffness=stiffness, branches=(*structure.branches, *branches))

    def plain(self, values: Values) -> dict[str, tuple[float, str, tuple[str, ...]]]:
        """Return the loss factor; the band is no property of the machine."""
        return {"loss_factor": (values["loss_factor"], "1", ("loss_factor",))}


class ExtraMode(Effect):
    """A further mass on a spring, at the motor or at the last mass, that the chain does not have."""

    name = "extra_mode"
    exact = True
    equation = "m q'' + c (q' - x') + k (q - x) = 0, k = m (2 pi frequency)^2"
    source = "Ormondroyd and Den Hartog 1928 (vibration absorber)"
    signature = "an antiresonance and a resonance close together at one frequency; linear"
    contrary = "harmonics; dependence on amplitude, direction or position"

    def structure(self, structure: Structure, values: Values) -> Structure:
        """Add the mass."""
        ends = structure.motors if self.location == "motor" else structure.ends
        w = 2 * np.pi * values["frequency"]
        m = values["mass"]
        damping = 2 * values["damping_ratio"] * m * w
        safe = m if abs(m) > 1e-9 else 1e-9
        return structure.with_mass(int(ends[self.axis]), safe, safe * w * w, damping)


def spring_candidates(context: Context) -> list[Effect]:
    """Return every kind of spring effect in every spring."""
    out: list[Effect] = []
    for axis, chain in enumerate(context.model.axes):
        length = context.length_unit(axis)
        per = context.per(axis, "")
        for spring in range(len(chain.springs)):
            place, k = f"spring {spring + 1}", chain.springs[spring].value
            size = context.elongations(axis, spring)
            most = 3.0 * k / size**2
            for kind, low, high in ((HardeningSpring, 0.0, most), (SofteningSpring, -most, 0.0)):
                cubic = Parameter(
                    "cubic", f"{per}3", 0.0, low, high, 0.01 * k / size**2, linear=True
                )
                out.append(kind(axis, (cubic,), place))
            hard = float(np.sqrt(k * chain.masses[spring + 1].value))
            lossy = Parameter(
                "contact_damper", context.per(axis, "s"), LOSS * hard, 1e-3 * LOSS * hard, 2 * hard,
                0.5 * LOSS * hard,
            )  # fmt: skip
            out += [
                Backlash(
                    axis,
                    (
                        Parameter("half_gap", length, g * size, 0.0, 20 * size, 0.1 * g * size),
                        lossy,
                    ),
                    place,
                )
                for g in GAPS
            ]
            begin, end = context.motions[0].clock[0], context.motions[-1].clock[-1]
            out += [
                StiffnessChange(
                    axis,
                    (
                        Parameter("change", "1", 0.0, -0.9, 5.0, 0.02, linear=True),
                        Parameter("time", "s", t, begin, end, 0.02 * (end - begin)),
                    ),
                    place,
                )
                for t in _times(context)
            ]
            low = 0.3 * max(0.3, 2.0 / max(m.rows * m.step for m in context.motions))
            high = 3.0 * context.top
            fixed = (Parameter("low", "Hz", low, low, low, 0.0),
                     Parameter("high", "Hz", high, high, high, 0.0))  # fmt: skip
            loss = Parameter("loss_factor", "1", 0.0, 0.0, 1.0, 0.01, linear=True)
            out.append(StructuralDamping(axis, (loss, *fixed), place))
    return out


def mode_candidates(context: Context) -> list[Effect]:
    """Return a further mass at motor and load of every axis; a search finds where in the band."""
    out: list[Effect] = []
    longest = max(m.rows * m.step for m in context.motions)
    low = 5.0 / longest
    for axis in range(len(context.axes)):
        inertia = context.inertia(axis)
        unit = "kg m2" if context.axes[axis].kind == "rotary" else "kg"
        if context.torque_unit(axis) == "A":
            unit = f"A s2/{context.length_unit(axis)}"
        for place in ["motor"] + (["load"] if context.masses(axis) > 1 else []):
            out.append(  # noqa: PERF401
                ExtraMode(
                    axis,
                    (
                        Parameter("mass", unit, 0.0, 0.0, inertia, 0.01 * inertia, linear=True),
                        Parameter(
                            "frequency", "Hz", low, 0.5 * low, 1.1 * context.excited, 0.02 * low
                        ),
                        Parameter("damping_ratio", "1", 0.03, 0.0005, 0.5, 0.02),
                    ),
                    place,
                )
            )
    return out


def _times(context: Context) -> list[float]:
    """Times at which something may have changed: between experiments, and within them."""
    times = [float(m.clock[0]) for m in context.motions[1:]]
    for m in context.motions:
        times += [float(m.clock[0] + s * m.rows * m.step) for s in (0.25, 0.5, 0.75)]
    return sorted(times)
