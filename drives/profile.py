"""Profiles: what a drive's objects mean, and what a machine's axes may do.

A profile is a YAML file.  Unknown keys, wrong types, wrong units and missing limits are refused with
file and line, because a misspelled limit must stop the program.  Profiles hold data only.

Files are looked for as given, else among the packaged ones (``profiles/drives``,
``profiles/machines``) by their name without ``.yaml``.
"""

from collections.abc import Mapping
from importlib.resources import as_file, files
from math import isfinite
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import yaml
from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    ValidationError,
    model_validator,
)

from drives.errors import ProfileError
from drives.objects import DataType, ObjectAddress
from drives.units import Kind, parse_quantity

MAX_PROFILE_BYTES = 1_000_000
MAX_DEPTH = 30
"""Of lists and mappings inside each other."""
_LOADER: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)

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


def _finite(value: float) -> float:
    if not isfinite(value):
        raise ValueError(f"needs a finite number, got {value}")
    return value


def _address(value: object) -> object:
    return ObjectAddress.parse(value) if isinstance(value, str) else value


def _time(value: object) -> float:
    return parse_quantity(value, "time")


Number = Annotated[float, Field(strict=True), AfterValidator(_finite)]
Positive = Annotated[Number, Field(gt=0)]
NotNegative = Annotated[Number, Field(ge=0)]
Seconds = Annotated[float, BeforeValidator(_time), Field(gt=0)]
Address = Annotated[ObjectAddress, BeforeValidator(_address)]
Name = Annotated[str, Field(pattern=r"^[A-Za-z][A-Za-z0-9_-]{0,31}$")]


class _Part(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, arbitrary_types_allowed=True)


class Identity(_Part):
    """What 0x1000 and 0x1018 of such a drive say; a number left out is not compared."""

    device_type: int | None = None
    vendor_id: int | None = None
    product_code: int | None = None


class ParameterInfo(_Part):
    """One controller parameter: its object, and what its number means."""

    object: Address
    type: DataType
    unit: str
    """Physical unit of value times scale, in SI of a rotary axis."""
    scale: Positive = 1.0
    """Physical value = drive value times scale."""
    write: Literal["always", "disabled"] = "disabled"
    """Whether it may be written while the drive is enabled."""
    minimum: Number | None = None
    maximum: Number | None = None
    """Range in physical units."""


class Store(_Part):
    """How parameters get into non-volatile memory."""

    object: Address
    timeout: Seconds


class DriveProfile(_Part):
    """A kind of drive."""

    format: Literal["fieldtool-drive/1"]
    name: Name
    description: str = ""
    eds: str
    """Name of the EDS file beside the profile."""
    identity: Identity
    rated_torque_unit: Positive
    """What one unit of 0x6076 is in N m (or N)."""
    quick_stop_reaction: Literal["disable", "hold"] = "disable"
    heartbeat_reaction: Literal[1, 2, 3] = 3
    """0x6007 to set while the machine moves: 1 fault, 2 disable voltage, 3 quick stop."""
    error_behaviour: Literal[0, 1, 2] | None = None
    """0x1029:1 to set while the machine moves; none where the drive has no such object."""
    interpolation: Literal["linear", "unknown"] = "unknown"
    """How the drive goes from one cyclic target to the next."""
    torque_lag: Annotated[float, BeforeValidator(_time), Field(ge=0)] = 0.0
    """From the drive's reference to the torque that it reports: current loop and inner sampling."""
    torque_offset: bool = False
    """Whether the drive adds 0x60B2 to its torque reference in cyclic position mode, at every SYNC,
    so that torques may be streamed together with positions."""
    interpolation_index: Literal[-6, -5, -4, -3] = -3
    """Exponent of ten that 0x60C2:2 gets."""
    volatile_commands: tuple[Address, ...] = ()
    """Writable objects that are commands, not parameters: never backed up nor restored."""
    feed_forward: tuple[str, ...] = ()
    """Names of parameters that are zero while frequency responses are measured: feed-forward of
    a target that is linear between SYNCs makes the torque jump at every SYNC, just where it is
    sampled."""
    parameters: dict[str, ParameterInfo]
    """By name, in the order in which they are written."""
    store: Store | None = None
    path: Path = Field(default=Path(), exclude=True)

    @model_validator(mode="after")
    def _known_names(self) -> "DriveProfile":
        for k, name in enumerate(self.feed_forward):
            if name not in self.parameters:
                raise _LocatedError(("feed_forward", k), f"{name} is not among the parameters")
        return self


