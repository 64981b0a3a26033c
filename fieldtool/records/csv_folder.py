"""A recording as a folder: ``recording.yaml`` beside one CSV file per experiment.

CSV: comma-separated, decimal point, one header line, one row per sample; columns ``time`` and for
each axis ``NAME.position`` and ``NAME.torque``, with ``NAME.position_reference`` or
``NAME.torque_reference`` (or both, or none on an axis that had no reference), optional
``NAME.velocity``, ``NAME.statusword`` and the axis's ``extra_columns`` as ``NAME.EXTRA``.  Other
columns are refused: a misspelled one must not be lost in silence.

``recording.yaml``: keys as in :class:`_RecordingFile`; positions in rad or m, torques in N m, N or
A.  Where axes of both kinds are in one folder, each axis has ``units`` of its own.  Beyond what
other programs need, an exported folder also names the free axes and the settled segments, so that
nothing is lost on the way back.
"""

import re
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from fieldtool.errors import FileFormatError
from fieldtool.records.files import check_size, make_folder, read_text, write_atomic
from fieldtool.records.recorded import (
    COLUMNS,
    AxisInfo,
    Controller,
    Experiment,
    ExperimentKind,
    FloatArray,
    Kind,
    PositionUnit,
    Recording,
    Segment,
    TorqueUnit,
    experiment_fault,
    grid_fault,
)
from fieldtool.records.yaml_file import (
    Count,
    Number,
    Path_,
    StrictModel,
    line_of,
    read_checked,
    write_yaml,
)

FORMAT = "fieldtool-recording/1"
RECORDING_FILE = "recording.yaml"
MAX_CSV_BYTES = 1024**3
_REFERENCES = ("position_reference", "torque_reference")
_NEWTON_METRES = {"Nm": "N m", "N·m": "N m", "N*m": "N m", "N.m": "N m"}
_PLAIN_FILE = re.compile(r"[^/\\:]+")


class _Units(StrictModel):
    time: Literal["s"] = "s"
    position: PositionUnit
    torque: Literal["N m", "N", "A", "Nm", "N·m", "N*m", "N.m"]

    @property
    def torque_unit(self) -> TorqueUnit:
        return _NEWTON_METRES.get(self.torque, self.torque)  # type: ignore[return-value]


class _Controller(StrictModel):
    position_p: Number = Field(ge=0)
    velocity_p: Number = Field(ge=0)
    velocity_i: Number = Field(ge=0)
    torque_limit: Number = Field(ge=0)


class _Axis(StrictModel):
    name: str
    kind: Kind
    masses: Count | None = None
    motor_inertia: Number | None = Field(default=None, gt=0)
    rated_torque: Number | None = Field(default=None, gt=0)
    encoder_counts_per_rev: Number | None = Field(default=None, gt=0)
    controller: _Controller | None = None
    extra_columns: list[str] = Field(default_factory=list)
    units: _Units | None = None


class _Segment(StrictModel):
    start: int = Field(ge=0)
    stop: int
    frequency: Number = Field(gt=0)
    periods: Count | None = None
    settled: bool = True
    note: str = ""


class _Experiment(StrictModel):
    file: str
    kind: ExperimentKind
    driven: list[str]
    name: str | None = None
    free: list[str] = Field(default_factory=list)
    period: Number | None = Field(default=None, gt=0)
    segments: list[_Segment] = Field(default_factory=list)
    complete: bool = True
    note: str = ""


class _RecordingFile(StrictModel):
    format: Literal["fieldtool-recording/1"]
    sample_period: Number = Field(gt=0)
    units: _Units | None = None
    axes: list[_Axis] = Field(min_length=1)
    experiments: list[_Experiment]
    description: str = ""
    source: dict[str, str] = Field(default_factory=dict)


