"""Plan the trial of old and new parameters: one plan for both, within the limits of either."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from drives.api import AxisLimits
from drives.canopen_drive import CanopenDrive, CanopenGroup
from drives.parameters import Change, read_loop, read_parameters
from fieldtool.design.moves import TestMove
from fieldtool.design.predict import Prediction, predict
from fieldtool.design.servo import Servo, servo_from_parameters
from fieldtool.errors import PlanRefusedError
from fieldtool.experiment.axes import torque_limits
from fieldtool.experiment.forecast import Setting
from fieldtool.experiment.multisine.design import fast_cycle_times
from fieldtool.experiment.verification.excitation import (
    HIGHEST,
    Lines,
    expected_peaks,
    sensitivity_plan,
)
from fieldtool.experiment.verification.trial import Trial
from fieldtool.records.model import FloatArray
from fieldtool.workflow.design_inputs import moves_of, timing_of
from fieldtool.workflow.preparation import check_seen, without_feed_forward
from fieldtool.workflow.trial_checks import (
    check_a_count,
    check_as_designed,
    check_excited,
    check_present,
    check_stable,
)
from fieldtool.workflow.trial_loops import answer_torque, drive_loop, first_answer
from fieldtool.workflow.trial_moves import MOST, free_move, takes_too_much, trial_move

GENTLER, TIMES = 0.75, 12
"""What is left of a move's velocity and acceleration where it takes more, and how often."""
EXCITED = 3.0
"""Times what the excitation does by the model that it may do."""
NOISE_SWINGS = 12.0
"""Times the RMS of the torque that an encoder's steps make: by so much it may swing, peak to peak."""
COUNT_SWINGS = 2.5
"""Times the torque that a single count makes: one to, one fro, and what else is heard."""
ROUNDED_TARGETS = 3.5
"""Targets are whole counts: their second difference, a cycle squared apart, may swing by so many counts,
peak to peak, and the inertia that is fed forward makes torque of it."""
ROOM_AGAIN = 0.66
"""Of the way to the end of the travel that a move may use where its trial is begun again: more than
ROOM of a planned one, for the axis coasted a little since."""
STANDSTILL_TIME, STANDSTILL_TIMEOUT = 0.25, 120.0
STANDSTILL_COUNTS, STANDSTILL_TRAVEL = 3.0, 2e-4
"""A disabled axis stands that moves by less than so many counts, or this share of its travel, in so many
seconds, twice; waited for at most."""
UNKNOWN_LAG = 0.25
"""Of the cycle."""
_UNASKED = (
    "{}: one count of its encoder makes so much torque that its controller is not asked for a first "
    "answer; it is watched from its first move on"
)


@dataclass(frozen=True, eq=False)
class TrialPlan:
    """What is tried, and what is to be expected of it."""

    trial: Trial
    lines: Lines | None
    """Of the excitation; None where there is none."""
    moves: tuple[TestMove, ...]
    old: tuple[Servo, ...]
    new: tuple[Servo, ...]
    before: Prediction
    after: Prediction
    notes: tuple[str, ...]
    bare: tuple[Servo, ...] = ()
    """The new ones as an excitation by references meets them: without what can be switched off."""
    lags: tuple[float, ...] = ()
    """s, of each axis' torque behind a torque offset; where its profile does not know it a quarter of
    the cycle."""


def no_room(group: CanopenGroup, trial: Trial) -> str:
    """Say which axis stands where a trial can not be begun any more; empty where all do well."""
    ways = {move.axis: move.distance for move in trial.moves}
    for k, drive in enumerate(group.drives):
        at, (low, high), way = drive.read_position(), drive.limits.travel, ways.get(k, 0.0)
        least = 0.0 if trial.excitation is None else float(trial.excursion[k])
        end = at + way / ROOM_AGAIN
        if min(at - least, end) < low or high < max(at + least, end):
            unit = drive.position_unit
            return (
                f"{drive.axis} stands at {at:.4g} {unit}, from where its move of {way:.3g} {unit} or "
                f"the excitation has no room in its travel, {low:.4g} to {high:.4g} {unit}."
            )
    return ""


