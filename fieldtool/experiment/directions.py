"""See that every axis goes the right way, by a small move and back."""

from contextlib import AbstractContextManager

import numpy as np

from drives.api import Capture, FloatArray, Motion, Source
from drives.errors import SafetyStopError, StoppedError
from fieldtool.errors import PlanRefusedError
from fieldtool.experiment.axes import (
    MOVE_SHARE,
    STILL_TIME,
    Axes,
    Keep,
    Mover,
    Standstill,
    keep_all,
    keep_whatever_happens,
    sample_times,
    until_still,
)
from fieldtool.experiment.plausible import (
    BLIND_SPEED,
    BLIND_TORQUE,
    BLIND_WAY,
    BlindPush,
    inertia_of_move,
)
from fieldtool.experiment.proof import PROOF_QUIET, PROOF_SHOWN, Proof
from fieldtool.experiment.stepped.plan import smooth_move
from fieldtool.records.recording import Experiment

CHECK_NAME = "direction check of {}"
CHECK_REST = 0.3
"""Seconds of rest before, between and after these moves."""
CHECK_SHARE = 0.05
"""Share of the velocity and acceleration limits that these moves use."""
CHECK_MOVE = 0.02
"""Share of the travel by which each axis moves when its direction is checked."""
CHECK_NUDGE = 0.1
"""Share of that move by which each axis is nudged first."""
CHECK_NUDGE_COUNTS, CHECK_NUDGE_MOST = 20, 0.5
"""A nudge is so many counts of the encoder at least, but never more than this share of the move."""
CHECK_COUNTS, CHECK_COUNTS_MOST = 3, 0.25
"""Counts of the encoder that are added to whatever an axis may go astray, but never more than this
share of the check's move."""
CHECK_SLICE = 2
"""Cycles after which the check looks at what the axes did."""
CHECK_ASTRAY, CHECK_PUSHED = 1e-3, 10.0
"""Share of its travel that an axis may go the wrong way or drift in the check; an axis that does
not move itself may be pushed by the factor more."""
PUSHED_WAY = 3.0
"""Times the way that its pulses may take an axis, by the prior model, that it may go in them."""
CHECK_ASTRAY_ERROR = 0.004
"""Share of the following error limit that it may go astray in any case."""
CHECK_TIME, CHECK_LAGS, CHECK_TIME_MOST = 1.0, 3.0, 12.0
"""Seconds that each of these moves takes at least; times the lag of its position loop that it takes, so
that slow loops follow it; but not more than this for the loop's sake, s."""
CHECK_QUIET = 0.5
"""Share of what it may drift within which an axis counts as standing, before the check begins;
where it stands does not matter: friction may hold it beside its target."""
CHECK_STARTED = 0.02
"""Share of the check's move that an axis must have done when half of it was commanded."""
LONGEST_MOVE = 600.0
"""Seconds that crossing the travel may take at most."""
HELD_BY_FRICTION = (
    "Its encoder counts, as pulses of torque showed before: friction holds it against its loops, or "
    "they are too slow for this move. Raise its gains position_p, velocity_p and velocity_i, or see "
    "whether its brake drags."
)
HELD_BY_ANYTHING = "Is it blocked or its brake closed, or does the encoder not count?"
PUSH_FACTOR = 4.0
"""Standard errors beyond which the sign of a torque counts."""


