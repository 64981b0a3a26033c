"""An axis' move in a trial: where it goes, how long it is watched, what it may do meanwhile."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from drives.api import AxisLimits
from drives.canopen_drive import CanopenDrive
from fieldtool.design.moves import TestMove
from fieldtool.design.predict import AxisPrediction, Prediction
from fieldtool.errors import PlanRefusedError
from fieldtool.experiment.forecast import Setting
from fieldtool.experiment.verification.steps import PUSHED_ERROR
from fieldtool.experiment.verification.swings import Swings
from fieldtool.experiment.verification.trial import TrialMove
from fieldtool.records.model import AxisModel, FloatArray

ROOM = 0.6
"""Of the way to the end of the travel that a move may use: it may overshoot."""
FEWEST_COUNTS, BAND_COUNTS = 100.0, 4.0
"""Counts of the encoder that a move, and the band about its target, have at least."""
KEPT = 0.85
"""Of the limits of torque, velocity and following error that a move may take by prediction; of what an
axis may be pushed that does not move itself, too."""
SWELLS, BESIDE = 1.6, 0.15
"""Times the predicted torque, and share of the limit besides, that a move may take; never more than
MOST of the limit, and OTHERS of it on axes that are not moved."""
MOST, OTHERS = 0.97, 0.95
REST, LEAST_REST, MOST_REST = 2.0, 0.5, 6.0
"""Times the predicted settling for which a move is watched after its end; at least, at most, s."""
SHAKES = 1.5
"""Times the largest quick swing of its torque that is predicted that an axis may swing in its move."""
UNFORESEEN, OFF_TARGET = 2.0, 0.05
"""Times what is predicted that an axis may swing and be off its target once its reference stands; and
the share of the way by which it may be off besides."""
FINE_SWING = 0.02
"""Of the limit of torque, or of the band about the target: smaller swings are left out."""
ACCELERATES = 0.6
"""Share of the time to speed up below which a torque that turns back is not the move's own."""


def free_move(drive: CanopenDrive, typical: TestMove) -> TestMove:
    """Return an axis' typical move from where it stands, as far as there is room for it.

    It goes its own way where that fits, else towards the farther end of the travel.

    Raises
    ------
    PlanRefusedError
        If there is no room.
    """
    limits = drive.limits
    at = drive.read_position()
    down, up = at - limits.travel[0], limits.travel[1] - at
    room = {1.0: ROOM * up, -1.0: ROOM * down}
    sign = float(np.sign(typical.distance))
    if abs(typical.distance) > room[sign]:
        sign = 1.0 if up >= down else -1.0
    way = min(abs(typical.distance), room[sign])
    counts = abs(drive.scaling.position)
    if way < FEWEST_COUNTS * counts:
        raise PlanRefusedError(
            f"{drive.axis}: stands at {at:.4g} {drive.position_unit} and has no room to move. Nothing "
            "was moved or written. Move it away from the end of its travel."
        )
    band = max(typical.settling_band * way / abs(typical.distance), BAND_COUNTS * counts)
    return replace(typical, distance=sign * way, band=band, start=at)


@dataclass(frozen=True)
class _Taken:
    """What a move takes of the limits of one axis: of torque, following error and velocity; SI."""

    torque: float
    following_error: float
    velocity: float


def takes_too_much(
    setting: Setting, k: int, predictions: Sequence[Prediction]
) -> tuple[float, str]:
    """Return how many times what is allowed an axis' move takes by these predictions, and of what.

    The limit, its own or one of an axis beside it, that it comes nearest to; 1 and no words where all
    are kept.
    """
    found = [(1.0, "")]
    for prediction in predictions:
        moved = prediction.axes[k]
        taken = _taken(moved, k)
        every = zip(setting.model.axes, setting.limits, taken, strict=True) if taken else ()
        for own, limits, one in every:
            while_moving = "" if own.name == moved.axis else f" while {moved.axis} moves"
            found += _shares(own, limits, one, while_moving)
    return max(found, key=lambda share: share[0])


def _taken(moved: AxisPrediction, k: int) -> list[_Taken]:
    """Return what the move of axis k takes of every axis; of none where it is not predicted.

    An axis whose reference stands still is off it by all its way.
    """
    if moved.curves is None or moved.move is None or moved.beside is None:
        return []
    taken = [_Taken(*row) for row in moved.beside.T.tolist()]
    speed = float(np.abs(np.gradient(moved.curves.position, moved.curves.time)).max())
    taken[k] = _Taken(moved.peak_torque, moved.move.following_error, speed)
    return taken


