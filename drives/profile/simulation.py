"""What stands behind a simulated machine: the truth that the tool itself never looks at."""

from typing import Annotated, Literal

from pydantic import Field, model_validator

from drives.profile.chain import ChainProfile, CouplingProfile
from drives.profile.values import NotNegative, Number, Part, Positive


class CoulombFrictionProfile(Part):
    """Dry friction between a chain's first (motor) or last (load) mass and ground."""

    effect: Literal["coulomb_friction"]
    location: Literal["motor", "load"] = "motor"
    torque: NotNegative
    """N m, or N on a linear axis; the same at standstill as while sliding."""


EffectProfile = CoulombFrictionProfile
"""One part of a simulated axis; a union of such classes, told apart by ``effect``."""


class SimulatedAxisProfile(Part):
    """The truth about one axis of a simulated machine, SI."""

    masses: Annotated[tuple[Positive, ...], Field(min_length=1, max_length=16)]
    springs: tuple[Positive, ...] = ()
    dampers: tuple[NotNegative, ...] = ()
    viscous_friction: NotNegative = 0.0
    effects: tuple[Annotated[EffectProfile, Field(discriminator="effect")], ...] = ()
    """What makes the axis non-linear, with the names of ``model.yaml``."""
    rated_torque: Positive
    peak_torque: Positive
    torque_noise: NotNegative = 0.0
    encoder_counts_per_rev: Annotated[int, Field(ge=16, le=2**30)] = 2**20
    gains: dict[str, Number] = Field(default_factory=dict)
    """Start values of the drive's parameters by name, physical units."""

    @model_validator(mode="after")
    def _chain(self) -> "SimulatedAxisProfile":
        ChainProfile(masses=self.masses, springs=self.springs, dampers=self.dampers)
        return self


class SimulationProfile(Part):
    """What stands behind ``interface: fieldsim``; the tool itself never looks at it."""

    axes: tuple[SimulatedAxisProfile, ...]
    couplings: tuple[CouplingProfile, ...] = ()
    seed: Annotated[int, Field(ge=0)] = 0
