"""Run a plan on enabled axes: block after block, settled before it is recorded.

The runner sees axes only through ``drives.api``; raw data go to the recording as each sweep ends,
also when it is cut short.
"""

from collections.abc import Callable, Generator, Iterable
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from drives.api import AxisLimits, Capture, FloatArray, Motion
from drives.errors import SafetyStopError, StoppedError
from fieldtool.errors import FieldtoolError, PlanRefusedError
from fieldtool.experiment.plan import Sweep, SweepPlan, Tone, smooth_move, tone_blocks, transition
from fieldtool.records.recording import Experiment, Segment

SETTLED = 1e-3
"""Relative change that may still be to come when a tone counts as settled."""
SLOWEST_DECAY = 4.0
"""Seconds: time constant that the settling test reckons with."""
NOISE_FACTOR = 4.0
"""Standard errors within which two blocks count as equal."""
OVERLOAD = 0.8
"""Share of a limit above which a tone is made smaller."""
DRIFTED = 0.5
"""Share of the room to the travel's end at which a floating axis is brought back."""
MOVE_SHARE = 0.25
"""Share of the velocity and acceleration limits that positioning moves use."""
STILL, STILL_TIME, STILL_TIMEOUT = 1e-4, 0.5, 20.0
"""An axis stands that moves less than this share of its travel in so many seconds; waited for at
most the last, seconds."""
CHECK_REST = 0.3
"""Seconds of rest before, between and after these moves."""
CHECK_SHARE = 0.05
"""Share of the velocity and acceleration limits that these moves use."""
CHECK_MOVE = 0.02
"""Share of the travel by which each axis moves when its direction is checked."""
CHECK_NUDGE = 0.1
"""Share of that move by which each axis is nudged first."""
CHECK_SLICE = 2
"""Cycles after which the check looks at what the axes did."""
CHECK_ASTRAY, CHECK_PUSHED = 1e-3, 10.0
"""Share of its travel that an axis may go the wrong way or drift in the check; an axis that does
not move itself may be pushed by the factor more."""
CHECK_ASTRAY_ERROR = 0.004
"""Share of the following error limit that it may go astray in any case."""
CHECK_TIME = 1.0
"""Seconds that each of these moves takes at least, so that slow loops follow it."""
CHECK_QUIET = 0.5
"""Share of what it may drift within which an axis counts as standing, before the check begins."""
CHECK_STARTED = 0.02
"""Share of the check's move that an axis must have done when half of it was commanded."""
LONGEST_MOVE = 600.0
"""Seconds that crossing the travel may take at most."""
HALVINGS = 6
"""Times that a tone's amplitude is halved before the axis counts as overloaded by something else."""


class Mover(Protocol):
    """Gives enabled axes: ``CanopenGroup`` does."""

    def motion(
        self, cycle_time: float, free: tuple[str, ...] = ()
    ) -> AbstractContextManager[Motion]:
        """Enable all axes; those in ``free`` float."""


@dataclass(frozen=True)
class Progress:
    """Where a measurement is."""

    sweep: int
    sweeps: int
    name: str
    tone: int
    tones: int
    frequency: float
    """Hz."""
    done: float
    """Share of all tones, 0 to 1."""
    machine_time: float
    """Seconds of excitation so far."""
    amplitude: float
    """Of the reference, rad or m."""


Report = Callable[[Progress], None]
Keep = Callable[[Experiment], None]


def _silent(_: Progress) -> None:
    return


@dataclass(frozen=True)
class Axes:
    """What the runner has to know of the axes."""

    names: tuple[str, ...]
    limits: tuple[AxisLimits, ...]
    centre: FloatArray
    units: tuple[str, ...] = ()
    """Of positions, for messages."""

    def unit(self, k: int) -> str:
        """Return the unit of an axis' positions, for messages; empty where it was not given."""
        return self.units[k] if self.units else ""

    @property
    def room(self) -> FloatArray:
        """From the centre to the nearer end of the travel, shape (M,)."""
        return np.array(
            [
                min(c - limits.travel[0], limits.travel[1] - c)
                for c, limits in zip(self.centre, self.limits, strict=True)
            ]
        )


