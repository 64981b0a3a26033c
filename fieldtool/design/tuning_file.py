"""``tuning.yaml``: designed parameters, why, and what they will do."""

from collections.abc import Mapping
from dataclasses import asdict
from math import inf
from pathlib import Path
from typing import Any, Literal

from pydantic import Field

from fieldtool.design.moves import TestMove
from fieldtool.design.predict import Prediction, finite
from fieldtool.design.shaping import Shaping
from fieldtool.design.tuning import BOUND, MOST_BOUND, AxisTuning, Choice, TradePoint, Tuning
from fieldtool.errors import FileFormatError
from fieldtool.records.yaml_file import Number, StrictModel, read_checked

FORMAT = "fieldtool-tuning/1"
Figures = dict[str, Number | None]


class _Axis(StrictModel):
    axis: str = Field(min_length=1)
    parameters: dict[str, Number]
    sensitivity_peak: Number = Field(gt=0)
    reason: str
    kind: Literal["rotary", "linear"] = "rotary"


class _Move(StrictModel):
    axis: str = Field(min_length=1)
    distance: Number
    velocity: Number
    acceleration: Number
    jerk: Number
    band: Number = 0.0
    start: Number | None = None


class _AxisPrediction(StrictModel):
    axis: str
    margins: Figures
    move: Figures | None
    load: Figures | None
    step: Figures | None
    compliance: Number | None
    noise: Number | None
    peak_torque: Number | None
    spread: dict[str, tuple[Number | None, Number | None]]


class _Prediction(StrictModel):
    stable: bool
    sensitivity_peak: Number | None
    axes: list[_AxisPrediction]


class _TradePoint(StrictModel):
    factor: Number
    bandwidth: list[Number]
    sensitivity_peak: list[Number | None]


class _Shaping(StrictModel):
    axis: str
    frequency: Number
    damping: Number
    shaper: str
    amplitudes: list[Number]
    times: list[Number]
    left: Number
    jerk: Number
    unit: Literal["rad", "m"] = "rad"


class _Choice(StrictModel):
    response: str = Field(min_length=1)
    bound: Number = Field(gt=1, le=MOST_BOUND)
    prediction: _Prediction | None
    kept: list[str]
    instead: str
    refused: str


class _TuningFile(StrictModel):
    format: Literal["fieldtool-tuning/1"]
    response: str = ""
    bound: Number = Field(default=BOUND, gt=1, le=MOST_BOUND)
    axes: list[_Axis] = Field(min_length=1)
    moves: list[_Move] = Field(default_factory=list)
    prediction: _Prediction | None = None
    present: _Prediction | None = None
    trade: list[_TradePoint] = Field(default_factory=list)
    shaping: list[_Shaping] = Field(default_factory=list)
    notes: list[str] = Field(default_factory=list)
    responses: list[_Choice] = Field(default_factory=list)
    by_hand: list[str] = Field(default_factory=list)


def tuning_as_dict(tuning: Tuning) -> dict[str, Any]:
    """Return plain values in the form of ``tuning.yaml``; what is infinite or not known is null."""
    return {
        "format": FORMAT,
        "response": tuning.response,
        "bound": tuning.bound,
        "axes": [
            {
                "axis": axis.axis,
                "parameters": dict(axis.parameters),
                "sensitivity_peak": axis.sensitivity_peak,
                "reason": axis.reason,
                "kind": axis.kind,
            }
            for axis in tuning.axes
        ],
        "moves": [asdict(move) for move in tuning.moves],
        "prediction": tuning.prediction.as_dict() if tuning.prediction else None,
        "present": tuning.present.as_dict() if tuning.present else None,
        "trade": [
            {
                "factor": point.factor,
                "bandwidth": list(point.bandwidth),
                "sensitivity_peak": finite(list(point.sensitivity_peak)),
            }
            for point in tuning.trade
        ],
        "shaping": [one.as_dict() for one in tuning.shaping],
        "notes": list(tuning.notes),
        "responses": [
            {
                "response": one.response,
                "bound": one.bound,
                "prediction": one.prediction.as_dict() if one.prediction else None,
                "kept": list(one.kept),
                "instead": one.instead,
                "refused": one.refused,
            }
            for one in tuning.responses
        ],
        "by_hand": list(tuning.by_hand),
    }


def read_tuning(path: Path) -> Tuning:
    """Read ``tuning.yaml``; one with parameters alone is read too.

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
    try:
        return Tuning(
            tuple(AxisTuning(**axis.model_dump()) for axis in checked.axes),
            checked.response,
            checked.bound,
            tuple(TestMove(**move.model_dump()) for move in checked.moves),
            _prediction(checked.prediction),
            _prediction(checked.present),
            tuple(_point(one.model_dump()) for one in checked.trade),
            tuple(_shaping(one.model_dump()) for one in checked.shaping),
            tuple(checked.notes),
            tuple(
                Choice(
                    one.response,
                    one.bound,
                    _prediction(one.prediction),
                    tuple(one.kept),
                    one.instead,
                    one.refused,
                )
                for one in checked.responses
            ),
            tuple(checked.by_hand),
        )
    except (KeyError, TypeError, ValueError) as error:
        raise FileFormatError(
            path, f"is no tuning ({error}); make it anew with `fieldtool design`."
        ) from None


def _prediction(data: _Prediction | None) -> Prediction | None:
    return None if data is None else Prediction.from_dict(data.model_dump())


def _point(data: Mapping[str, Any]) -> TradePoint:
    peaks = tuple(inf if p is None else float(p) for p in data["sensitivity_peak"])
    return TradePoint(data["factor"], tuple(data["bandwidth"]), peaks)


def _shaping(data: Mapping[str, Any]) -> Shaping:
    lists = {"amplitudes": tuple(data["amplitudes"]), "times": tuple(data["times"])}
    return Shaping(**{**data, **lists})
