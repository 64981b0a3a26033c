"""The short test of the loops that are in the drives: hold, nudge, move, excite; watched throughout.

Nothing is trusted that has not been seen: the axes first stand still, then each is nudged by a little of
its move, then each makes its move and comes back, then all are excited a little at the same time.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from drives.api import Capture, FloatArray, Motion, MotionWatch
from drives.errors import StoppedError
from fieldtool.experiment.axes import (
    Axes,
    Keep,
    Mover,
    come_to_rest,
    keep_whatever_happens,
    sample_times,
)
from fieldtool.experiment.directions import (
    CHECK_ASTRAY,
    CHECK_ASTRAY_ERROR,
    CHECK_COUNTS,
    CHECK_PUSHED,
)
from fieldtool.experiment.multisine.plan import MultisinePlan
from fieldtool.experiment.multisine.runner import Report, run_multisine
from fieldtool.experiment.stepped.plan import smooth_move
from fieldtool.experiment.verification.oscillation import LONGEST_HALF, OscillationWatch
from fieldtool.records.recording import Experiment

HOLD_TIME = 0.5
"""Seconds in which all axes stand still before anything else is asked of them."""
NUDGE_SHARE, NUDGE_TIME, NUDGE_COUNTS = 0.02, 0.5, 20.0
"""A nudge is this share of the move, or so many counts of the encoder; seconds for each way."""
NUDGE_TORQUE = 0.3
"""Share of the torque limit that a nudge may take."""
BEYOND, BEHIND = 0.5, 0.15
"""Shares of a move by which it may be overshot, and by which the axis may go the wrong way."""
SHAKEN = 4.0
"""Times what an axis may go at rest that it may be beside its way: the others' moves shake it."""
PUSHED_ERROR = 0.3
"""Share of its following error limit by which an axis may be pushed that does not move itself."""
SLICE_TIME = 0.02
"""Seconds that are sent at a time."""
SENT_AHEAD = 2
"""Slices that are on their way when a row is asked for, at most."""


@dataclass(frozen=True, eq=False)
class TrialMove:
    """One axis' move out, as displacements; it comes back the same way."""

    axis: int
    reference: FloatArray
    """From 0 to the distance, shape (n,), rad or m."""
    rest: int
    """Cycles that are watched after it, and after the way back."""
    torque: FloatArray
    """How far torques may go from those at rest meanwhile, shape (M,)."""
    half_period: float = LONGEST_HALF
    """Seconds from turn to turn below which torque and position do not turn by what is commanded while
    the reference moves."""
    swings: tuple[float, float] | None = None
    """Peak to peak of torque and position of the axis once its reference stands, at most; None: not
    known."""
    astray: float = np.inf
    """Distance from the target once the reference stands, at most, rad or m."""

    @property
    def distance(self) -> float:
        """With its sign."""
        return float(self.reference[-1])


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
        nudges = len(self.moves) * 4 * NUDGE_TIME
        excited = self.excitation.duration if self.excitation else 0.0
        return rows * self.cycle_time + nudges + 2 * HOLD_TIME + excited


@dataclass(frozen=True, eq=False)
class Tried:
    """What was recorded."""

    experiments: tuple[Experiment, ...]
    noise: FloatArray
    """Peak-to-peak torque of each axis while all stood still, shape (M,)."""

    def move(self, axis: str) -> Experiment | None:
        """Return the move of an axis; None if there was none."""
        return next((e for e in self.experiments if e.driven == (axis,)), None)

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


