"""Recordings and their file (HDF5, format ``fieldtool-recording/1``).

Layout: attributes ``format``, ``sample_period``, ``description``; group ``source`` with free text
attributes; groups ``axes/0000``, ... with the fields of :class:`AxisInfo` as attributes and an
optional group ``controller``; groups ``experiments/0000``, ... with the fields of
:class:`Experiment` as attributes and datasets, ``extra`` a group of datasets, ``segments`` a group
of one dataset per field.  What is None is left out.  Signals are stored without loss.
"""

from math import inf
from pathlib import Path
from types import TracebackType
from typing import Any, cast

import h5py
import numpy as np

from fieldtool.errors import FileFormatError
from fieldtool.records.hdf5_file import MemoryFile, Reader, opened, put
from fieldtool.records.recorded import (
    AxisInfo,
    Controller,
    Experiment,
    ExperimentKind,
    GridFault,
    Kind,
    PositionUnit,
    Recording,
    Segment,
    TorqueUnit,
    experiment_fault,
    grid_fault,
)

__all__ = [
    "FORMAT",
    "AxisInfo",
    "Controller",
    "Experiment",
    "GridFault",
    "Recording",
    "RecordingWriter",
    "Segment",
    "experiment_fault",
    "experiment_names",
    "grid_fault",
    "load",
    "save",
    "whole_kinds",
]

FORMAT = "fieldtool-recording/1"
_SIGNALS = ("position_reference", "torque_reference", "velocity")
_CONTROLLER = ("position_p", "velocity_p", "velocity_i", "torque_limit")
_NUMBERS = ("motor_inertia", "rated_torque", "encoder_counts_per_rev")


class RecordingWriter:
    """Write a recording while it is measured, one experiment at a time.

    After :meth:`append` returns, the file on the disk is whole and holds that experiment; before,
    it is whole without it.  A crash of the program or a full disk never leaves half a file.
    """

    def __init__(self, path: Path | str, header: Recording) -> None:
        """Open ``path`` with the axes, period and experiments (mostly none) of ``header``.

        Raises
        ------
        OutputError
            If the file can not be written: seen before anything is measured.
        """
        self.path = Path(path)
        self._recording = header
        self._file = MemoryFile(FORMAT)
        try:
            _write_header(self._file.root, header)
            for experiment in header.experiments:
                _write_experiment(self._file.root, experiment)
            self._file.write(self.path)
        except BaseException:
            self._file.close()
            raise

    @property
    def recording(self) -> Recording:
        """All that has been written so far."""
        return self._recording

    def append(self, experiment: Experiment) -> None:
        """Add one experiment and bring the file on the disk up to date.

        Raises
        ------
        ValueError
            If it does not belong to the axes and sample period of the header.
        OutputError
            If the file can not be written; what was there before is unchanged, and the experiment
            stays in memory: the next call, or :meth:`flush`, tries to write it again.
        """
        present = self._recording
        self._recording = Recording(
            present.sample_period,
            present.axes,
            (*present.experiments, experiment),
            present.description,
            present.source,
        )
        _write_experiment(self._file.root, experiment)
        self.flush()

    def flush(self) -> None:
        """Write the file again, for instance after the disk was full; raises OutputError."""
        self._file.write(self.path)

    def close(self) -> None:
        """Free the memory; the file is already whole."""
        self._file.close()

    def __enter__(self) -> "RecordingWriter":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()


def save(recording: Recording, path: Path | str) -> None:
    """Write ``recording`` to ``path`` in one step.

    Raises
    ------
    OutputError
        If the folder is missing or not writable, or the disk is full.
    """
    RecordingWriter(path, recording).close()


def recorded_seconds(path: Path) -> float:
    """Return the seconds that a recording holds, all experiments together; no signal is read.

    Raises
    ------
    FileFormatError
        As :func:`load`.
    """
    with opened(path, FORMAT) as reader:
        rows = sum(one.rows("time") for one in reader.child("experiments").children())
        seconds = rows * reader.number("sample_period")
        if not 0.0 <= seconds < inf:
            raise reader.fault(f"{rows} rows of one 'sample_period' are {seconds} s.")
        return seconds


def experiment_names(path: Path) -> tuple[str, ...]:
    """Return the names of the experiments; no signal is read.

    Raises
    ------
    FileFormatError
        As :func:`load`.
    """
    with opened(path, FORMAT) as reader:
        return tuple(one.text("name") for one in reader.child("experiments").children())


def whole_kinds(path: Path) -> set[str]:
    """Return the kinds of the experiments that came to their end; no signal is read.

    Raises
    ------
    FileFormatError
        As :func:`load`.
    """
    with opened(path, FORMAT) as reader:
        experiments = reader.child("experiments").children()
        return {one.text("kind") for one in experiments if one.number("complete")}


def load(path: Path | str) -> Recording:
    """Return the recording in the file ``path``.

    Raises
    ------
    FileFormatError
        If it is missing, no HDF5 file, of another format, damaged, or its content contradicts
        itself.
    """
    with opened(path, FORMAT) as reader:
        try:
            return _read_recording(reader)
        except ValueError as error:
            raise FileFormatError(path, f"does not hold a valid recording: {error}.") from error


