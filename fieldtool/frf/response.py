"""The frequency response of a machine as a value, and its file ``frequency-response.h5``.

Layout of the file (HDF5, format ``fieldtool-frequency-response/1``): group ``responses`` with one
group ``0000``, ... per response: attributes ``name``, ``condition``, ``axes``; datasets
``frequencies`` (F,), ``response`` (F, M, M) as pairs r, i, ``std`` (F, M, M), and, where errors of
the elements go together, ``covariance`` (F, M*M, M*M) as pairs r, i.  Where a model was fitted, group
``band`` with ``frequencies`` (B,) and ``relative_std`` (B, M, M).
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray

from fieldtool.records.hdf5_file import MemoryFile, Reader, opened, put

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
FORMAT = "fieldtool-frequency-response/1"


@dataclass(frozen=True, eq=False)
class FrequencyResponse:
    """Position of axis i per torque of axis j of M axes at F frequencies; NaN = not measured."""

    axes: tuple[str, ...]
    frequencies: FloatArray
    """(F,), Hz, rising."""
    response: ComplexArray
    """(F, M, M), rad/(N m) or m/N (or per A); [f, i, j] is position i per torque j."""
    std: FloatArray
    """(F, M, M): standard error of the real part, and of the imaginary part."""
    condition: str
    """What the axes that were not driven did: ``others free``, ``others locked``, ..."""
    covariance: ComplexArray | None = None
    """(F, M*M, M*M): E[e e^H] of the errors of the elements, row after row (element i, j at
    i * M + j), Hermitian; None where the errors of elements are independent.  NaN rows and columns
    where an element was not measured."""

    def __post_init__(self) -> None:
        F, M = self.frequencies.size, len(self.axes)
        if self.frequencies.shape != (F,) or M == 0:
            raise ValueError(f"frequencies must be (F,) and axes named, got {F} and {self.axes}")
        if not np.all(np.isfinite(self.frequencies)) or np.any(self.frequencies <= 0):
            raise ValueError("frequencies must be finite and above 0 Hz")
        if np.any(np.diff(self.frequencies) <= 0):
            raise ValueError("frequencies must rise, each there once")
        for name, values in (("response", self.response), ("std", self.std)):
            if values.shape != (F, M, M):
                raise ValueError(f"{name} must have shape {(F, M, M)}, got {values.shape}")
            if np.any(np.isinf(values)):
                raise ValueError(f"{name} must not be infinite")
        if not np.array_equal(np.isnan(self.response), np.isnan(self.std)):
            raise ValueError("response and std must be NaN at the same places")
        if np.any(self.std < 0):
            raise ValueError("std must not be negative")
        if self.covariance is not None:
            self._check_covariance(self.covariance)

    def _check_covariance(self, covariance: ComplexArray) -> None:
        F, M = self.frequencies.size, len(self.axes)
        if covariance.shape != (F, M * M, M * M):
            raise ValueError(
                f"covariance must have shape {(F, M * M, M * M)}, got {covariance.shape}"
            )
        variance = np.einsum("fkk->fk", covariance).real.reshape(F, M, M)
        there = self.measured
        if not np.allclose(variance[there], self.complex_std[there] ** 2, rtol=1e-6, atol=0.0):
            raise ValueError("the diagonal of covariance must be twice the square of std")

    @property
    def measured(self) -> NDArray[np.bool_]:
        """Where there is a value, (F, M, M)."""
        return ~np.isnan(self.response)

    @property
    def complex_std(self) -> FloatArray:
        """Square root of E|error|^2 of the complex value, (F, M, M): sqrt(2) times ``std``."""
        scaled: FloatArray = np.sqrt(2.0) * self.std
        return scaled

    def element(
        self, position: str | int, torque: str | int
    ) -> tuple[FloatArray, ComplexArray, FloatArray]:
        """Return frequencies, response and std of one element where it was measured, (f,) each."""
        i, j = self.index(position), self.index(torque)
        there = self.measured[:, i, j]
        return self.frequencies[there], self.response[there, i, j], self.std[there, i, j]

    def index(self, axis: str | int) -> int:
        """Return the place of an axis; KeyError if there is none of that name."""
        if isinstance(axis, str):
            if axis not in self.axes:
                raise KeyError(f"no axis '{axis}' among {', '.join(self.axes)}")
            return self.axes.index(axis)
        return range(len(self.axes))[axis]


@dataclass(frozen=True, eq=False)
class ModelBand:
    """How well the response of a fitted model is known."""

    frequencies: FloatArray
    """(B,), Hz."""
    relative_std: FloatArray
    """(B, M, M): standard error of the logarithm of the size."""

    def __post_init__(self) -> None:
        B = self.frequencies.size
        if not B or not 0 < self.frequencies[0] < np.inf or np.any(np.diff(self.frequencies) <= 0):
            raise ValueError("frequencies of a band must rise from above 0 Hz")
        if self.relative_std.ndim != 3 or self.relative_std.shape[0] != B:
            raise ValueError(
                f"relative_std must have shape {(B, 'M', 'M')}, got {self.relative_std.shape}"
            )


def save_responses(
    responses: Mapping[str, FrequencyResponse], path: Path | str, band: ModelBand | None = None
) -> None:
    """Write named responses to one file, in one step, with the band of the model fitted to them.

    Raises
    ------
    OutputError
        If the file can not be written.
    """
    file = MemoryFile(FORMAT)
    try:
        root = file.root.create_group("responses")
        for index, (name, response) in enumerate(responses.items()):
            group = root.create_group(f"{index:04d}")
            group.attrs["name"] = name
            group.attrs["condition"] = response.condition
            axes = np.array(response.axes, dtype=object)
            group.attrs.create("axes", axes, dtype=h5py.string_dtype())
            put(group, "frequencies", response.frequencies)
            put(group, "response", response.response)
            put(group, "std", response.std)
            if response.covariance is not None:
                put(group, "covariance", response.covariance)
        if band is not None:
            group = file.root.create_group("band")
            put(group, "frequencies", band.frequencies)
            put(group, "relative_std", band.relative_std)
        file.write(path)
    finally:
        file.close()


def load_responses(path: Path | str) -> dict[str, FrequencyResponse]:
    """Return the named responses in the file ``path``, in the order they were saved in.

    Raises
    ------
    FileFormatError
        If it is missing, no HDF5 file, of another format, damaged, or contradicts itself.
    """
    with opened(path, FORMAT) as reader:
        return dict(_read(group) for group in reader.child("responses").children())


def load_band(path: Path | str) -> ModelBand | None:
    """Return the band of the model in the file ``path``; None where it holds none.

    Raises
    ------
    FileFormatError
        As :func:`load_responses`.
    """
    with opened(path, FORMAT) as reader:
        if "band" not in reader.group:
            return None
        held = reader.child("band")
        return ModelBand(
            held.array("frequencies", np.float64, 1), held.array("relative_std", np.float64, 3)
        )


def _read(reader: Reader) -> tuple[str, FrequencyResponse]:
    response = FrequencyResponse(
        axes=reader.texts("axes"),
        frequencies=reader.array("frequencies", np.float64, 1),
        response=reader.array("response", np.complex128, 3),
        std=reader.array("std", np.float64, 3),
        condition=reader.text("condition"),
        covariance=reader.optional_array("covariance", np.complex128, 3),
    )
    return reader.text("name"), response