def read_folder(folder: Path | str) -> Recording:
    """Return the recording in ``folder`` (``recording.yaml`` and the CSV files it names).

    Raises
    ------
    FileFormatError
        With file and, where there is one, line: a file that is missing or too large, an unknown
        key, column or unit, a value that is no finite number, rows of different length, a time
        column that disagrees with the sample period.
    """
    path = Path(folder) / RECORDING_FILE
    checked, lines = read_checked(path, _RecordingFile)
    axes = tuple(
        _axis(path, lines, checked.units, axis, index) for index, axis in enumerate(checked.axes)
    )
    extras = tuple(
        f"{axis.name}.{column}" for axis in checked.axes for column in axis.extra_columns
    )
    experiments = []
    for index, entry in enumerate(checked.experiments):
        line = line_of(lines, ("experiments", index))
        csv = _csv_path(path, entry.file, line_of(lines, ("experiments", index, "file")))
        table = _read_csv(csv, _allowed_columns(axes, extras), checked.sample_period)
        experiment = _experiment(path, line, csv, entry, axes, table)
        fault = experiment_fault(experiment, tuple(a.name for a in axes), checked.sample_period)
        if fault:
            raise FileFormatError(path, f"experiment {experiment.name}: {fault}.", line)
        experiments.append(experiment)
    for name in extras:
        if experiments and not any(name in experiment.extra for experiment in experiments):
            raise FileFormatError(path, f"the extra column '{name}' is in none of the files.")
    try:
        return Recording(
            checked.sample_period, axes, tuple(experiments), checked.description, checked.source
        )
    except ValueError as error:
        raise FileFormatError(path, f"{error}.") from error


def write_folder(recording: Recording, folder: Path | str) -> None:
    """Write ``recording`` into ``folder`` (made if missing); every number survives exactly.

    Raises
    ------
    OutputError
        If the folder or a file in it can not be written.
    """
    folder = make_folder(folder)
    files = _file_names([experiment.name for experiment in recording.experiments])
    for experiment, file in zip(recording.experiments, files, strict=True):
        write_atomic(folder / file, _csv_text(experiment, recording.names).encode("utf-8"))
    write_yaml(folder / RECORDING_FILE, _as_dict(recording, files))


def _axis(
    path: Path, lines: Mapping[Path_, int], shared: _Units | None, axis: _Axis, index: int
) -> AxisInfo:
    line = line_of(lines, ("axes", index))
    units = axis.units or shared
    if units is None:
        raise FileFormatError(
            path, "the key 'units' is missing: give {time: s, position: rad, torque: N m}.", 1
        )
    gains = axis.controller
    try:
        return AxisInfo(
            name=axis.name,
            kind=axis.kind,
            masses=axis.masses,
            motor_inertia=axis.motor_inertia,
            rated_torque=axis.rated_torque,
            encoder_counts_per_rev=axis.encoder_counts_per_rev,
            controller=None if gains is None else Controller(**gains.model_dump()),
            torque_unit=units.torque_unit,
            position_unit=units.position,
        )
    except ValueError as error:
        raise FileFormatError(path, f"{error}.", line) from error


def _csv_path(path: Path, file: str, line: int | None) -> Path:
    if not _PLAIN_FILE.fullmatch(file) or file in (".", ".."):
        raise FileFormatError(
            path, f"file '{file}' must be the plain name of a file in the same folder.", line
        )
    csv = path.parent / file
    if not csv.is_file():
        raise FileFormatError(path, f"the file '{file}' is not in the folder.", line)
    return csv


def _allowed_columns(axes: tuple[AxisInfo, ...], extras: tuple[str, ...]) -> dict[str, bool]:
    """Return every column a CSV may have, and whether it must."""
    allowed = {"time": True}
    for axis in axes:
        allowed |= {f"{axis.name}.{name}": name in ("position", "torque") for name in COLUMNS}
    return allowed | dict.fromkeys(extras, False)


def _read_csv(path: Path, allowed: dict[str, bool], sample_period: float) -> dict[str, FloatArray]:
    check_size(path, MAX_CSV_BYTES)
    header = _read_header(path, allowed)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # a file without rows is named below
            table = np.loadtxt(path, delimiter=",", skiprows=1, comments=None, ndmin=2,
                           encoding="utf-8-sig")  # fmt: skip
    except (ValueError, OSError, OverflowError):
        raise _bad_line(path, header) from None
    if table.shape[0] == 0:
        raise FileFormatError(path, "has a header but no rows.", 1)
    if table.shape[1] != len(header) or not np.all(np.isfinite(table)):
        raise _bad_line(path, header)
    columns = {name: np.ascontiguousarray(table[:, i]) for i, name in enumerate(header)}
    fault = grid_fault(columns["time"], sample_period)
    if fault is not None:
        raise FileFormatError(path, f"{fault.message}.", _line_of_row(path, fault.row))
    for name, values in columns.items():
        if name.endswith(".statusword"):
            bad = (values < 0) | (values > 0xFFFF) | (values != np.round(values))
            if np.any(bad):
                row = int(np.argmax(bad))
                raise FileFormatError(
                    path,
                    f"column '{name}' has {values[row]:g}, a statusword is a whole number from 0 "
                    "to 65535.",
                    _line_of_row(path, row),
                )
    return columns