class Limits(_Part):
    """What an axis may do during experiments, SI.  All are mandatory: no limit known, no motion."""

    travel: tuple[Number, Number]
    """Lowest and highest position, rad or m."""
    velocity: Positive
    acceleration: Positive
    torque: Positive
    following_error: Positive


class MotorInertia(_Part):
    """The motor's inertia from its data sheet, kg m2 or kg."""

    value: Positive
    tolerance: Annotated[Number, Field(gt=0, lt=1)] = 0.1
    """Relative."""


class ChainProfile(_Part):
    """Numbers of one chain, motor side first, SI."""

    masses: Annotated[tuple[Positive, ...], Field(min_length=1, max_length=16)]
    springs: tuple[Positive, ...] = ()
    dampers: tuple[NotNegative, ...] = ()
    viscous_friction: NotNegative = 0.0

    @model_validator(mode="after")
    def _lengths(self) -> "ChainProfile":
        n = len(self.masses)
        if len(self.springs) != n - 1:
            raise ValueError(f"{n} masses need {n - 1} springs, got {len(self.springs)}")
        if self.dampers and len(self.dampers) != n - 1:
            raise ValueError(f"{n} masses need {n - 1} dampers, got {len(self.dampers)}")
        return self


class CouplingProfile(_Part):
    """Inertia coupling between the last masses of two axes."""

    axes: tuple[Name, Name]
    value: Number


class AxisProfile(_Part):
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
    motor_inertia: MotorInertia | None = None
    limits: Limits
    prior: ChainProfile
    """The axis as last accepted."""

    @model_validator(mode="before")
    @classmethod
    def _units(cls, data: Any) -> Any:
        """Read the limits' units, which depend on the axis' kind."""
        if not isinstance(data, dict) or not isinstance(data.get("limits"), dict):
            return data
        kind = data.get("kind")
        if kind not in DIMENSIONS:
            return data
        dimension = DIMENSIONS[kind]
        of_key = {
            "travel": dimension["position"],
            "velocity": dimension["velocity"],
            "acceleration": dimension["acceleration"],
            "torque": dimension["torque"],
            "following_error": dimension["position"],
        }
        limits = dict(data["limits"])
        for key, quantity in of_key.items():
            if key not in limits:
                continue
            value = limits[key]
            try:
                limits[key] = (
                    tuple(parse_quantity(v, quantity) for v in value)
                    if isinstance(value, list)
                    else parse_quantity(value, quantity)
                )
            except ValueError as error:
                raise _LocatedError(("limits", key), str(error)) from None
        return {**data, "limits": limits}

    @model_validator(mode="after")
    def _travel(self) -> "AxisProfile":
        low, high = self.limits.travel
        if low >= high:
            raise ValueError(f"travel must go from low to high, got {low} to {high}")
        return self


class BusProfile(_Part):
    """Where the machine's CAN bus is, in python-can's words."""

    interface: str
    channel: str | int | None = None
    bitrate: Annotated[int, Field(ge=10_000, le=1_000_000)] = 1_000_000


class CoulombFrictionProfile(_Part):
    """Dry friction between a chain's first (motor) or last (load) mass and ground."""

    effect: Literal["coulomb_friction"]
    location: Literal["motor", "load"] = "motor"
    torque: NotNegative
    """N m, or N on a linear axis; the same at standstill as while sliding."""


EffectProfile = CoulombFrictionProfile
"""One part of a simulated axis; a union of such classes, told apart by ``effect``."""


class SimulatedAxisProfile(_Part):
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
    gains: dict[str, Number] = {}
    """Start values of the drive's parameters by name, physical units."""

    @model_validator(mode="after")
    def _chain(self) -> "SimulatedAxisProfile":
        ChainProfile(masses=self.masses, springs=self.springs, dampers=self.dampers)
        return self