class WatchedMover:
    """Gives enabled axes that were seen to stand still first, with a watch that looks at every cycle."""

    def __init__(
        self,
        group: Mover,
        watch: OscillationWatch,
        rests: list[Capture],
        cut_off: Callable[[Capture, str], None],
    ) -> None:
        self._group, self._watch, self._rests, self._cut_off = group, watch, rests, cut_off
        self.held = np.zeros(0)
        """Targets at which the axes of the motion were seen to stand, shape (M,): going on from there is
        no jolt, which it would be from where they are."""

    @contextmanager
    def motion(
        self,
        cycle_time: float,
        free: tuple[str, ...] = (),
        torque_offset: bool = False,
        watch: MotionWatch | None = None,
    ) -> Iterator[Motion]:
        """Enable all axes, and see them stand still for a while before they are handed on."""
        if watch is not None:
            raise ValueError("these axes have a watch already")
        self._watch.begin()
        with self._group.motion(cycle_time, free, torque_offset, self._watch) as motion:
            start = motion.position
            self._watch.hold(start)
            self.held = start
            still = np.tile(start, (max(2, round(HOLD_TIME / cycle_time)), 1))
            self._rests.append(self.follow(motion, still))
            yield motion

    def follow(self, motion: Motion, targets: FloatArray) -> Capture:
        """Follow targets, shape (n, M); what was captured of it is kept if it is stopped."""
        try:
            return motion.stream(_slices(targets, motion.cycle_time))
        except StoppedError as error:
            if isinstance(error.capture, Capture) and error.capture.rows > 1:
                self._cut_off(error.capture, str(error))
            raise


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
    still = still_allowed(axes)
    watch = OscillationWatch(
        axes.names,
        axes.limits,
        axes.counts,
        still,
        trial.cycle_time,
        trusts_loops=trusts_loops,
        louder=louder,
        steps=steps,
        units=axes.units,
    )
    rests: list[Capture] = []
    kept: list[Experiment] = []

    def cut_off(capture: Capture, why: str) -> None:
        kept.append(_recorded(capture, (), f"{name}: standing still", trial.cycle_time, why))

    mover = WatchedMover(group, watch, rests, cut_off)
    try:
        with mover.motion(trial.cycle_time) as motion:
            start = mover.held
            doing = _Steps(motion, watch, axes, still, start, name, kept)
            for move in trial.moves:
                doing.nudge(move)
            for move in trial.moves:
                doing.move(move)
            come_to_rest(motion, axes, start)
        if trial.excitation is not None:
            there = replace(axes, centre=start)
            excited = _Excited(mover, watch, start, trial, still)
            with exciting():
                run_multisine(excited, _named(trial.excitation, name), there, kept.append, report)
    except BaseException as error:
        keep_whatever_happens(kept, keep, error)
        raise
    for experiment in kept:  # the disk may be slow: not while axes wait for their SYNC
        keep(experiment)
    noise = np.max([np.ptp(rest.torque[rest.rows // 2 :], axis=0) for rest in rests], axis=0)
    return Tried(tuple(kept), noise)


def _named(plan: MultisinePlan, name: str) -> MultisinePlan:
    """Return an excitation whose experiments say whose loops are tried."""
    named = tuple(replace(one, name=f"{name}: {one.name}") for one in plan.experiments)
    return replace(plan, experiments=named)


class _Steps:
    """Nudges and moves of one motion."""

    def __init__(
        self,
        motion: Motion,
        watch: OscillationWatch,
        axes: Axes,
        still: FloatArray,
        start: FloatArray,
        name: str,
        kept: list[Experiment],
    ) -> None:
        self._motion, self._watch, self._axes = motion, watch, axes
        self._still, self._start, self._name, self._kept = still, start, name, kept

    def nudge(self, move: TrialMove) -> None:
        """Go a little way and back; the axis has to go there, and no other may move."""
        axes, k, step = self._axes, move.axis, self._motion.cycle_time
        size = max(NUDGE_SHARE * abs(move.distance), NUDGE_COUNTS * float(axes.counts[k]))
        size = float(np.copysign(min(size, abs(move.distance)), move.distance))
        limits = axes.limits[k]
        there = smooth_move(size, limits.velocity, limits.acceleration, step, NUDGE_TIME)
        pause = np.full(max(2, round(NUDGE_TIME / step)), 1.0)
        path = np.concatenate([there, size * pause, size - there, 0 * pause])
        torque = NUDGE_TORQUE * np.array([one.torque for one in axes.limits])
        low, high = self._ways(k, size, BEYOND * abs(size))
        torque = np.minimum(torque, move.torque)
        self._watch.move(low, high, torque, NUDGE_TIME / 3, axis=k, gentle=True)
        self._stream(path, move.axis, f"{self._name}: nudge of {axes.names[k]}", keep=False)

    def move(self, move: TrialMove) -> None:
        """Go the whole way, rest, come back, rest."""
        out, rest = move.reference, np.ones(move.rest)
        path = np.concatenate([out, move.distance * rest, move.distance - out, 0 * rest])
        self._allow(move)
        name = f"{self._name}: move of {self._axes.names[move.axis]}"
        half = out.size + move.rest
        late = SENT_AHEAD * round(SLICE_TIME / self._motion.cycle_time)
        turns = [(half, partial(self._allow, move, back=True))]
        if late < move.rest:
            turns = [
                (out.size + late, partial(self._settle, move, back=False)),
                *turns,
                (half + out.size + late, partial(self._settle, move, back=True)),
            ]
        self._stream(path, move.axis, name, turns=turns)

    def _settle(self, move: TrialMove, *, back: bool) -> None:
        """Allow the axis what is left of its move, about its target."""
        k = move.axis
        low, high = self._ways(k, move.distance, self._beyond(move), back=back)
        target = float(self._start[k]) + (0.0 if back else move.distance)
        room = move.astray + SHAKEN * float(self._still[k])
        low[k], high[k] = max(low[k], target - room), min(high[k], target + room)
        self._watch.settle(low, high, move.torque, move.half_period, k, move.swings)

    def _allow(self, move: TrialMove, *, back: bool = False) -> None:
        """Allow an axis its way out, or the way back."""
        low, high = self._ways(move.axis, move.distance, self._beyond(move), back=back)
        self._watch.move(low, high, move.torque, move.half_period, axis=move.axis)

    @staticmethod
    def _beyond(move: TrialMove) -> float:
        """Return how far the axis may go beyond the end of its way, rad or m."""
        return min(BEYOND * abs(move.distance), move.astray)

    def _ways(
        self, k: int, distance: float, beyond: float, *, back: bool = False
    ) -> tuple[FloatArray, FloatArray]:
        """Return the corridors of a way, which may be overshot at its own end."""
        errors = np.array([one.following_error for one in self._axes.limits])
        slack = np.maximum(CHECK_PUSHED * self._still, PUSHED_ERROR * errors)
        low, high = self._start - slack, self._start + slack
        slack_k = SHAKEN * float(self._still[k])
        size, behind = abs(distance), BEHIND * abs(distance)
        way = (-beyond, size + behind) if back else (-behind, size + beyond)
        ends = way if distance > 0 else (-way[0], -way[1])
        low[k] = self._start[k] + min(ends) - slack_k
        high[k] = self._start[k] + max(ends) + slack_k
        return low, high

    def _stream(
        self,
        path: FloatArray,
        k: int,
        name: str,
        *,
        keep: bool = True,
        turns: "Sequence[Turn]" = (),
    ) -> None:
        """Follow a path."""
        targets = np.tile(self._start, (path.size, 1))
        targets[:, k] += path
        try:
            capture = self._motion.stream(_slices(targets, self._motion.cycle_time, turns))
        except StoppedError as error:
            if isinstance(error.capture, Capture) and error.capture.rows > 1:
                self._kept.append(self._experiment(error.capture, k, name, str(error)))
            raise
        if keep:
            self._kept.append(self._experiment(capture, k, name))

    def _experiment(self, capture: Capture, k: int, name: str, note: str = "") -> Experiment:
        driven = (self._axes.names[k],)
        return _recorded(capture, driven, name, self._motion.cycle_time, note)


def _recorded(
    capture: Capture, driven: tuple[str, ...], name: str, cycle_time: float, note: str
) -> Experiment:
    """Return a capture as an experiment; a note says what cut it short."""
    return Experiment(
        name=name,
        kind="moves",
        driven=driven,
        free=(),
        period=None,
        time=sample_times(capture.rows, cycle_time),
        position=capture.position,
        torque=capture.torque,
        position_reference=capture.position_reference,
        statusword=capture.statusword,
        complete=not note and not capture.missing,
        note=note or ("samples are missing" if capture.missing else ""),
    )


class _Excited:
    """A mover that allows swings once the axes have stood still."""

    def __init__(
        self,
        mover: WatchedMover,
        watch: OscillationWatch,
        start: FloatArray,
        trial: Trial,
        still: FloatArray,
    ) -> None:
        self._mover, self._watch, self._torque = mover, watch, trial.torque
        self._start, self._room = start, trial.excursion + still

    @contextmanager
    def motion(
        self,
        cycle_time: float,
        free: tuple[str, ...] = (),
        torque_offset: bool = False,
        watch: MotionWatch | None = None,
    ) -> Iterator[Motion]:
        with self._mover.motion(cycle_time, free, torque_offset, watch) as motion:
            ends = (
                np.minimum(self._start, self._mover.held),
                np.maximum(self._start, self._mover.held),
            )
            self._watch.excite(ends[0] - self._room, ends[1] + self._room, self._torque)
            u = np.arange(1, round(NUDGE_TIME / cycle_time) + 1) * cycle_time / NUDGE_TIME
            rises = u**3 * (10 - 15 * u + 6 * u * u)
            way = self._mover.held + np.outer(rises, self._start - self._mover.held)
            self._mover.follow(motion, way)
            yield _Standing(motion, way[-1])


class _Standing:
    """A motion whose axes are taken to be where they were told to stand: from there on is no jolt."""

    def __init__(self, motion: Motion, at: FloatArray) -> None:
        self.cycle_time, self.position = motion.cycle_time, at
        self.stream = motion.stream


Turn = tuple[int, Callable[[], None]]
"""A row, and what is done before it is sent."""


def _slices(targets: FloatArray, step: float, turns: Sequence[Turn] = ()) -> "_Slices":
    return _Slices(targets, max(2, round(SLICE_TIME / step)), turns)


class _Slices:
    """Targets in slices; a ``drives.api.Source``."""

    def __init__(self, targets: FloatArray, rows: int, turns: Sequence[Turn] = ()) -> None:
        self._targets, self._rows, self._done, self._turns = targets, rows, 0, list(turns)

    def __call__(self, _before: Capture | None) -> FloatArray | None:
        if self._done >= self._targets.shape[0]:
            return None
        end = self._done + self._rows
        if self._turns and self._done == self._turns[0][0]:
            self._turns.pop(0)[1]()
        if self._turns:
            end = min(end, self._turns[0][0])
        part = self._targets[self._done : end]
        self._done += part.shape[0]
        return part
