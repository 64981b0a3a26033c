"""What was measured on a machine, as values: axes, experiments, settled stretches.

Signals of M axes at n samples are arrays of shape (n, M), axes in the order of the recording.
Position and torque in one row belong to one instant (one SYNC).  SI units: rad and N m on rotary
axes, m and N on linear ones; where only a motor current is known, torque is in A.

Time grid: rows follow each other at the sample period.  A single step may be off by 1 % of it
(jitter of a clock, rounding in a text file), the mean step by 0.1 %; anything else is a missing or
doubled sample or a wrong sample period, and is refused with the row.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
WordArray = NDArray[np.uint16]
Kind = Literal["rotary", "linear"]
TorqueUnit = Literal["N m", "N", "A"]
PositionUnit = Literal["rad", "m"]
ExperimentKind = Literal["multisine", "stepped_sine", "moves", "other"]

KINDS: tuple[Kind, ...] = ("rotary", "linear")
TORQUE_UNITS: tuple[TorqueUnit, ...] = ("N m", "N", "A")
POSITION_UNITS: tuple[PositionUnit, ...] = ("rad", "m")
EXPERIMENT_KINDS: tuple[ExperimentKind, ...] = ("multisine", "stepped_sine", "moves", "other")
COLUMNS = ("position_reference", "torque_reference", "position", "torque", "velocity", "statusword")
"""The signals of one axis, in the order in which files have them."""

LARGEST = 1e12
"""Of any position, velocity or torque, SI."""
STEP_TOLERANCE = 0.01
"""Largest deviation of one time step, as a share of the sample period."""
MEAN_TOLERANCE = 0.001
"""Largest deviation of the mean time step, as a share of the sample period."""
_FORBIDDEN_IN_NAMES = frozenset("./\\,;:'\"#")


@dataclass(frozen=True)
class Controller:
    """The cascade that held the axis: position P, velocity PI, velocity of the reference fed on.

    Units for a rotary axis; on a linear one read N for N m and m for rad.
    """

    position_p: float
    """1/s."""
    velocity_p: float
    """N m s/rad."""
    velocity_i: float
    """N m/rad."""
    torque_limit: float
    """N m."""

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not (np.isfinite(value) and value >= 0):
                raise ValueError(f"controller: {name} must be finite and not negative, got {value}")


@dataclass(frozen=True)
class AxisInfo:
    """What is known of an axis beforehand."""

    name: str
    kind: Kind
    masses: int | None = None
    """Number of masses in its chain; None where it is not known."""
    motor_inertia: float | None = None
    """From the data sheet, kg m2 or kg."""
    rated_torque: float | None = None
    """N m or N."""
    encoder_counts_per_rev: float | None = None
    controller: Controller | None = None
    torque_unit: TorqueUnit = "N m"
    position_unit: PositionUnit = "rad"

    def __post_init__(self) -> None:
        if (
            not self.name.strip()
            or self.name != self.name.strip()
            or not self.name.isprintable()
            or _FORBIDDEN_IN_NAMES & set(self.name)
        ):
            raise ValueError(
                f"axis name {self.name!r} can not be used: give a plain word without any of "
                f"{' '.join(sorted(_FORBIDDEN_IN_NAMES))} and without blanks at its ends"
            )
        _one_of(f"axis {self.name}: kind", self.kind, KINDS)
        _one_of(f"axis {self.name}: torque unit", self.torque_unit, TORQUE_UNITS)
        _one_of(f"axis {self.name}: position unit", self.position_unit, POSITION_UNITS)
        fitting = ("m", "N") if self.kind == "linear" else ("rad", "N m")
        if self.position_unit != fitting[0] or self.torque_unit not in (fitting[1], "A"):
            raise ValueError(
                f"axis {self.name}: a {self.kind} axis has positions in {fitting[0]} and torques "
                f"in {fitting[1]} or A, got {self.position_unit} and {self.torque_unit}"
            )
        if self.masses is not None and self.masses < 1:
            raise ValueError(f"axis {self.name}: masses must be at least 1, got {self.masses}")
        for name in ("motor_inertia", "rated_torque", "encoder_counts_per_rev"):
            value = getattr(self, name)
            if value is not None and not (np.isfinite(value) and value > 0):
                raise ValueError(f"axis {self.name}: {name} must be positive, got {value}")


@dataclass(frozen=True)
class Segment:
    """Rows ``start`` to ``stop`` (not included) of one stepped-sine frequency."""

    start: int
    stop: int
    frequency: float
    """Hz."""
    periods: int | None = None
    """Whole periods in these rows (to half a sample at each end); None where it is no whole
    number."""
    settled: bool = True
    """Whether the transient had died out."""
    note: str = ""

    def __post_init__(self) -> None:
        if not 0 <= self.start < self.stop:
            raise ValueError(f"segment: rows {self.start} to {self.stop} are no stretch")
        if not (np.isfinite(self.frequency) and self.frequency > 0):
            raise ValueError(f"segment: frequency must be positive, got {self.frequency} Hz")
        if self.periods is not None and self.periods < 1:
            raise ValueError(f"segment: periods must be at least 1, got {self.periods}")


@dataclass(frozen=True, eq=False)
class Experiment:
    """One measured stretch of motion of all M axes; arrays are kept read-only."""

    name: str
    kind: ExperimentKind
    driven: tuple[str, ...]
    """Axes that were excited."""
    free: tuple[str, ...]
    """Axes with torque zero; neither driven nor free means the axis held its position."""
    period: float | None
    """Of a periodic excitation, s."""
    time: FloatArray
    """(n,), s, rising."""
    position: FloatArray
    """(n, M), rad or m."""
    torque: FloatArray
    """(n, M), N m, N or A: what the drive reports as actual."""
    position_reference: FloatArray | None = None
    """(n, M); the column of an axis that had none is NaN throughout."""
    torque_reference: FloatArray | None = None
    """(n, M); the column of an axis that had none is NaN throughout."""
    velocity: FloatArray | None = None
    """(n, M), rad/s or m/s."""
    statusword: WordArray | None = None
    """(n, M), object 0x6041."""
    extra: Mapping[str, FloatArray] = field(default_factory=dict)
    """Further signals, (n,) each, by ``AXIS.NAME``."""
    segments: tuple[Segment, ...] = ()
    """Stepped sine: the settled stretches, by rising row."""
    complete: bool = True
    """False for an experiment that was cut short."""
    note: str = ""

    def __post_init__(self) -> None:
        if not self.name or not self.name.isprintable():
            raise ValueError(f"experiment name {self.name!r} can not be used: give a plain word")
        _one_of(f"experiment {self.name}: kind", self.kind, EXPERIMENT_KINDS)
        if self.period is not None and not (np.isfinite(self.period) and self.period > 0):
            raise ValueError(
                f"experiment {self.name}: period must be positive, got {self.period} s"
            )
        object.__setattr__(self, "note", _clean(self.note))
        self._freeze_arrays()
        fault = self._time_fault() or self._signal_fault() or self._segment_fault()
        if fault:
            raise ValueError(f"experiment {self.name}: {fault}")

    @property
    def samples(self) -> int:
        """Number of rows n."""
        return int(self.time.size)

    def signals(self) -> dict[str, FloatArray]:
        """All two-dimensional float signals that are there, (n, M) each, by name."""
        names = ("position_reference", "torque_reference", "position", "torque", "velocity")
        present = {name: getattr(self, name) for name in names}
        return {name: values for name, values in present.items() if values is not None}

    def _freeze_arrays(self) -> None:
        floats = ("time", "position", "torque", "position_reference", "torque_reference",
                  "velocity")  # fmt: skip
        for name in floats:
            if getattr(self, name) is not None:
                object.__setattr__(self, name, _read_only(getattr(self, name), np.float64))
        if self.statusword is not None:
            words = np.asarray(self.statusword)
            whole = np.issubdtype(words.dtype, np.integer)
            if not whole or np.any((words < 0) | (words > 0xFFFF)):
                raise ValueError(
                    f"experiment {self.name}: statuswords must be whole numbers from 0 to 65535"
                )
            object.__setattr__(self, "statusword", _read_only(self.statusword, np.uint16))
        extra = {str(k): _read_only(v, np.float64) for k, v in self.extra.items()}
        object.__setattr__(self, "extra", extra)

    def _time_fault(self) -> str:
        if self.time.ndim != 1 or self.time.size == 0:
            return f"time must have one row per sample, got the shape {self.time.shape}"
        if not np.all(np.isfinite(self.time)):
            return f"time in row {_first(~np.isfinite(self.time))} is no finite number"
        back = np.diff(self.time) <= 0
        if np.any(back):
            row = _first(back) + 1
            return (
                f"time does not rise in row {row} ({self.time[row]:.9g} s after "
                f"{self.time[row - 1]:.9g} s): the sample is doubled or out of order"
            )
        return ""

    def _signal_fault(self) -> str:
        n, shape = self.samples, self.position.shape
        if len(shape) != 2 or shape[0] != n or shape[1] == 0:
            return f"position must have the shape ({n}, axes), got {shape}"
        for name, values in self.signals().items():
            if values.shape != shape:
                return f"{name} must have the shape {shape} of position, got {values.shape}"
            bad = ~np.isfinite(values)
            if name.endswith("_reference"):
                bad[:, np.all(np.isnan(values), axis=0)] = False
            if np.any(bad):
                row, column = np.argwhere(bad)[0]
                return f"{name} of axis number {column} in row {row} is no finite number"
            if np.any(np.abs(values) > LARGEST):
                row, column = np.argwhere(np.abs(values) > LARGEST)[0]
                return (
                    f"{name} of axis number {column} in row {row} is {values[row, column]:.3g}, no "
                    f"machine has more than {LARGEST:g}: correct the unit or the column"
                )
        if self.statusword is not None and self.statusword.shape != shape:
            return f"statusword must have the shape {shape}, got {self.statusword.shape}"
        for name, values in self.extra.items():
            if values.shape != (n,):
                return f"extra signal {name} must have the shape ({n},), got {values.shape}"
            if not np.all(np.isfinite(values)):
                row = _first(~np.isfinite(values))
                return f"extra signal {name} in row {row} is no finite number"
        return ""

    def _segment_fault(self) -> str:
        end = 0
        for segment in self.segments:
            rows = f"segment of rows {segment.start} to {segment.stop}"
            if segment.start < end:
                return f"{rows} begins before the one before it ends (row {end})"
            if segment.stop > self.samples:
                return f"{rows} is longer than the {self.samples} rows there are"
            end = segment.stop
        return ""


@dataclass(frozen=True, eq=False)
class Recording:
    """All that was measured in one session on one machine."""

    sample_period: float
    """s."""
    axes: tuple[AxisInfo, ...]
    experiments: tuple[Experiment, ...] = ()
    description: str = ""
    source: Mapping[str, str] = field(default_factory=dict)
    """Where it comes from: tool version, machine, operator, ...; free words."""

    def __post_init__(self) -> None:
        if not (np.isfinite(self.sample_period) and self.sample_period > 0):
            raise ValueError(f"sample period must be positive, got {self.sample_period} s")
        names = self.names
        if not names or len(set(names)) != len(names):
            raise ValueError(f"a recording needs axes of different names, got {names}")
        titles = [experiment.name for experiment in self.experiments]
        doubled = {title for title in titles if titles.count(title) > 1}
        if doubled:
            raise ValueError(f"experiment names must differ, got {sorted(doubled)} twice")
        object.__setattr__(self, "description", _clean(self.description))
        object.__setattr__(self, "source", {_clean(k): _clean(v) for k, v in self.source.items()})
        for experiment in self.experiments:
            fault = experiment_fault(experiment, names, self.sample_period)
            if fault:
                raise ValueError(f"experiment {experiment.name}: {fault}")

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the axes in order."""
        return tuple(axis.name for axis in self.axes)

    def experiment(self, name: str) -> Experiment:
        """Return the experiment called ``name``; KeyError with the names there are, if none is."""
        for experiment in self.experiments:
            if experiment.name == name:
                return experiment
        raise KeyError(
            f"no experiment '{name}'; there are {[one.name for one in self.experiments]}"
        )


