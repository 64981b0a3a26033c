"""HDF5 files: written in memory and renamed into place whole, read with clear errors."""

from collections.abc import Iterator
from contextlib import contextmanager
from itertools import count
from mmap import ACCESS_READ, mmap
from pathlib import Path
from struct import Struct
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from fieldtool.errors import FileFormatError
from fieldtool.records.files import check_size, write_atomic

MAX_BYTES = 16 * 1024**3
DAMAGED = (OSError, RuntimeError, KeyError, TypeError, OverflowError, UnicodeError, MemoryError)
"""What h5py raises where a file's inner structure is not whole."""
MAX_VALUES = 500_000_000
"""Most values in one dataset that are read: 4 GB of float64."""
_HEAP, _HEAP_HEAD = b"GCOL\1\0\0\0", 16
"""How a global heap begins: signature, version, nothing; and bytes until its first entry."""
_ENTRY = Struct("<H6xQ")
"""Number, 0 for free room, and size."""


_numbers = count()


class MemoryFile:
    """An HDF5 file in memory; :meth:`write` puts a whole, valid copy of it on the disk.

    The file on the disk is replaced in one step, so it is valid at any moment, also when the
    program or the power goes.  It costs one copy of the (compressed) file in memory.
    """

    def __init__(self, file_format: str) -> None:
        name = f"in-memory-{next(_numbers)}.h5"  # HDF5 opens none twice, not in memory either
        self.root = h5py.File(name, "w", driver="core", backing_store=False)
        self.root.attrs["format"] = file_format

    def write(self, path: Path | str) -> None:
        """Replace ``path`` by the present content; raise OutputError if that is not possible."""
        self.root.flush()
        write_atomic(path, self.root.id.get_file_image())

    def close(self) -> None:
        """Forget the content; calling it twice does no harm."""
        self.root.close()


def put(group: Any, name: str, values: NDArray[Any]) -> None:
    """Store an array, compressed without loss."""
    packed = {"compression": "gzip", "compression_opts": 4, "shuffle": True} if values.size else {}
    group.create_dataset(name, data=values, **packed)


class Reader:
    """One group of an HDF5 file; whatever is missing or of a wrong type names file and place."""

    def __init__(self, path: Path, group: Any) -> None:
        self.path, self.group = path, group

    def fault(self, message: str) -> FileFormatError:
        """Return an error about this group."""
        return FileFormatError(self.path, f"in {self.group.name}: {message}")

    def child(self, name: str) -> "Reader":
        """Return the group ``name`` inside this one."""
        found = self.group.get(name)
        if not isinstance(found, h5py.Group):
            raise self.fault(f"the group '{name}' is missing; the file is damaged or of another "
                             "program.")  # fmt: skip
        return Reader(self.path, found)

    def children(self) -> list["Reader"]:
        """Return all groups inside this one, by rising name."""
        return [self.child(name) for name in sorted(self.group)]

    def rows(self, name: str) -> int:
        """Return how many rows the dataset ``name`` has; nothing of it is read."""
        found = self._dataset(name)
        if not found.ndim:
            raise self.fault(f"the dataset '{name}' is one value and has no rows.")
        return int(found.shape[0])

    def array(self, name: str, dtype: Any, ndim: int) -> NDArray[Any]:
        """Return the dataset ``name`` as an array of ``ndim`` dimensions and type ``dtype``."""
        found = self._dataset(name)
        if found.ndim != ndim or found.size > MAX_VALUES:
            raise self.fault(f"the dataset '{name}' has the shape {found.shape}, which is "
                             f"not {ndim}-dimensional or above {MAX_VALUES} values.")  # fmt: skip
        if not np.can_cast(found.dtype, dtype, casting="safe"):
            raise self.fault(f"the dataset '{name}' holds {found.dtype}, expected {dtype}.")
        try:
            return np.asarray(found[()], dtype=dtype)
        except OSError as error:
            raise self.fault(f"the dataset '{name}' is damaged ({error}).") from error

    def _dataset(self, name: str) -> Any:
        found = self.group.get(name)
        if not isinstance(found, h5py.Dataset):
            raise self.fault(f"the dataset '{name}' is missing; the file is damaged or of another "
                             "program.")  # fmt: skip
        return found

    def optional_array(self, name: str, dtype: Any, ndim: int) -> NDArray[Any] | None:
        """Return the dataset ``name``, or None where the file has none."""
        return self.array(name, dtype, ndim) if name in self.group else None

    def text(self, name: str, default: str | None = None) -> str:
        """Return the text attribute ``name``."""
        value = self._attribute(name, default)
        if not _is_text(value):
            raise self.fault(f"the attribute '{name}' is no text.")
        return str(value)

    def texts(self, name: str) -> tuple[str, ...]:
        """Return the attribute ``name``, a list of texts."""
        value = np.atleast_1d(self._attribute(name))
        if not all(_is_text(item) for item in value):
            raise self.fault(f"the attribute '{name}' is no list of texts.")
        return tuple(str(item) for item in value)

    def number(self, name: str) -> float:
        """Return the number attribute ``name``."""
        value: Any = self._attribute(name)
        if isinstance(value, bool) or not isinstance(value, int | float | np.integer | np.floating):
            raise self.fault(f"the attribute '{name}' is no number.")
        return float(value)

    def optional_number(self, name: str) -> float | None:
        """Return the number attribute ``name``, or None where the file has none."""
        return self.number(name) if name in self.group.attrs else None

    def _attribute(self, name: str, default: object | None = None) -> Any:
        value = _value(self.group, name)
        value = default if value is None else value
        if value is None:
            raise self.fault(f"the attribute '{name}' is missing; the file is damaged or of "
                             "another program.")  # fmt: skip
        return value


