"""Machine profiles: bus, axes, limits, and the model as last accepted."""

from dataclasses import fields
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from drives.api import AxisLimits
from drives.profile.bus import BusProfile
from drives.profile.chain import ChainProfile, CouplingProfile
from drives.profile.simulation import SimulationProfile
from drives.profile.values import (
    DIMENSIONS,
    LocatedError,
    Name,
    NotNegative,
    Number,
    Part,
    Positive,
    Seconds,
)
from drives.units import Kind, parse_quantity

SAG_SHARE = 0.01
"""Share of its travel that an axis may be allowed to sag, at most."""


class Limits(Part):
    """What an axis may do during experiments, SI.  No limit known, no motion: all are mandatory but
    ``sag``.
    """

    travel: tuple[Number, Number]
    """Lowest and highest position, rad or m."""
    velocity: Positive
    acceleration: Positive
    torque: Positive
    following_error: Positive
    sag: Positive | None = None
    """How far a weight may pull the axis when its drive is enabled and its brake opens, until its loop
    holds it, rad or m; none: it has to stand still then, too."""

    @property
    def watched(self) -> AxisLimits:
        """As what moves axes takes them."""
        return AxisLimits(**{one.name: getattr(self, one.name) for one in fields(AxisLimits)})


class MotorInertia(Part):
    """The motor's inertia from its data sheet, kg m2 or kg."""

    value: Positive
    tolerance: Annotated[Number, Field(gt=0, lt=1)] = 0.1
    """Relative."""


class LoopProfile(Part):
    """Gains of a drive as a person read them: without them nobody knows what a target does, SI."""

    position_p: Positive
    """1/s."""
    velocity_p: Positive
    """N m s/rad or N s/m."""
    velocity_i: NotNegative
    """N m/rad or N/m."""
    velocity_ff: NotNegative = 0.0
    """Share of the reference's velocity that is fed forward."""
    viscous_ff: NotNegative = 0.0
    """N m s/rad or N s/m: torque per velocity of the reference."""
    inertia_ff: NotNegative = 0.0
    """kg m2 or kg."""


class MoveProfile(Part):
    """A move that the axis usually makes, SI: what its parameters are to be good at."""

    distance: Positive
    """rad or m."""
    velocity: Positive
    """rad/s or m/s."""
    acceleration: Positive
    """rad/s2 or m/s2."""
    jerk: Positive | None = None
    """rad/s3 or m/s3; none: the acceleration builds up over a quarter of the time to speed up."""
    band: Positive | None = None
    """rad or m to both sides of the target within which the axis has arrived; none: a hundredth of
    the distance."""


def _travel_of(given: object, quantity: str) -> tuple[float, ...]:
    """Read the lowest and the highest position, SI."""
    if isinstance(given, list) and len(given) == 2:
        return tuple(parse_quantity(value, quantity) for value in given)
    wanted = "needs the lowest and the highest position in brackets, such as [-90 deg, 90 deg]"
    if quantity == "length":
        wanted = "needs the lowest and the highest position in brackets, such as [-0.2 m, 0.2 m]"
    if isinstance(given, list) and len(given) > 2:
        raise ValueError(
            f"{wanted}; {len(given)} values stand here. A comma ends a value: write numbers with a "
            "point, 1.5 and not 1,5"
        )
    raise ValueError(f"{wanted}, got {given!r}")