def experiment_fault(
    experiment: Experiment, axes: tuple[str, ...], sample_period: float
) -> str | None:
    """Say in words why ``experiment`` does not belong to these axes and period; None if it does."""
    if experiment.position.shape[1] != len(axes):
        return f"has {experiment.position.shape[1]} columns of position for {len(axes)} axes"
    for role, members in (("driven", experiment.driven), ("free", experiment.free)):
        unknown = [name for name in members if name not in axes]
        if unknown:
            return f"{role} axes {unknown} are not among {list(axes)}"
        if len(set(members)) != len(members):
            return f"{role} axes {list(members)} name an axis twice"
    both = set(experiment.driven) & set(experiment.free)
    if both:
        return f"axes {sorted(both)} can not be driven and free at once"
    for name in experiment.extra:
        axis, _, rest = name.partition(".")
        if axis not in axes or not rest.strip() or set('/,"') & set(name):
            return f"extra signal '{name}' must be called AXIS.NAME with one of {list(axes)}"
        if rest in COLUMNS:
            return f"extra signal '{name}' has the name of a signal of its own: choose another"
    fault = grid_fault(experiment.time, sample_period)
    if fault is not None:
        return f"row {fault.row}: {fault.message}"
    for segment in experiment.segments:
        message = _segment_length_fault(segment, sample_period)
        if message:
            return message
    return None


