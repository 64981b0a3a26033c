"""A design's controllers as the drives hold them: rounded, within ranges, still within the margin."""

import numpy as np

from fieldtool.design.design import Task
from fieldtool.design.robust import check
from fieldtool.design.rule import DesignError
from fieldtool.design.servo import Servo
from fieldtool.design.start import slower
from fieldtool.design.tuning import as_parameters

TIMES = 6
"""That gains are lowered because rounding took the margin."""


def held(
    task: Task, kept: frozenset[int] = frozenset()
) -> tuple[tuple[Servo, ...], frozenset[int]]:
    """Return a task's best controllers as the drives will hold them, and the axes that keep theirs.

    An axis whose drive can not hold anything within the margin keeps its present parameters, where
    these are within it.

    Parameters
    ----------
    task
        The task.
    kept
        Axes whose controllers are the present ones, and stay.

    Raises
    ------
    DesignError
        If rounding or ranges leave no margin on some machine.
    """
    servos, present = list(task.servos), task.present
    for _ in range(TIMES):
        parameters = [
            as_parameters(servo, side) for servo, side in zip(servos, task.sides, strict=True)
        ]
        rounded = tuple(
            servo if k in kept else side.servo(side.held(one))
            for k, (side, one, servo) in enumerate(zip(task.sides, parameters, servos, strict=True))
        )
        peaks = check(task.machines, rounded).peaks.max(axis=0)
        over = peaks / task.limits(kept)
        if np.all(over <= 1.0):
            return rounded, kept
        for k, servo in enumerate(servos):
            if over[k] > 1.0 and k not in kept:
                servos[k] = slower(servo)
    k = int(np.argmax(over))
    if present is not None and k not in kept:
        mixed = (*rounded[:k], present[k], *rounded[k + 1 :])
        if task.holds(mixed, kept | {k}):
            return mixed, kept | {k}
    outside = task.sides[k].out_of_range(parameters[k])
    why = (
        f"its ranges are too small: {', '.join(outside)}" if outside else "its steps are too coarse"
    )
    raise DesignError(
        f"{task.sides[k].axis}: with the numbers that the drive can hold, the peak of sensitivity is "
        f"{peaks[k]:.3g}, above {task.bound:.3g}; {why}. Nothing is written. Choose other units or "
        "ranges in the drive, allow more with --bound, or enter gains by hand."
    )
