"""Run a plan on enabled axes: block after block, settled before it is recorded.

The runner sees axes only through ``drives.api``; raw data go to the recording as each sweep ends,
also when it is cut short.
"""

from collections.abc import Callable, Generator
from dataclasses import dataclass, replace

import numpy as np

from drives.api import Capture, FloatArray
from drives.errors import SafetyStopError, StoppedError
from fieldtool.experiment.axes import (
    Axes,
    Keep,
    Mover,
    bring_to_centre,
    keep_all,
    keep_whatever_happens,
    sample_times,
)
from fieldtool.experiment.stepped.plan import Sweep, SweepPlan, Tone, tone_blocks, transition
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
HALVINGS = 6
"""Times that a tone's amplitude is halved before the axis counts as overloaded by something else."""


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


def _silent(_: Progress) -> None:
    return


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
                bring_to_centre(motion, axes)
            teller = _Teller(report, number + 1, plan, done, machine_time)
            source = _SweepSource(sweep, first, axes, plan.cycle_time, teller)
            recorded: object = None
            try:
                with group.motion(plan.cycle_time, sweep.free) as motion:
                    source.start(motion.position)
                    recorded = capture = motion.stream(source)
            except BaseException as error:  # once the drives are off: writing to a disk takes time
                if isinstance(error, StoppedError) and recorded is None:
                    recorded = error.capture
                if isinstance(recorded, Capture) and recorded.rows > 1:
                    cut = source.experiment(recorded, complete=False, note=str(error))
                    keep_whatever_happens([cut], keep, error)
                raise
            machine_time += capture.rows * plan.cycle_time
            keep_all([source.experiment(capture)], keep)
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
            time=sample_times(capture.rows, self._step),
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