@dataclass(frozen=True)
class GridFault:
    """Where a time column leaves the sample grid, and how."""

    row: int
    message: str


def grid_fault(time: FloatArray, sample_period: float) -> GridFault | None:
    """Find the first row of ``time`` (n,) that is not one sample period after the row before.

    Returns None for a whole grid.  The tolerances are 1 % of the sample period for one step and
    0.1 % for the mean step.
    """
    if time.size < 2:
        return None
    with np.errstate(over="ignore"):  # then it is infinite, which is no step either
        steps = np.diff(time) / sample_period
    mean = float(np.median(steps))
    if abs(mean - 1) > STEP_TOLERANCE:
        return GridFault(
            1,
            f"the time column has steps of {mean * sample_period:.6g} s, the sample period is "
            f"given as {sample_period:.6g} s: correct the one that is wrong",
        )
    off = np.abs(steps - 1) > STEP_TOLERANCE
    if np.any(off):
        row = _first(off) + 1
        return GridFault(row, _step_fault(float(steps[row - 1]), sample_period))
    mean = float((time[-1] - time[0]) / (sample_period * (time.size - 1)))
    if abs(mean - 1) > MEAN_TOLERANCE:
        return GridFault(
            int(time.size - 1),
            f"the mean time step is {mean * sample_period:.8g} s, the sample period is given as "
            f"{sample_period:.8g} s: give the sample period to 0.1 %",
        )
    return None


