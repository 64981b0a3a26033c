"""Files that somebody changed: their plain values, their text, or their bytes."""

import copy
from collections.abc import Callable, Iterator
from typing import Any

import yaml
from hypothesis import strategies as st

STRANGE = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(-(2**70), 2**70),
    st.floats(),
    st.text(st.characters(codec="ascii", exclude_categories=["Cc"]), max_size=12),
    st.sampled_from(["0x6040", "0x2010:01", "UNSIGNED32", "REAL64", "open", "stored", "../a", ""]),
    st.lists(st.integers(), max_size=2),
    st.dictionaries(st.text(max_size=3), st.integers(), max_size=2),
    st.dates(),
    st.binary(max_size=4),
)
RAW = (
    "0x" + "f" * 5000,
    "9" * 5000,
    "1e999",
    "-.inf",
    ".nan",
    "190:20:30",
    "2020-13-45",
    "!!python/object/apply:os.system ['true']",
    "!!binary x",
    "!!float abc",
    "!!int [1]",
    "!!int ''",
    "!!bool maybe",
    "!!timestamp 1",
    "&a [1]",
    "*a",
    "<<: {a: 1}",
    "{" * 50,
    "[" * 5000,
    "? [1, 2]\n: 3",
    '"\\e[31mred\\a"',
    "'" + "x" * 5000 + "'",
    "| \n  a\n\n  b",
    "\t",
    "\x00",
    "\u202e\ufeff",
    "@",
    "%",
    "",
)
"""What can stand in YAML in place of a value: tags, aliases, numbers beyond any type, depth, noise."""
LONGEST = 1500
"""Characters that an error may have, its path left out."""


def places(value: Any, where: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Yield every place inside plain values."""
    yield where
    if isinstance(value, dict | list):
        items = value.items() if isinstance(value, dict) else enumerate(value)
        for key, part in items:
            yield from places(part, (*where, key))


def changed(data: Any, where: tuple[Any, ...], new: Any, how: str) -> Any:
    """Return a copy with one place replaced, taken out, or doubled."""
    data = copy.deepcopy(data)
    inside = data
    for key in where[:-1]:
        inside = inside[key]
    if how == "replace":
        inside[where[-1]] = new
    elif how == "remove":
        del inside[where[-1]]
    elif isinstance(inside, list):
        inside.append(copy.deepcopy(inside[where[-1]]))
    else:
        inside[f"{where[-1]}-2"] = new
    return data


@st.composite
def changed_yaml(draw: st.DrawFn, text: str) -> bytes:
    """A YAML file with one or two values replaced, taken out or doubled, a word or bytes changed."""
    way = draw(st.sampled_from(["value", "value", "word", "bytes"]))
    if way == "value":
        data = yaml.safe_load(text)
        for _ in range(draw(st.integers(1, 2))):
            where = draw(st.sampled_from([w for w in places(data) if w]))
            how = draw(st.sampled_from(["replace", "remove", "double"]))
            data = changed(data, where, draw(STRANGE), how)
        return yaml.safe_dump(data, sort_keys=False).encode()
    raw = text.encode()
    if way == "word":
        begin, end = draw(st.sampled_from(scalars_of(text)))
        return (text[:begin] + draw(st.sampled_from(RAW)) + text[end:]).encode()
    return noisy(draw, raw)


def noisy(draw: st.DrawFn, raw: bytes) -> bytes:
    """Bytes with some replaced, left out or put in."""
    at, left_out = draw(st.integers(0, len(raw))), draw(st.integers(0, 40))
    return raw[:at] + draw(st.binary(max_size=40)) + raw[at + left_out :]


def scalars_of(text: str) -> list[tuple[int, int]]:
    """Where each word of a YAML text begins and ends."""
    return [(n.start_mark.index, n.end_mark.index) for n in _scalars(yaml.compose(text))]


def _scalars(node: yaml.Node) -> Iterator[yaml.ScalarNode]:
    if isinstance(node, yaml.ScalarNode):
        yield node
        return
    for part in node.value:
        for inner in part if isinstance(part, tuple) else (part,):
            yield from _scalars(inner)


def in_words(read: Callable[[], Any], error: type[Exception]) -> Any:
    """Return what is read, or None where it is refused: by this error alone, in one short line."""
    try:
        return read()
    except error as refused:
        said = str(refused)
        assert "Traceback" not in said
        assert said.isprintable(), repr(said)
        assert len(said) < LONGEST + 200, len(said)
        return None
