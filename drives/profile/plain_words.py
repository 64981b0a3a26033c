"""What is wrong with a YAML file, in the words of people who write one once a year."""

import re
from collections.abc import Mapping, Sequence
from typing import Any

from drives.units import unit_on

UNBUILT = (ValueError, TypeError, LookupError, AttributeError)
"""What the YAML library raises where a value is not of the type that stands before it: ``!!int x``."""
Place = tuple[str | int, ...]
_COMMA = re.compile(r"\s*([+-]?\d+),(\d+)(\s.*)?")
_UNDER = "this line does not stand under the ones above"
_OPEN = "is opened and not closed, or a comma is missing, in this line or the one above it"
_SYNTAX: tuple[tuple[str, str], ...] = (
    ("tab", "a line begins with a tab: indent with blanks"),
    (
        "could not find expected ':'",
        "a key needs a colon and a blank after it, as in `key: value`; look at this line and the "
        "one above it",
    ),
    (
        "unexpected end of stream",
        "a quote or a bracket is opened and not closed before this line",
    ),
    (
        "did not find expected '-' indicator",
        f"{_UNDER}: all lines of an item begin in one column",
    ),
    ("expected ',' or ']'", f"a bracket [ {_OPEN}"),
    ("expected ',' or '}'", f"a brace {{ {_OPEN}"),
    (
        "did not find expected key",
        f"{_UNDER}: all keys of one level begin in one column, and a list begins with -",
    ),
    (
        "mapping values are not allowed",
        "a second colon in one line, or a line that is indented too far: put text with a colon "
        "in quotes",
    ),
)
"""Part of a parser's complaint, and what it means."""
_POWER = re.compile(
    r"\s*([-+]?(?:\d{1,20}\.?\d{0,20}|\.\d{1,20}))e([-+]?)(\d{1,3})\s*", re.IGNORECASE
)
"""A power of ten; a text to YAML 1.1 but with a point and a sign, as 1.0e-3."""
_OCTAL = re.compile(r"[-+]?0[0-7_]+")
_PATTERNS = {
    r"^[A-Za-z][A-Za-z0-9_-]{0,31}$": "is a letter, then up to 31 letters, digits, _ or -, none with "
    "accents",
}
"""Regular expressions of values that a person writes, in words."""
LONGEST_NUMBER = 1000
"""Bits of a whole number that is shown; Python refuses to write very long ones out."""
LONGEST_TEXT = 60
"""Characters of a text that is shown."""


_WITH_UNIT = re.compile(r"\s*[-+]?\d[\d.]*(e[-+]?\d+)?\s*[^\s\d.,].*", re.IGNORECASE)
_BARE: Mapping[str, str] = {
    "bitrate": "bit/s",
    "feed": "m per encoder revolution",
    "torque_constant": "N m/A",
    "motor_inertia.value": "kg m2",
    "masses": "kg m2",
    "springs": "N m/rad",
    "dampers": "N m s/rad",
    "viscous_friction": "N m s/rad",
    "rated_torque": "N m",
    "peak_torque": "N m",
    "torque_noise": "N m",
    "typical_move.distance": "rad",
    "typical_move.velocity": "rad/s",
    "typical_move.acceleration": "rad/s2",
    "typical_move.jerk": "rad/s3",
    "typical_move.band": "rad",
    "loop.position_p": "1/s",
    "loop.velocity_p": "N m s/rad",
    "loop.velocity_i": "N m/rad",
    "loop.viscous_ff": "N m s/rad",
    "loop.inertia_ff": "kg m2",
}
"""Units on rotary axes of bare numbers in machine profiles, by the last keys of their place."""


def unit_of(place: Place, data: Any) -> str:
    """Return the unit of a bare number in a machine profile; empty where none is known.

    Parameters
    ----------
    place
        Keys and list positions.
    data
        The file's plain values, for the kinds of axes.
    """
    names = [part for part in place if isinstance(part, str)]
    unit = _BARE.get(".".join(names[-2:])) or _BARE.get("".join(names[-1:]), "")
    number = next((part for part in place if isinstance(part, int)), None)
    axes = data.get("axes") if isinstance(data, Mapping) else None
    if number is None or not isinstance(axes, list) or number >= len(axes):
        return unit
    linear = isinstance(axes[number], Mapping) and axes[number].get("kind") == "linear"
    return unit_on("linear", unit) if linear else unit


def syntax_words(problem: str | None) -> str:
    """Return what a YAML parser complains of, in words; its own where there are none."""
    for theirs, ours in _SYNTAX:
        if problem and theirs in problem:
            return ours
    return problem or "it can not be read"


def misread(text: str) -> str:
    """Return why a bare number of YAML 1.1 is not the one that its writer means; empty where it is.

    Parameters
    ----------
    text
        As it stands in the file, without quotes, where YAML takes it for a number.
    """
    if ":" in text:
        return f"{text} would be read to the base of 60: write the number out, or text in quotes"
    if _OCTAL.fullmatch(text) and int(text, 8) != int(text):
        return (
            f"{text} would be read to the base of 8: leave the leading 0 away (and if it stands behind "
            "a comma, write the number with a point)"
        )
    return ""


