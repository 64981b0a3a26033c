"""Run a plan on enabled axes: block after block, settled before it is recorded.

The runner sees axes only through ``drives.api``; raw data go to the recording as each sweep ends,
also when it is cut short.
"""

from collections.abc import Callable, Generator
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from drives.api import AxisLimits, Capture, FloatArray, Motion
from drives.errors import SafetyStopError, StoppedError
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
    """Move every axis a little and back, and see that it goes the right way.

    Raises
    ------
    SafetyStopError
        If an axis does not follow, or moves the wrong way, or its torque has the wrong sign.
    """
    with group.motion(cycle_time) as motion:
        _centre(motion, axes)
        for k, name in enumerate(axes.names):
            limits = axes.limits[k]
            distance = CHECK_MOVE * (limits.travel[1] - limits.travel[0])
            rest = max(2, round(CHECK_REST / cycle_time))
            there = smooth_move(
                distance,
                CHECK_SHARE * limits.velocity,
                CHECK_SHARE * limits.acceleration,
                cycle_time,
            )
            path = np.concatenate(
                [
                    np.zeros(rest),
                    there,
                    np.full(rest, distance),
                    distance - there,
                    np.zeros(rest),
                ]
            )
            targets = np.tile(axes.centre, (path.size, 1))
            targets[:, k] += path
            capture = _stream_once(motion, targets, name, keep)
            _judge_direction(name, distance, capture, k, rest, there.size)


def _judge_direction(
    name: str, wanted: float, capture: Capture, k: int, rest: int, rows: int
) -> None:
    position, torque = capture.position[:, k], capture.torque[:, k]
    moved = float(position[2 * rest + rows - 1] - position[0])
    if moved * wanted < 0:
        raise SafetyStopError(
            f"{name}: moves the wrong way: {wanted:.3g} was commanded, it moved {moved:.3g}. Check the "
            "encoder's direction and the motor's phases.",
            axis=name,
        )
    if not 0.5 * wanted < moved < 1.5 * wanted:
        raise SafetyStopError(
            f"{name}: does not follow: {wanted:.3g} was commanded, it moved {moved:.3g}. Is it blocked "
            "or its brake closed, or is the encoder's resolution (0x608F) wrong?",
            axis=name,
        )
    # Whatever swings behind the motor, half way the whole axis has the momentum that the motor gave.
    push = torque[rest : rest + rows // 2] - torque[:rest].mean()
    if float(push.sum()) * wanted < 0:
        raise SafetyStopError(
            f"{name}: the torque that starts a positive move is negative. Check the drive's polarity "
            "(0x607E).",
            axis=name,
        )


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
            with group.motion(plan.cycle_time, sweep.free) as motion:
                source.start(motion.position)
                try:
                    capture = motion.stream(source)
                except StoppedError as error:
                    if isinstance(error.capture, Capture) and error.capture.rows > 1:
                        keep(source.experiment(error.capture, complete=False, note=str(error)))
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
            while True:
                smaller = yield from self._measure(tone, before, k)
                before = tone
                if smaller is None:
                    break
                tone = smaller
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
        if self._overloaded(capture):
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


def _once(motion: Motion, targets: FloatArray) -> Capture:
    return motion.stream(lambda before: targets if before is None else None)


def _stream_once(motion: Motion, targets: FloatArray, driven: str, keep: Keep) -> Capture:
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
        capture = _once(motion, targets)
    except StoppedError as error:
        if isinstance(error.capture, Capture) and error.capture.rows > 1:
            keep(experiment(error.capture, str(error)))
        raise
    keep(experiment(capture))
    return capture


def _times(rows: int, step: float) -> FloatArray:
    times: FloatArray = np.arange(rows, dtype=np.float64) * step
    return times
