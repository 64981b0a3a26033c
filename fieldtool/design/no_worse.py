"""New parameters against those that the drives have: an axis that would be worse keeps its own.

Worse is slower, and softer where nothing that was asked for takes stiffness: an axis that is no more
than softer is designed anew first, with its stiffness as a bound.  A motor that strays more
from its reference is told (:mod:`fieldtool.design.given_up`): that is how the last mass arrives early.
"""

from math import inf

import numpy as np

from fieldtool.design.design import INSIDE, Task, improved
from fieldtool.design.held import held
from fieldtool.design.machine import machine_of
from fieldtool.design.predict import AxisPrediction, Prediction, predict
from fieldtool.design.robust import SLACK, stable_on_all
from fieldtool.design.rule import DesignError
from fieldtool.design.servo import Servo
from fieldtool.design.uncertainty import samples_of

LONGER = 1.05
"""Of the present settling time of the motor, or of the time until motor and last mass have arrived: what
makes new parameters worse."""
TICK = 0.002
"""s of settling that nobody notices."""
SOFTER = 1.2
"""Of the present largest compliance: from it an axis is clearly softer."""
SPREAD_OF = 8
"""Machines that the prediction's spread is over."""
SPREAD_SEED = 20


def no_worse(
    task: Task, chosen: tuple[Servo, ...], kept: frozenset[int] = frozenset()
) -> tuple[tuple[Servo, ...], frozenset[int]]:
    """Return controllers of which none is worse than what its drive has, and the axes that keep theirs.

    Only present controllers that keep the margin are to be beaten.  The other axes are designed anew
    round those that are kept, where they do not go with them as they are.  All keep theirs where new
    ones of some would make an axis worse that keeps its own.

    Parameters
    ----------
    task
        The task; its best controllers change where axes are designed anew.
    chosen
        New controllers as the drives hold them.
    kept
        Axes that keep their present controllers already.

    Raises
    ------
    DesignError
        If new parameters are worse, and the present ones do not keep the margin on all machines.
    """
    present, beaten = task.present, _to_beat(task)
    if present is None or beaten is None:
        return chosen, kept
    old, good = beaten
    every = frozenset(range(len(present)))
    # no response asks to give up stiffness, and no machine that the model allows
    firm = not task.softens and task.holds(present, every)
    stiff = [firm and one.margins.sensitivity_peak <= SLACK * task.bound for one in old.axes]
    chosen, kept = _firmer(task, chosen, old, (good, stiff), kept)
    while worse := _worse_axes(task, chosen, old, (good, stiff), kept):
        kept |= worse
        mixed = tuple(present[k] if k in kept else one for k, one in enumerate(chosen))
        if not task.holds(mixed, kept):
            mixed = _round_these(task, mixed, kept) or present
        if mixed == present:
            if task.holds(present, every):
                return present, every
            raise _worse(task, chosen, old, min(worse))
        chosen = mixed
    if hurt := _worse_axes(
        task, chosen, old, (good, stiff), frozenset()
    ):  # kept ones, by the others
        if task.holds(present, every):
            return present, every
        raise _worse(task, chosen, old, min(hurt))
    return chosen, kept


def _to_beat(task: Task) -> tuple[Prediction, list[bool]] | None:
    """Return what the present controllers do, and which of them count: they keep the margin.

    None where they are not known, or not stable.
    """
    present = task.present
    old = None if present is None else predicted(task, present, spread=False)
    if old is None or not old.stable:
        return None
    return old, [axis.margins.sensitivity_peak <= SLACK * task.most for axis in old.axes]


def is_slower(task: Task, servos: tuple[Servo, ...]) -> bool:
    """Return whether an axis would be slower than with its present controller, where that counts."""
    beaten = _to_beat(task)
    if beaten is None:
        return False
    old, good = beaten
    return bool(_worse_axes(task, servos, old, (good, [False] * len(good)), frozenset()))


