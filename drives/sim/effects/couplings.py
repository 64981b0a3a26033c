"""What joins two chains beside the inertia between their last masses."""

from dataclasses import dataclass

from drives.sim.effects.shapes import Location, check_location, check_number


def _check_chains(effect: str, chains: tuple[int, int]) -> None:
    if chains[0] == chains[1] or min(chains) < 0:
        raise ValueError(f"{effect}: chains {chains} must be two different ones, counted from 0")


@dataclass(frozen=True)
class CouplingSpring:
    """A spring and damper between masses of two chains; model name coupling_spring.

    Raises
    ------
    ValueError
        If a value is not physical.
    """

    chains: tuple[int, int]
    """Their numbers, from 0."""
    spring: float
    """N m/rad or N/m, above 0."""
    damper: float = 0.0
    """N m s/rad or N s/m, at least 0."""
    location: Location = "load"

    def __post_init__(self) -> None:
        _check_chains("coupling spring", self.chains)
        check_location("coupling spring", self.location)
        check_number("coupling spring", "spring", self.spring, "N m/rad (N/m)", 1e-12)
        check_number("coupling spring", "damper", self.damper, "N m s/rad (N s/m)", 0.0)


@dataclass(frozen=True)
class CouplingInertia:
    """An entry of the mass matrix between masses of two chains; model name coupling_inertia.

    Raises
    ------
    ValueError
        If a value is not physical.
    """

    chains: tuple[int, int]
    """Their numbers, from 0."""
    inertia: float
    """kg m2 or kg, of either sign."""
    location: Location = "motor"

    def __post_init__(self) -> None:
        _check_chains("coupling inertia", self.chains)
        check_location("coupling inertia", self.location)
        check_number("coupling inertia", "inertia", self.inertia, "kg m2 (kg)")