def _write_header(root: Any, recording: Recording) -> None:
    root.attrs["sample_period"] = recording.sample_period
    root.attrs["description"] = recording.description
    source = root.create_group("source", track_order=True)
    for key, value in recording.source.items():
        source.attrs[key] = value
    axes = root.create_group("axes")
    for index, axis in enumerate(recording.axes):
        group = axes.create_group(f"{index:04d}")
        for name in ("name", "kind", "torque_unit", "position_unit"):
            group.attrs[name] = getattr(axis, name)
        for name in ("masses", *_NUMBERS):
            if getattr(axis, name) is not None:
                group.attrs[name] = getattr(axis, name)
        if axis.controller is not None:
            controller = group.create_group("controller")
            for name in _CONTROLLER:
                controller.attrs[name] = getattr(axis.controller, name)
    root.create_group("experiments")


def _write_experiment(root: Any, experiment: Experiment) -> None:
    group = root["experiments"].create_group(f"{len(root['experiments']):04d}")
    for name in ("name", "kind", "note"):
        group.attrs[name] = getattr(experiment, name)
    group.attrs["complete"] = int(experiment.complete)
    for name in ("driven", "free"):
        texts = np.array(getattr(experiment, name), dtype=object)
        group.attrs.create(name, texts, dtype=h5py.string_dtype())
    if experiment.period is not None:
        group.attrs["period"] = experiment.period
    put(group, "time", experiment.time)
    for name, values in experiment.signals().items():
        put(group, name, values)
    if experiment.statusword is not None:
        put(group, "statusword", experiment.statusword)
    extra = group.create_group("extra", track_order=True)
    for name, values in experiment.extra.items():
        put(extra, name, values)
    if experiment.segments:
        _write_segments(group.create_group("segments"), experiment.segments)


def _write_segments(group: Any, segments: tuple[Segment, ...]) -> None:
    put(group, "start", np.array([s.start for s in segments], dtype=np.int64))
    put(group, "stop", np.array([s.stop for s in segments], dtype=np.int64))
    put(group, "frequency", np.array([s.frequency for s in segments]))
    put(group, "periods", np.array([s.periods or 0 for s in segments], dtype=np.int64))
    put(group, "settled", np.array([s.settled for s in segments], dtype=np.uint8))
    notes = np.array([s.note for s in segments], dtype=object)
    group.attrs.create("note", notes, dtype=h5py.string_dtype())


def _read_recording(reader: Reader) -> Recording:
    source = reader.child("source")
    return Recording(
        sample_period=reader.number("sample_period"),
        axes=tuple(_read_axis(axis) for axis in reader.child("axes").children()),
        experiments=tuple(_read_experiment(e) for e in reader.child("experiments").children()),
        description=reader.text("description"),
        source={key: source.text(key) for key in source.group.attrs},
    )


def _read_axis(reader: Reader) -> AxisInfo:
    controller = None
    if "controller" in reader.group:
        gains = reader.child("controller")
        controller = Controller(*(gains.number(name) for name in _CONTROLLER))
    masses = reader.optional_number("masses")
    motor_inertia, rated_torque, counts = (reader.optional_number(name) for name in _NUMBERS)
    return AxisInfo(
        name=reader.text("name"),
        kind=cast("Kind", reader.text("kind")),
        masses=None if masses is None else int(masses),
        motor_inertia=motor_inertia,
        rated_torque=rated_torque,
        encoder_counts_per_rev=counts,
        controller=controller,
        torque_unit=cast("TorqueUnit", reader.text("torque_unit")),
        position_unit=cast("PositionUnit", reader.text("position_unit")),
    )


def _read_experiment(reader: Reader) -> Experiment:
    extra = reader.child("extra")
    position_reference, torque_reference, velocity = (
        reader.optional_array(name, np.float64, 2) for name in _SIGNALS
    )
    return Experiment(
        name=reader.text("name"),
        kind=cast("ExperimentKind", reader.text("kind")),
        driven=reader.texts("driven"),
        free=reader.texts("free"),
        period=reader.optional_number("period"),
        time=reader.array("time", np.float64, 1),
        position=reader.array("position", np.float64, 2),
        torque=reader.array("torque", np.float64, 2),
        position_reference=position_reference,
        torque_reference=torque_reference,
        velocity=velocity,
        statusword=reader.optional_array("statusword", np.uint16, 2),
        extra={name: extra.array(name, np.float64, 1) for name in extra.group},
        segments=_read_segments(reader.child("segments")) if "segments" in reader.group else (),
        complete=bool(reader.number("complete")),
        note=reader.text("note"),
    )


def _read_segments(reader: Reader) -> tuple[Segment, ...]:
    start, stop, periods = (reader.array(n, np.int64, 1) for n in ("start", "stop", "periods"))
    frequency = reader.array("frequency", np.float64, 1)
    settled = reader.array("settled", np.uint8, 1)
    notes = reader.texts("note")
    return tuple(
        Segment(int(a), int(b), float(f), int(p) or None, bool(s), note)
        for a, b, f, p, s, note in zip(start, stop, frequency, periods, settled, notes, strict=True)
    )