def _shares(
    own: AxisModel, limits: AxisLimits, taken: _Taken, while_moving: str
) -> Iterator[tuple[float, str]]:
    """Yield the share that is taken of what is allowed of each limit, and that in words."""
    torque, length = ("N m", "rad") if own.kind == "rotary" else ("N", "m")
    for name, unit in (
        ("torque", torque),
        ("following_error", length),
        ("velocity", f"{length}/s"),
    ):
        value, most = getattr(taken, name), KEPT * getattr(limits, name)
        if while_moving and name == "following_error":
            most *= PUSHED_ERROR
        yield (
            value / most,
            f"{own.name}: {name.replace('_', ' ')} {value:.3g} {unit}{while_moving}, {most:.3g} "
            f"{unit} is allowed",
        )


def trial_move(
    move: TestMove,
    k: int,
    cycle: float,
    limits: FloatArray,
    steps: float,
    predictions: Sequence[Prediction],
    answer: tuple[FloatArray, float],
) -> TrialMove:
    """Return an axis' move with what it may do by any of these predictions.

    Parameters
    ----------
    move, k
        Of the axis; its index.
    cycle
        s.
    limits
        Of all torques, (M,).
    steps
        By how much its torque may swing because targets are whole counts, peak to peak.
    predictions
        With the loops that it will meet.
    answer
        Path and torque: see :func:`fieldtool.workflow.trial_loops.first_answer`.
    """
    known = [one.axes[k] for one in predictions if one.axes[k].move is not None]
    peak = max((one.peak_torque for one in known), default=0.0)
    torque = OTHERS * limits
    torque[k] = min(SWELLS * peak + BESIDE * limits[k] + steps / 2, MOST * limits[k])
    settles = max(
        (
            one.move.settling_time
            for one in known
            if one.move is not None and np.isfinite(one.move.settling_time)
        ),
        default=MOST_REST,
    )
    rest = min(max(REST * settles, LEAST_REST, move.duration), MOST_REST)
    rise, held, _ = move.parts
    half = ACCELERATES * (2 * rise + held)
    swings, astray = _coming_to_rest(move, k, limits[k], predictions)
    shakes = SHAKES * max((_quick_swing(one, half, limits[k]) for one in known), default=0.0)
    reference = move.reference(cycle)
    return TrialMove(
        k, reference, round(rest / cycle), torque, half, swings, astray, *answer, shakes
    )


def _quick_swing(prediction: AxisPrediction, longest: float, limit: float) -> float:
    """Return the largest swing of an axis' torque in its own move that turns within so many seconds."""
    curves = prediction.curves
    if curves is None:
        return 0.0
    swings, time = Swings(), curves.time
    swings.restart(FINE_SWING * limit)
    most = 0.0
    for value in curves.torque.tolist():
        if swings.take(value) and len(swings.times) > 1:
            first, last = (time[n - 1] for n in swings.times[-2:])
            most = max(most, swings.sizes[-1] if last - first <= longest else 0.0)
    return most


def _coming_to_rest(
    move: TestMove, k: int, limit: float, predictions: Sequence[Prediction]
) -> tuple[tuple[float, float] | None, float]:
    """Return how far an axis may swing once its reference stands, and how far it may be off its target.

    Every prediction counts UNFORESEEN times; None and infinite where there is none.
    """
    curves = [one.axes[k].curves for one in predictions]
    after = [(c.torque, c.position, c.time >= move.duration) for c in curves if c is not None]
    if len(after) < len(curves):
        return None, np.inf
    torque = max(_second_swing(t[rest], FINE_SWING * limit) for t, _, rest in after)
    position = max(_second_swing(p[rest], FINE_SWING * move.settling_band) for _, p, rest in after)
    sign = np.sign(move.distance)
    off = max(
        float(
            max(
                np.abs(p[rest] - move.distance).max(initial=0.0), (sign * (p - move.distance)).max()
            )
        )
        for _, p, rest in after
    )
    astray = UNFORESEEN * off + OFF_TARGET * abs(move.distance)
    return (UNFORESEEN * torque, UNFORESEEN * position), astray


def _second_swing(signal: FloatArray, fine: float) -> float:
    """Return the second largest swing from turn to turn: what an alarm after two of them would see."""
    swings = Swings()
    swings.restart(fine)
    sizes = [swings.sizes[-1] for value in signal.tolist() if swings.take(value)]
    return sorted([0.0, 0.0, *sizes])[-2]