def place_words(place: Place, data: Any) -> str:
    """Return where something stands: axes by their names, items of lists by numbers from 1.

    Parameters
    ----------
    place
        Keys and list positions.
    data
        The file's plain values, for the names.
    """
    words: list[str] = []
    here = data
    for k, part in enumerate(place):
        if isinstance(part, int):
            name = _name_of(here, part, data, place[:k])
            if place[k - 1 : k] == ("axes",) and words:
                words[-1] = f"axis {name}" if name else f"axis number {part + 1}"
            else:
                words.append(f"number {part + 1}" + (f" ({name})" if name else ""))
            here = here[part] if isinstance(here, Sequence) and part < len(here) else None
        else:
            joined = bool(words) and not words[-1].startswith(("axis ", "number "))
            if joined and k and not isinstance(place[k - 1], int):
                words[-1] += f".{part}"
            else:
                words.append(part)
            here = here.get(part) if isinstance(here, Mapping) else None
    return ", ".join(words)


def _name_of(items: Any, number: int, data: Any, above: Place) -> str:
    """Return the name of an item of a list; of a simulated axis that of the axis it stands for."""
    item = items[number] if isinstance(items, Sequence) and number < len(items) else None
    if isinstance(item, Mapping) and isinstance(item.get("name"), str):
        return str(item["name"])
    if above[-1:] == ("axes",) and len(above) > 1 and isinstance(data, Mapping):
        return _name_of(data.get("axes"), number, None, ())
    return ""


def problem_words(error: Mapping[str, Any], unit: str = "") -> str:
    """Return what is wrong with a value, of one of pydantic's errors, with what was given.

    ``unit``: in which a number is meant that stands without one.
    """
    kind, given = str(error["type"]), error.get("input")
    limits: Mapping[str, Any] = error.get("ctx") or {}
    shown = f", not {_shown(given)}" if isinstance(given, str | int | float | bool) else ""
    if isinstance(given, str) and kind.startswith(("float", "int")) and _COMMA.fullmatch(given):
        return f"a number is written with a point: {_pointed(given)}{shown}"
    if isinstance(given, str) and kind.startswith(("float", "int")) and _POWER.fullmatch(given):
        return (
            f"{given.strip()} is text to YAML: write {_power(given, whole=kind.startswith('int'))}"
        )
    if kind in ("tuple_type", "list_type"):
        example = f", such as [{given}]" if type(given) is int and abs(given) < 10**9 else ""
        return f"a list in brackets belongs here{example}"
    if kind.startswith(("float", "int")):
        whole = "" if kind.startswith("float") else "whole "
        alone = isinstance(given, str) and _WITH_UNIT.fullmatch(given)
        without = " without a unit" if alone else ""
        return f"a {whole}number{without} belongs here{f', in {unit}' if unit else ''}{shown}"
    if kind.startswith("bool"):
        return f"true or false belongs here{shown}"
    if kind == "string_type":
        return f"text belongs here{shown} (put it in quotes if it is to be text)"
    if kind in ("model_type", "dict_type", "model_attributes_type"):
        return f"keys with values belong here, one a line and indented{shown}"
    if kind == "string_pattern_mismatch" and limits.get("pattern") in _PATTERNS:
        return f"{_PATTERNS[limits['pattern']]}{shown}"
    if kind in ("too_long", "too_short"):
        return _count_words(limits)
    if kind == "literal_error":
        return f"has to be {str(limits.get('expected')).replace(chr(39), '')}{shown}"
    for name, words in (("gt", "above"), ("ge", "at least"), ("lt", "below"), ("le", "at most")):
        if name in limits:
            comma = ""
            if given == 0 and isinstance(error["loc"][-1], int):
                comma = ". A comma ends a value: write numbers with a point, 0.02 and not 0,02"
            return f"has to be {words} {limits[name]}{shown}{comma}"
    message = str(error["msg"]).removeprefix("Value error, ")
    value = f" (value {_shown(given)})" if isinstance(given, str | int | float | bool) else ""
    return f"{message[0].lower()}{message[1:]}{value}"


def _count_words(limits: Mapping[str, Any]) -> str:
    most, least = limits.get("max_length"), limits.get("min_length")
    wanted = f"at most {most}" if most is not None else f"at least {least}"
    return f"{limits.get('actual_length')} values stand here, {wanted} belong here"


def _shown(given: object) -> str:
    if isinstance(given, int) and given.bit_length() > LONGEST_NUMBER:
        return f"a number of {given.bit_length()} bits"
    if isinstance(given, str) and len(given) > LONGEST_TEXT:
        return f"{given[:LONGEST_TEXT]!r} ..."
    return repr(given)


def _power(text: str, *, whole: bool) -> str:
    """Return a number of YAML 1.1 for a power of ten that is none to it."""
    number, sign, power = _POWER.sub(r"\1 \2 \3", text).split(" ")
    if whole and sign != "-" and int(power) < 10 and float(text).is_integer():
        return f"{float(text):.0f}"
    number = re.sub(r"^([-+]?)[.]", r"\g<1>0.", number if "." in number else f"{number}.0")
    return f"{number}e{sign or '+'}{power}"


def _pointed(text: str) -> str:
    return _COMMA.sub(r"\1.\2\3", text).strip()