def _firmer(
    task: Task,
    chosen: tuple[Servo, ...],
    old: Prediction,
    which: tuple[list[bool], list[bool]],
    kept: frozenset[int],
) -> tuple[tuple[Servo, ...], frozenset[int]]:
    """Design axes anew that are worse for being softer alone; unchanged where that does not help."""
    good, stiff = which
    worse = _worse_axes(task, chosen, old, which, kept)
    soft = worse - _worse_axes(task, chosen, old, (good, [False] * len(stiff)), kept)
    if not soft:
        return chosen, kept
    task.softest = {k: INSIDE * SOFTER * old.axes[k].compliance for k in soft}
    task.take(chosen)
    for axis in sorted(soft):
        improved(task, axis)
    try:
        firmer, same = held(task, kept)
    except DesignError:
        return chosen, kept
    better = _worse_axes(task, firmer, old, which, same) < worse
    return (firmer, same) if better else (chosen, kept)


def _round_these(
    task: Task, mixed: tuple[Servo, ...], kept: frozenset[int]
) -> tuple[Servo, ...] | None:
    """Design the other axes anew; None where that does not come out within the margin."""
    if len(kept) == len(mixed) or not stable_on_all(task.machines, mixed):
        return None
    task.take(mixed)
    for axis in range(len(mixed)):
        if axis not in kept:
            improved(task, axis)
    try:
        return held(task, kept)[0]
    except DesignError:
        return None


def _worse_axes(
    task: Task,
    servos: tuple[Servo, ...],
    old: Prediction,
    which: tuple[list[bool], list[bool]],
    kept: frozenset[int],
) -> frozenset[int]:
    """Return the axes that would be worse, of those whose present loops count, and as how stiff."""
    new, (good, stiff) = predicted(task, servos, spread=False), which
    return frozenset(
        k
        for k, (one, was) in enumerate(zip(new.axes, old.axes, strict=True))
        if good[k] and k not in kept
        if slower_than(one, was) or (stiff[k] and softer_than(one, was))
    )


def _worse(task: Task, servos: tuple[Servo, ...], old: Prediction, axis: int) -> DesignError:
    new, was = predicted(task, servos, spread=False).axes[axis], old.axes[axis]
    return DesignError(
        f"{new.axis}: the new parameters would need {arrival(new):.3g} s for its typical move, the "
        f"present ones need {arrival(was):.3g} s with a peak of sensitivity of "
        f"{was.margins.sensitivity_peak:.3g}, and do not keep {task.most:.3g} on every machine that "
        "the model allows; nothing is written. Keep the present ones, or try --response stiff."
    )


def predicted(task: Task, servos: tuple[Servo, ...], *, spread: bool = True) -> Prediction:
    """Return what controllers do on the task's machine."""
    rng = np.random.default_rng(SPREAD_SEED)
    return predict(
        task.machines[0],
        servos,
        task.moves,
        resolutions=[side.resolution for side in task.sides],
        samples=[machine_of(m) for m in samples_of(task.model, SPREAD_OF, rng)] if spread else (),
    )


def arrival(axis: AxisPrediction) -> float:
    """Return when motor and last mass have both arrived, s from the beginning of the move."""
    if axis.move is None or axis.load is None:
        return inf
    return max(axis.move.positioning_time, axis.load.positioning_time)


def slower_than(new: AxisPrediction, was: AxisPrediction) -> bool:
    """Return whether an axis arrives or settles later than it did, by more than anybody would take."""
    if new.move is None or was.move is None:
        return was.move is not None
    return (
        arrival(new) > LONGER * arrival(was)
        or new.move.settling_time > LONGER * was.move.settling_time + TICK
    )


def softer_than(new: AxisPrediction, was: AxisPrediction) -> bool:
    """Return whether an axis gives way to torques clearly more than it did."""
    return new.compliance > SOFTER * was.compliance