def check_directions(group: Mover, axes: Axes, cycle_time: float, keep: Keep) -> None:
    """Move every axis a little and back, where it stands, and see that it goes the right way.

    Each axis moves towards its centre, at first by a nudge only.  It is judged every few cycles, long
    before its following error leaves the limit: a loop of the wrong sign runs away from the smallest
    push, its own or another axis', and the nudges find that while it is slow.  Each move is judged
    from where the axes stand when it begins: friction may have held one beside its target, but not
    farther from its very first start than its own nudge (in the moves after the nudges: than it may
    be pushed).  An axis whose limits say how far it may sag is first given the time to do so.

    Raises
    ------
    PlanRefusedError
        If the limits make positioning so slow that it would take too long; nothing moves.
    SafetyStopError
        If an axis does not follow, or moves the wrong way or by itself, or its torque has the
        wrong sign.
    """
    _check_pace(axes)
    experiments: list[Experiment] = []
    try:
        with _enabled(group, axes, cycle_time) as motion:
            start = motion.position
            sunk = _let_sink(motion, axes, start, experiments.append)
            proven = _prove(motion, axes, start, sunk, experiments.append)
            experiments.clear()  # of these, too, only one that was cut short is worth keeping
            for k in range(len(axes.names)):
                stands = motion.position
                nudge = _DirectionCheck(
                    axes, k, start, stands, cycle_time, proven[k], sunk, nudge=True
                )
                _stream_check(
                    motion,
                    nudge,
                    f"direction check of {axes.names[k]}",
                    axes.names[k],
                    experiments.append,
                )
            experiments.clear()  # of the nudges only one that was cut short is worth keeping
            for k in range(len(axes.names)):
                stands = motion.position
                check = _DirectionCheck(axes, k, start, stands, cycle_time, proven[k], sunk)
                capture = _stream_check(
                    motion,
                    check,
                    f"direction check of {axes.names[k]}",
                    axes.names[k],
                    experiments.append,
                )
                check.judge(capture)
    except BaseException as error:
        keep_whatever_happens(experiments, keep, error)
        raise
    keep_all(experiments, keep)  # the disk may be slow: not while axes wait for their SYNC


def _enabled(group: Mover, axes: Axes, cycle_time: float) -> AbstractContextManager[Motion]:
    if any(axes.torque_offsets):
        return group.motion(cycle_time, torque_offset=True)
    return group.motion(cycle_time)


def _let_sink(motion: Motion, axes: Axes, start: FloatArray, keep: Keep) -> FloatArray:
    """Wait until axes that sag stand; return how far from their start they are then, shape (M,)."""
    sags = axes.sags
    if not np.any(sags):
        return np.zeros_like(start)
    allowed = _astray(axes) + CHECK_COUNTS * axes.counts

    def judge(position: FloatArray) -> None:
        for k in range(sags.size):
            _stay(axes, k, float(position[k] - start[k]), 0.0, float(allowed[k] + sags[k]))

    source = until_still(motion, start, CHECK_QUIET * allowed, CHECK_SLICE, judge)
    _stream_check(motion, source, "standing still", "", keep)
    return np.where(sags > 0, motion.position - start, 0.0)


def _prove(
    motion: Motion, axes: Axes, start: FloatArray, sunk: FloatArray, keep: Keep
) -> tuple[bool, ...]:
    """See that every encoder counts; return of which it is sure."""
    allowed = _astray(axes) + CHECK_COUNTS * axes.counts
    quiet = np.maximum(PROOF_SHOWN * axes.counts, PROOF_QUIET * allowed)
    proven, ways = [], np.zeros(len(axes.names))
    units = np.array([axes.unit(k) for k in range(ways.size)])
    for k, name in enumerate(axes.names):

        def judge(position: FloatArray, way: float, k: int = k) -> None:
            ways[k] = max(ways[k], way)
            for j in range(ways.size):
                most = float(allowed[j]) + PUSHED_WAY * float(ways[units == units[j]].max())
                if (
                    j != k
                ):  # another's pulses may shake it as far as another's move, or its own pulses
                    own = float(allowed[j]) + PUSHED_WAY * float(ways[j])
                    most = min(most, max(CHECK_PUSHED * float(allowed[j]), own))
                _stay(axes, j, float(position[j] - start[j]), float(sunk[j]), most)

        proof = Proof(axes, k, start, motion.cycle_time, quiet, judge)
        if proof.asks:
            _stream_check(motion, proof, "pulses of {}", name, keep)
        proven.append(proof.answered)
    return tuple(proven)


def _astray(axes: Axes) -> FloatArray:
    """How far each axis may go astray, shape (M,), counts of its encoder left out."""
    travel = np.array([one.travel[1] - one.travel[0] for one in axes.limits])
    errors = np.array([one.following_error for one in axes.limits])
    return np.maximum(CHECK_ASTRAY * travel, CHECK_ASTRAY_ERROR * errors)


def small_moves(axes: Axes) -> str:
    """Return in words how far each axis moves when its direction is checked."""
    ways = [
        f"{name} {CHECK_MOVE * (one.travel[1] - one.travel[0]):.3g} {axes.unit(k)}".strip()
        for k, (name, one) in enumerate(zip(axes.names, axes.limits, strict=True))
    ]
    return (
        f"Pulses of torque show whether each encoder counts. Then each axis in turn moves slowly by "
        f"{100 * CHECK_MOVE:g} % of its travel and back, after a nudge of a tenth of that: "
        f"{', '.join(ways)}."
    )