def _value(group: Any, name: str) -> Any:
    """Return an attribute; None where there is none, or it is a list of any length.

    No file has such lists, and one changed byte makes one of a text: of a kind that the HDF5 library
    (2.0) does not know, and whose values it looks for anywhere in memory.
    """
    attributes = group.attrs
    if name not in attributes or attributes.get_id(name).get_type().get_class() == h5py.h5t.VLEN:
        return None
    return attributes[name]


def _is_text(value: object) -> bool:
    """Whether it is text, and all of it can be written again: h5py reads other bytes as surrogates."""
    return isinstance(value, str) and not any("\ud800" <= c <= "\udfff" for c in value)


def _check_heaps(path: Path) -> None:
    """Refuse a file that would never let the HDF5 library go: free room of no size in a global heap.

    The library walks a heap by the sizes that stand in it (HDF5 file format, III.E "Global Heap").

    Raises
    ------
    FileFormatError
        If there is such a heap, or the file can not be read.
    """
    try:
        with path.open("rb") as file, mmap(file.fileno(), 0, access=ACCESS_READ) as data:
            at = data.find(_HEAP)
            while at >= 0:
                if _goes_round(data, at):
                    raise FileFormatError(path, f"is damaged (a heap without end at byte {at}).")
                at = data.find(_HEAP, at + 1)
    except OSError as error:
        raise FileFormatError(path, f"can not be read ({error.strerror}).") from error


def _goes_round(data: mmap, at: int) -> bool:
    """Whether who walks the heap that begins here would stand still."""
    if at + _HEAP_HEAD > len(data):
        return False
    end = min(at + int.from_bytes(data[at + 8 : at + 16], "little"), len(data))
    at += _HEAP_HEAD
    while at + _ENTRY.size <= end:
        number, size = _ENTRY.unpack_from(data, at)
        step = size if number == 0 else _ENTRY.size + (size + 7) // 8 * 8
        if step == 0:
            return True
        at += step
    return False


@contextmanager
def opened(path: Path | str, file_format: str) -> Iterator[Reader]:
    """Open ``path`` for reading and check what it says it is.

    Raises
    ------
    FileFormatError
        If it is no HDF5 file, its attribute ``format`` is not ``file_format``, or what is read of it
        inside the block is damaged or contradicts itself (ValueError).
    """
    path = Path(path)
    if check_size(path, MAX_BYTES):
        _check_heaps(path)
    try:
        file = h5py.File(path, "r")
    except DAMAGED as error:
        raise FileFormatError(
            path, f"is not a readable HDF5 file, expected {file_format}."
        ) from error
    with file:
        try:
            found = _value(file, "format")
            if not isinstance(found, str) or found != file_format:
                raise FileFormatError(
                    path,
                    f"has the format {found!r}, expected '{file_format}': it is of another "
                    "program or of a newer version.",
                )
            yield Reader(path, file)
        except DAMAGED as error:
            raise FileFormatError(path, f"is damaged ({error}).") from error
        except ValueError as error:
            raise FileFormatError(path, f"contradicts itself: {error}.") from error
