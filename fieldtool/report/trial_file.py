"""``verification.yaml`` as the report shows it: read with file and line in every error."""

from pathlib import Path
from typing import Literal, Self

from pydantic import Field, model_validator

from fieldtool.records.yaml_file import Number, PartModel, read_checked

Values = list[float]
"""Of a curve; what is no number is a gap."""


class Figures(PartModel):
    """What one axis did, or would do, in the short test; SI, None: not known."""

    settling_time: Number | None = None
    overshoot: Number | None = None
    vibration: Number | None = None
    following_error: Number | None = None
    peak_torque: Number | None = None
    sensitivity_peak: Number | None = None
    sensitivity_frequency: Number | None = None


class Sensitivity(PartModel):
    """Frequencies (Hz) and sizes of 1 / (1 + L), and of L / (1 + L) where it is told."""

    frequency: Values
    size: Values
    response: Values | None = None

    @model_validator(mode="after")
    def _of_one_length(self) -> Self:
        for values in (self.size, self.response):
            if values is not None and len(self.frequency) != len(values):
                raise ValueError("frequency, size and response are not of one length")
        return self


class Sensitivities(PartModel):
    """An axis' sensitivity each time."""

    before: Sensitivity | None = None
    predicted: Sensitivity | None = None
    after: Sensitivity | None = None


class Step(PartModel):
    """A step of the reference without feed-forward, by the model: time (s), position over its height."""

    time: Values
    position: Values

    @model_validator(mode="after")
    def _of_one_length(self) -> Self:
        if len(self.time) != len(self.position):
            raise ValueError("time and position are not of one length")
        return self


class Steps(PartModel):
    """An axis' step with the old and with the new parameters."""

    before: Step | None = None
    predicted: Step | None = None


class Move(PartModel):
    """An axis' typical move each time: positions at the times in common (s)."""

    time: Values = Field(default_factory=list)
    before: Values | None = None
    predicted: Values | None = None
    after: Values | None = None

    @model_validator(mode="after")
    def _of_one_length(self) -> Self:
        for values in (self.before, self.predicted, self.after):
            if values is not None and len(values) != len(self.time):
                raise ValueError("time and positions are not of one length")
        return self


class AxisTrial(PartModel):
    """One axis before, as predicted, and after."""

    axis: str
    unit: str = ""
    """Of positions."""
    before: Figures | None = None
    predicted: Figures | None = None
    after: Figures | None = None
    sensitivity: Sensitivities = Sensitivities()
    step: Steps = Steps()
    curves: Move = Move()


class TrialFile(PartModel):
    """What a trial of new parameters showed."""

    format: Literal["fieldtool-verification/1"]
    sentence: str
    axes: list[AxisTrial]
    notes: list[str] = Field(default_factory=list)


def read_trial(path: Path) -> TrialFile:
    """Read ``verification.yaml``.

    Raises
    ------
    FileFormatError
        If it is missing, or does not tell of a trial: with the line.
    """
    return read_checked(path, TrialFile)[0]
