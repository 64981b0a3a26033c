"""``tuning.yaml``: designed parameters and why."""

from pathlib import Path
from typing import Any

import yaml

from fieldtool.design.tuning import AxisTuning, Tuning
from fieldtool.errors import FileFormatError


def tuning_as_dict(tuning: Tuning) -> dict[str, Any]:
    """Return plain values in the form of ``tuning.yaml``."""
    return {
        "format": "fieldtool-tuning/1",
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
        If it is missing or not a tuning.
    """
    try:
        data = yaml.safe_load(path.read_text(encoding="utf-8"))
        if data.get("format") != "fieldtool-tuning/1":
            raise FileFormatError(path, "format must be fieldtool-tuning/1", 1)
        return Tuning(
            tuple(
                AxisTuning(
                    str(axis["axis"]),
                    {str(k): float(v) for k, v in axis["parameters"].items()},
                    float(axis["sensitivity_peak"]),
                    str(axis["reason"]),
                )
                for axis in data["axes"]
            )
        )
    except (OSError, yaml.YAMLError, AttributeError, KeyError, TypeError, ValueError) as error:
        raise FileFormatError(
            path, f"is no tuning ({error}); run `fieldtool design` first"
        ) from None
