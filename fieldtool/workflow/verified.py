"""What the trial of new parameters on the machine showed."""

from dataclasses import dataclass
from typing import Any, Literal

from drives.parameters import Change
from fieldtool.design.verdict import Comparison

FORMAT = "fieldtool-verification/1"
Verdict = Literal["verified", "restored", "mixed"]


@dataclass(frozen=True, eq=False)
class Verified:
    """What the trial showed."""

    verdict: Verdict
    reasons: tuple[str, ...]
    """Why the old parameters were to be restored; empty where the new ones are kept."""
    axes: tuple[Comparison, ...]
    parameters: tuple[Change, ...]
    """What was tried: new parameters, and the old ones that they took the place of."""
    bound: float
    model: Literal["identified", "prior"]
    """What the prediction rests on."""
    cycle: float
    """s."""
    notes: tuple[str, ...] = ()
    moves: tuple[dict[str, list[float]], ...] = ()
    """Each axis' move out: time, reference, and position before, predicted, after, at the same times."""

    @property
    def sentence(self) -> str:
        """What came of it, for a person."""
        if self.verdict == "verified":
            return "The new parameters stood their trial on the machine."
        if self.verdict == "mixed":
            return f"Not all drives are known to hold their old values again: {'; '.join(self.reasons)}"
        return f"The new parameters were taken back: {'; '.join(self.reasons)}"

    def as_dict(self) -> dict[str, Any]:
        """Plain values, as ``verification.yaml`` and ``--json`` have them."""
        return {
            "format": FORMAT,
            "verdict": self.verdict,
            "sentence": self.sentence,
            "reasons": list(self.reasons),
            "bound": self.bound,
            "model": self.model,
            "cycle": self.cycle,
            "axes": [
                {**axis.as_dict(), "curves": curves}
                for axis, curves in zip(self.axes, self.moves, strict=True)
            ],
            "parameters": [
                {
                    "axis": c.axis,
                    "name": c.name,
                    "object": str(c.info.address),
                    "before": c.before,
                    "after": c.after,
                    "raw": c.after_raw,
                }
                for c in self.parameters
            ],
            "notes": list(self.notes),
        }