class AxisProfile(Part):
    """One axis of a machine."""

    name: Name
    kind: Kind
    node_id: Annotated[int, Field(ge=1, le=127, strict=True)]
    drive: str
    """Name of the drive profile, or path of its file."""
    may_float: bool = False
    """Whether the axis may be without torque while others move; never for gravity axes."""
    serial_number: int | None = None
    feed: Positive | None = None
    """Metres per encoder revolution (0x608F) of a linear motor's scale; linear axes only.  A screw
    driven by a rotary motor is a rotary axis here: torques are those of the motor."""
    eds: str | None = None
    """This drive's own EDS or DCF file, beside the machine profile; else the drive profile's."""
    password: str | None = None
    """What unlocks the drive's parameters, where its profile asks for one."""
    encoder_counts_per_rev: Annotated[int, Field(ge=1, strict=True)] | None = None
    """Position units per motor revolution, for drives that do not tell."""
    torque_constant: Positive | None = None
    """N m/A (or N/A) of the motor, for drives whose torque is per mille of a current."""
    loop: LoopProfile | None = None
    """The drive's gains as they are now, for drives whose gains the tool can not read in SI."""
    motor_inertia: MotorInertia | None = None
    limits: Limits
    typical_move: MoveProfile | None = None
    """None: one that follows from the limits."""
    prior: ChainProfile
    """The axis as last accepted."""

    @model_validator(mode="before")
    @classmethod
    def _units(cls, data: Any) -> Any:
        """Read the limits' units, which depend on the axis' kind."""
        if not isinstance(data, dict) or not isinstance(data.get("limits"), dict):
            return data
        kind = data.get("kind")
        if not isinstance(kind, str) or kind not in DIMENSIONS:
            return data
        dimension = DIMENSIONS[kind]
        of_key = {
            "travel": dimension["position"],
            "velocity": dimension["velocity"],
            "acceleration": dimension["acceleration"],
            "torque": dimension["torque"],
            "following_error": dimension["position"],
            "sag": dimension["position"],
        }
        limits = dict(data["limits"])
        for key, quantity in of_key.items():
            if key not in limits:
                continue
            value = limits[key]
            try:
                limits[key] = (
                    _travel_of(value, quantity)
                    if key == "travel"
                    else parse_quantity(value, quantity)
                )
            except ValueError as error:
                raise LocatedError(("limits", key), str(error)) from None
        return {**data, "limits": limits}

    @model_validator(mode="after")
    def _travel(self) -> "AxisProfile":
        low, high = self.limits.travel
        if low >= high:
            unit = "rad" if self.kind == "rotary" else "m"
            raise LocatedError(
                ("limits", "travel"),
                f"must go from low to high, got {low:.4g} {unit} to {high:.4g} {unit}: write the lower "
                "position first",
            )
        self._check_sag(high - low)
        move = self.typical_move
        if move is not None:
            for name, wanted, limit in (
                ("distance", move.distance, high - low),
                ("velocity", move.velocity, self.limits.velocity),
                ("acceleration", move.acceleration, self.limits.acceleration),
            ):
                if wanted > limit:
                    raise LocatedError(
                        ("typical_move", name),
                        f"{wanted:g} is more than the limits allow, {limit:g}",
                    )
        return self

    def _check_sag(self, travel: float) -> None:
        sag, unit = self.limits.sag, "rad" if self.kind == "rotary" else "m"
        if sag is None:
            return
        if self.may_float:
            raise LocatedError(
                ("limits", "sag"),
                "an axis that may float (`may_float: true`) has no weight that pulls it down: remove "
                "`sag`, or `may_float` if it has one",
            )
        error = self.limits.following_error
        for most, what in (
            (SAG_SHARE * travel, f"{100 * SAG_SHARE:g} % of the travel"),
            (error, "the following error limit"),
        ):
            if sag > most:
                raise LocatedError(
                    ("limits", "sag"),
                    f"{sag:.4g} {unit} is more than {most:.4g} {unit}, {what}: for an axis that sags so "
                    "far raise the gains velocity_i and position_p in its drive",
                )


class MachineProfile(Part):
    """A machine: bus, axes, limits, and the model as last accepted."""

    format: Literal["fieldtool-machine/1"]
    name: Name
    description: str = ""
    bus: BusProfile
    axes: Annotated[tuple[AxisProfile, ...], Field(min_length=1, max_length=32)]
    controller_cycle: Annotated[Seconds, Field(ge=1e-5, le=0.1)] | None = None
    """s, from one cyclic target to the next of the machine's own controller, which moves it after the
    commissioning: parameters are designed for it; None: for the cycle of this tool."""
    couplings: tuple[CouplingProfile, ...] = ()
    """Of the prior model."""
    simulation: SimulationProfile | None = None
    path: Path = Field(default=Path(), exclude=True)

    @model_validator(mode="after")
    def _consistent(self) -> "MachineProfile":
        names = [axis.name for axis in self.axes]
        for k, axis in enumerate(self.axes):
            for other in self.axes[:k]:
                if axis.name == other.name:
                    raise LocatedError(("axes", k, "name"), f"two axes are called {axis.name}")
                if axis.node_id == other.node_id:
                    raise LocatedError(
                        ("axes", k, "node_id"),
                        f"axes {other.name} and {axis.name} both have node id {axis.node_id}; "
                        "each drive on the bus needs its own",
                    )
        simulated = self.simulation
        for where, couplings in (
            (("couplings",), self.couplings),
            (("simulation", "couplings"), simulated.couplings if simulated else ()),
            (("simulation", "effects"), simulated.effects if simulated else ()),
        ):
            for k, coupling in enumerate(couplings):
                a, b = coupling.axes
                if a == b or a not in names or b not in names:
                    raise LocatedError(
                        (*where, k, "axes"), f"{a} - {b} does not join two of the axes {names}"
                    )
        if self.simulation and len(self.simulation.axes) != len(names):
            raise LocatedError(
                ("simulation", "axes"),
                f"{len(self.simulation.axes)} simulated axes for {len(names)} axes",
            )
        return self