def _read_header(path: Path, allowed: dict[str, bool]) -> list[str]:
    try:
        with path.open(encoding="utf-8-sig") as file:
            first = file.readline(1_000_000)
    except OSError as error:
        raise FileFormatError(path, f"can not be read ({error.strerror}).") from error
    except UnicodeDecodeError:
        read_text(path, MAX_CSV_BYTES)  # says in which line
        raise
    if ";" in first and "," not in first:
        raise FileFormatError(
            path, "is separated by semicolons: use commas, and points in the numbers.", 1
        )
    header = [name.strip().strip('"') for name in first.strip().split(",")]
    missing = [name for name, needed in allowed.items() if needed and name not in header]
    if missing:
        raise FileFormatError(
            path, f"the column(s) {', '.join(missing)} are missing; there are {', '.join(header)}.",
            1,
        )  # fmt: skip
    unknown = [name for name in header if name not in allowed]
    if unknown:
        raise FileFormatError(
            path,
            f"the column(s) {', '.join(map(repr, unknown))} are not known: correct the name, or "
            "list it under extra_columns of its axis in recording.yaml.",
            1,
        )
    doubled = sorted({name for name in header if header.count(name) > 1})
    if doubled:
        raise FileFormatError(path, f"the column(s) {', '.join(doubled)} are there twice.", 1)
    return header


def _bad_line(path: Path, header: list[str]) -> FileFormatError:
    """Read slowly, line by line, to say which line and column could not be read."""
    for number, line in enumerate(read_text(path, MAX_CSV_BYTES).split("\n")[1:], start=2):
        if not line.strip():
            continue
        cells = line.split(",")
        if len(cells) != len(header):
            return FileFormatError(
                path, f"has {len(cells)} values, the header has {len(header)} columns.", number
            )
        for name, cell in zip(header, cells, strict=True):
            try:
                finite = bool(np.isfinite(float(cell)))
            except ValueError:
                finite = False
            if not finite or "_" in cell:
                return FileFormatError(
                    path, f"column '{name}' has {cell.strip()!r}, expected a finite number.", number
                )
    return FileFormatError(path, "can not be read as a table of numbers.")


def _line_of_row(path: Path, row: int) -> int:
    """Return the line of data row ``row``; blank lines do not count as rows."""
    seen = -1
    for number, line in enumerate(read_text(path, MAX_CSV_BYTES).split("\n")[1:], start=2):
        seen += bool(line.strip())
        if seen == row:
            return number
    return row + 2


def _experiment(
    path: Path,
    line: int | None,
    csv: Path,
    entry: _Experiment,
    axes: tuple[AxisInfo, ...],
    table: dict[str, FloatArray],
) -> Experiment:
    statusword = _signal(table, axes, "statusword")
    if statusword is not None and np.any(np.isnan(statusword)):
        raise FileFormatError(csv, "has a statusword for some axes only: give all or none.", 1)
    velocity = _signal(table, axes, "velocity")
    if velocity is not None and np.any(np.isnan(velocity)):
        raise FileFormatError(csv, "has a velocity for some axes only: give all or none.", 1)
    plain = {"time", *(f"{axis.name}.{name}" for axis in axes for name in COLUMNS)}
    try:
        return Experiment(
            name=entry.name or Path(entry.file).stem,
            kind=entry.kind,
            driven=tuple(entry.driven),
            free=tuple(entry.free),
            period=entry.period,
            time=table["time"],
            position=np.column_stack([table[f"{axis.name}.position"] for axis in axes]),
            torque=np.column_stack([table[f"{axis.name}.torque"] for axis in axes]),
            position_reference=_signal(table, axes, "position_reference"),
            torque_reference=_signal(table, axes, "torque_reference"),
            velocity=velocity,
            statusword=None if statusword is None else statusword.astype(np.uint16),
            extra={name: values for name, values in table.items() if name not in plain},
            segments=tuple(Segment(**segment.model_dump()) for segment in entry.segments),
            complete=entry.complete,
            note=entry.note,
        )
    except ValueError as error:
        raise FileFormatError(path, f"{error}.", line) from error


