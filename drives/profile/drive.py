"""Drive profiles: what the objects of one kind of drive mean, and what is not known of them."""

from pathlib import Path
from typing import Annotated, Literal

from canopen.objectdictionary import ObjectDictionary
from pydantic import Field, model_validator

from drives.errors import ProfileError
from drives.objects import ObjectAddress
from drives.profile.eds import info_at
from drives.profile.parameter import FilterInfo, GainsVia, Latch, ParameterInfo, Store, Unlock
from drives.profile.scales import PositionScale, Quantity, SyncRules, TorqueScale, VelocityUnit
from drives.profile.values import (
    UNKNOWN,
    Address,
    Delay,
    LocatedError,
    Name,
    Part,
    Seconds,
    Unknown,
    unknown_keys,
)

OWN_EDS = "own"
"""In place of an EDS file's name: everybody gives that of the own drive, in the machine profile."""
BUILT_IN_QUANTITIES = ("counts_per_rev", "rated_torque")
"""Quantities that every drive has: position units a motor revolution, N m of 1000 per mille."""
PID_PARAMETERS = ("pid_p", "pid_i", "pid_d")
CASCADE_PARAMETERS = ("position_p", "velocity_p", "velocity_i")


class Identity(Part):
    """What 0x1000 and 0x1018 of such a drive say; a number left out is not compared."""

    device_type: int | None = None
    low_word_only: bool = False
    """Compare the low word of the device type (its CiA profile) alone."""
    vendor_id: int | None = None
    product_code: int | None = None
    supported_modes: int | None = None
    """All of 0x6502, where it tells this drive from its maker's others."""


