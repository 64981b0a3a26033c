"""Chains of masses and their couplings, as profiles hold them."""

from typing import Annotated

from pydantic import Field, model_validator

from drives.profile.values import Name, NotNegative, Number, Part, Positive


class ChainProfile(Part):
    """Numbers of one chain, motor side first, SI."""

    masses: Annotated[tuple[Positive, ...], Field(min_length=1, max_length=16)]
    springs: tuple[Positive, ...] = ()
    dampers: tuple[NotNegative, ...] = ()
    viscous_friction: NotNegative = 0.0

    @model_validator(mode="after")
    def _lengths(self) -> "ChainProfile":
        n = len(self.masses)
        if len(self.springs) != n - 1:
            more = " (numbers are written with a point, not with a comma)"
            raise ValueError(
                f"{n} masses need {n - 1} springs, got {len(self.springs)}"
                + (more if len(self.springs) > n - 1 else "")
            )
        if self.dampers and len(self.dampers) != n - 1:
            raise ValueError(f"{n} masses need {n - 1} dampers, got {len(self.dampers)}")
        return self


class CouplingProfile(Part):
    """Inertia coupling between the last masses of two axes."""

    axes: tuple[Name, Name]
    value: Number
