"""The steps of a trial in one motion, each axis by itself: first answer, nudge, move."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial

import numpy as np

from drives.api import AxisLimits, Capture, FloatArray, Motion
from drives.errors import StoppedError
from fieldtool.experiment.axes import Axes, sample_times, torque_limits
from fieldtool.experiment.directions import CHECK_PUSHED
from fieldtool.experiment.stepped.plan import smooth_move
from fieldtool.experiment.verification.oscillation import LONGEST_HALF
from fieldtool.experiment.verification.slices import SENT_AHEAD, SLICE_TIME, Turn, slices
from fieldtool.experiment.verification.watch import TrialWatch
from fieldtool.records.recording import Experiment

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
SHAKES = 1.5
"""Times the torque that a first answer should take, peak to peak, that is no swing yet."""
PROBE_REST = 0.12
"""Seconds that are watched after a first answer."""
REST_AGAIN = 0.12
"""Seconds to wait before it is asked for again: controllers are not compared soon after a late cycle."""
ASKED, MARGIN = 4, 8
"""Times that a first answer is asked for, at most; and cycles of it that may be missing: the first ones
of a trial, and the last ones, which are compared when later ones are known."""
MOVED = 3
"""Times that a nudge or a move is made at most, where cycles were late or frames were lost."""
MOST_LATE, MOST_LATE_CYCLES = 0.01, 1.0
"""Seconds, and cycles, by which a cycle of a move may begin late.  An axis whose targets stand still for
longer is told to go on at full speed: better a quick stop than the swing that this makes."""
NO_PROBE: FloatArray = np.zeros(0)


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

    probe: FloatArray = field(default_factory=lambda: NO_PROBE)
    """Some counts to and fro in some cycles, from 0 to 0, shape (n,), that the controller is known by;
    empty: none."""
    answer: float = 0.0
    """Peak to peak of the torque that it takes, N m or N."""

    shakes: float = 0.0
    """Peak to peak of its torque in quick swings while its reference moves, at most; 0: not known."""

    @property
    def distance(self) -> float:
        """With its sign."""
        return float(self.reference[-1])


class Steps:
    """Nudges and moves of one motion."""

    def __init__(
        self,
        motion: Motion,
        watch: TrialWatch,
        axes: Axes,
        still: FloatArray,
        start: FloatArray,
        name: str,
        kept: list[Experiment],
    ) -> None:
        self._motion, self._watch, self._axes = motion, watch, axes
        self._still, self._start, self._name, self._kept = still, start, name, kept

    def probe(self, move: TrialMove) -> None:
        """Have an axis' controller answer before anything else moves: to some counts, in some cycles.

        Once more where late cycles hid it, up to ASKED times.
        """
        if not move.probe.size:
            return
        k, step = move.axis, self._motion.cycle_time
        torque = np.minimum(self._gentle_torque, move.torque)
        torque[k] = max(float(torque[k]), move.answer)
        low, high = self._ways(k, float(move.probe[np.argmax(np.abs(move.probe))]), 0.0)
        path = np.concatenate([move.probe, np.zeros(round(PROBE_REST / step))])
        name = f"{self._name}: first answer of {self._axes.names[k]}"
        again = np.concatenate([np.zeros(round(REST_AGAIN / step)), path])
        for one in (path, *[again] * (ASKED - 1)):
            self._watch.move(small=True)
            self._watch.swings.move(
                low, high, torque, PROBE_REST / 3, axis=k, shakes=SHAKES * move.answer
            )
            self._stream(one, k, name, keep=False)
            if self._watch.saw(path.size - MARGIN):
                break

    @property
    def _gentle_torque(self) -> FloatArray:
        return NUDGE_TORQUE * torque_limits(self._axes.limits)

    def nudge(self, move: TrialMove) -> None:
        """Go a little way and back; the axis has to go there, and no other may move.

        Once more where samples are missing, for then nobody saw all that the motor did.
        Never faster than the move itself, which was planned to keep the axis' limits.
        """
        axes, k, step = self._axes, move.axis, self._motion.cycle_time
        size = nudge_size(move, axes)
        there = smooth_move(size, *_pace(move, axes.limits[k], step), step, NUDGE_TIME)
        pause = np.full(max(2, round(NUDGE_TIME / step)), 1.0)
        path = np.concatenate([there, size * pause, size - there, 0 * pause])
        low, high = self._ways(k, size, BEYOND * abs(size))
        torque = np.minimum(self._gentle_torque, move.torque)
        for _ in range(MOVED):
            self._watch.move(small=True)
            self._watch.swings.move(low, high, torque, NUDGE_TIME / 3, axis=k, gentle=True)
            name = f"{self._name}: nudge of {axes.names[k]}"
            if not self._stream(path, move.axis, name, keep=False).missing:
                break

    def move(self, move: TrialMove) -> None:
        """Go the whole way, rest, come back, rest; once more where samples are missing."""
        name = f"{self._name}: move of {self._axes.names[move.axis]}"
        for again in range(MOVED):
            if not self._move(move, f"{name} ({again + 1})" if again else name):
                break

    def _move(self, move: TrialMove, name: str) -> bool:
        """Do a move once; return whether samples are missing."""
        out, rest = move.reference, np.ones(move.rest)
        self._watch.move(small=False)
        path = np.concatenate([out, move.distance * rest, move.distance - out, 0 * rest])
        self._allow(move)
        half = out.size + move.rest
        late = SENT_AHEAD * round(SLICE_TIME / self._motion.cycle_time)
        turns = [(half, partial(self._allow, move, back=True))]
        if late < move.rest:
            turns = [
                (out.size + late, partial(self._settle, move, back=False)),
                *turns,
                (half + out.size + late, partial(self._settle, move, back=True)),
            ]
        return bool(self._stream(path, move.axis, name, turns=turns).missing)

    def _settle(self, move: TrialMove, *, back: bool) -> None:
        """Allow the axis what is left of its move, about its target."""
        k = move.axis
        low, high = self._ways(k, move.distance, self._beyond(move), back=back)
        target = float(self._start[k]) + (0.0 if back else move.distance)
        room = move.astray + SHAKEN * float(self._still[k])
        low[k], high[k] = max(low[k], target - room), min(high[k], target + room)
        self._watch.swings.settle(low, high, move.torque, move.half_period, k, move.swings)

    def _allow(self, move: TrialMove, *, back: bool = False) -> None:
        """Allow an axis its way out, or the way back."""
        low, high = self._ways(move.axis, move.distance, self._beyond(move), back=back)
        self._watch.swings.move(
            low, high, move.torque, move.half_period, axis=move.axis, shakes=move.shakes
        )

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
        turns: Sequence[Turn] = (),
    ) -> Capture:
        """Follow a path; return what was captured of it."""
        targets = np.tile(self._start, (path.size, 1))
        targets[:, k] += path
        self._watch.most_late = max(MOST_LATE, MOST_LATE_CYCLES * self._motion.cycle_time)
        try:
            capture = self._motion.stream(slices(targets, self._motion.cycle_time, turns))
        except StoppedError as error:
            if isinstance(error.capture, Capture) and error.capture.rows > 1:
                self._kept.append(self._experiment(error.capture, k, name, str(error)))
            raise
        finally:
            self._watch.most_late = np.inf
        if keep:
            self._kept.append(self._experiment(capture, k, name))
        return capture

    def _experiment(self, capture: Capture, k: int, name: str, note: str = "") -> Experiment:
        driven = (self._axes.names[k],)
        return recorded(capture, driven, name, self._motion.cycle_time, note)


def nudge_size(move: TrialMove, axes: Axes) -> float:
    """Return how far a nudge goes, with the move's sign, rad or m."""
    size = max(NUDGE_SHARE * abs(move.distance), NUDGE_COUNTS * float(axes.counts[move.axis]))
    return float(np.copysign(min(size, abs(move.distance)), move.distance))


def _pace(move: TrialMove, limits: AxisLimits, cycle: float) -> tuple[float, float]:
    """Return the largest velocity and acceleration of a move, within the axis' limits."""
    velocity = np.diff(move.reference, append=move.distance) / cycle
    acceleration = np.diff(velocity, prepend=0.0) / cycle
    return (
        min(limits.velocity, float(np.abs(velocity).max())),
        min(limits.acceleration, float(np.abs(acceleration).max())),
    )


def recorded(
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