def wait_for_standstill(group: CanopenGroup) -> None:
    """Wait until no disabled axis moves any more: whatever coasts or swings has to come to rest.

    Raises
    ------
    PlanRefusedError
        If one goes on moving.
    """
    still = 0
    before = [drive.read_position() for drive in group.drives]
    moved: list[str] = []
    for _ in range(round(STANDSTILL_TIMEOUT / STANDSTILL_TIME)):
        group.drives[0].wait(STANDSTILL_TIME)
        now = [drive.read_position() for drive in group.drives]
        moved = [
            drive.axis
            for drive, a, b in zip(group.drives, before, now, strict=True)
            if abs(b - a) > STANDSTILL_COUNTS * abs(drive.scaling.position)
            and abs(b - a) > STANDSTILL_TRAVEL * (drive.limits.travel[1] - drive.limits.travel[0])
        ]
        before, still = now, 0 if moved else still + 1
        if still >= 2:
            return
    raise PlanRefusedError(
        f"{', '.join(moved)}: moves although its drive is disabled. Does "
        "its brake close, does something push it, or does its encoder drift?"
    )


def servo_of(drive: CanopenDrive, changes: Sequence[Change], cycle_time: float) -> Servo:
    """Return the controller in a drive, with some of its parameters changed."""
    return servo_from_parameters(_values(drive, changes), timing_of(drive.profile, cycle_time))


def torque_steps(drive: CanopenDrive, servo: Servo, cycle_time: float) -> float:
    """Return how far the steps of encoder and targets alone may make a torque swing, peak to peak."""
    step = abs(drive.scaling.position)
    rounded = ROUNDED_TARGETS * servo.loop.inertia_ff * step / cycle_time**2
    return encoder_swing(drive, servo) + rounded


def encoder_swing(drive: CanopenDrive, servo: Servo) -> float:
    """Return how far the steps of the encoder may make a torque swing at rest, peak to peak."""
    count = abs(drive.scaling.position)
    return max(NOISE_SWINGS * servo.torque_noise(count), COUNT_SWINGS * servo.count_torque(count))


def _values(drive: CanopenDrive, changes: Sequence[Change]) -> Mapping[str, float]:
    """Return the cascade's parameters in a drive, by name, after these changes."""
    own = {change.name: change.after for change in changes if change.axis == drive.axis}
    if not own:
        return read_loop(drive)
    values = dict(read_loop(drive))
    held = read_parameters(drive) | own
    return {**values, **drive.conversion().as_cascade(held)}


def plan_trial(
    group: CanopenGroup,
    setting: Setting,
    changes: Sequence[Change],
    bound: float,
    stated: Mapping[str, float],
    designed: Prediction | None = None,
) -> TrialPlan:
    """Plan moves and excitation from where the axes stand, for the old and the new parameters.

    Parameters
    ----------
    group
        Drives; nothing moves.
    setting
        Model, the loops that are in the drives now, limits.
    changes
        What the new parameters change.
    bound
        Of the peak of sensitivity that the new parameters were designed for.
    stated
        What that peak is by the tuning, by axis; empty where the model is not the one it was made for.
    designed
        What the tuning predicts, where it does.

    Raises
    ------
    PlanRefusedError
        If the new loops are not stable by the model, there is no room to move, or an excitation within
        all limits would not be seen.
    """
    cycle = fast_cycle_times(setting.model, group.shortest_cycle)[0]
    old = tuple(servo_of(drive, (), cycle) for drive in group.drives)
    new = tuple(servo_of(drive, changes, cycle) for drive in group.drives)
    for k, drive in enumerate(group.drives):
        check_a_count(drive, (old[k], new[k]), setting.limits[k].torque, cycle)
    typical = moves_of(group.machine, setting.model)
    moves = tuple(free_move(*pair) for pair in zip(group.drives, typical, strict=True))
    for _ in range(TIMES):
        before, after = (predict(setting.model, servos, moves) for servos in (old, new))
        check_present(before)
        check_stable(after, bound)
        check_as_designed(after, stated, designed)
        over = [takes_too_much(setting, k, (before, after)) for k in range(len(moves))]
        if not any(words for _, words in over):
            break
        moves = tuple(
            _gentler(move, min(GENTLER, share**-0.5)) if words else move
            for move, (share, words) in zip(moves, over, strict=True)
        )
    else:
        raise PlanRefusedError(
            "no move can be found that keeps all limits with the old and the new parameters, though it "
            f"was made slower {TIMES} times ({'; '.join(words for _, words in over if words)}). "
            "Nothing was moved or written. Widen the limits if the machine allows it, or use "
            "--no-verify."
        )
    for drive, move in zip(group.drives, moves, strict=True):
        check_seen(drive, abs(move.distance), "the trial's move")
    limits = torque_limits(setting.limits)
    steps = [
        max(torque_steps(drive, servo, cycle) for servo in (old[k], new[k]))
        for k, drive in enumerate(group.drives)
    ]
    answers = [
        _answer(drive, (old[k], new[k]), setting.limits[k], moves[k].distance, cycle)
        for k, drive in enumerate(group.drives)
    ]
    unasked = [
        d.axis for d, answer in zip(group.drives, answers, strict=True) if not answer[0].size
    ]
    notes = tuple(_UNASKED.format(axis) for axis in unasked)
    trial_moves = tuple(
        trial_move(move, k, cycle, limits, steps[k], (before, after), answers[k])
        for k, move in enumerate(moves)
    )
    plan = TrialPlan(
        Trial(cycle, trial_moves, None, np.zeros(limits.size), np.zeros(limits.size)),
        None,
        moves,
        old,
        new,
        before,
        after,
        notes,
        lags=tuple(drive.profile.torque_lag or UNKNOWN_LAG * cycle for drive in group.drives),
    )
    return _with_excitation(plan, group, setting, steps)


