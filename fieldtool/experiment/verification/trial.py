"""The short test of the loops that are in the drives, watched throughout: hold, answer, move, excite.

Nothing is trusted that has not been seen: the axes first stand still, then each controller answers to
some counts, then each axis is nudged by a little of its move, then each makes its move and comes back,
then all are excited a little at the same time.
"""

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace

import numpy as np

from drives.api import Capture, FloatArray
from fieldtool.experiment.axes import (
    Axes,
    Keep,
    Mover,
    come_to_rest,
    keep_all,
    keep_whatever_happens,
)
from fieldtool.experiment.directions import (
    CHECK_ASTRAY,
    CHECK_ASTRAY_ERROR,
    CHECK_COUNTS,
    CHECK_QUIET,
)
from fieldtool.experiment.multisine.plan import MultisinePlan
from fieldtool.experiment.multisine.runner import Report, run_multisine
from fieldtool.experiment.verification.brakes import Brakes
from fieldtool.experiment.verification.mover import HOLD_TIME, ExcitedMover, WatchedMover
from fieldtool.experiment.verification.oscillation import SAGS, OscillationWatch
from fieldtool.experiment.verification.steps import (
    NUDGE_TIME,
    PROBE_REST,
    Steps,
    TrialMove,
    recorded,
)
from fieldtool.experiment.verification.watch import Guards, TrialWatch
from fieldtool.records.recording import Experiment

__all__ = ["HOLD_TIME", "Guards", "Trial", "TrialMove", "Tried", "run_trial", "still_allowed"]


@dataclass(frozen=True, eq=False)
class Trial:
    """What is done; the same with old and with new loops."""

    cycle_time: float
    """Seconds."""
    moves: tuple[TrialMove, ...]
    excitation: MultisinePlan | None
    """Small multisine of all axes at once; None: none."""
    excursion: FloatArray
    """How far it may take each axis from where it stands, shape (M,)."""
    torque: FloatArray
    """How far it may take the torques from those at rest, shape (M,)."""

    @property
    def duration(self) -> float:
        """Seconds, all of it."""
        rows = sum(2 * (move.reference.size + move.rest) for move in self.moves)
        rows += sum(move.probe.size for move in self.moves)
        nudges = len(self.moves) * (4 * NUDGE_TIME + PROBE_REST)
        excited = self.excitation.duration if self.excitation else 0.0
        return rows * self.cycle_time + nudges + 2 * HOLD_TIME + excited


@dataclass(frozen=True, eq=False)
class Tried:
    """What was recorded."""

    experiments: tuple[Experiment, ...]
    noise: FloatArray
    """Peak-to-peak torque of each axis while all stood still, shape (M,)."""
    rest: FloatArray
    """Torque of each axis where it began, once all have come back there and rest, shape (M,)."""
    unsure: FloatArray
    """By how much that was another one shortly before, or after drives were enabled anew, shape (M,)."""
    sags: FloatArray
    """How far each axis went as it was enabled, while it was told to stand, shape (M,)."""

    def move(self, axis: str) -> Experiment | None:
        """Return the last move of an axis; None if there was none."""
        moves = [e for e in self.experiments if e.kind == "moves" and e.driven == (axis,)]
        return moves[-1] if moves else None

    @property
    def excitation(self) -> Experiment | None:
        """The multisine; None if there was none."""
        return next((e for e in self.experiments if e.kind == "multisine"), None)


def still_allowed(axes: Axes) -> FloatArray:
    """Return how far axes may go that are told to stand still, shape (M,), rad or m."""
    travel = np.array([one.travel[1] - one.travel[0] for one in axes.limits])
    errors = np.array([one.following_error for one in axes.limits])
    still: FloatArray = np.maximum(CHECK_ASTRAY * travel, CHECK_ASTRAY_ERROR * errors)
    return still + CHECK_COUNTS * axes.counts


NOBODY = Guards()
SAGGED = 1.5
"""Times the way that axes sagged before that they may sag again."""
REST_TIME = 0.2
"""Seconds at the end of a move's record from which the torque at rest is taken."""


