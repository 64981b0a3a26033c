"""``tool.yaml`` of a tool set, and what a session's ``verification.yaml`` says of what it wrote."""

import hashlib
from collections.abc import Mapping, Sequence
from math import inf
from pathlib import Path
from typing import Any, Literal, TypeVar

import yaml
from pydantic import BaseModel, ValidationError

from drives.errors import ProfileError
from drives.parameters import DriveRecord
from drives.parameters.backup import checksum
from drives.parameters.durable import write_durably
from drives.profile import read_yaml
from drives.profile.plain_words import place_words, problem_words
from drives.profile.yaml_reader import line_of
from fieldtool.design.tuning import why_not_stored
from fieldtool.records.yaml_file import Number, PartModel, StrictModel

FORMAT = "fieldtool-tool/1"
FIGURES = ("settling_time", "overshoot", "sensitivity_peak")
Figures = dict[str, dict[str, Number | None]]
Schema = TypeVar("Schema", bound=BaseModel)


class ToolFile(StrictModel):
    """What ``tool.yaml`` says besides its format and checksum."""

    name: str
    machine: str
    kept: str
    source: str
    verified: bool
    figures: Figures
    parameters: str
    """SHA-256 of ``parameters.yaml`` beside it: what was tried is what stands there."""


class _Whole(ToolFile):
    format: Literal["fieldtool-tool/1"]
    checksum: str


class _Parameter(PartModel):
    axis: str
    object: str
    raw: int | float | str


class _After(PartModel):
    settling_time: Number | None
    overshoot: Number | None
    sensitivity_peak: Number | None


class _Axis(PartModel):
    axis: str
    after: _After | None


class _Verification(PartModel):
    verdict: str
    model: str = "prior"
    bound: Number | None = None
    parameters: list[_Parameter]
    axes: list[_Axis]


def write_tool_file(path: Path, tool: ToolFile) -> None:
    """Bring ``tool.yaml`` to the disk.

    Raises
    ------
    OSError
        If it can not be written.
    """
    body = tool.model_dump()
    data = {"format": FORMAT, "checksum": checksum(body), **body}
    write_durably(path, yaml.safe_dump(data, sort_keys=False).encode())


def read_tool_file(path: Path, name: str, machine: str) -> ToolFile:
    """Read ``tool.yaml`` of this tool set.

    Raises
    ------
    ProfileError
        If it is none, was changed, is another one's, or the parameters beside it are not its own.
    """
    whole = _checked(path, _Whole)
    tool = ToolFile(**whole.model_dump(exclude={"format", "checksum"}))
    if whole.checksum != checksum(tool.model_dump()):
        raise ProfileError(
            path,
            "is not whole: its checksum does not fit what stands in it; it was changed. Keep the tool "
            "set anew",
        )
    if (tool.name, tool.machine) != (name, machine):
        raise ProfileError(
            path,
            f"is tool set {tool.name!r} of machine {tool.machine}, not {name!r} of {machine}. Keep the "
            "tool set anew",
        )
    beside = path.with_name("parameters.yaml")
    if tool.parameters != file_checksum(beside):
        raise ProfileError(
            beside,
            f"holds other parameters than those that were kept as {name}; its checksum is another than "
            f"{path.name} says. Keep the tool set anew",
        )
    return tool


def file_checksum(path: Path) -> str:
    """Return the SHA-256 of a file; raise ProfileError if it can not be read."""
    try:
        return hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError as error:
        raise ProfileError(path, f"can not be read: {error.strerror}") from None


def trial_of(path: Path, records: Sequence[DriveRecord]) -> tuple[bool, Figures]:
    """Return whether what was written stood its trial, and what that measured.

    Not verified is what may not be stored either: with a bound above the usual one, or compared with
    no identified model.

    Parameters
    ----------
    path
        ``verification.yaml``.
    records
        Of the journal: what was written.

    Raises
    ------
    ProfileError
        If the file is there and is none.
    """
    if not path.is_file():
        return False, {}
    found = _checked(path, _Verification)
    written = {
        (record.axis, str(entry.info.address)): entry.after
        for record in records
        for entry in record.entries
    }
    tried = {(p.axis, p.object): p.raw for p in found.parameters}
    bound = inf if found.bound is None else found.bound
    unfit = why_not_stored(bound, identified=found.model == "identified")
    if found.verdict != "verified" or tried != written or unfit:
        return False, {}
    return True, {
        axis.axis: {name: getattr(axis.after, name) for name in FIGURES}
        for axis in found.axes
        if axis.after is not None
    }


def _checked(path: Path, schema: type[Schema]) -> Schema:
    data, lines = read_yaml(path)
    try:
        return schema.model_validate(data)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        place = tuple(part for part in first["loc"] if not _names_a_type(part))
        said = _problem(first, place_words(place, data))
        raise ProfileError(path, said, line_of(lines, place)) from None


def _names_a_type(part: str | int) -> bool:
    """Pydantic puts the tried member of a union into the path; a person does not look for it."""
    return part in ("int", "float", "str") or (isinstance(part, str) and "[" in part)


def _problem(error: Mapping[str, Any], place: str) -> str:
    if error["type"] == "missing":
        return f"the key '{place}' is missing"
    if error["type"] == "extra_forbidden":
        return f"the key '{place}' is not known"
    return f"'{place}': {problem_words(error)}"
