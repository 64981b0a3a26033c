"""YAML files read safely: bounded size, no aliases, no double keys, and the line of every fault.

A file is checked against a pydantic model; what does not fit is reported with file and line.
"""

from collections.abc import Hashable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, TypeVar

import yaml
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError

from drives.profile.plain_words import (
    UNBUILT,
    misread,
    place_words,
    problem_words,
    syntax_words,
)
from fieldtool.errors import FileFormatError
from fieldtool.records.files import MEBIBYTE, read_text, write_atomic

MAX_BYTES = 1 * MEBIBYTE
MAX_DEPTH = 30
"""Of lists and mappings inside each other."""
Path_ = tuple[str | int, ...]
Model = TypeVar("Model", bound=BaseModel)


def _no_truth_value(value: object) -> object:
    if isinstance(value, bool):
        raise ValueError("expected a number, got yes/no")  # noqa: TRY004 - pydantic wants ValueError
    return value


Number = Annotated[float, BeforeValidator(_no_truth_value), Field(allow_inf_nan=False)]
"""A finite number; ``1e-3``, which YAML takes for text, counts too; yes/no does not."""
Count = Annotated[int, BeforeValidator(_no_truth_value), Field(ge=1)]
"""A whole number from 1."""


class StrictModel(BaseModel):
    """Base of all file schemas: unknown keys are refused."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class PartModel(BaseModel):
    """Base of what is read of a file that has more in it: unknown keys are passed over."""

    model_config = ConfigDict(extra="ignore", frozen=True)


def read_checked(path: Path | str, schema: type[Model]) -> tuple[Model, Mapping[Path_, int]]:
    """Return the file as an instance of ``schema``, and the line of every key in it.

    The lines are found under the path of keys and list positions, such as
    ``("axes", 0, "kind")``.

    Raises
    ------
    FileFormatError
        With the line of the first fault: not YAML, an alias, a double or unknown key, a number
        that YAML reads otherwise than it looks, a missing key, a value of the wrong type or outside
        its range.
    """
    text = read_text(path, MAX_BYTES)
    data, lines = _parse(Path(path), text)
    try:
        return schema.model_validate(data), lines
    except ValidationError as error:
        faults = error.errors(include_url=False)  # a misspelled key is unknown and missing at once
        first = min(faults, key=lambda fault: fault["type"] != "extra_forbidden")
        where = tuple(part for part in first["loc"] if not _names_a_type(part))
        raise FileFormatError(path, _sentence(first, where, data), line_of(lines, where)) from error


def line_of(lines: Mapping[Path_, int], where: Sequence[str | int]) -> int | None:
    """Return the line of the innermost part of ``where`` that the file has."""
    where = tuple(where)
    for length in range(len(where), -1, -1):
        if where[:length] in lines:
            return lines[where[:length]]
    return None


def write_yaml(path: Path | str, data: Mapping[str, Any]) -> None:
    """Write plain values as YAML, keys in the given order; numbers survive exactly.

    Raises
    ------
    OutputError
        If the file can not be written.
    """
    text = yaml.safe_dump(
        plain(data), sort_keys=False, allow_unicode=True, default_flow_style=None, width=100
    )
    write_atomic(path, text.encode("utf-8"))


def plain(value: Any) -> Any:
    """Return ``value`` with numpy numbers, tuples and mappings made plain Python values."""
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    return value.item() if hasattr(value, "item") else value


def _names_a_type(part: str | int) -> bool:
    """Pydantic puts the tried member of a union into the path; a person does not look for it."""
    return isinstance(part, str) and (part.startswith("_") or "[" in part)


def _sentence(error: Mapping[str, Any], where: Path_, data: Any) -> str:
    name = place_words(where, data) or "the file"
    kind = error["type"]
    if kind == "missing":
        return f"the key '{name}' is missing."
    if kind == "extra_forbidden":
        return f"the key '{name}' is not known: check its spelling."
    return f"'{name}': {problem_words(error)}."


def _parse(path: Path, text: str) -> tuple[Any, dict[Path_, int]]:
    try:
        _refuse_tricks(path, text)
        root = yaml.compose(text, Loader=yaml.SafeLoader)
        if root is None:
            raise FileFormatError(path, "is empty.")
        lines: dict[Path_, int] = {}
        _collect_lines(path, root, (), lines)
        return yaml.safe_load(text), lines
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark
        problem = f"is not valid YAML: {syntax_words(error.problem or error.context)}."
        raise FileFormatError(path, problem, _line(mark)) from error
    except yaml.YAMLError as error:
        problem = " ".join(str(error).split())
        raise FileFormatError(path, f"is not valid YAML: {problem}.") from error
    except UNBUILT as error:
        raise FileFormatError(path, f"has a value YAML can not build: {error}.") from error


def _line(mark: Any) -> int | None:
    """Return the line of a YAML mark, from 1; None where the parser gives none."""
    return None if mark is None else int(mark.line) + 1


def _refuse_tricks(path: Path, text: str) -> None:
    depth = 0
    for event in yaml.parse(text, Loader=yaml.SafeLoader):
        depth += isinstance(event, yaml.CollectionStartEvent)
        depth -= isinstance(event, yaml.CollectionEndEvent)
        if depth > MAX_DEPTH:
            raise FileFormatError(
                path, "is nested too deeply to be a sensible file.", _line(event.start_mark)
            )
        if isinstance(event, yaml.AliasEvent):
            raise FileFormatError(
                path, "uses a YAML alias (*): write the values out.", _line(event.start_mark)
            )


def _collect_lines(path: Path, node: yaml.Node, where: Path_, lines: dict[Path_, int]) -> None:
    lines.setdefault(where, node.start_mark.line + 1)
    if isinstance(node, yaml.SequenceNode):
        for index, item in enumerate(node.value):
            _collect_lines(path, item, (*where, index), lines)
    elif isinstance(node, yaml.MappingNode):
        seen: set[Hashable] = set()
        for key, item in node.value:
            line = key.start_mark.line + 1
            if not isinstance(key, yaml.ScalarNode):
                raise FileFormatError(path, "has a key that is not a plain word.", line)
            if key.value in seen:
                raise FileFormatError(path, f"has the key '{key.value}' twice.", line)
            seen.add(key.value)
            lines[*where, key.value] = line
            _collect_lines(path, item, (*where, key.value), lines)
    elif node.tag.endswith((":int", ":float")) and (why := misread(node.value)):
        raise FileFormatError(path, f"{why}.", node.start_mark.line + 1)
