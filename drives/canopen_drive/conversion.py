"""Controller parameters between a drive's own numbers and SI, as its profile says.

physical = scale * raw ** power * product of quantities and of parameters before it

A drive whose position loop is one PID is described by cascade gains all the same::

    torque = velocity_p (position_p e + e') + velocity_i integral(position_p e + e')
    pid_p = velocity_p position_p + velocity_i,  pid_i = velocity_i position_p,  pid_d = velocity_p

which is the cascade with the whole reference velocity fed forward, because D acts on the error.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from math import isfinite, prod, sqrt

from drives.errors import NotSupportedError
from drives.objects import ObjectInfo
from drives.profile import DriveProfile, ParameterInfo
from drives.profile.drive import CASCADE_PARAMETERS, PID_PARAMETERS

Raw = int | float | str


@dataclass(frozen=True)
class Conversion:
    """How one drive's parameters become physical, with its own quantities read."""

    axis: str
    profile: DriveProfile
    quantities: Mapping[str, float]
    """By name, SI."""
    unmet: Mapping[str, str] = field(default_factory=dict)
    """Parameters whose unit is not the profile's in this drive: why, in words."""

    def physical(self, name: str, raw: Raw, others: Mapping[str, float]) -> float:
        """Return a parameter's physical value.

        Parameters
        ----------
        name
            Of the parameter.
        raw
            What the drive holds.
        others
            Physical values of the parameters before it.

        Raises
        ------
        NotSupportedError
            If its unit, or what it depends on, is not known or zero.
        """
        parameter = self.profile.parameters[name]
        value = float(raw)
        if parameter.power < 0:
            if value == 0:
                return 0.0  # a reset time of 0 switches the part off
            value = 1 / value
        return self._factor(name, parameter, others) * value

    def raw(self, name: str, value: float, others: Mapping[str, float]) -> Raw:
        """Return what the drive holds next to a physical value; not yet checked against its type.

        Raises
        ------
        NotSupportedError
            As :meth:`physical`.
        """
        parameter = self.profile.parameters[name]
        exact = value / self._factor(name, parameter, others)
        if parameter.power < 0:
            exact = 0.0 if exact == 0 else 1 / exact
        return exact if parameter.type.startswith("REAL") else round(exact)

    def understood(self, name: str) -> bool:
        """Whether the profile knows what a parameter's unit is worth."""
        parameter = self.profile.parameters[name]
        return (
            parameter.factor != "unknown"
            and name not in self.unmet
            and all(
                other in self.quantities
                or (other in self.profile.parameters and self.understood(other))
                for other in parameter.times
            )
        )

    def _factor(self, name: str, parameter: ParameterInfo, others: Mapping[str, float]) -> float:
        try:
            scale = parameter.scale
        except NotSupportedError as error:
            raise NotSupportedError(f"{self.axis}, {name}, {error}") from None
        if name in self.unmet:
            raise NotSupportedError(f"{self.axis}, {name}: {self.unmet[name]}")
        known = {**others, **self.quantities}
        lacking = [other for other in parameter.times if other not in known]
        if lacking:
            raise NotSupportedError(
                f"{self.axis}, {name}: depends on {', '.join(lacking)}, which is not known. Write them "
                "together."
            )
        factor = scale * prod(known[other] ** power for other, power in parameter.times.items())
        if not (isfinite(factor) and factor > 0):
            zero = [other for other in parameter.times if known[other] == 0]
            raise NotSupportedError(
                f"{self.axis}, {name}, object {parameter.object}: its unit depends on "
                f"{', '.join(zero or parameter.times)}, which the drive does not hold (0). Enter the "
                "motor's data in the drive first."
            )
        return factor

    # --- cascade and PID -----------------------------------------------------------------------

    def as_held(self, wanted: Mapping[str, float]) -> dict[str, float]:
        """Return cascade gains as the parameters that this kind of drive has.

        Raises
        ------
        NotSupportedError
            If some of the cascade's gains are missing, or a share of the velocity other than 1 is to
            be fed forward by a PID.
        """
        if self.profile.structure != "pid":
            return dict(wanted)
        held = {k: v for k, v in wanted.items() if k not in (*CASCADE_PARAMETERS, "velocity_ff")}
        named = [name for name in CASCADE_PARAMETERS if name in wanted]
        if not named:
            return held
        lacking = [name for name in CASCADE_PARAMETERS if name not in wanted]
        if lacking:
            raise NotSupportedError(
                f"{self.axis}: the drive's loop is one PID, so {', '.join(CASCADE_PARAMETERS)} are "
                f"written together; {', '.join(lacking)} is missing. Nothing was written."
            )
        if wanted.get("velocity_ff", 1.0) != 1.0:
            raise NotSupportedError(
                f"{self.axis}: the drive's loop is one PID, which feeds the whole reference velocity "
                f"forward; velocity_ff = {wanted['velocity_ff']:g} can not be written. Nothing was "
                "written."
            )
        position_p, velocity_p, velocity_i = (float(wanted[name]) for name in CASCADE_PARAMETERS)
        values = (velocity_p * position_p + velocity_i, velocity_i * position_p, velocity_p)
        return {**held, **dict(zip(PID_PARAMETERS, values, strict=True))}

    def as_cascade(self, held: Mapping[str, float]) -> dict[str, float]:
        """Return a drive's parameters with the cascade's gains among them.

        Raises
        ------
        NotSupportedError
            If a PID is not one that a cascade can be.
        """
        if self.profile.structure != "pid" or any(name not in held for name in PID_PARAMETERS):
            return dict(held)
        p, i, d = (held[name] for name in PID_PARAMETERS)
        # velocity_p position_p and velocity_i have the sum p and the product i d
        root = p * p - 4 * i * d
        if root < 0 or d <= 0:
            raise NotSupportedError(
                f"{self.axis}: the drive's PID (P {p:.4g}, I {i:.4g}, D {d:.4g}) is none that position "
                "P and velocity PI could be, so what it does is not predicted. Give it D above 0, and I "
                f"of at most P^2 / 4 D{f' = {p * p / (4 * d):.4g}' if d > 0 else ''}."
            )
        larger = (p + sqrt(root)) / 2
        values = (larger / d, d, p - larger)
        return {**held, **dict(zip(CASCADE_PARAMETERS, values, strict=True)), "velocity_ff": 1.0}


def quantity_objects(profile: DriveProfile) -> Iterator[tuple[str, ObjectInfo, float]]:
    """Yield name, object and scale of every quantity that a parameter's unit depends on.

    Those of unknown scale are left out.
    """
    needed = {other for one in profile.parameters.values() for other in one.times}
    for name, quantity in profile.quantities.items():
        if name in needed and not isinstance(quantity.scale, str):
            yield name, ObjectInfo(quantity.object, quantity.type, name), quantity.scale


def unmet_conditions(
    profile: DriveProfile, value_of: Callable[[ObjectInfo], int | None]
) -> dict[str, str]:
    """Return the parameters whose unit is not the profile's in this drive: why, in words.

    Parameters
    ----------
    profile
        Of the drive.
    value_of
        Returns what the drive holds of an object; None where it has no such object.
    """
    out = {}
    for name, parameter in profile.parameters.items():
        condition = parameter.only_if
        if condition is None:
            continue
        found = value_of(ObjectInfo(condition.object, condition.type, "condition"))
        if found == condition.equals or (found is None and condition.missing_is_fine):
            continue
        out[name] = (
            f"its unit is known only while object {condition.object} is {condition.equals} "
            f"(0x{condition.equals:X}); the drive has {'none' if found is None else found}. Set it, "
            "or enter the gain with the maker's software."
        )
    return out
