"""Multisine recordings made ready: periods found, dead signals refused, transients and reversals out."""

from dataclasses import replace

import numpy as np

from fieldtool.errors import NotEnoughDataError
from fieldtool.frf.multisine.period import samples_of_period
from fieldtool.records.recording import Experiment, Recording

STRETCHES = 200
"""Of a period, over which an axis has to move on to count as one that never reverses."""


def with_periods(recording: Recording) -> Recording:
    """Return the recording with the period of every multisine, found where none is given.

    Raises
    ------
    NotEnoughDataError
        If none is given and nothing repeats.
    """
    step = recording.sample_period
    experiments = tuple(
        replace(one, period=samples_of_period(one, step) * step)
        if one.kind == "multisine" and one.complete and one.period is None
        else one
        for one in recording.experiments
    )
    return replace(recording, experiments=experiments)


def check_alive(recording: Recording) -> None:
    """Refuse multisines in which an axis' measured position or torque is one value throughout.

    Raises
    ------
    NotEnoughDataError
        Naming axis, signal and value.
    """
    multisines = [e for e in recording.experiments if e.kind == "multisine" and e.complete]
    for k, axis in enumerate(recording.axes):
        for signal, unit in (("position", axis.position_unit), ("torque", axis.torque_unit)):
            columns = [getattr(e, signal)[:, k] for e in multisines]
            if not columns or any(np.ptp(values) > 0 for values in columns):
                continue
            raise NotEnoughDataError(
                f"axis {axis.name}: its measured {signal} is {columns[0][0]:.4g} {unit} in every sample "
                f"of all {len(columns)} multisine experiments: the axis was not excited, is blocked, or "
                "its signal is not recorded; check the column or the drive's mapping, and measure again."
            )


def settled(experiment: Experiment, sample_period: float) -> Experiment:
    """Return positions and torques with the last period twice, a constant velocity kept.

    What had not settled in the periods before is gone; what dry friction is estimated from has no
    other guard against transients.
    """
    rows = round((experiment.period or 0.0) / sample_period)
    if rows == 0 or experiment.samples < 2 * rows:
        return experiment
    position, torque = experiment.position[-2 * rows :], experiment.torque[-rows:]
    way = position[rows:].mean(axis=0) - position[:rows].mean(axis=0)
    return replace(
        experiment,
        time=experiment.time[-2 * rows :],
        position=np.concatenate([position[rows:] - way, position[rows:]]),
        torque=np.concatenate([torque, torque]),
        position_reference=None,
        torque_reference=None,
        velocity=None,
        statusword=None,
        extra={},
        segments=(),
    )


def moving_on(recording: Recording) -> Recording:
    """Return the recording without the multisines in which an axis reverses that elsewhere never does.

    An axis gets a constant velocity because it has dry friction: where it never reverses, friction is
    a constant and out of the response; where it does, friction would bend the model.  All experiments
    are kept unless at least as many as there are axes remain.
    """
    step, multisines = recording.sample_period, {}
    for one in recording.experiments:
        if one.kind == "multisine" and one.complete:
            multisines[one.name] = [_moves_on(one, k, step) for k in range(len(recording.axes))]
    if not multisines:
        return recording
    freed = np.any(list(multisines.values()), axis=0)
    kept = [name for name, on in multisines.items() if np.all(np.array(on)[freed])]
    if not np.any(freed) or len(kept) < len(recording.axes):
        return recording
    experiments = tuple(
        one for one in recording.experiments if one.name in kept or one.name not in multisines
    )
    return replace(recording, experiments=experiments)


def _moves_on(experiment: Experiment, axis: int, sample_period: float) -> bool:
    """Whether an axis moves one way only in the last period of an experiment."""
    rows = round((experiment.period or 0.0) / sample_period)
    apart = max(1, rows // STRETCHES)
    ways = np.diff(experiment.position[-rows - 1 :: apart, axis])
    return bool(ways.size and (np.all(ways > 0) or np.all(ways < 0)))