class DriveProfile(Part):
    """A kind of drive."""

    format: Literal["fieldtool-drive/1"]
    name: Name
    description: str = ""
    eds: str
    """Name of the EDS file beside the profile; ``own``: the machine profile has to give one."""
    identity: Identity
    modes: tuple[int, ...] | Unknown = UNKNOWN
    """Modes of operation, for drives whose 0x6502 does not tell."""
    absent: tuple[Address, ...] = ()
    """Objects that other drives have and this one is known not to have."""
    position: PositionScale | Unknown = PositionScale()
    velocity: VelocityUnit | Unknown = "position units/s"
    torque: TorqueScale | Unknown = TorqueScale()
    quantities: dict[Name, Quantity] = Field(default_factory=dict)
    """By name: what units of parameters depend on."""
    sync: SyncRules = SyncRules()
    interpolation: Literal["linear", "unknown"] = "unknown"
    """How the drive goes from one cyclic target to the next."""
    interpolation_index: Literal[-6, -5, -4, -3] = -3
    """Exponent of ten that 0x60C2:2 gets."""
    torque_lag: Delay = 0.0
    """From the drive's reference to the torque that it reports: current loop and inner sampling."""
    loop_period: Seconds | Unknown = UNKNOWN
    """Of position and velocity loop: how often they see the encoder."""
    torque_offset: bool | Unknown = False
    """Whether the drive adds 0x60B2 to its torque reference in cyclic position mode, at every SYNC,
    so that torques may be streamed together with positions."""
    quick_stop_reaction: Literal["disable", "hold"] = "disable"
    heartbeat_reaction: Literal[1, 2, 3] | Unknown = 3
    """0x6007 to set while the machine moves: 1 fault, 2 disable voltage, 3 quick stop."""
    error_behaviour: Literal[0, 1, 2] | None = None
    """0x1029:1 to set while the machine moves; none where the drive has no such object."""
    recovery: Literal["fault reset", "communication reset", "unknown"] = "unknown"
    """What ends the fault after a lost heartbeat: a fault reset alone, or one that comes after NMT
    reset communication."""
    structure: Literal["cascade", "pid", "unknown"] = "cascade"
    """Of the loops in cyclic position mode.  ``cascade``: position P, velocity PI.  ``pid``: one PID
    from position error to torque, whose D acts on the error."""
    gains_via: GainsVia = "objects"
    volatile_commands: tuple[Address, ...] = ()
    """Writable objects that are commands, not parameters, or that the drive refuses to have written:
    never backed up nor restored.  Without a sub-index: all of the object."""
    feed_forward: tuple[str, ...] = ()
    """Names of parameters that are zero while frequency responses are measured: feed-forward of
    a target that is linear between SYNCs makes the torque jump at every SYNC, just where it is
    sampled."""
    parameters: dict[str, ParameterInfo] = Field(default_factory=dict)
    """By name, in the order in which they are written."""
    latches: tuple[Latch, ...] = ()
    filters: tuple[FilterInfo, ...] = ()
    unlock: Unlock | None = None
    store: Store | Unknown | None = None
    notes: tuple[str, ...] = ()
    """What else a technician has to know, a sentence each."""
    sources: tuple[str, ...] = ()
    """Where the facts come from."""
    path: Annotated[Path, Field(exclude=True)] = Path()

    @model_validator(mode="after")
    def _known_names(self) -> "DriveProfile":
        for k, name in enumerate(self.feed_forward):
            if name not in self.parameters:
                raise LocatedError(("feed_forward", k), f"{name} is not among the parameters")
        for k, latch in enumerate(self.latches):
            for j, name in enumerate(latch.after):
                if name not in self.parameters:
                    raise LocatedError(
                        ("latches", k, "after", j), f"{name} is not among the parameters"
                    )
        earlier: set[str] = set()
        for name, parameter in self.parameters.items():
            if parameter.follows is not None and parameter.follows not in earlier:
                raise LocatedError(
                    ("parameters", name, "follows"),
                    f"{parameter.follows} is no parameter that stands before {name}",
                )
            earlier.add(name)
        before = {*BUILT_IN_QUANTITIES, *self.quantities}
        for name, parameter in self.parameters.items():
            for other in parameter.times:
                if other not in before:
                    raise LocatedError(
                        ("parameters", name, "times", other),
                        f"{other} is neither a quantity nor a parameter that stands before {name}",
                    )
            before.add(name)
        return self

    @model_validator(mode="after")
    def _consistent(self) -> "DriveProfile":
        if self.gains_via == "password" and self.unlock is None:
            raise LocatedError(("gains_via",), "password needs `unlock`: where it is written")
        if self.gains_via in ("none", "interpreter") and self.parameters:
            raise LocatedError(
                ("gains_via",), f"{self.gains_via} means no objects, but there are parameters"
            )
        if self.structure == "pid" and self.parameters:
            lacking = [name for name in PID_PARAMETERS if name not in self.parameters]
            if lacking:
                raise LocatedError(
                    ("structure",), f"pid needs the parameters {', '.join(PID_PARAMETERS)}"
                )
        return self

    @property
    def eds_path(self) -> Path | None:
        """The EDS file; None where the profile ships none and none was given."""
        return None if self.eds == OWN_EDS else self.path.parent / self.eds

    @property
    def unknown(self) -> tuple[str, ...]:
        """Keys under which the profile says ``unknown``, dotted."""
        lag = (
            () if self.torque_lag or "torque_lag" not in self.model_fields_set else ("torque_lag",)
        )
        return (*unknown_keys(self), *lag)

    @property
    def by_hand(self) -> bool:
        """Whether this tool writes none of the drive's gains: a person enters them."""
        return self.gains_via not in ("objects", "password")

    @property
    def tunable(self) -> frozenset[str]:
        """Names of the parameters that a design for such a drive may have.

        Of a drive whose gains this tool does not write they are those that a person can enter with
        the maker's software.
        """
        if self.by_hand:
            return frozenset(CASCADE_PARAMETERS)
        known = {n for n, one in self.parameters.items() if one.factor != UNKNOWN}
        if self.structure == "pid" and known.issuperset(PID_PARAMETERS):
            known |= set(CASCADE_PARAMETERS)
        return frozenset(known)

    def is_volatile(self, address: ObjectAddress) -> bool:
        """Whether an object is among ``volatile_commands``, or stores, unlocks, or shows either."""
        told: set[ObjectAddress | None] = set()
        if isinstance(self.store, Store):
            told |= {self.store.object, self.store.status}
        if self.unlock is not None:
            told |= {self.unlock.object, self.unlock.level}
        return address in told or not {address, ObjectAddress(address.index)}.isdisjoint(
            self.volatile_commands
        )

    def with_types_of(self, dictionary: ObjectDictionary) -> "DriveProfile":
        """Return the profile with every parameter's type from an EDS file.

        Raises
        ------
        ProfileError
            If the file has no such object, or gives it another type than the profile says.
        """
        typed = {}
        for name, parameter in self.parameters.items():
            info = info_at(dictionary, parameter.object)
            told = parameter.told_type
            if info is None:
                raise ProfileError(
                    self.path,
                    f"parameters.{name}: {Path(self.eds).name} has no object {parameter.object} with a "
                    "type that can be written. Give the drive's own EDS with `eds:` at the axis in the "
                    "machine profile, or a drive profile without it",
                )
            if told not in (UNKNOWN, info.type):
                raise ProfileError(
                    self.path,
                    f"parameters.{name}: object {parameter.object} is {told} here and {info.type} in "
                    f"{Path(self.eds).name}. The EDS of the drive's firmware is right: correct the "
                    "profile",
                )
            typed[name] = parameter.model_copy(update={"told_type": info.type})
        return self.model_copy(update={"parameters": typed})

    def with_eds(self, path: Path) -> "DriveProfile":
        """Return the profile with another EDS file: that of the drive at hand."""
        return self.model_copy(update={"eds": str(path.absolute())})