def _gentler(move: TestMove, factor: float) -> TestMove:
    return replace(
        move,
        velocity=move.velocity * factor,
        acceleration=move.acceleration * factor**2,
        jerk=move.jerk * factor**3,
    )


def _answer(
    drive: CanopenDrive, servos: Sequence[Servo], limits: AxisLimits, distance: float, cycle: float
) -> tuple[FloatArray, float]:
    """Return the path by which an axis' controller is known, and the torque that it takes."""
    loops = [drive_loop(drive, servo) for servo in servos]
    answer = first_answer(loops, abs(drive.scaling.position), limits, distance, cycle)
    return answer, answer_torque(loops, answer, cycle)


def _with_excitation(
    plan: TrialPlan, group: CanopenGroup, setting: Setting, steps: Sequence[float]
) -> TrialPlan:
    """Add the small multisine.

    Raises
    ------
    PlanRefusedError
        If none can be planned that is seen: what was not measured is never kept.
    """
    cycle = plan.trial.cycle_time
    limits = torque_limits(setting.limits)
    highest = 0.9 * HIGHEST / cycle
    peaks = [
        sorted(
            {
                min(prediction.axes[k].margins.peak_frequency, highest)
                for prediction in (plan.before, plan.after)
            }
        )
        for k in range(limits.size)
    ]
    at = np.array([drive.read_position() for drive in group.drives])
    loops = [
        tuple(without_feed_forward(d, s.loop) for d, s in zip(group.drives, servos, strict=True))
        for servos in (plan.old, plan.new)
    ]
    here = [replace(setting, loops=own, centre=at) for own in loops]
    try:
        excitation, lines = sensitivity_plan(here, peaks, group.torque_offsets, cycle)
        check_excited(excitation, group.drives)
    except PlanRefusedError as error:
        raise PlanRefusedError(
            f"the peak of sensitivity could not be measured: {error} Nothing was moved or written, for "
            "nothing is kept that was not measured; --no-verify writes without a trial, and then "
            "nothing can be stored."
        ) from None
    done = np.max([expected_peaks(excitation, one) for one in here], axis=0)
    trial = replace(
        plan.trial,
        excitation=excitation,
        excursion=EXCITED * done[0],
        torque=np.minimum(EXCITED * done[3] + 0.05 * limits + 3 * np.array(steps), MOST * limits),
    )
    bare = tuple(replace(s, loop=own) for s, own in zip(plan.new, loops[1], strict=True))
    return replace(plan, trial=trial, lines=lines, bare=bare)
