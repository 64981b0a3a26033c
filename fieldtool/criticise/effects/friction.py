"""Friction between a mass and ground: viscous, dry, Stribeck, and with a direction.

Dry friction at the motor builds up over the presliding distance after each turn (Dahl's model).  Its
limit is reached within the rounding velocity, limit tanh(abs(v) / rounding), for lubricated contacts do
not jump.  In rows in which the axis may stand still nothing is compared: there friction is not known.
"""

from dataclasses import replace

import numpy as np

from fieldtool.criticise.effects.base import (
    Context,
    Effect,
    FloatArray,
    Mark,
    Parameter,
    Values,
)
from fieldtool.criticise.simulate.kernels import slider
from fieldtool.criticise.simulate.motion import Motion
from fieldtool.criticise.simulate.structure import Element, Law, Structure

TURNS = ((1e-5, 1e-3), (1e-5, 0.03), (1e-3, 1e-3), (1e-2, 1e-3))
"""Start values: presliding distance over the travel, rounding velocity over the fastest."""
OF_ITS_OWN = 0.1
"""Of friction, that has to fall with the speed or differ between the directions to be called so."""
FALLS_AT = 0.15
"""Share of the fastest velocity within which dry friction that is no Coulomb friction falls."""
SLOWEST = (0.05, 0.15, 0.4)
"""Shares of the fastest velocity, as start values of the Stribeck velocity."""


class ViscousFriction(Effect):
    """A torque in proportion to the velocity of the first or last mass."""

    name = "viscous_friction"
    exact = True
    equation = "tau = coefficient v"
    source = "Newton's law of viscosity; Armstrong-Helouvry et al., Automatica 30, 1994"
    signature = "torque in phase with the velocity, linear, at all speeds"
    contrary = "odd harmonics of a sine; a step where the velocity changes its sign"
    shows = ("speed",)
    relatives = ("structural_damping",)

    def structure(self, structure: Structure, values: Values) -> Structure:
        """Add to the damping of the mass."""
        damping = structure.damping.copy()
        ends = structure.motors if self.location == "motor" else structure.ends
        damping[ends[self.axis], ends[self.axis]] += values["coefficient"]
        return replace(structure, damping=damping)

    def marks(self, values: Values, context: Context) -> tuple[Mark, ...]:
        """A loss against ground: at the motor there must be none below zero to make up for it.

        Friction at the load less the same at the motor is a loss in the springs.
        """
        known = abs(context.model.axes[self.axis].viscous_friction.value)
        if self.location == "motor" or not known:
            return ()
        words = "a friction of the motor that is not below zero beside it"
        return (Mark("structural_damping", words, "viscous_friction", -known, special=True),)


class CoulombFriction(Effect):
    """A constant torque against the motion."""

    name = "coulomb_friction"
    equation = "tau = torque sign(v); at rest up to torque"
    source = "Coulomb 1785; presliding: Dahl, AIAA Journal 14, 1976"
    signature = "torque that follows the sign of the velocity and not its size; odd harmonics"
    contrary = "even harmonics; growth with the amplitude"
    shows = ("direction",)

    def torque(self, motion: Motion, values: Values) -> FloatArray | None:
        """At the motor."""
        if self.location != "motor":
            return None
        limit = values["torque"] * _rounded(motion, self.axis, values)
        position = np.ascontiguousarray(motion.smooth_position[:, self.axis])
        return np.asarray(slider(position, limit, limit, values["presliding"]))

    def structure(self, structure: Structure, values: Values) -> Structure:
        """At the last mass, rounded around standstill."""
        if self.location == "motor":
            return structure
        dry = (values["torque"], values["rounding"], 0.0, 0.0)
        return structure.with_elements(Element(Law.DRY, int(structure.ends[self.axis]), -1, dry))

    def marks(self, values: Values, context: Context) -> tuple[Mark, ...]:
        """The same torque in both directions, and at all speeds."""
        if self.location != "motor":
            return ()
        whole = 2.0 * OF_ITS_OWN * values["torque"]
        return (
            Mark(
                "asymmetric_friction",
                "the same torque in both directions",
                "offset",
                0.5 * whole,
                special=True,
                either_sign=True,
                or_else="a false zero of the torque's measurement",
            ),
            Mark(
                "stribeck_friction",
                "the same torque at all speeds",
                "extra",
                whole,
                FallingFriction.beside(self, values, context),
                special=True,
            ),
        )