class SimulationProfile(_Part):
    """What stands behind ``interface: fieldsim``; the tool itself never looks at it."""

    axes: tuple[SimulatedAxisProfile, ...]
    couplings: tuple[CouplingProfile, ...] = ()
    seed: Annotated[int, Field(ge=0)] = 0


class MachineProfile(_Part):
    """A machine: bus, axes, limits, and the model as last accepted."""

    format: Literal["fieldtool-machine/1"]
    name: Name
    description: str = ""
    bus: BusProfile
    axes: Annotated[tuple[AxisProfile, ...], Field(min_length=1, max_length=32)]
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
                    raise _LocatedError(("axes", k, "name"), f"two axes are called {axis.name}")
                if axis.node_id == other.node_id:
                    raise _LocatedError(
                        ("axes", k, "node_id"),
                        f"axes {other.name} and {axis.name} both have node id {axis.node_id}; "
                        "each drive on the bus needs its own",
                    )
        for where, couplings in (
            (("couplings",), self.couplings),
            (("simulation", "couplings"), self.simulation.couplings if self.simulation else ()),
        ):
            for k, coupling in enumerate(couplings):
                a, b = coupling.axes
                if a == b or a not in names or b not in names:
                    raise _LocatedError(
                        (*where, k, "axes"), f"{a} - {b} does not join two of the axes {names}"
                    )
        if self.simulation and len(self.simulation.axes) != len(names):
            raise _LocatedError(
                ("simulation", "axes"),
                f"{len(self.simulation.axes)} simulated axes for {len(names)} axes",
            )
        return self


class _LocatedError(ValueError):
    """A refusal whose place inside the part is known."""

    def __init__(self, location: tuple[str | int, ...], message: str) -> None:
        self.location = location
        super().__init__(message)


def load_machine(name_or_path: str | Path) -> MachineProfile:
    """Return the machine profile of this name or file.

    Raises
    ------
    ProfileError
        If there is none, or it is wrong: with file, line, key and value.
    """
    path = _find("machines", name_or_path)
    return _load(path, MachineProfile)


def load_drive(name_or_path: str | Path, beside: Path | None = None) -> DriveProfile:
    """Return the drive profile of this name or file.

    Parameters
    ----------
    name_or_path
        Name of a packaged profile, or path of a file.
    beside
        File whose folder relative paths start from (the machine profile's).

    Raises
    ------
    ProfileError
        As :func:`load_machine`.
    """
    if beside is not None and (beside.parent / name_or_path).is_file():
        name_or_path = beside.parent / name_or_path
    return _load(_find("drives", name_or_path), DriveProfile)


def packaged(kind: Literal["drives", "machines"]) -> tuple[str, ...]:
    """Return the names of the packaged profiles, in order."""
    folder = files("profiles").joinpath(kind)
    names = (entry.name for entry in folder.iterdir())
    return tuple(sorted(n.removesuffix(".yaml") for n in names if n.endswith(".yaml")))


def _find(kind: Literal["drives", "machines"], name_or_path: str | Path) -> Path:
    path = Path(name_or_path)
    try:
        if path.is_file():
            return path
    except (OSError, ValueError) as error:
        raise ProfileError(str(path)[:80], f"is no name of a file ({error})") from None
    if path.suffix not in (".yaml", ".yml") and len(path.parts) == 1:
        packaged_file = files("profiles").joinpath(kind, f"{path.name}.yaml")
        with as_file(packaged_file) as found:
            if found.is_file():
                return found
    raise ProfileError(
        path,
        f"no such {kind[:-1]} profile; packaged are: {', '.join(packaged(kind))}. "
        "Give one of these names or the path of a YAML file.",
    )


P = TypeVar("P", DriveProfile, MachineProfile)


def _load(path: Path, model: type[P]) -> P:
    data, lines = read_yaml(path)
    try:
        profile = model.model_validate(data)
    except ValidationError as error:
        errors = error.errors()  # a misspelled key also shows as a missing one: name the spelling
        first = next((e for e in errors if e["type"] == "extra_forbidden"), errors[0])
        location = _without_tags(first["loc"])
        message = first["msg"].removeprefix("Value error, ")
        inner = first.get("ctx", {}).get("error")
        if isinstance(inner, _LocatedError):
            location += inner.location
        location = tuple(p for p in location if not (isinstance(p, str) and p == "function-before"))
        raise ProfileError(
            path, _sentence(location, message, first), _line(lines, location)
        ) from None
    return profile.model_copy(update={"path": path})


