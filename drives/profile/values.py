"""What profiles are made of: numbers with their bounds, addresses, and refusals with their place."""

from math import isfinite
from typing import Annotated, Any, Literal, TypeVar

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, WithJsonSchema

from drives.objects import ObjectAddress
from drives.units import Kind, parse_quantity

DIMENSIONS: dict[Kind, dict[str, str]] = {
    "rotary": {
        "position": "angle",
        "velocity": "angular velocity",
        "acceleration": "angular acceleration",
        "torque": "torque",
        "mass": "inertia",
    },
    "linear": {
        "position": "length",
        "velocity": "velocity",
        "acceleration": "acceleration",
        "torque": "force",
        "mass": "mass",
    },
}
"""What position, torque ... are on an axis of this kind."""

Unknown = Literal["unknown"]
"""Stands in a profile where a fact is not known; the tool does not guess it."""
UNKNOWN: Unknown = "unknown"


def _finite(value: float) -> float:
    if not isfinite(value):
        raise ValueError(f"needs a finite number, got {value}")
    return value


def _address(value: object) -> object:
    return ObjectAddress.parse(value) if isinstance(value, str) else value


def _time(value: object) -> float:
    return parse_quantity(value, "time")


def _delay(value: object) -> float:
    return 0.0 if value == UNKNOWN else _time(value)


_TIME = {
    "type": "string",
    "pattern": r"^\s*[0-9.eE+-]+\s*(s|ms|us)\s*$",
    "examples": ["5 s", "0.2 ms"],
}
_TIME_SCHEMA = WithJsonSchema(_TIME)
_DELAY_SCHEMA = WithJsonSchema({"anyOf": [_TIME, {"const": UNKNOWN, "type": "string"}]})
_ADDRESS_SCHEMA = WithJsonSchema(
    {
        "type": "string",
        "pattern": r"^0x[0-9A-Fa-f]{1,4}(:(0x)?[0-9A-Fa-f]{1,2})?$",
        "examples": ["0x6072", "0x2010:01"],
    }
)

Number = Annotated[float, Field(strict=True), AfterValidator(_finite)]
Positive = Annotated[Number, Field(gt=0)]
NotNegative = Annotated[Number, Field(ge=0)]
Seconds = Annotated[float, BeforeValidator(_time), Field(gt=0), _TIME_SCHEMA]
Delay = Annotated[float, BeforeValidator(_delay), Field(ge=0), _DELAY_SCHEMA]
"""Seconds; 0, which may be written ``unknown``, where nobody knows it."""
Address = Annotated[ObjectAddress, BeforeValidator(_address), _ADDRESS_SCHEMA]
Name = Annotated[str, Field(pattern=r"^[A-Za-z][A-Za-z0-9_-]{0,31}$")]

T = TypeVar("T")


class Part(BaseModel):
    """A part of a profile: unknown keys are refused, and nothing changes once it is read."""

    model_config = ConfigDict(extra="forbid", frozen=True, arbitrary_types_allowed=True)


class LocatedError(ValueError):
    """A refusal whose place inside the part is known."""

    def __init__(self, location: tuple[str | int, ...], message: str) -> None:
        self.location = location
        super().__init__(message)


def known(value: T | Unknown, otherwise: T | None = None) -> T | None:
    """Return a fact, or something else where the profile does not know it."""
    return otherwise if value == UNKNOWN else value


def unknown_keys(value: Any, place: str = "") -> tuple[str, ...]:
    """Return the keys under which ``unknown`` stands, dotted, in order."""
    if value == UNKNOWN:
        return (place,)
    items: list[tuple[Any, Any]] = []
    if isinstance(value, BaseModel):
        items = [
            (told.alias or name, getattr(value, name))
            for name, told in type(value).model_fields.items()
        ]
    elif isinstance(value, dict):
        items = list(value.items())
    elif isinstance(value, tuple | list):
        items = list(enumerate(value))
    found: list[str] = []
    for key, inner in items:
        found += unknown_keys(inner, f"{place}.{key}" if place else str(key))
    return tuple(found)