def _check_pace(axes: Axes) -> None:
    for name, limits in zip(axes.names, axes.limits, strict=True):
        way = limits.travel[1] - limits.travel[0]
        velocity, acceleration = limits.velocity, limits.acceleration
        duration = max(
            1.875 * way / (MOVE_SHARE * velocity),
            1.875 * CHECK_MOVE * way / (CHECK_SHARE * velocity),
            np.sqrt(5.774 * way / (MOVE_SHARE * acceleration)),
        )
        if not duration <= LONGEST_MOVE:
            raise PlanRefusedError(
                f"{name}: with a velocity limit of {velocity:g}/s and an acceleration limit of "
                f"{acceleration:g}/s2, moving across the travel {limits.travel[0]:g} to "
                f"{limits.travel[1]:g} takes {duration:.3g} s, at most {LONGEST_MOVE:g} s are "
                "allowed. Nothing was moved. Correct the limits in the machine profile."
            )


def _shortest(axes: Axes, k: int) -> float:
    """Return the seconds that an axis' move takes at least: some lags of its position loop."""
    pace = 0.0 if axes.pace is None else float(axes.pace[k])
    return min(max(CHECK_TIME, CHECK_LAGS / pace), CHECK_TIME_MOST) if pace > 0 else CHECK_TIME


