"""EDS and DCF files (CiA 306): read with ``canopen``'s reader, whatever is wrong said in a sentence.

The reader raises whatever its parser stumbles upon, and believes what a file says of its own size;
so a file is looked at before it is handed over.
"""

import re
from functools import lru_cache
from io import StringIO
from pathlib import Path

from canopen.objectdictionary import (
    ObjectDictionary,
    ODArray,
    ODRecord,
    ODVariable,
    datatypes,
    import_od,
)

from drives.errors import ProfileError, UserStopError
from drives.objects import DATA_TYPES, DataType, ObjectAddress, ObjectInfo, type_range

MAX_EDS_BYTES = 5_000_000
"""The largest files of real drives have about 1 MB."""
MAX_OBJECTS = 0x10000
FIRST_OBJECT = 0x1000
"""Below are data types."""
_MANDATORY = ("mandatoryobjects", "optionalobjects", "manufacturerobjects")
_SECTION = re.compile(r"^\s*\[([^\]\r\n]*)\]", re.MULTILINE)
_COMPACT = re.compile(r"^\s*(?:CompactSubObj|SubNumber|NrOfEntries)\s*[=:]\s*(\S+)", re.M | re.I)
_MOST_SUBINDICES = 255
_READABLE = ("ro", "rw", "rwr", "rww", "const")
WRITABLE = ("rw", "rwr", "rww")
TYPE_OF_CODE: dict[int, DataType] = {
    getattr(datatypes, name): name for name in DATA_TYPES if hasattr(datatypes, name)
}
"""Data type by its number in EDS files."""


def read_eds(path: Path) -> ObjectDictionary:
    """Return the dictionary that an EDS or DCF file describes.

    Files are read once; the dictionary is shared and must not be changed.

    Raises
    ------
    ProfileError
        If the file can not be read, is too large, or is no EDS: with what is wrong, and what to do.
    """
    try:
        status = path.stat()
    except OSError as error:
        raise ProfileError(path, f"can not be read: {error.strerror}") from None
    if status.st_size > MAX_EDS_BYTES:
        raise ProfileError(
            path,
            f"is too large for an EDS: {status.st_size} bytes; at most {MAX_EDS_BYTES} are read",
        )
    return _read(path.absolute(), status.st_mtime_ns)


@lru_cache(maxsize=64)
def _read(path: Path, _changed: int) -> ObjectDictionary:
    try:
        text = _decoded(path.read_bytes())
    except OSError as error:
        raise ProfileError(path, f"can not be read: {error.strerror}") from None
    _check_shape(path, text)
    source = StringIO(text)
    source.name = str(path.with_suffix(".eds"))  # by which the reader knows what it is
    try:
        dictionary = import_od(source)
    except RecursionError:
        raise ProfileError(path, "is no EDS that can be read: it refers to itself") from None
    except UserStopError:
        raise
    except Exception as error:  # the EDS reader raises whatever its parser stumbles upon
        said = " ".join(str(error).split())[:160] or type(error).__name__
        raise ProfileError(
            path, f"is no EDS that can be read: {said}. Export it anew from the maker's software"
        ) from None
    if not len(dictionary):
        raise ProfileError(path, "is no EDS: it describes no object")
    return dictionary


def _decoded(data: bytes) -> str:
    """Return a file's text: UTF-8, or the code page of Western Windows, as makers write names."""
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        return data.decode("latin-1")


def _check_shape(path: Path, text: str) -> None:
    if "\0" in text:
        raise ProfileError(
            path, "is no EDS: it is not plain text (UTF-16 or binary?); save it as ASCII or UTF-8"
        )
    sections = [name.strip().lower() for name in _SECTION.findall(text)]
    if not any(name in sections for name in _MANDATORY):
        raise ProfileError(
            path,
            "is no EDS: it has none of the sections [MandatoryObjects], [OptionalObjects] and "
            "[ManufacturerObjects]",
        )
    if len(sections) > 4 * MAX_OBJECTS:
        raise ProfileError(path, f"describes too many objects: {len(sections)} sections")
    for match in _COMPACT.finditer(text):
        try:
            count = int(match.group(1), 0)
        except ValueError:
            continue
        if count > _MOST_SUBINDICES + 1:
            line = text.count("\n", 0, match.start()) + 1
            raise ProfileError(
                path, f"says that an object has {count} sub-indices; 255 is the most there is", line
            )


def variables(dictionary: ObjectDictionary) -> list[ODVariable]:
    """Return all entries, by index and sub-index; data types that only fill gaps in PDOs left out."""
    found: list[ODVariable] = []
    for index in sorted(i for i in dictionary if i >= FIRST_OBJECT):
        entry = dictionary[index]
        if isinstance(entry, ODRecord | ODArray):
            found += [entry.subindices[k] for k in sorted(entry.subindices)]
        else:
            found.append(entry)
    return found


def variable_at(dictionary: ObjectDictionary, address: ObjectAddress) -> ODVariable | None:
    """Return one entry, None if the file has none."""
    entry = dictionary.get(address.index)
    if entry is None:
        return None
    if isinstance(entry, ODVariable):
        return entry if address.subindex == 0 else None
    variable = entry.subindices.get(address.subindex)
    if variable is None and isinstance(entry, ODArray):
        variable = dictionary.get_variable(address.index, address.subindex)
    return variable if isinstance(variable, ODVariable) else None


def info_at(dictionary: ObjectDictionary, address: ObjectAddress) -> ObjectInfo | None:
    """Return address, type and name of an entry; None if there is none, or of a type not known."""
    variable = variable_at(dictionary, address)
    if variable is None or variable.data_type not in TYPE_OF_CODE:
        return None
    return ObjectInfo(address, TYPE_OF_CODE[variable.data_type], variable.name)


def range_at(dictionary: ObjectDictionary | None, info: ObjectInfo) -> tuple[int, int] | None:
    """Return smallest and largest whole number that an entry takes, by its type and its limits.

    None if it holds no whole numbers.  Limits that leave nothing are no limits.
    """
    try:
        low, high = type_range(info.type)
    except ValueError:
        return None
    variable = None if dictionary is None else variable_at(dictionary, info.address)
    told = (None, None) if variable is None else (variable.min, variable.max)
    least = low if told[0] is None else max(low, int(told[0]))
    most = high if told[1] is None else min(high, int(told[1]))
    return (least, most) if least < most else (low, high)


def default_at(dictionary: ObjectDictionary, address: ObjectAddress) -> int | None:
    """Return the whole number that a DCF says an entry holds, else its default, None if neither."""
    variable = variable_at(dictionary, address)
    if variable is None:
        return None
    for value in (getattr(variable, "value", None), variable.default):
        if isinstance(value, int):
            return value
    return None


def readable(variable: ODVariable) -> bool:
    """Whether an entry can be read."""
    return str(variable.access_type).lower() in _READABLE


def writable(variable: ODVariable) -> bool:
    """Whether an entry can be read and written."""
    return str(variable.access_type).lower() in WRITABLE