class FallingFriction(Effect):
    """What dry friction has more of at low speed than at high speed, whatever its law.

    It has no name of its own.
    """

    name = "falling_friction"
    equation = "tau = extra exp(-abs(v) / velocity) sign(v)"
    source = "Tustin 1947; Armstrong-Helouvry et al., Automatica 30, 1994"
    signature = "follows the sign of the velocity at low speed only"
    contrary = "a torque at high speed"

    def torque(self, motion: Motion, values: Values) -> FloatArray | None:
        """At the motor."""
        speed = np.abs(motion.smooth_velocity[:, self.axis]) / values["velocity"]
        limit = np.exp(-speed) * _rounded(motion, self.axis, values)
        position = np.ascontiguousarray(motion.smooth_position[:, self.axis])
        return np.asarray(values["extra"] * slider(position, limit, limit, values["presliding"]))

    @classmethod
    def beside(cls, dry: Effect, values: Values, context: Context) -> "FallingFriction":
        """Return none at all of it, to be fitted beside dry friction."""
        size, torque = context.torque_size(dry.axis), context.torque_unit(dry.axis)
        velocity = FALLS_AT * context.fastest(dry.axis)
        length, speed = context.length_unit(dry.axis), _speed_unit(context, dry.axis)
        fixed = [("velocity", speed, velocity), ("presliding", length, values["presliding"]),
                 ("rounding", speed, values["rounding"])]  # fmt: skip
        extra = Parameter("extra", torque, 0.0, -10 * size, 10 * size, 0.1 * size, linear=True)
        return cls(dry.axis, (extra, *(Parameter(n, u, v, v, v, 0.0) for n, u, v in fixed)))


class StribeckFriction(Effect):
    """Dry friction that falls from breakaway to sliding as the axis gets faster."""

    name = "stribeck_friction"
    equation = "tau = (torque + (breakaway - torque) exp(-(v / velocity)^2)) sign(v)"
    source = "Stribeck 1902; Bo and Pavelescu, Wear 82, 1982 (exponent 2)"
    signature = "follows the sign of the velocity, and is larger at low speed than at high speed"
    contrary = "a torque that is the same at all speeds; even harmonics"
    shows = ("speed", "direction")

    def torque(self, motion: Motion, values: Values) -> FloatArray | None:
        """At the motor; the parameter ``extra`` is breakaway less sliding friction."""
        speed = motion.smooth_velocity[:, self.axis] / values["velocity"]
        limit = values["torque"] + values["extra"] * np.exp(-(speed**2))
        limit = limit * _rounded(motion, self.axis, values)
        position = np.ascontiguousarray(motion.smooth_position[:, self.axis])
        return np.asarray(slider(position, limit, limit, values["presliding"]))

    def implausible(self, values: Values, context: Context) -> str:
        """Refuse what is the same at all speeds: then it is dry friction, whatever its form."""
        if values["extra"] < OF_ITS_OWN * values["torque"]:
            return "it would be nearly the same at all speeds"
        return ""

    def plain(self, values: Values) -> dict[str, tuple[float, str, tuple[str, ...]]]:
        """Breakaway as a whole, as it is usually stated."""
        out = super().plain(values)
        unit = out.pop("extra")[1]
        out["breakaway"] = (values["torque"] + values["extra"], unit, ("torque", "extra"))
        return out