def check_directions(group: Mover, axes: Axes, cycle_time: float, keep: Keep) -> None:
    """Move every axis a little and back, where it stands, and see that it goes the right way.

    Each axis moves towards its centre, at first by a nudge only.  It is judged every few cycles, long
    before its following error leaves the limit: a loop of the wrong sign runs away from the smallest
    push, its own or another axis', and the nudges find that while it is slow.

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
        with group.motion(cycle_time) as motion:
            start = motion.position
            for k in range(len(axes.names)):
                nudge = _DirectionCheck(axes, k, start, cycle_time, nudge=True)
                _stream_check(motion, nudge, axes.names[k], experiments.append)
            experiments.clear()  # of the nudges only one that was cut short is worth keeping
            for k in range(len(axes.names)):
                check = _DirectionCheck(axes, k, start, cycle_time)
                capture = _stream_check(motion, check, axes.names[k], experiments.append)
                check.judge(capture)
    except BaseException as error:
        _keep_whatever_happens(experiments, keep, error)
        raise
    for experiment in experiments:  # the disk may be slow: not while axes wait for their SYNC
        keep(experiment)


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


class _DirectionCheck:
    """One axis' small move, in slices of a few cycles that are judged as they come.

    It begins when nothing swings any more from the check of the axis before.
    """

    def __init__(
        self, axes: Axes, k: int, start: FloatArray, cycle_time: float, nudge: bool = False
    ) -> None:
        self._axes, self._k, self._start, self._nudge = axes, k, start, nudge
        limits = axes.limits[k]
        size = CHECK_MOVE * (limits.travel[1] - limits.travel[0])
        self._wanted = float(np.copysign(size, axes.centre[k] - start[k]))
        self._rest = max(2, round(CHECK_REST / cycle_time))
        there = smooth_move(
            self._wanted,
            CHECK_SHARE * limits.velocity,
            CHECK_SHARE * limits.acceleration,
            cycle_time,
            CHECK_TIME,
        )
        self._rows = there.size
        rest, away = np.zeros(self._rest), np.full(self._rest, self._wanted)
        self._path = np.concatenate([rest, there, away, self._wanted - there, rest])
        if nudge:
            self._path, self._wanted = CHECK_NUDGE * self._path, CHECK_NUDGE * self._wanted
        self._done = 0
        travel = np.array([one.travel[1] - one.travel[0] for one in axes.limits])
        errors = np.array([one.following_error for one in axes.limits])
        self._allowed = np.maximum(CHECK_ASTRAY * travel, CHECK_ASTRAY_ERROR * errors)
        self._waiting = k > 0 or not nudge
        self._waited = self._still = 0
        self._still_rows = round(STILL_TIME / cycle_time)
        self._longest_wait = round(STILL_TIMEOUT / cycle_time)

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

    def _watch(self, capture: Capture) -> None:
        moved = capture.position[-1] - self._start
        pushed = not self._nudge and (self._waiting or self._done > self._rest)
        for j, name in enumerate(self._axes.names):
            allowed = float(self._allowed[j])
            if self._done > self._rest and j == self._k:
                self._follow(name, float(moved[j]), allowed)
            else:
                most = allowed * (CHECK_PUSHED if pushed else 1.0)
                self._stay(name, float(moved[j]), most, self._axes.unit(j))
        quiet = bool(np.all(np.abs(moved) < CHECK_QUIET * self._allowed))
        self._still = self._still + CHECK_SLICE if quiet else 0
        if self._still >= self._still_rows or self._waited >= self._longest_wait:
            self._waiting = False

    @staticmethod
    def _stay(name: str, moved: float, allowed: float, unit: str) -> None:
        if abs(moved) > allowed:
            raise SafetyStopError(
                f"{name}: moved by {moved:.3g} {unit} while it was told to stand still; its power was "
                "cut and all axes were stopped. Either the axis moves the wrong way (check the "
                "encoder's direction and the motor's phases), or its loop is not stable, or it sags "
                "when its brake opens.",
                axis=name,
                runaway=True,
            )

    def _follow(self, name: str, moved: float, allowed: float) -> None:
        forward, unit = moved * np.sign(self._wanted), self._axes.unit(self._k)
        size = abs(self._wanted)
        comes_back = self._done > 2 * self._rest + self._rows
        astray = 0.5 * size if comes_back else allowed  # it may overshoot, there as well as back
        if forward < -astray or forward > 1.5 * size:
            raise SafetyStopError(
                f"{name}: moves the wrong way or by itself: {self._wanted:.3g} {unit} was commanded, it "
                f"moved {moved:.3g} {unit}; its power was cut and all axes were stopped. Check the "
                "encoder's direction and the motor's phases.",
                axis=name,
                runaway=True,
            )
        half_way = self._rest + self._rows // 2 <= self._done < self._rest + self._rows
        if half_way and not self._nudge and forward < CHECK_STARTED * size:
            raise SafetyStopError(
                f"{name}: does not follow: half of {self._wanted:.3g} {unit} was commanded, it moved "
                f"{moved:.3g} {unit}; its power was cut and all axes were stopped. Is it blocked or "
                "its brake closed, or does the encoder not count?",
                axis=name,
                runaway=True,
            )

    def judge(self, capture: Capture) -> None:
        """Raise SafetyStopError if the whole move was not what was commanded."""
        name, wanted, k = self._axes.names[self._k], self._wanted, self._k
        position, torque = capture.position[self._waited :, k], capture.torque[self._waited :, k]
        moved = float(position[2 * self._rest + self._rows - 1] - position[0])
        unit = self._axes.unit(k)
        if not 0.5 < moved / wanted < 1.5:
            raise SafetyStopError(
                f"{name}: does not follow: {wanted:.3g} {unit} was commanded, it moved {moved:.3g} "
                f"{unit}; all axes were stopped. Is it blocked or its brake closed, or is the "
                "encoder's resolution (0x608F) wrong?",
                axis=name,
            )
        # Whatever swings behind the motor, half way the whole axis has the momentum that the motor
        # gave.
        rest, half = self._rest, self._rows // 2
        push = float((torque[rest : rest + half] - torque[:rest].mean()).sum())
        noise = float(torque[:rest].std()) * np.sqrt(half + half**2 / rest)
        if push * np.sign(wanted) < -NOISE_FACTOR * noise:
            raise SafetyStopError(
                f"{name}: the torque that starts a positive move is negative; all axes were stopped. "
                "Check the drive's polarity (0x607E).",
                axis=name,
            )


def _stream_check(motion: Motion, check: _DirectionCheck, driven: str, keep: Keep) -> Capture:
    def experiment(capture: Capture, note: str = "") -> Experiment:
        return Experiment(
            name=f"direction check of {driven}",
            kind="moves",
            driven=(driven,),
            free=(),
            period=None,
            time=_times(capture.rows, motion.cycle_time),
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


def _keep_whatever_happens(
    experiments: Iterable[Experiment], keep: Keep, cause: BaseException
) -> None:
    """Keep what was recorded before an error; that error counts, not one of the disk."""
    try:
        for experiment in experiments:
            keep(experiment)
    except FieldtoolError as error:
        cause.add_note(f"what was recorded last could not be kept: {error}")


def run_plan(
    group: Mover, plan: SweepPlan, axes: Axes, keep: Keep, report: Report = _silent
) -> float:
    """Run every sweep of a plan; return the seconds of machine time.

    Parameters
    ----------
    group
        Gives enabled axes.
    plan
        A plan that was checked by ``forecast``.
    axes
        Names, limits, centres.
    keep
        Gets each sweep's raw data as soon as it has ended, also when it was cut short.
    report
        Called after every block.

    Raises
    ------
    StoppedError
        If a limit was passed, a drive failed, or the user stopped; all axes are disabled.
    """
    machine_time = 0.0
    done = 0
    for number, sweep in enumerate(plan.sweeps):
        first = 0
        while first < len(sweep.tones):
            with group.motion(plan.cycle_time) as motion:
                _centre(motion, axes)
            teller = _Teller(report, number + 1, plan, done, machine_time)
            source = _SweepSource(sweep, first, axes, plan.cycle_time, teller)
            try:
                with group.motion(plan.cycle_time, sweep.free) as motion:
                    source.start(motion.position)
                    capture = motion.stream(source)
            except StoppedError as error:  # once the drives are off: writing to a disk takes time
                if isinstance(error.capture, Capture) and error.capture.rows > 1:
                    cut = source.experiment(error.capture, complete=False, note=str(error))
                    _keep_whatever_happens([cut], keep, error)
                raise
            machine_time += capture.rows * plan.cycle_time
            keep(source.experiment(capture))
            first = source.next_tone
        done += len(sweep.tones)
    return machine_time


@dataclass(frozen=True)
class _Teller:
    """Turns a block's end into a progress report."""

    report: Report
    sweep: int
    plan: SweepPlan
    tones_before: int
    time_before: float

    def tell(self, sweep: Sweep, tone: Tone, k: int, seconds: float) -> None:
        self.report(
            Progress(
                self.sweep,
                len(self.plan.sweeps),
                sweep.name,
                k + 1,
                len(sweep.tones),
                tone.frequency,
                (self.tones_before + k) / max(1, self.plan.tones),
                self.time_before + seconds,
                tone.amplitude,
            )
        )


