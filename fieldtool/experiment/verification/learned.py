"""What the trial of the old parameters taught of drives' torques: what is usual with the new ones."""

from dataclasses import dataclass

import numpy as np

from fieldtool.experiment.verification.gains import NAMES
from fieldtool.records.model import FloatArray

LEAST_SEEN = 0.5
"""Share of its cycles that have to be compared for a trial to tell anything of controllers."""
LEARNED, LEAST_LEARNED, MOST_LEARNED = 2.0, 0.8, 4.0
"""Times the difference that was seen with the old parameters that is allowed with the new ones; of the
usual one at least; and times the usual one above which a drive is not judged."""


@dataclass(frozen=True, eq=False)
class Learned:
    """How well torques followed from parameters that are known to be in the drives; shapes (M,)."""

    still: FloatArray
    """Largest lasting difference while the axes stood still, N m or N."""
    share: FloatArray
    """Largest lasting difference of all, over what is usually allowed."""
    late: FloatArray
    """s, by which torques answered positions later or earlier than they should, by least squares."""
    seen: float = 1.0
    """Share of the cycles that were compared."""
    off: FloatArray | None = None
    """Shares by which gains were surely off, shape (3, M), as an estimate has them; None: none."""

    @property
    def gains(self) -> FloatArray:
        """The same; zeros where there is none."""
        return np.zeros((len(NAMES), self.share.size)) if self.off is None else self.off

    def why_not(self) -> tuple[str, ...]:
        """Return for each axis why it can not be judged by what was seen; empty where it can."""
        if self.seen < LEAST_SEEN:
            why = f"late cycles left {100 * self.seen:.0f} % of the trial of its old parameters"
            return (why,) * self.share.size
        return tuple(
            f"with its old parameters its torque was up to {share:.2g} times as far from what they make "
            "of target and position as is usual"
            if LEARNED * share > MOST_LEARNED
            else ""
            for share in self.share.tolist()
        )
