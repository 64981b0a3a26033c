"""``tuning.yaml``: designed parameters and why."""

from pathlib import Path
from typing import Any, Literal

from pydantic import Field

from fieldtool.design.tuning import AxisTuning, Tuning
from fieldtool.errors import FileFormatError
from fieldtool.records.yaml_file import Number, StrictModel, read_checked

FORMAT = "fieldtool-tuning/1"


class _Axis(StrictModel):
    axis: str = Field(min_length=1)
    parameters: dict[str, Number]
    sensitivity_peak: Number = Field(gt=0)
    reason: str


class _TuningFile(StrictModel):
    format: Literal["fieldtool-tuning/1"]
    axes: list[_Axis] = Field(min_length=1)


def tuning_as_dict(tuning: Tuning) -> dict[str, Any]:
    """Return plain values in the form of ``tuning.yaml``."""
    return {
        "format": FORMAT,
        "axes": [
            {
                "axis": axis.axis,
                "parameters": dict(axis.parameters),
                "sensitivity_peak": axis.sensitivity_peak,
                "reason": axis.reason,
            }
            for axis in tuning.axes
        ],
    }


def read_tuning(path: Path) -> Tuning:
    """Read ``tuning.yaml``.

    Raises
    ------
    FileFormatError
        With file and line: it is missing, too large, not YAML, no tuning, has a value that is no
        finite number, or an axis twice.
    """
    if not path.is_file():
        raise FileFormatError(path, "is not there; run `fieldtool design` first.")
    checked, _ = read_checked(path, _TuningFile)
    names = [axis.axis for axis in checked.axes]
    doubled = next((name for name in names if names.count(name) > 1), None)
    if doubled is not None:
        raise FileFormatError(path, f"has parameters for the axis {doubled!r} twice.")
    return Tuning(tuple(AxisTuning(**axis.model_dump()) for axis in checked.axes))
