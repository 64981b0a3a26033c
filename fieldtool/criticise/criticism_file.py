"""``criticism.yaml``: read a criticism back, with file and line in every error."""

from pathlib import Path
from typing import Literal

from pydantic import Field

from fieldtool.criticise.criticism import (
    FORMAT,
    Base,
    Cause,
    Criticism,
    HeldOut,
    Judged,
    Number,
    Rejected,
    Rival,
    SignalError,
    Verdict,
)
from fieldtool.errors import FileFormatError
from fieldtool.records.model import MachineModel
from fieldtool.records.yaml_file import Number as Value
from fieldtool.records.yaml_file import StrictModel, line_of, read_checked

Axes = str | tuple[str, str]


class _Number(StrictModel):
    value: Value
    std: Value | None = Field(default=None, ge=0)
    unit: str


class _Rival(StrictModel):
    effect: str
    axis: Axes
    location: str
    experiment: str


class _Cause(StrictModel):
    effect: str
    axis: Axes
    location: str
    parameters: dict[str, _Number]
    evidence: str
    gain: Value
    chance: Value
    ties: list[_Rival] = Field(default_factory=list)


class _SignalError(StrictModel):
    torque: Value | None
    position: Value


class _HeldOut(StrictModel):
    experiments: list[str]
    split: Literal["experiments", "time"]
    error_before: dict[str, _SignalError]
    error_after: dict[str, _SignalError]
    noise_floor: dict[str, Value | None]
    explained: dict[str, Value]


class _Judged(StrictModel):
    data: Base
    before: Value | None
    after: Value | None
    noise: Value | None
    decides: bool


class _Rejected(StrictModel):
    effect: str
    axis: Axes
    location: str
    why: str


class _Criticism(StrictModel):
    format: str
    verdict: Verdict
    where: list[str]
    causes: list[_Cause]
    unexplained: list[str]
    held_out: _HeldOut
    judged: dict[str, _Judged] = Field(default_factory=dict)
    rejected: list[_Rejected]
    changes: list[str]
    band_hz: tuple[Value, Value]
    notes: list[str] = Field(default_factory=list)


def read_criticism(path: Path, model: MachineModel) -> Criticism:
    """Read ``criticism.yaml``.

    Parameters
    ----------
    path : Path
    model : MachineModel
        What it is about; it stands in a file of its own (``model.yaml``).

    Raises
    ------
    FileFormatError
        If it is missing, or is no criticism: with the line.
    """
    data, lines = read_checked(path, _Criticism)
    if data.format != FORMAT:
        raise FileFormatError(
            path, f"format must be {FORMAT}, got {data.format!r}", line_of(lines, ("format",))
        )
    held = data.held_out
    axes = set(held.error_before)
    if not axes == set(held.error_after) == set(held.noise_floor):
        raise FileFormatError(
            path,
            "held_out does not speak of the same axes everywhere.",
            line_of(lines, ("held_out",)),
        )
    judged = {name: Judged(**one.model_dump()) for name, one in data.judged.items()}
    if judged and set(judged) != axes:
        raise FileFormatError(
            path, "judged is not of the axes of held_out.", line_of(lines, ("judged",))
        )
    return Criticism(
        data.verdict,
        tuple(data.where),
        tuple(_cause(c) for c in data.causes),
        tuple(data.unexplained),
        HeldOut(
            tuple(held.experiments),
            held.split,
            {k: SignalError(e.torque, e.position) for k, e in held.error_before.items()},
            {k: SignalError(e.torque, e.position) for k, e in held.error_after.items()},
            held.noise_floor,
            held.explained,
        ),
        tuple(Rejected(r.effect, r.axis, r.location, r.why) for r in data.rejected),
        tuple(data.changes),
        model,
        data.band_hz,
        judged or {name: _as_unseen(data, name) for name in held.error_before},
        tuple(data.notes),
    )


def _as_unseen(data: _Criticism, name: str) -> Judged:
    """Return what a file without ``judged`` says of an axis.

    Which axes decided, it does not say.  It may be all of which something is unexplained, and all with
    causes where these explain only a part: none is then said to be explained that may not be.
    """
    held = data.held_out
    of_causes = {axis for c in data.causes for axis in _cause(c).axes}
    decides = (data.verdict == "partly explained" and name in of_causes) or (
        data.verdict in ("partly explained", "unexplained")
        and any(s.startswith(f"{name}: ") for s in data.unexplained)
    )
    before, after = held.error_before[name].torque, held.error_after[name].torque
    if before is None:
        return Judged("nothing", None, None, None, decides)
    return Judged("unseen", before, after, held.noise_floor[name], decides)


def _cause(data: _Cause) -> Cause:
    return Cause(
        data.effect,
        data.axis,
        data.location,
        {
            name: Number(n.value, float("nan") if n.std is None else n.std, n.unit)
            for name, n in data.parameters.items()
        },
        data.evidence,
        data.gain,
        data.chance,
        tuple(Rival(r.effect, r.axis, r.location, r.experiment) for r in data.ties),
    )