class _SweepSource:
    """Gives a sweep's targets block by block, and decides when a tone is settled and measured."""

    def __init__(
        self, sweep: Sweep, first: int, axes: Axes, cycle_time: float, teller: _Teller
    ) -> None:
        self._sweep, self._axes, self._step, self._teller = sweep, axes, cycle_time, teller
        self._driven = axes.names.index(sweep.driven)
        self._free = [axes.names.index(name) for name in sweep.free]
        self._first = self.next_tone = first
        self._base = axes.centre
        self._rows = 0
        self._segments: list[Segment] = []
        self._steps = self._tones()
        self._drifted = False

    def start(self, position: FloatArray) -> None:
        """Move about the place where the axes stand when the stream begins."""
        self._base = position.copy()

    def __call__(self, before: Capture | None) -> FloatArray | None:
        try:
            block = next(self._steps) if before is None else self._steps.send(before)
        except StopIteration:
            return None
        targets = np.tile(self._base, (block.size, 1))
        targets[:, self._driven] += block
        self._rows += block.size
        return targets

    def experiment(self, capture: Capture, complete: bool = True, note: str = "") -> Experiment:
        """Return what was recorded, with its settled stretches."""
        part = f", from tone {self._first + 1}" if self._first else ""
        segments = tuple(s for s in self._segments if s.stop <= capture.rows)
        return Experiment(
            name=self._sweep.name + part,
            kind="stepped_sine",
            driven=(self._sweep.driven,),
            free=self._sweep.free,
            period=None,
            time=_times(capture.rows, self._step),
            position=capture.position,
            torque=capture.torque,
            position_reference=capture.position_reference,
            statusword=capture.statusword,
            segments=segments,
            complete=complete,
            note=note,
        )

    def _tones(self) -> Generator[FloatArray, Capture, None]:
        before: Tone | None = None
        for k in range(self._first, len(self._sweep.tones)):
            tone = self._sweep.tones[k]
            for _ in range(1 + HALVINGS):
                smaller = yield from self._measure(tone, before, k)
                before = tone
                if smaller is None:
                    break
                tone = smaller
            else:
                raise self._overload(tone)
            self.next_tone = k + 1
            if self._drifted:
                break
        if before is not None:
            yield transition(None, before)

    def _measure(
        self, tone: Tone, before: Tone | None, k: int
    ) -> Generator[FloatArray, Capture, Tone | None]:
        """Settle and record one tone; return a smaller one if this one loads the axis too much."""
        blocks = tone_blocks(tone, before)
        capture: Capture = yield next(blocks)
        halved = before is not None and tone == replace(before, amplitude=before.amplitude / 2)
        if not halved and self._overloaded(capture):  # the way down from an overload is not judged
            return replace(tone, amplitude=tone.amplitude / 2)
        previous: _Phasors | None = None
        settled, count, start = False, 0, self._rows
        for number in range(self._sweep.settle_blocks + self._sweep.blocks):
            block_start = self._rows
            capture = yield next(blocks)
            self._teller.tell(self._sweep, tone, k, self._rows * self._step)
            if self._overloaded(capture):
                return replace(tone, amplitude=tone.amplitude / 2)
            if capture.missing:  # a spoiled block is measured again
                previous, count = None, 0
                continue
            phasors = _phasors(capture, tone)
            if count == 0:
                settled = previous is not None and previous.agrees(phasors, tone.block_time)
                late = number >= self._sweep.settle_blocks - 1
                start = block_start if (settled or late) else start
                count = 1 if (settled or late) else 0
            else:
                count += 1
            previous = phasors
            if count == self._sweep.blocks:
                break
        self._drifted = bool(
            any(
                abs(float(capture.position[:, i].mean()) - self._axes.centre[i])
                > DRIFTED * self._axes.room[i]
                for i in self._free
            )
        )
        if count:
            self._segments.append(
                Segment(
                    start,
                    self._rows,
                    tone.frequency,
                    tone.periods * count,
                    settled,
                    "" if settled else "not settled within the time allowed",
                )
            )
        return None

    def _overloaded(self, capture: Capture) -> bool:
        k = self._driven
        limits, room = self._axes.limits[k], float(self._axes.room[k])
        return bool(
            np.abs(capture.torque[:, k]).max() > OVERLOAD * limits.torque
            or np.abs(capture.position[:, k] - self._axes.centre[k]).max() > OVERLOAD * room
        )

    def _overload(self, tone: Tone) -> SafetyStopError:
        name = self._sweep.driven
        return SafetyStopError(
            f"{name}: at {tone.frequency:.3g} Hz its torque or its position stays above "
            f"{100 * OVERLOAD:.0f} % of the limit however small the tone ({HALVINGS} times halved); "
            "all axes were stopped. Does something else load it, or is its torque limit too low?",
            axis=name,
        )


