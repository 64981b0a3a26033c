"""Pictures of where a simulation is wrong as values; ``criticism-views.h5`` holds them."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, cast, get_args

import h5py
import numpy as np
from numpy.typing import NDArray

from fieldtool.records.hdf5_file import MemoryFile, Reader, opened, put

FloatArray = NDArray[np.float64]
FORMAT = "fieldtool-views/1"
Kind = Literal[
    "frequency", "lines", "amplitude", "velocity", "position", "time", "session", "axes", "follows"
]
NOISE_ONLY = "what is not explained is noise"
"""Sentence of a picture that shows nothing else."""


@dataclass(frozen=True, eq=False)
class Series:
    """One curve of a picture, or one row of bars."""

    label: str
    x: FloatArray
    y: FloatArray
    std: FloatArray | None = None
    """Standard error of y."""


@dataclass(frozen=True, eq=False)
class Picture:
    """One way to look at the error of one axis."""

    axis: str
    kind: Kind
    sentence: str
    x: str
    """What lies along the horizontal, with its unit."""
    y: str
    series: tuple[Series, ...]
    categories: tuple[str, ...] = ()
    """Names of the places 0, 1, ... of x, where these are no numbers."""
    logarithmic: bool = False


def save_pictures(pictures: Sequence[Picture], path: Path) -> None:
    """Write pictures to one HDF5 file, in one step.

    Raises
    ------
    OutputError
        If the file can not be written.
    """
    file = MemoryFile(FORMAT)
    try:
        root = file.root.create_group("pictures")
        for number, one in enumerate(pictures):
            group = root.create_group(f"{number:04d}")
            for name in ("axis", "kind", "sentence", "x", "y"):
                group.attrs[name] = getattr(one, name)
            group.attrs["logarithmic"] = int(one.logarithmic)
            words = np.array(one.categories, dtype=object)
            group.attrs.create("categories", words, dtype=h5py.string_dtype())
            held = group.create_group("series")
            for place, series in enumerate(one.series):
                curve = held.create_group(f"{place:04d}")
                curve.attrs["label"] = series.label
                put(curve, "x", series.x)
                put(curve, "y", series.y)
                if series.std is not None:
                    put(curve, "std", series.std)
        file.write(path)
    finally:
        file.close()


def load_pictures(path: Path) -> tuple[Picture, ...]:
    """Return the pictures in the file ``path``.

    Raises
    ------
    FileFormatError
        If it is missing, damaged, or of another format.
    """
    with opened(path, FORMAT) as reader:
        return tuple(_read(one) for one in reader.child("pictures").children())


def _read(reader: Reader) -> Picture:
    kind = reader.text("kind")
    if kind not in get_args(Kind):
        raise reader.fault(f"no picture is of kind {kind!r}.")
    series = []
    for one in reader.child("series").children():
        x, y = one.array("x", np.float64, 1), one.array("y", np.float64, 1)
        std = one.optional_array("std", np.float64, 1)
        if x.shape != y.shape or (std is not None and std.shape != y.shape):
            raise one.fault("x, y and std are not of one length.")
        series.append(Series(one.text("label"), x, y, std))
    categories = reader.texts("categories")
    for curve in series if categories else ():
        if not np.all(np.isin(curve.x, np.arange(len(categories)))):
            raise reader.fault(f"{curve.label}: x is no place among {len(categories)} categories.")
    return Picture(
        reader.text("axis"),
        cast("Kind", kind),
        reader.text("sentence"),
        reader.text("x"),
        reader.text("y"),
        tuple(series),
        categories,
        bool(reader.number("logarithmic")),
    )