def _signal(
    table: dict[str, FloatArray], axes: tuple[AxisInfo, ...], name: str
) -> FloatArray | None:
    """Return the columns of one signal, (n, M), NaN for an axis without it; None if none has it."""
    if not any(f"{axis.name}.{name}" in table for axis in axes):
        return None
    nothing = np.full(table["time"].shape, np.nan)
    return np.column_stack([table.get(f"{axis.name}.{name}", nothing) for axis in axes])


def _file_names(names: list[str]) -> list[str]:
    """Return a file name for each experiment: portable, and different even without case."""
    files: list[str] = []
    taken: set[str] = set()
    for name in names:
        stem = re.sub(r"[^A-Za-z0-9._+-]+", "_", name).strip("._") or "experiment"
        candidate, number = stem, 2
        while candidate.lower() in taken:
            candidate, number = f"{stem}-{number}", number + 1
        taken.add(candidate.lower())
        files.append(f"{candidate}.csv")
    return files


def _csv_text(experiment: Experiment, names: tuple[str, ...]) -> str:
    header, columns = ["time"], [experiment.time.tolist()]
    for column, axis in enumerate(names):
        for signal in COLUMNS:
            values: NDArray[Any] | None = getattr(experiment, signal)
            if values is None or (signal in _REFERENCES and np.all(np.isnan(values[:, column]))):
                continue
            header.append(f"{axis}.{signal}")
            columns.append(values[:, column].tolist())
    for name, extra in experiment.extra.items():
        header.append(name)
        columns.append(extra.tolist())
    rows = (",".join(map(repr, row)) for row in zip(*columns, strict=True))
    return "\n".join([",".join(header), *rows, ""])


def _as_dict(recording: Recording, files: list[str]) -> dict[str, Any]:
    units = [
        {"time": "s", "position": axis.position_unit, "torque": axis.torque_unit}
        for axis in recording.axes
    ]
    shared = all(unit == units[0] for unit in units)
    data: dict[str, Any] = {"format": FORMAT}
    if recording.description:
        data["description"] = recording.description
    if recording.source:
        data["source"] = dict(recording.source)
    data["sample_period"] = recording.sample_period
    if shared:
        data["units"] = units[0]
    extras = {name for experiment in recording.experiments for name in experiment.extra}
    data["axes"] = [
        _axis_as_dict(axis, sorted(extras)) | ({} if shared else {"units": unit})
        for axis, unit in zip(recording.axes, units, strict=True)
    ]
    data["experiments"] = [
        _experiment_as_dict(experiment, file)
        for experiment, file in zip(recording.experiments, files, strict=True)
    ]
    return data


def _axis_as_dict(axis: AxisInfo, extras: list[str]) -> dict[str, Any]:
    data: dict[str, Any] = {"name": axis.name, "kind": axis.kind}
    for name in ("masses", "motor_inertia", "rated_torque", "encoder_counts_per_rev"):
        if getattr(axis, name) is not None:
            data[name] = getattr(axis, name)
    if axis.controller is not None:
        data["controller"] = dict(vars(axis.controller))
    own = [name.split(".", 1)[1] for name in extras if name.split(".", 1)[0] == axis.name]
    if own:
        data["extra_columns"] = own
    return data


def _experiment_as_dict(experiment: Experiment, file: str) -> dict[str, Any]:
    data: dict[str, Any] = {"file": file, "kind": experiment.kind, "driven": [*experiment.driven]}
    if Path(file).stem != experiment.name:
        data["name"] = experiment.name
    if experiment.free:
        data["free"] = [*experiment.free]
    if experiment.period is not None:
        data["period"] = experiment.period
    if not experiment.complete:
        data["complete"] = False
    if experiment.note:
        data["note"] = experiment.note
    if experiment.segments:
        data["segments"] = [_segment_as_dict(segment) for segment in experiment.segments]
    return data


def _segment_as_dict(segment: Segment) -> dict[str, Any]:
    defaults = {"periods": None, "settled": True, "note": ""}
    return {
        name: value
        for name, value in vars(segment).items()
        if name not in defaults or value != defaults[name]
    }