@dataclass(frozen=True)
class _Phasors:
    """Complex amplitudes of one block: positions and torques of all axes."""

    values: np.ndarray[tuple[int], np.dtype[np.complex128]]
    errors: FloatArray
    """Standard errors from what the sine does not explain, same shape."""

    def agrees(self, other: "_Phasors", block_time: float) -> bool:
        """Whether nothing but noise differs, and little is still to come at a slow decay."""
        share = 1 - np.exp(-block_time / SLOWEST_DECAY)
        size = np.abs(other.values)
        m = size.size // 2
        scale = np.concatenate([np.full(m, size[:m].max()), np.full(m, size[m:].max())])
        allowed = np.maximum(
            SETTLED * share * scale, NOISE_FACTOR * np.hypot(self.errors, other.errors)
        )
        return bool(np.all(np.abs(self.values - other.values) <= allowed))


def _phasors(capture: Capture, tone: Tone) -> _Phasors:
    signals = np.hstack([capture.position, capture.torque])
    n = signals.shape[0]
    turns = tone.frequency * tone.cycle_time * np.arange(n)
    carrier = np.exp(-2j * np.pi * turns)
    level = signals - signals.mean(axis=0)
    values = 2 / n * (carrier @ level)
    rest = level - np.real(np.outer(carrier.conj(), values))
    return _Phasors(values, rest.std(axis=0) * np.sqrt(2 / n))


