"""What stands behind a simulated machine: the truth that the tool itself never looks at."""

from typing import Annotated

from pydantic import Field, model_validator

from drives.profile.chain import ChainProfile, CouplingProfile
from drives.profile.effects import EffectProfile, MachineEffectProfile
from drives.profile.values import LocatedError, NotNegative, Number, Part, Positive


class FaceProfile(Part):
    """A kind of drive to simulate, by its files; their paths start from the machine profile's folder."""

    profile: str
    """Path of the drive profile, or name of a packaged one."""
    eds: str | None = None
    """Path of the EDS or DCF file; else the drive profile's."""


class SimulatedAxisProfile(Part):
    """The truth about one axis of a simulated machine, SI."""

    masses: Annotated[tuple[Positive, ...], Field(min_length=1, max_length=16)]
    springs: tuple[Positive, ...] = ()
    dampers: tuple[NotNegative, ...] = ()
    viscous_friction: NotNegative = 0.0
    effects: tuple[Annotated[EffectProfile, Field(discriminator="effect")], ...] = ()
    """What else acts, with the names of ``model.yaml``."""
    rated_torque: Positive
    peak_torque: Positive
    torque_noise: NotNegative = 0.0
    torque_constant: Positive = 0.1
    """N m/A (or N/A) of the motor, for drives that know currents."""
    face: FaceProfile | str | None = None
    """Kind of drive that is simulated, by its packaged name or by its files; else that of the axis'
    drive profile, or the reference drive."""
    encoder_counts_per_rev: Annotated[int, Field(ge=16, le=2**30)] = 2**20
    gains: dict[str, Number] = Field(default_factory=dict)
    """Start values of the drive's parameters by name, physical units."""

    @model_validator(mode="after")
    def _chain(self) -> "SimulatedAxisProfile":
        ChainProfile(masses=self.masses, springs=self.springs, dampers=self.dampers)
        for k, part in enumerate(self.effects):
            joint = getattr(part, "joint", 1)
            if hasattr(part, "joint") and joint > len(self.springs):
                raise LocatedError(
                    ("effects", k),
                    f"joint {joint} does not exist: this axis has {len(self.springs)} springs",
                )
        return self


class SimulationProfile(Part):
    """What stands behind ``interface: fieldsim``; the tool itself never looks at it."""

    axes: tuple[SimulatedAxisProfile, ...]
    couplings: tuple[CouplingProfile, ...] = ()
    effects: tuple[Annotated[MachineEffectProfile, Field(discriminator="effect")], ...] = ()
    """What else joins axes."""
    seed: Annotated[int, Field(ge=0)] = 0
