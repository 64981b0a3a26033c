"""YAML files as plain values, with the line of every key; what could do harm is refused."""

from pathlib import Path
from typing import Any

import yaml

from drives.errors import ProfileError
from drives.profile.plain_words import UNBUILT, misread, syntax_words

MAX_PROFILE_BYTES = 1_000_000
MAX_DEPTH = 30
"""Of lists and mappings inside each other."""
_LOADER: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)

Location = tuple[str | int, ...]
Lines = dict[Location, int]
"""Place of a key or item: its line."""


def line_of(lines: Lines, location: tuple[str | int, ...]) -> int | None:
    """Return the line of a place, or of the nearest place around it."""
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
        If the file can not be read, is too large, is no YAML, uses aliases, has a key twice or a
        number that YAML reads otherwise than it looks, or is no mapping.
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
            path, f"is no YAML: {syntax_words(error.problem)}", mark.line + 1 if mark else None
        ) from None
    except (yaml.YAMLError, RecursionError) as error:
        raise ProfileError(path, f"is no YAML: {' '.join(str(error).split())}") from None
    except UNBUILT as error:
        raise ProfileError(path, f"has a value YAML can not build: {error}") from None


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
        before = ""
        for key, value in node.value:
            if before.isdigit() and str(key.value)[:1].isdigit() and value.value == "":
                raise ProfileError(
                    path,
                    f"a number is written with a point, not with a comma: {before}.{key.value}",
                    key.start_mark.line + 1,
                )
            before = str(value.value)
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
    elif node.tag.endswith((":int", ":float")) and (why := misread(node.value)):
        raise ProfileError(path, why, node.start_mark.line + 1)
