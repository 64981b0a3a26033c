"""What a simulated machine has beyond chains of masses and springs, with the names of ``model.yaml``.

Where a number is the same as in ``model.yaml`` and ``criticism.yaml`` it has their name; the plant's own
name, by which Python knows it, is read as well.

Numbers are SI: N m, rad, kg m2 on a rotary axis; N, m, kg on a linear one.  ``location`` is the chain's
first (motor) or last (load) mass, ``joint`` the number of a spring from the motor, from 1.
"""

from typing import Annotated, Any, Literal

from pydantic import AliasChoices, Field, model_validator

from drives.profile.values import Name, NotNegative, Number, Part, Positive

Location = Literal["motor", "load"]


def _told(name: str, own: str) -> Any:
    """A key that is told by the name of ``model.yaml``, and read by the plant's own name, too."""
    return Field(validation_alias=AliasChoices(name, own))


Joint = Annotated[int, Field(ge=1, le=16, strict=True)]


class CoulombFrictionProfile(Part):
    """Dry friction between a mass and ground."""

    effect: Literal["coulomb_friction"]
    location: Location = "motor"
    torque: NotNegative
    """The same at standstill as while sliding."""


class StribeckFrictionProfile(Part):
    """Dry friction that is larger at low speed."""

    effect: Literal["stribeck_friction"]
    location: Location = "motor"
    torque: Positive
    """At high speed."""
    breakaway: Positive
    """At standstill, at least ``torque``."""
    velocity: Positive
    """At which the surplus has fallen to 1/e."""

    @model_validator(mode="after")
    def _larger(self) -> "StribeckFrictionProfile":
        if self.breakaway < self.torque:
            raise ValueError(
                f"breakaway {self.breakaway} must be at least the sliding torque {self.torque}"
            )
        return self


class AsymmetricFrictionProfile(Part):
    """Dry friction that differs between directions."""

    effect: Literal["asymmetric_friction"]
    location: Location = "motor"
    forward: Positive = _told("coulomb_positive", "forward")
    backward: Positive = _told("coulomb_negative", "backward")


class BacklashProfile(Part):
    """Free play in a joint."""

    effect: Literal["backlash"]
    joint: Joint = 1
    play: Positive = _told("gap", "play")
    """From contact to contact."""
    restitution: Annotated[Number, Field(ge=0.1, le=1)] = 0.6


class HardeningSpringProfile(Part):
    """A joint that stiffens as it is twisted."""

    effect: Literal["hardening_spring"]
    joint: Joint = 1
    stretch: Positive
    """Twist at which the joint is 1.54 times as stiff."""


class SofteningSpringProfile(Part):
    """A joint that yields as it is twisted."""

    effect: Literal["softening_spring"]
    joint: Joint = 1
    stretch: Positive
    """The torque never exceeds the spring times this twist."""


class StructuralDampingProfile(Part):
    """Losses in a joint that hardly depend on the frequency."""

    effect: Literal["structural_damping"]
    joint: Joint = 1
    loss_factor: Annotated[Number, Field(gt=0, le=0.5)]


class StiffnessChangeProfile(Part):
    """A joint whose spring changes at some time."""

    effect: Literal["stiffness_change"]
    joint: Joint = 1
    factor: Positive
    """After over before."""
    time: NotNegative
    """Seconds since the machine was switched on."""
    duration: Positive = 0.05
    """Seconds."""


class GravityProfile(Part):
    """A weight; the axis then has a brake, closed while its power stage is off."""

    effect: Literal["gravity"]
    location: Location = "load"
    torque: Number
    """With the arm horizontal; on a linear axis the weight, which pulls towards negative positions."""
    angle: Number = 0.0
    """Of the arm from hanging down at position 0, rad; not used on a linear axis."""


class CoggingProfile(Part):
    """Torque of the motor's magnets."""

    effect: Literal["cogging"]
    torque: Positive = _told("amplitude", "torque")
    """Amplitude of the first harmonic."""
    periods: Positive
    """A revolution, or a metre."""
    phase: Number = 0.0
    """rad at position 0."""
    sharpness: Annotated[Number, Field(ge=0, le=3)] = 0.3
    """0 is a sine."""


class PeriodicDisturbanceProfile(Part):
    """A force that goes round by itself."""

    effect: Literal["periodic_disturbance"]
    location: Location = "load"
    torque: Positive
    """Amplitude."""
    frequency: Positive
    """Hz."""
    phase: Number = 0.0
    """rad at time 0."""


class ExtraModeProfile(Part):
    """A mass on a spring that hangs on a mass of the chain."""

    effect: Literal["extra_mode"]
    location: Location = "load"
    inertia: Positive = _told("mass", "inertia")
    frequency: Positive
    """Of the mass with the other end held, Hz."""
    damping: NotNegative = Field(0.02, validation_alias=AliasChoices("damping_ratio", "damping"))
    """Damping ratio."""


class TorqueScaleProfile(Part):
    """The motor gives this many times the torque that the drive reports."""

    effect: Literal["torque_scale"]
    factor: Positive = _told("scale", "factor")


class TorqueSaturationProfile(Part):
    """The motor never gives more than this, whatever the drive reports."""

    effect: Literal["torque_saturation"]
    torque: Positive = _told("limit", "torque")


class TorqueLagProfile(Part):
    """The motor's torque lags the reported one."""

    effect: Literal["torque_lag"]
    time: Annotated[Number, Field(gt=0, le=10)]
    """Time constant, seconds."""


class MeasurementDelayProfile(Part):
    """The position that the host gets is older than the torque."""

    effect: Literal["measurement_delay"]
    time: Annotated[Number, Field(ge=0, le=0.1)] = _told("delay", "time")
    """Seconds; whole steps of 1/8000 s."""


class EncoderErrorProfile(Part):
    """A periodic error of the encoder."""

    effect: Literal["encoder_error"]
    amplitude: Positive
    periods: Positive
    """A revolution, or a metre."""
    phase: Number = 0.0
    """rad."""

    @model_validator(mode="after")
    def _small(self) -> "EncoderErrorProfile":
        if self.amplitude * self.periods > 1.0:
            raise ValueError(
                f"amplitude {self.amplitude} must be at most 1/periods = {1 / self.periods:.4g}"
            )
        return self


class CouplingSpringProfile(Part):
    """A spring and damper between masses of two axes."""

    effect: Literal["coupling_spring"]
    axes: tuple[Name, Name]
    location: Location = "load"
    spring: Positive = _told("stiffness", "spring")
    damper: NotNegative = 0.0


class CouplingInertiaProfile(Part):
    """An inertia coupling between masses of two axes; ``couplings`` has those of the last masses."""

    effect: Literal["coupling_inertia"]
    axes: tuple[Name, Name]
    location: Location = "motor"
    inertia: Number


EffectProfile = (
    CoulombFrictionProfile
    | StribeckFrictionProfile
    | AsymmetricFrictionProfile
    | BacklashProfile
    | HardeningSpringProfile
    | SofteningSpringProfile
    | StructuralDampingProfile
    | StiffnessChangeProfile
    | GravityProfile
    | CoggingProfile
    | PeriodicDisturbanceProfile
    | ExtraModeProfile
    | TorqueScaleProfile
    | TorqueSaturationProfile
    | TorqueLagProfile
    | MeasurementDelayProfile
    | EncoderErrorProfile
)
"""One part of a simulated axis, told apart by ``effect``."""

MachineEffectProfile = CouplingSpringProfile | CouplingInertiaProfile
"""One part between two simulated axes, told apart by ``effect``."""
