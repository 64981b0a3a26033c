"""One controller parameter of a drive: its object, its unit, and how it may be written."""

from typing import Annotated, Literal

from pydantic import ConfigDict, Field, model_validator

from drives.errors import NotSupportedError
from drives.objects import DataType
from drives.profile.values import (
    UNKNOWN,
    Address,
    LocatedError,
    Number,
    Part,
    Positive,
    Seconds,
    Unknown,
)

GainsVia = Literal["objects", "password", "read-only", "interpreter", "none", "unknown"]
"""How gains are reached: as objects; as objects once a password was written; as objects that can
only be read; through the drive's own language, which this tool does not speak; not at all."""


class Condition(Part):
    """What an object of the drive must hold for a fact of the profile to be true."""

    object: Address
    type: DataType
    equals: int
    missing_is_fine: bool = False
    """Whether a drive without the object does as one whose object holds the value."""


class ParameterInfo(Part):
    """One controller parameter: its object, and what its number means.

    physical = scale * value ** power * product of ``times``
    """

    model_config = ConfigDict(
        extra="forbid", frozen=True, arbitrary_types_allowed=True, populate_by_name=True
    )

    object: Address
    told_type: DataType | Unknown = Field(alias="type")
    """The type; ``unknown``: only the drive's own EDS tells."""
    unit: str
    """Physical unit, in SI of a rotary axis."""
    factor: Positive | Unknown = Field(default=1.0, alias="scale")
    """The scale, where it is known."""
    power: Literal[1, -1] = 1
    """-1: the object holds the reciprocal, as a reset time does."""
    times: dict[str, Annotated[int, Field(ge=-3, le=3)]] = Field(default_factory=dict)
    """Quantities of the drive, or parameters that stand before this one, with their powers."""
    only_if: Condition | None = None
    """What must be so in the drive for the unit to be the one given."""
    follows: str | None = None
    """Parameter before it that it always gets the value of."""
    write: Literal["always", "disabled", "unknown"] = "disabled"
    """Whether it may be written while the drive is enabled."""
    minimum: Number | None = None
    maximum: Number | None = None
    """Range in physical units."""

    @property
    def type(self) -> DataType:
        """The type.

        Raises
        ------
        NotSupportedError
            If nobody has told it yet.
        """
        if self.told_type == UNKNOWN:
            raise NotSupportedError(
                f"object {self.object}: its type is not known. Give the drive's own EDS with `eds:` at "
                "the axis in the machine profile."
            )
        return self.told_type

    @property
    def scale(self) -> float:
        """Physical value per unit of the drive, the product of ``times`` left out.

        Raises
        ------
        NotSupportedError
            If the profile does not know it.
        """
        if self.factor == UNKNOWN:
            raise NotSupportedError(
                f"object {self.object}: what its unit is worth is not known, so it is neither "
                "understood nor written. Give `scale` in a drive profile of your own."
            )
        return float(self.factor)


class Latch(Part):
    """An object that has to be written before values written earlier take effect."""

    object: Address
    type: DataType
    set_bits: Annotated[int, Field(ge=1)]
    """Written together with what the object holds already."""
    after: Annotated[tuple[str, ...], Field(min_length=1)]
    """Parameters that wait for it."""


class FilterInfo(Part):
    """Filters that the drive has in one place of its loops."""

    place: str
    """Such as ``torque reference`` or ``velocity feedback``."""
    count: Annotated[int, Field(ge=1)] = 1
    form: Literal["notch", "low-pass", "notch or low-pass", "biquad", "coefficients", "unknown"]
    order: Annotated[int, Field(ge=1)] | Unknown = "unknown"
    objects: tuple[Address, ...] = ()
    usable: bool = False
    """Whether this tool writes it: its parameters are under ``parameters``."""


class Unlock(Part):
    """A password, written before parameters are."""

    object: Address
    level: Address | None = None
    """Object that shows afterwards who the drive takes us for; 0 is nobody."""


class Store(Part):
    """How parameters get into non-volatile memory."""

    object: Address
    signature: Annotated[str, Field(pattern=r"^[ -~]{4}$")] | int = "save"
    """Four letters, as 0x1010 wants them, or a number."""
    what: str = "all parameters"
    """Which parameters it stores: some drives have one sub-index for each category."""
    duration: Seconds | Unknown = UNKNOWN
    """How long it usually takes."""
    timeout: Seconds
    """Longest time until the drive answers."""
    verify: Literal["answer", "status", "read-back after restart"] = "answer"
    """How one sees that it was done: the drive answers when it has finished; ``status`` does so;
    or only values read after a restart tell."""
    status: Address | None = None
    """Object that shows whether storing is done."""
    status_done: int | None = None
    """Its value then."""
    restart: bool | Unknown = False
    """Whether stored values act only after a restart."""
    states: Literal["any", "disabled", "unknown"] = "disabled"
    """Power states in which the drive stores."""

    @model_validator(mode="after")
    def _status_is_known(self) -> "Store":
        if self.verify == "status" and (self.status is None or self.status_done is None):
            raise LocatedError(
                ("verify",), "status needs `status` and `status_done`: where, and what"
            )
        return self

    @property
    def signature_value(self) -> int:
        """The number to write."""
        if isinstance(self.signature, int):
            return self.signature
        return int.from_bytes(self.signature.encode("ascii"), "little")