class _DirectionCheck:
    """One axis' small move, in slices of a few cycles that are judged as they come.

    It begins when nothing swings any more from the check of the axis before.
    """

    def __init__(
        self,
        axes: Axes,
        k: int,
        start: FloatArray,
        stands: FloatArray,
        cycle_time: float,
        proven: bool,
        sunk: FloatArray,
        nudge: bool = False,
    ) -> None:
        self._axes, self._k, self._start, self._nudge = axes, k, start, nudge
        self._proven = proven
        limits = axes.limits[k]
        travel = np.array([one.travel[1] - one.travel[0] for one in axes.limits])
        sizes = CHECK_MOVE * travel
        self._slack = np.minimum(CHECK_COUNTS * axes.counts, CHECK_COUNTS_MOST * sizes)
        astray = _astray(axes)
        self._allowed = astray + self._slack
        most = np.minimum(CHECK_NUDGE_COUNTS * axes.counts, CHECK_NUDGE_MOST * sizes)
        nudges = np.maximum(CHECK_NUDGE * sizes, most)
        reach = nudges if nudge else np.maximum(nudges, CHECK_PUSHED * astray)
        self._reach = np.minimum(-reach, sunk), np.maximum(reach, sunk)
        self._begin_at(stands)
        self._wanted = float(np.copysign(sizes[k], axes.centre[k] - start[k]))
        self._rest = max(2, round(CHECK_REST / cycle_time))
        there = smooth_move(
            self._wanted,
            CHECK_SHARE * limits.velocity,
            CHECK_SHARE * limits.acceleration,
            cycle_time,
            _shortest(axes, k),
        )
        self._rows = there.size
        rest, away = np.zeros(self._rest), np.full(self._rest, self._wanted)
        self._path = np.concatenate([rest, there, away, self._wanted - there, rest])
        if nudge:
            share = float(nudges[k] / sizes[k])
            self._path, self._wanted = share * self._path, share * self._wanted
        self._done = 0
        self._standstill = Standstill(stands - start, CHECK_QUIET * self._allowed, cycle_time)
        self._waiting = k > 0 or not nudge
        self._waited = 0
        self._still_rows = round(STILL_TIME / cycle_time)
        self._cycle_time = cycle_time
        self._blind: BlindPush | None = None
        self._resting: list[float] = []
        self._moves = False

    def __call__(self, before: Capture | None) -> FloatArray | None:
        """Return the next slice of targets; see ``drives.api.Source``."""
        if before is not None:
            self._watch(before)
        if self._waiting:
            self._waited += CHECK_SLICE
            return np.tile(self._start, (CHECK_SLICE, 1))
        if self._done >= self._path.size:
            return None
        part = self._path[self._done : self._done + CHECK_SLICE]
        self._done += part.size
        targets = np.tile(self._start, (part.size, 1))
        targets[:, self._k] += part
        return targets

    def _begin_at(self, stands: FloatArray) -> None:
        """Judge from here, as distances from the very first start, and never from beyond reach."""
        self._offset = np.clip(stands - self._start, *self._reach)

    def _watch(self, capture: Capture) -> None:
        self._watch_torque(capture)
        moved = capture.position[-1] - self._start
        pushed = not self._nudge and (self._waiting or self._done > self._rest)
        for j, name in enumerate(self._axes.names):
            allowed = float(self._allowed[j])
            if self._done > self._rest and j == self._k:
                self._follow(name, float(moved[j]), float(self._offset[j]), allowed)
            else:
                most = allowed * (CHECK_PUSHED if pushed else 1.0)
                _stay(self._axes, j, float(moved[j]), float(self._offset[j]), most)
        if self._waiting:
            self._wait(moved)

    def _watch_torque(self, capture: Capture) -> None:
        """Raise if the torque has taken the axis far, by the prior model, and its encoder shows none."""
        axes, k = self._axes, self._k
        if self._proven or axes.inertia is None:
            return
        torque = capture.torque[:, k]
        if self._waiting or self._done <= self._rest:
            self._resting = [*self._resting, *torque.tolist()][-self._still_rows :]
            return
        moves = bool(np.ptp(capture.position_reference[:, k]) > 0)
        if moves and not self._moves:
            limits = axes.limits[k]
            self._blind = BlindPush(
                float(axes.inertia[k]),
                self._cycle_time,
                BLIND_SPEED * limits.velocity,
                BLIND_WAY * (limits.travel[1] - limits.travel[0]),
                float(self._slack[k]),
                float(np.mean(self._resting)) if self._resting else 0.0,
            )
        self._moves = moves
        if self._blind is None or (self._blind.moved and not moves):
            return  # friction may hold it where it was told to stand
        blind = self._blind.take(capture.position[:, k], torque)
        if blind and abs(float(torque[-1])) > BLIND_TORQUE * axes.limits[k].torque:
            unit = "N m" if axes.unit(k) == "rad" else "N"
            raise SafetyStopError(
                f"{axes.names[k]}: does not move by its encoder, while its torque has risen to "
                f"{torque[-1]:.3g} {unit}, which would have taken it far by the prior model; its power "
                "was cut and all axes were stopped. Does the encoder count, is the axis blocked or its "
                "brake closed? If dry friction holds it, raise its gains position_p and velocity_p.",
                axis=axes.names[k],
                runaway=True,
            )

    def _wait(self, moved: FloatArray) -> None:
        """End the wait when all axes have stood for long enough, wherever that is."""
        if self._standstill.take(moved, CHECK_SLICE):
            self._waiting = False
            self._begin_at(self._start + moved)

    def _follow(self, name: str, moved: float, offset: float, allowed: float) -> None:
        sign, unit = float(np.sign(self._wanted)), self._axes.unit(self._k)
        size, slack = abs(self._wanted), float(self._slack[self._k])
        held = HELD_BY_FRICTION if self._proven else HELD_BY_ANYTHING
        forward, ahead = sign * moved, sign * offset
        comes_back = self._done > 2 * self._rest + self._rows
        # it may overshoot, there as well as back
        astray = max(0.5 * size + slack, allowed) if comes_back else allowed
        if forward < min(0.0, ahead) - astray or forward > max(0.0, ahead) + 1.5 * size + allowed:
            raise SafetyStopError(
                f"{name}: moves the wrong way or by itself: {self._wanted:.3g} {unit} was commanded, it "
                f"moved {moved - offset:.3g} {unit}; its power was cut and all axes were stopped. "
                "Check the encoder's direction and the motor's phases.",
                axis=name,
                runaway=True,
            )
        half_way = self._rest + self._rows // 2 <= self._done < self._rest + self._rows
        if half_way and not self._nudge and forward - ahead < CHECK_STARTED * size:
            raise SafetyStopError(
                f"{name}: does not follow: half of {self._wanted:.3g} {unit} was commanded, it moved "
                f"{moved - offset:.3g} {unit}; its power was cut and all axes were stopped. {held}",
                axis=name,
                runaway=True,
            )

    def judge(self, capture: Capture) -> None:
        """Raise SafetyStopError if the whole move was not what was commanded."""
        name, wanted, k = self._axes.names[self._k], self._wanted, self._k
        position, torque = capture.position[self._waited :, k], capture.torque[self._waited :, k]
        moved = float(position[2 * self._rest + self._rows - 1] - position[0])
        unit = self._axes.unit(k)
        slack = float(self._slack[k]) / abs(wanted)
        if not 0.5 - slack < moved / wanted < 1.5 + slack:
            raise SafetyStopError(
                f"{name}: does not follow: {wanted:.3g} {unit} was commanded, it moved {moved:.3g} "
                f"{unit}; all axes were stopped. Is it blocked or its brake closed, or is the "
                "encoder's resolution (0x608F) wrong?",
                axis=name,
            )
        # Whatever swings behind the motor, half way the whole axis has the momentum that the motor
        # gave.  Friction may have held it under a torque before, on the way there or back, not both.
        rest, half, back = self._rest, self._rows // 2, 2 * self._rest + self._rows
        starts = torque[rest : rest + half]
        noise = float(torque[:rest].std()) * np.sqrt(2 * half + half**2 / rest)
        pushes = np.array(
            [(starts - torque[:rest].mean()).sum(), (starts - torque[back : back + half]).sum()]
        )
        if np.all(pushes * np.sign(wanted) < -PUSH_FACTOR * noise):
            raise SafetyStopError(
                f"{name}: the torque that starts a positive move is negative; all axes were stopped. "
                "Check the drive's polarity (0x607E).",
                axis=name,
            )
        self._judge_inertia(capture)

    def _judge_inertia(self, capture: Capture) -> None:
        """Raise SafetyStopError if the torque is not one that moves the axis of the prior model."""
        axes, k = self._axes, self._k
        if axes.inertia is None:
            return
        rows = slice(self._waited, None)
        found = inertia_of_move(
            capture.position_reference[rows, k],
            capture.position[rows, k],
            capture.torque[rows, k],
            self._cycle_time,
        )
        prior = float(axes.inertia[k])
        factor = found.factor_off(prior)
        if factor is not None:
            unit = "kg m2" if axes.unit(k) == "rad" else "kg"
            raise SafetyStopError(
                f"{axes.names[k]}: by its torque this move shows {found.value:.3g} {unit}, the prior "
                f"model has {prior:.3g} {unit} in all: a factor of {factor:.2g}. All axes were stopped. "
                "Either the torque scale is wrong (rated torque 0x6076, torque constant, the drive "
                "profile's units), or the machine profile's prior masses are; correct the one that is.",
                axis=axes.names[k],
            )