class AsymmetricFriction(Effect):
    """Dry and viscous friction that differ between the directions of motion."""

    name = "asymmetric_friction"
    equation = "tau = coulomb+ + viscous+ v for v > 0, -coulomb- + viscous- v for v < 0"
    source = "Janot, Gautier, Brunot, EMPS reference models, 2019"
    signature = "follows the sign of the velocity, with another size in either direction"
    contrary = "the same torque in both directions"
    shows = ("direction", "speed")

    def torque(self, motion: Motion, values: Values) -> FloatArray | None:
        """At the motor."""
        velocity = motion.smooth_velocity[:, self.axis]
        rounded = _rounded(motion, self.axis, values)
        position = np.ascontiguousarray(motion.smooth_position[:, self.axis])
        dry = slider(
            position,
            values["coulomb_positive"] * rounded,
            values["coulomb_negative"] * rounded,
            values["presliding"],
        )
        moving = motion.velocity[:, self.axis]
        wet = np.where(velocity > 0, values["viscous_positive"], values["viscous_negative"])
        return np.asarray(dry + wet * moving, dtype=np.float64)

    def implausible(self, values: Values, context: Context) -> str:
        """Refuse what is the same in both directions: then it is dry friction."""
        forward, backward = (
            values[f"coulomb_{way}"] + values[f"viscous_{way}"] * speed
            for way in ("positive", "negative")
            for speed in (context.fastest(self.axis),)
        )
        dry = values["coulomb_positive"], values["coulomb_negative"]
        apart = max(abs(dry[0] - dry[1]) / max(*dry, 1e-300),
                    abs(forward - backward) / max(abs(forward), abs(backward), 1e-300))  # fmt: skip
        return "it would be nearly the same in both directions" if apart < OF_ITS_OWN else ""


def friction_candidates(context: Context) -> list[Effect]:
    """Return every kind of friction on every axis, with start values from travel and speed."""
    out: list[Effect] = []
    for axis in range(len(context.axes)):
        torque, size = context.torque_unit(axis), context.torque_size(axis)
        fastest, travel = context.fastest(axis), context.travel(axis)
        if fastest <= 0.0 or travel <= 0.0:
            continue
        wet = context.per(axis, "s")

        def dry(name: str, size: float = size, unit: str = torque) -> Parameter:
            return Parameter(name, unit, 0.0, 0.0, 10.0 * size, 0.1 * size, linear=True)

        def viscous(
            name: str, fast: float = fastest, size: float = size, unit: str = wet
        ) -> Parameter:
            most = 10.0 * size / fast
            return Parameter(name, unit, 0.0, -most, most, 0.1 * size / fast, linear=True)

        places = ["motor"] + (["load"] if context.masses(axis) > 1 else [])
        for place in places:
            variable = "viscous_friction" if place == "motor" else "load_friction"
            if f"{context.axes[axis].name}.{variable}" not in context.variable:
                out.append(ViscousFriction(axis, (viscous("coefficient"),), place))
        for share, slow_share in TURNS:
            reach = Parameter(
                "presliding", context.length_unit(axis), share * travel, 1e-6 * travel, 0.05 * travel,
                0.3 * share * travel,
            )  # fmt: skip
            turn = Parameter(
                "rounding", _speed_unit(context, axis), slow_share * fastest, 1e-4 * fastest,
                0.1 * fastest, 0.3 * slow_share * fastest,
            )  # fmt: skip
            out.append(CoulombFriction(axis, (dry("torque"), reach, turn)))
            # A constant torque beside it would be the same but for the rows about each turn.
            both = ("coulomb_friction", "viscous_friction", "offset")
            out.append(
                AsymmetricFriction(
                    axis,
                    (
                        dry("coulomb_positive"),
                        dry("coulomb_negative"),
                        viscous("viscous_positive"),
                        viscous("viscous_negative"),
                        reach,
                        turn,
                    ),
                    replaces=both,
                )
            )
            out.extend(
                StribeckFriction(
                    axis,
                    (
                        dry("torque"),
                        dry("extra"),
                        Parameter(
                            "velocity",
                            _speed_unit(context, axis),
                            slow * fastest,
                            0.005 * fastest,
                            0.7 * fastest,
                            0.3 * slow * fastest,
                        ),
                        reach,
                        turn,
                    ),
                    replaces=("coulomb_friction",),
                )
                for slow in SLOWEST
            )
        if context.masses(axis) > 1:
            rounding = Parameter(
                "rounding", _speed_unit(context, axis), 0.02 * fastest, 0.002 * fastest,
                0.2 * fastest, 0.01 * fastest,
            )  # fmt: skip
            out.append(CoulombFriction(axis, (dry("torque"), rounding), "load"))
    return out


def _speed_unit(context: Context, axis: int) -> str:
    return f"{context.length_unit(axis)}/s"


def _rounded(motion: Motion, axis: int, values: Values) -> FloatArray:
    speed = np.abs(motion.smooth_velocity[:, axis])
    return np.asarray(np.tanh(speed / values["rounding"]), dtype=np.float64)
