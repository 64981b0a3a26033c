"""Joints that are no plain springs: a gap, a bend, hysteresis, a change in the middle.

The matrices of the plant hold every joint as a linear spring and damper.  A part here is what the real
joint pulls beyond that.  d is the twist of the joint (its outer mass minus its inner one), k its spring.
"""

from dataclasses import dataclass
from math import log, log1p, pi

import numpy as np
from scipy.optimize import brentq

from drives.sim.effects.shapes import Element, ElementKind, Site, check_number

_BRANCHES_PER_DECADE = 2


def _masses(effect: str, joint: int, site: Site) -> tuple[int, int]:
    if not 1 <= joint <= len(site.springs):
        raise ValueError(
            f"{effect}: joint {joint} does not exist; the chain has {len(site.springs)}, count from 1"
        )
    return site.first + joint - 1, site.first + joint


@dataclass(frozen=True)
class Backlash:
    """Free play with elastic contact that loses energy; model name backlash.

    Within the play nothing is transmitted.  In contact, with half the play g and the penetration
    p = abs(d) - g, f = k p (1 + u p' / v g / (g + p)) + c p', never pulling; v is the largest p' of this
    contact.  The loss is one of the impact: deep in contact, and without play, the joint is its spring
    and damper.  What u gives back the share e of the velocity of two free masses follows, where p stays
    well below g, from u (1 + e) = ln((1 + u) / (1 - u e)).
    Source: Gonthier, McPhee, Lange, Piedboeuf, Multibody System Dynamics 11, 2004, p. 209.

    Raises
    ------
    ValueError
        If a value is not physical, or, when built in, the joint does not exist.
    """

    play: float
    """From contact to contact, rad or m, above 0."""
    joint: int = 1
    restitution: float = 0.6
    """Velocity after a light impact over that before, 0.1 to 1."""

    def __post_init__(self) -> None:
        check_number("backlash", "play", self.play, "rad (m)", 1e-12)
        check_number("backlash", "restitution", self.restitution, "", 0.1, 1.0)

    def elements(self, site: Site) -> tuple[Element, ...]:
        """One gap."""
        first, second = _masses("backlash", self.joint, site)
        spring, damper = site.springs[self.joint - 1], site.dampers[self.joint - 1]
        values = (0.5 * self.play, spring, damper, _impact_share(self.restitution))
        return (Element(ElementKind.GAP, first, second, values),)


def _impact_share(restitution: float) -> float:
    """U of :class:`Backlash`; 0 for an elastic impact."""
    e = restitution
    if e > 0.999:
        return 1.0 - e

    def missed(u: float) -> float:
        return log1p(u) - log1p(-u * e) - u * (1.0 + e)

    return float(brentq(missed, 0.25 * (1.0 - e), (1.0 - 1e-12) / e))


@dataclass(frozen=True)
class HardeningSpring:
    """A joint that stiffens as it is twisted, f = k s sinh(d / s); model name hardening_spring.

    Valid for: harmonic drives and rubber in compression.
    """

    stretch: float
    """s, rad or m: at this twist the tangent is 1.54 times as stiff; above 0."""
    joint: int = 1

    def __post_init__(self) -> None:
        check_number("hardening spring", "stretch", self.stretch, "rad (m)", 1e-12)

    def elements(self, site: Site) -> tuple[Element, ...]:
        """One spring."""
        first, second = _masses("hardening spring", self.joint, site)
        values = (site.springs[self.joint - 1], self.stretch)
        return (Element(ElementKind.HARDENING, first, second, values),)


@dataclass(frozen=True)
class SofteningSpring:
    """A joint that yields as it is twisted, f = k s tanh(d / s); model name softening_spring.

    Valid for: belts, friction-locked joints before they slip.
    """

    stretch: float
    """s, rad or m: the torque never exceeds k s; above 0."""
    joint: int = 1

    def __post_init__(self) -> None:
        check_number("softening spring", "stretch", self.stretch, "rad (m)", 1e-12)

    def elements(self, site: Site) -> tuple[Element, ...]:
        """One spring."""
        first, second = _masses("softening spring", self.joint, site)
        values = (site.springs[self.joint - 1], self.stretch)
        return (Element(ElementKind.SOFTENING, first, second, values),)


@dataclass(frozen=True)
class StructuralDamping:
    """Losses that hardly depend on the frequency; model name structural_damping.

    A ladder of springs with dashpots in series (Maxwell elements), two a decade, whose relaxation times
    cover the band.  The joint's stiffness is k at the middle of the band (geometric mean) and rises
    slowly with the frequency, as causality asks of any material with losses.

    Valid for: loss factors up to about 0.3, within the band.
    """

    loss_factor: float
    """Of the joint, above 0: twice the damping ratio of a mode that it alone makes."""
    joint: int = 1
    band: tuple[float, float] = (0.1, 1000.0)
    """Hz."""

    def __post_init__(self) -> None:
        check_number("structural damping", "loss_factor", self.loss_factor, "", 1e-9, 0.5)
        low, high = self.band
        check_number("structural damping", "band", low, "Hz", 1e-6, high / 2)

    def elements(self, site: Site) -> tuple[Element, ...]:
        """The ladder, and the spring that takes its stiffness at the middle of the band off again."""
        first, second = _masses("structural damping", self.joint, site)
        spring = site.springs[self.joint - 1]
        low, high = self.band
        count = max(2, round(_BRANCHES_PER_DECADE * np.log10(high / low)) + 1)
        rates = 2.0 * pi * np.geomspace(low, high, count)
        ratio = log(high / low) / (count - 1)
        branch = spring * self.loss_factor * ratio * 2.0 / pi
        middle = 2.0 * pi * (low * high) ** 0.5
        stored = float(np.sum(branch * middle**2 / (rates**2 + middle**2)))
        ladder = tuple(
            Element(ElementKind.MAXWELL, first, second, (branch, 1.0 / float(rate)))
            for rate in rates
        )
        return (*ladder, Element(ElementKind.SPRING_STEP, first, second, (-stored, -1.0, 1.0)))


@dataclass(frozen=True)
class StiffnessChange:
    """A joint whose spring changes at some time, as a screw that comes loose; model name
    stiffness_change.
    """

    factor: float
    """Spring after over spring before, above 0."""
    time: float
    """When it begins, s after the machine was switched on, at least 0."""
    duration: float = 0.05
    """How long it takes, s, above 0."""
    joint: int = 1

    def __post_init__(self) -> None:
        check_number("stiffness change", "factor", self.factor, "", 1e-6)
        check_number("stiffness change", "time", self.time, "s", 0.0)
        check_number("stiffness change", "duration", self.duration, "s", 1e-6)

    def elements(self, site: Site) -> tuple[Element, ...]:
        """One spring that comes or goes."""
        first, second = _masses("stiffness change", self.joint, site)
        change = (self.factor - 1.0) * site.springs[self.joint - 1]
        return (
            Element(ElementKind.SPRING_STEP, first, second, (change, self.time, self.duration)),
        )