def _sag_words(sag: float | None, unit: str) -> str:
    """Say what to do about an axis that moved as it was enabled, and may have sagged."""
    if sag is None:
        return (
            "Secure it against falling and look before you enable it again. Only if its weight pulls "
            "it down a little and its loop then holds it: raise its gains velocity_i and position_p, or "
            "write how far it may sink as `sag` into its limits in the machine profile."
        )
    return (
        f"Its limit `sag` in the machine profile is {sag:.3g} {unit}, which counts only while drives "
        "are being enabled: if it sags farther, raise its gains velocity_i and position_p."
    )


def _stay(axes: Axes, k: int, moved: float, offset: float, allowed: float) -> None:
    """Raise if it left where it stood; back to its first start, where its target is, it may go."""
    if not min(0.0, offset) - allowed <= moved <= max(0.0, offset) + allowed:
        name, unit, sag = axes.names[k], axes.unit(k), axes.limits[k].sag
        raise SafetyStopError(
            f"{name}: moved by {moved - offset:.3g} {unit} while it was told to stand still; its "
            "power was cut and all axes were stopped. Either the axis moves the wrong way (check "
            "the encoder's direction and the motor's phases), or its loop is not stable, or it sags "
            f"when its brake opens. {_sag_words(sag, unit)}",
            axis=name,
            runaway=True,
        )


def _stream_check(motion: Motion, check: Source, name: str, driven: str, keep: Keep) -> Capture:
    def experiment(capture: Capture, note: str = "") -> Experiment:
        return Experiment(
            name=name.format(driven),
            kind="moves",
            driven=(driven,) if driven else (),
            free=(),
            period=None,
            time=sample_times(capture.rows, motion.cycle_time),
            position=capture.position,
            torque=capture.torque,
            position_reference=capture.position_reference,
            statusword=capture.statusword,
            complete=not note,
            note=note,
        )

    try:
        capture = motion.stream(check)
    except StoppedError as error:
        if isinstance(error.capture, Capture) and error.capture.rows > 1:
            keep(experiment(error.capture, str(error)))
        raise
    keep(experiment(capture))
    return capture