def run_trial(
    group: Mover,
    trial: Trial,
    axes: Axes,
    keep: Keep,
    name: str,
    *,
    trusts_loops: bool,
    louder: FloatArray | None = None,
    steps: FloatArray | None = None,
    fed: FloatArray | None = None,
    sags: FloatArray | None = None,
    guards: Guards = NOBODY,
    report: Report = lambda _: None,
    exciting: Callable[[], AbstractContextManager[object]] = nullcontext,
) -> Tried:
    """Do all of a trial where the axes stand; whatever ends it, they are stopped and disabled.

    Parameters
    ----------
    group
        Gives enabled axes.
    trial
        Moves and excitation; they have to fit the travel from where the axes stand.
    axes
        Names, limits, counts.
    keep
        Gets each experiment's raw data once the drives are off, also when it was cut short.
    name
        Whose loops are tried, for the experiments' names: ``before``, ``after``.
    trusts_loops, louder, steps
        See :class:`OscillationWatch`.
    fed
        Torque per velocity and per acceleration that loops feed forward, shape (2, M), SI.
    sags
        How far axes were seen to sag under other loops as they were enabled, shape (M,), rad or m.
    guards
        What else looks at every cycle.
    report
        Is told how far the excitation is.
    exciting
        Entered for the time of the excitation, with all drives disabled before and after.

    Raises
    ------
    OscillationError
        If a loop swings, runs away or pushes; its power was cut.
    StoppedError
        If a limit was passed, a drive failed or the user stopped.
    """
    still, may_sag = still_allowed(axes), axes.sags
    quiet = CHECK_QUIET * still
    if sags is not None:
        may_sag = np.minimum(may_sag, SAGGED * sags)
        # what goes beyond that is `sag`, which counts only as drives are enabled
        still = np.maximum(still, SAGGED * np.minimum(sags, SAGS * still))
    swings = OscillationWatch(
        axes.names,
        axes.limits,
        axes.counts,
        still,
        trial.cycle_time,
        trusts_loops=trusts_loops,
        louder=louder,
        steps=steps,
        units=axes.units,
        sags=may_sag,
    )
    brakes = None if fed is None else Brakes(fed, trial.cycle_time)
    watch = TrialWatch(axes.names, swings, guards, brakes, trial.cycle_time)
    rests: list[Capture] = []
    kept: list[Experiment] = []

    def cut_off(capture: Capture, why: str) -> None:
        kept.append(recorded(capture, (), f"{name}: standing still", trial.cycle_time, why))

    mover = WatchedMover(group, watch, rests, cut_off, may_sag, quiet)
    try:
        with mover.motion(trial.cycle_time) as motion:
            start = mover.held
            doing = Steps(motion, watch, axes, still, start, name, kept)
            for move in trial.moves:
                doing.probe(move)
            for move in trial.moves:
                doing.nudge(move)
            for move in trial.moves:
                doing.move(move)
            come_to_rest(motion, axes, start)
        if trial.excitation is not None:
            there = replace(axes, centre=start)
            room = trial.excursion + still
            excited = ExcitedMover(mover, watch, start, room, trial.torque)
            with exciting():
                run_multisine(excited, _named(trial.excitation, name), there, kept.append, report)
    except BaseException as error:
        keep_whatever_happens(kept, keep, error)
        raise
    keep_all(kept, keep)  # the disk may be slow: not while axes wait for their SYNC
    noise = np.max([np.ptp(rest.torque[rest.rows // 2 :], axis=0) for rest in rests], axis=0)
    last = next((one.torque for one in reversed(kept) if one.kind == "moves"), rests[0].torque)
    rows = round(REST_TIME / trial.cycle_time)
    rest, earlier = last[-rows:].mean(axis=0), last[-2 * rows : -rows]
    others = [rests[-1].torque[rests[-1].rows // 2 :], *([earlier] if earlier.size else [])]
    unsure = np.max([np.abs(one.mean(axis=0) - rest) for one in others], axis=0)
    seen = [*mover.sinks[:2], rests[0]]
    sagged = np.max([np.abs(c.position - c.position_reference).max(axis=0) for c in seen], axis=0)
    return Tried(tuple(kept), noise, rest, unsure, sagged)


def _named(plan: MultisinePlan, name: str) -> MultisinePlan:
    """Return an excitation whose experiments say whose loops are tried."""
    named = tuple(replace(one, name=f"{name}: {one.name}") for one in plan.experiments)
    return replace(plan, experiments=named)