def _without_tags(location: tuple[str | int, ...]) -> tuple[str | int, ...]:
    """Leave out the effect's name, which pydantic puts behind its number in a list of effects."""
    return tuple(p for k, p in enumerate(location) if k < 2 or location[k - 2] != "effects")


def _sentence(location: tuple[str | int, ...], message: str, error: Mapping[str, Any]) -> str:
    where = ".".join(str(p) for p in location) or "the file"
    kind = error["type"]
    if kind == "missing":
        if "limits" in location:
            return f"{where} is missing; without this limit nothing may move. Add it."
        return f"{where} is missing. Add it."
    if kind == "extra_forbidden":
        return f"{where} is not a known key. Check its spelling or take it out."
    shown = error.get("input")
    value = f" (value {shown!r})" if isinstance(shown, str | int | float | bool) else ""
    return f"{where}: {message[0].lower()}{message[1:]}{value}."


Lines = dict[tuple[str | int, ...], int]


def _line(lines: Lines, location: tuple[str | int, ...]) -> int | None:
    while location and location not in lines:
        location = location[:-1]
    return lines.get(location)


def read_yaml(path: Path, largest: int = MAX_PROFILE_BYTES) -> tuple[Any, Lines]:
    """Return a YAML file's plain values, and the line on which each key or item stands.

    Parameters
    ----------
    path
        File, UTF-8.
    largest
        Bytes that are read at most.

    Raises
    ------
    ProfileError
        If the file can not be read, is too large, is no YAML, uses aliases, has a key twice, or is
        no mapping.
    """
    try:
        size = path.stat().st_size
        if size > largest:
            raise ProfileError(path, f"is too large: {size} bytes; at most {largest} are read")
        text = path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise ProfileError(path, f"can not be read: {error.strerror}") from None
    except UnicodeDecodeError as error:
        line = error.object[: error.start].count(b"\n") + 1
        raise ProfileError(path, "is not UTF-8 text; save it as UTF-8", line) from None
    lines: Lines = {}
    try:
        _refuse_aliases(text, path)
        loader = _LOADER(text)
        root = loader.get_single_node()
        if not isinstance(root, yaml.MappingNode):
            raise ProfileError(path, "is no mapping of keys to values", 1)
        _note_lines(root, (), lines, path)
        return loader.construct_document(root), lines
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        raise ProfileError(
            path, f"is no YAML: {error.problem}", mark.line + 1 if mark else None
        ) from None
    except (yaml.YAMLError, ValueError, TypeError, RecursionError) as error:
        raise ProfileError(path, f"is no YAML: {' '.join(str(error).split())}") from None


def _refuse_aliases(text: str, path: Path) -> None:
    """A few lines of aliases can stand for more values than fit into a computer."""
    depth = 0
    for event in yaml.parse(text, Loader=_LOADER):
        depth += isinstance(event, yaml.CollectionStartEvent)
        depth -= isinstance(event, yaml.CollectionEndEvent)
        line = event.start_mark.line + 1 if event.start_mark else None
        if depth > MAX_DEPTH:
            raise ProfileError(path, "is nested too deep", line)
        if isinstance(event, yaml.AliasEvent):
            raise ProfileError(path, "uses a YAML alias (*); write the values out", line)


def _note_lines(node: yaml.Node, place: tuple[str | int, ...], lines: Lines, path: Path) -> None:
    lines.setdefault(place, node.start_mark.line + 1)
    if isinstance(node, yaml.MappingNode):
        for key, value in node.value:
            here = (*place, str(key.value))
            if here in lines:
                raise ProfileError(
                    path, f"{key.value} stands here a second time", key.start_mark.line + 1
                )
            lines[here] = key.start_mark.line + 1
            _note_lines(value, here, lines, path)
    elif isinstance(node, yaml.SequenceNode):
        for k, value in enumerate(node.value):
            _note_lines(value, (*place, k), lines, path)