def _centre(motion: Motion, axes: Axes) -> None:
    """Bring every axis to its centre, all at the same time, and wait until nothing swings."""
    start = motion.position
    paths = [
        _move(axes, k, float(axes.centre[k] - start[k]), motion.cycle_time)
        for k in range(len(axes.names))
    ]
    n = max(path.size for path in paths)
    way = np.empty((n, len(paths)))
    for k, path in enumerate(paths):
        way[:, k] = start[k] + np.concatenate([path, np.full(n - path.size, path[-1])])
    hold = np.tile(way[-1], (max(2, round(STILL_TIME / motion.cycle_time)), 1))
    travel = np.array([limits.travel[1] - limits.travel[0] for limits in axes.limits])
    held = 0

    def source(before: Capture | None) -> FloatArray | None:
        nonlocal held
        if before is None:
            return way
        moved = np.ptp(before.position, axis=0)
        if held and (np.all(moved < STILL * travel) or held * STILL_TIME > STILL_TIMEOUT):
            return None
        held += 1
        return hold

    motion.stream(source)


def _move(axes: Axes, k: int, distance: float, step: float) -> FloatArray:
    limits = axes.limits[k]
    return smooth_move(
        distance, MOVE_SHARE * limits.velocity, MOVE_SHARE * limits.acceleration, step
    )


def _times(rows: int, step: float) -> FloatArray:
    times: FloatArray = np.arange(rows, dtype=np.float64) * step
    return times
