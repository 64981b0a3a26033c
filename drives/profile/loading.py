"""Profiles by name or file: read, checked, and refused with file, line, key and value."""

from collections.abc import Mapping
from importlib.resources import as_file, files
from os.path import isfile
from pathlib import Path
from typing import Any, Literal, TypeVar

from pydantic import ValidationError

from drives.errors import ProfileError
from drives.profile.bus import SIMULATED, BusProfile
from drives.profile.drive import DriveProfile
from drives.profile.machine import MachineProfile
from drives.profile.plain_words import place_words, problem_words, unit_of
from drives.profile.values import LocatedError
from drives.profile.yaml_reader import Lines, Location, line_of, read_yaml


def load_machine(name_or_path: str | Path) -> MachineProfile:
    """Return the machine profile of this name or file.

    Raises
    ------
    ProfileError
        If there is none, or it is wrong: with file, line, key and value.
    """
    path = _find("machines", name_or_path)
    machine = _load(path, MachineProfile)
    return machine.model_copy(update={"bus": _channel_beside(machine.bus, path)})


def _channel_beside(bus: BusProfile, path: Path) -> BusProfile:
    """Return a simulated bus whose channel is a file beside the profile with that file's whole path.

    What is no such file stays: the name of a packaged or running machine.  Channels of adapters are
    names anyhow.
    """
    if bus.interface != SIMULATED or not bus.channel:
        return bus
    file = path.absolute().parent / str(bus.channel)
    return bus.model_copy(update={"channel": str(file)}) if isfile(file) else bus


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
    try:
        path = _find("drives", name_or_path)
    except _NoProfileError as error:
        raise _named_in(beside, str(name_or_path), error) from None
    return _load(path, DriveProfile)


class _NoProfileError(ProfileError):
    """There is none of that name."""

    def __init__(self, path: Path, kind: str, known: str) -> None:
        self.message = (
            f"no such {kind} profile; packaged are: {known}. Give one of these names or the path of a "
            "YAML file."
        )
        super().__init__(path, self.message)


def _named_in(file: Path | None, name: str, error: _NoProfileError) -> ProfileError:
    """Return what says where a machine profile names a drive profile that there is none of."""
    if file is None or not file.is_file():
        return error
    data, lines = read_yaml(file)
    for place in lines:
        if place[-1:] in (("drive",), ("profile",)) and _at(data, place) == name:
            message = f"{place_words(place, data)}, {name!r}: {error.message}"
            return ProfileError(file, message, line_of(lines, place))
    return error


def _at(data: Any, place: Location) -> Any:
    for part in place:
        data = data[part]
    return data


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
    raise _NoProfileError(path, kind[:-1], ", ".join(packaged(kind)))


LONGEST_NUMBER = 1000
"""Bits of a whole number that is shown; Python refuses to write very long ones out."""
P = TypeVar("P", DriveProfile, MachineProfile)


def _load(path: Path, model: type[P]) -> P:
    data, lines = read_yaml(path)
    try:
        profile = model.model_validate(data)
    except ValidationError as error:
        location, message, first = _first_of(error, lines, data)
        raise ProfileError(
            path, _sentence(location, message, first, data), line_of(lines, location)
        ) from None
    return profile.model_copy(update={"path": path})


def _first_of(
    error: ValidationError, lines: Lines, data: Any
) -> tuple[Location, str, Mapping[str, Any]]:
    """Return place, message and details of the error to tell.

    A misspelled key also shows as a missing one: its spelling is named.  A value of several forms,
    one of them ``unknown``, gives an error for each form: the first one is told.
    """
    errors = error.errors()
    first = next((e for e in errors if e["type"] == "extra_forbidden"), errors[0])
    location = _in_file(first["loc"], lines, missing=first["type"] == "missing")
    message = problem_words(first, unit_of(location, data))
    inner = first.get("ctx", {}).get("error")
    if isinstance(inner, LocatedError):
        location += inner.location
    others = [e for e in errors if e is not first and _in_file(e["loc"], lines) == location]
    if any(e["type"] == "literal_error" and "'unknown'" in e["msg"] for e in others):
        message += ", or unknown"
    return location, message, first


def _in_file(location: Location, lines: Lines, *, missing: bool = False) -> Location:
    """Leave out of a place what pydantic adds: names of forms and of effects."""
    kept: Location = ()
    for k, part in enumerate(location):
        is_last = k == len(location) - 1
        if (*kept, part) in lines or (missing and is_last):
            kept = (*kept, part)
    return kept


def _sentence(location: Location, message: str, error: Mapping[str, Any], data: Any) -> str:
    where = place_words(location, data) or "the file"
    kind = error["type"]
    if kind == "missing":
        if "limits" in location:
            return f"{where} is missing; without this limit nothing may move. Add it."
        return f"{where} is missing. Add it."
    if kind == "extra_forbidden":
        return f"{where} is not a known key. Check its spelling or take it out."
    return f"{where}: {message}."
