"""What criticism finds, as one frozen value; ``criticism.yaml`` holds it."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from math import isfinite
from typing import Any, Literal

from fieldtool.records.model import MachineModel

FORMAT = "fieldtool-criticism/1"
Verdict = Literal["adequate", "explained", "partly explained", "unexplained"]
Base = Literal["unseen", "all", "nothing"]
"""Data that an axis is judged by: what no fit has seen; all, where that tells nothing of its torque;
nothing, where not even all data do."""


@dataclass(frozen=True)
class Number:
    """A number of a cause."""

    value: float
    std: float
    unit: str

    def as_dict(self) -> dict[str, Any]:
        """Plain values; an unknown standard error is null."""
        return {"value": self.value, "std": _plain(self.std), "unit": self.unit}


@dataclass(frozen=True)
class Rival:
    """What explains the data as well as a cause does."""

    effect: str
    axis: str | tuple[str, str]
    location: str
    experiment: str
    """What would tell them apart."""


@dataclass(frozen=True)
class Cause:
    """A named effect and why it is named."""

    effect: str
    axis: str | tuple[str, str]
    location: str
    """``motor``, ``load``, ``spring K``."""
    parameters: Mapping[str, Number]
    evidence: str
    gain: float
    """RMS of what it explains of the unseen torque, beside all others, over RMS of that torque."""
    chance: float
    """Probability that the error on unseen data falls so much by chance."""
    ties: tuple[Rival, ...] = ()

    @property
    def axes(self) -> tuple[str, ...]:
        """The axis, or both."""
        return (self.axis,) if isinstance(self.axis, str) else self.axis

    @property
    def axis_words(self) -> str:
        """The axis, or both."""
        return " - ".join(self.axes)


@dataclass(frozen=True)
class SignalError:
    """RMS of measured minus simulated over RMS of measured, of one axis."""

    torque: float | None
    """None where no line of it can be compared: the axis is still, or its encoder hides at all
    frequencies what torque its motion needs."""
    position: float


@dataclass(frozen=True)
class Judged:
    """What the verdict, its sentences and the tables say of the torque of one axis."""

    data: Base
    before: float | None
    """RMS of measured minus simulated over RMS of measured, in these data, without effects."""
    after: float | None
    """With the causes; the same where there is none."""
    noise: float | None
    """In the same measure; None where no period repeats."""
    decides: bool
    """Whether the verdict would be better without what is left of this axis."""


@dataclass(frozen=True)
class HeldOut:
    """Before and after, on what no fit has seen."""

    experiments: tuple[str, ...]
    split: Literal["experiments", "time"]
    error_before: Mapping[str, SignalError]
    error_after: Mapping[str, SignalError]
    noise_floor: Mapping[str, float | None]
    """Of the torque, in the same measure; None where no period repeats, or there is no torque."""
    explained: Mapping[str, float]
    """Share of the power of the error that could be explained (noise taken off) that is now."""


@dataclass(frozen=True)
class Rejected:
    """An effect that gets no name here, and why."""

    effect: str
    axis: str | tuple[str, str]
    location: str
    why: str


@dataclass(frozen=True, eq=False)
class Criticism:
    """Where a simulation is wrong, why, and what is gained."""

    verdict: Verdict
    where: tuple[str, ...]
    """One sentence an axis: the error of the machine without effects, of the data it is judged by."""
    causes: tuple[Cause, ...]
    """In order of gain."""
    unexplained: tuple[str, ...]
    """What is left, described by its signature; empty where nothing is."""
    held_out: HeldOut
    rejected: tuple[Rejected, ...]
    changes: tuple[str, ...]
    """What changed since the machine was last accepted; empty where that is not known."""
    model: MachineModel
    """With the effects, and masses and springs fitted beside them."""
    band: tuple[float, float]
    """Frequencies compared, Hz."""
    judged: Mapping[str, Judged]
    """By axis."""
    notes: tuple[str, ...] = field(default=())

    def as_dict(self) -> dict[str, Any]:
        """Plain values, as ``criticism.yaml`` and ``--json`` have them."""
        held = self.held_out
        return {
            "format": FORMAT,
            "verdict": self.verdict,
            "where": list(self.where),
            "causes": [
                {
                    "effect": c.effect,
                    "axis": c.axis if isinstance(c.axis, str) else list(c.axis),
                    "location": c.location,
                    "parameters": {k: n.as_dict() for k, n in c.parameters.items()},
                    "evidence": c.evidence,
                    "gain": c.gain,
                    "chance": c.chance,
                    "ties": [
                        {
                            "effect": r.effect,
                            "axis": r.axis if isinstance(r.axis, str) else list(r.axis),
                            "location": r.location,
                            "experiment": r.experiment,
                        }
                        for r in c.ties
                    ],
                }
                for c in self.causes
            ],
            "unexplained": list(self.unexplained),
            "held_out": {
                "experiments": list(held.experiments),
                "split": held.split,
                "error_before": _errors(held.error_before),
                "error_after": _errors(held.error_after),
                "noise_floor": dict(held.noise_floor),
                "explained": dict(held.explained),
            },
            "judged": {name: asdict(j) for name, j in self.judged.items()},
            "rejected": [
                {
                    "effect": r.effect,
                    "axis": r.axis if isinstance(r.axis, str) else list(r.axis),
                    "location": r.location,
                    "why": r.why,
                }
                for r in self.rejected
            ],
            "changes": list(self.changes),
            "band_hz": list(self.band),
            "notes": list(self.notes),
        }


def _errors(errors: Mapping[str, SignalError]) -> dict[str, dict[str, float | None]]:
    return {name: {"torque": e.torque, "position": e.position} for name, e in errors.items()}


def _plain(value: float) -> float | None:
    return value if isfinite(value) else None
