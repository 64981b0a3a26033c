"""EDS and DCF files (CiA 306) as entries of the simulated drive.

Read by hands of its own, not by the host's reader: what one of them misunderstands then shows as a
difference between host and drive.
"""

import re
from codecs import BOM_UTF8
from configparser import Error, RawConfigParser
from pathlib import Path

from durand.datatypes import DatatypeEnum as Type
from durand.datatypes import is_float, is_numeric, range_dict

from drives.sim.entries import Entry, ObjectEntry

_OBJECT = re.compile(r"([0-9A-F]{4})", re.IGNORECASE)
_SUB = re.compile(r"([0-9A-F]{4})sub([0-9A-F]{1,2})", re.IGNORECASE)
_NODE_ID = "$NODEID"
_TEXTS = (Type.VISIBLE_STRING, Type.OCTET_STRING, Type.DOMAIN)
_ACCESS = {"ro": "ro", "wo": "wo", "const": "const", "rw": "rw", "rwr": "rw", "rww": "rw"}


class EdsFileError(ValueError):
    """The file can not be read as an EDS."""


class EdsFile:
    """An EDS or DCF file; its entries by index.

    Raises
    ------
    EdsFileError
        If the file can not be read.
    """

    def __init__(self, path: Path) -> None:
        self._ini = RawConfigParser(strict=False, comment_prefixes=(";",), delimiters=("=",))
        try:
            self._ini.read_string(path.read_bytes().removeprefix(BOM_UTF8).decode("latin-1"))
        except (OSError, Error) as error:
            raise EdsFileError(f"{path}: can not be read as an EDS ({error})") from error
        self.objects: dict[int, ObjectEntry] = {}
        subs: dict[int, list[Entry]] = {}
        for section in self._ini.sections():
            match = _SUB.fullmatch(section)
            if match:
                index, subindex = (int(text, 16) for text in match.groups())
                subs.setdefault(index, []).append(self._entry(section, index, subindex))
        for section in self._ini.sections():
            if _OBJECT.fullmatch(section):
                index = int(section, 16)
                self.objects[index] = self._object(section, index, subs.get(index, []))

    def device(self, key: str) -> int:
        """Return a number of the section [DeviceInfo], 0 if there is none."""
        return _whole(self._ini.get("DeviceInfo", key, fallback="") or "0")[0]

    def _object(self, section: str, index: int, subs: list[Entry]) -> ObjectEntry:
        name = self._ini.get(section, "ParameterName", fallback=section)
        kind = _whole(self._ini.get(section, "ObjectType", fallback="7"))[0]
        if kind not in (8, 9):
            return ObjectEntry(index, name, (self._entry(section, index, 0),), is_variable=True)
        if not subs:
            count = _whole(self._ini.get(section, "CompactSubObj", fallback="0"))[0]
            first = Entry(index, 0, "Highest sub-index", Type.UNSIGNED8, "ro", default=count)
            subs = [first, *(self._entry(section, index, k) for k in range(1, count + 1))]
        ordered = tuple(sorted(subs, key=lambda e: e.subindex))
        return ObjectEntry(index, name, ordered, is_array=kind == 8)

    def _entry(self, section: str, index: int, subindex: int) -> Entry:
        get = self._ini.get
        kind = _type(get(section, "DataType", fallback="5"))
        text = get(section, "ParameterValue", fallback="") or get(
            section, "DefaultValue", fallback=""
        )
        default, relative = _value(kind, text)
        low, high = (
            _value(kind, limit)[0] if limit and is_numeric(kind) and _NODE_ID not in limit else None
            for limit in (get(section, key, fallback="") for key in ("LowLimit", "HighLimit"))
        )
        if low is not None and high is not None and float(low) >= float(high):
            low = high = None
        return Entry(
            index,
            subindex,
            get(section, "ParameterName", fallback=section),
            kind,
            _ACCESS.get(get(section, "AccessType", fallback="ro").strip().lower(), "ro"),
            default=default,
            low=None if low is None else float(low),
            high=None if high is None else float(high),
            mappable=_whole(get(section, "PDOMapping", fallback="0") or "0")[0] == 1,
            plus_node_id=relative,
        )


def _type(text: str) -> Type:
    try:
        kind = Type(_whole(text)[0])
    except ValueError:
        return Type.DOMAIN
    return kind if is_numeric(kind) or kind in _TEXTS else Type.DOMAIN


def _value(kind: Type, text: str) -> tuple[int | float | bytes, bool]:
    """Return a value, and whether the node id is to be added."""
    if not is_numeric(kind):
        return text.encode("ascii", errors="replace"), False
    if not text.strip():
        return 0, False
    if is_float(kind):
        try:
            return float(text), False
        except ValueError:
            return 0.0, False
    value, relative = _whole(text)
    low, high = range_dict[kind]
    if low < 0 and high < value <= 2 * high + 1:
        value -= 2 * (high + 1)  # written as the bits of a negative number
    return min(max(value, low), high), relative


def _whole(text: str) -> tuple[int, bool]:
    relative = _NODE_ID in text.upper()
    bare = re.sub(r"\$NODEID\s*\+?|\+?\s*\$NODEID", "", text, flags=re.IGNORECASE).strip() or "0"
    for base in (0, 10):
        try:
            return int(bare, base), relative
        except ValueError:
            continue
    return 0, relative