def _step_fault(step: float, sample_period: float) -> str:
    where = (
        f"the time step is {step * sample_period:.6g} s, the sample period {sample_period:.6g} s"
    )
    if not np.isfinite(step):
        return "the time column leaves every grid"
    if step <= 0.5:
        return f"{where}: a sample is doubled or out of order"
    if step >= 1.5:
        return f"{where}: {round(step) - 1} sample(s) missing before this row"
    return f"{where}: the clock jumps by more than 1 % of it; write times with more digits"


def _segment_length_fault(segment: Segment, sample_period: float) -> str:
    rows = f"segment of rows {segment.start} to {segment.stop}"
    per_sample = segment.frequency * sample_period
    if per_sample >= 0.5:
        return (
            f"{rows}: {segment.frequency:.6g} Hz is not below half the sample rate "
            f"({0.5 / sample_period:.6g} Hz)"
        )
    held = (segment.stop - segment.start) * per_sample
    if segment.periods is not None and abs(held - segment.periods) > per_sample * (1 + 1e-6):
        return f"{rows} holds {held:.4f} periods of {segment.frequency:.6g} Hz, " \
               f"not {segment.periods}"  # fmt: skip
    return ""


def _read_only(values: Any, dtype: type[np.generic]) -> NDArray[Any]:
    array: NDArray[Any] = np.asarray(values, dtype=dtype).view()
    array.flags.writeable = False
    return array


def _clean(text: str) -> str:
    """Drop the NUL bytes that drives leave in their names and that files can not hold."""
    return str(text).replace("\0", "")


def _first(mask: NDArray[np.bool_]) -> int:
    return int(np.argmax(mask))


def _one_of(what: str, value: str, known: tuple[str, ...]) -> None:
    if value not in known:
        raise ValueError(f"{what} must be one of {', '.join(known)}, got {value!r}")
