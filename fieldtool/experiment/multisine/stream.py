"""The targets of experiments that follow each other, and the judgement of what the axes do.

The excitation fades out at the end of a stream, whatever ends it, and the axes come to rest.
"""

from collections.abc import Callable, Generator, Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain, repeat

import numpy as np

from drives.api import Capture, FloatArray, Targets
from drives.errors import SafetyStopError
from fieldtool.errors import LoopUnstableError, NotEnoughDataError
from fieldtool.experiment.axes import Axes, sample_times
from fieldtool.experiment.multisine.clipping import clipped_samples
from fieldtool.experiment.multisine.excitation import Excitation, IntArray
from fieldtool.experiment.multisine.growth import Growth, GrowthWatch, out_of_band
from fieldtool.experiment.multisine.passes import (
    AS_IT_CAME,
    BoolArray,
    Whole,
    sound_in_a_row,
    sound_rows,
    whole_periods,
)
from fieldtool.experiment.multisine.plan import MultisineExperiment
from fieldtool.experiment.stepped.runner import OVERLOAD
from fieldtool.records.recording import Experiment

BLOCK_TIME = 0.25
"""Seconds after which the axes are judged, about."""
HALVINGS = 4
"""Times that an experiment's amplitude is halved before the axis counts as overloaded by something
else."""
PREFERRED, MOST_PERIODS = 2, 6
"""Times the planned periods that an experiment goes on for sound ones in a row, and until every row of
all of them was sound."""
MOST_ATTEMPTS = 3
"""Times that an experiment is begun which can not go on: with a bias velocity there is no room."""
TAIL = 2
"""Times its run-in that a late cycle disturbs an experiment: a period of the lowest line as a rule."""
STOP_TIME, STOP_SHARE = 0.25, 0.5
"""An unstable loop's excitation ends in so many seconds at least, and with this share of the velocity
and acceleration limits."""


Tell = Callable[[int, "Job | None", int, int], None]
"""Gets cycles that were sent, the experiment they belong to (None at the end), the period that counts
from 1 on (0 in the run-in), and cycles still to come."""


@dataclass(frozen=True)
class Job:
    """An experiment that is still to be measured."""

    experiment: MultisineExperiment
    expected: FloatArray | None
    attempt: int = 1
    halvings: int = 0

    def again(self, halved: bool) -> "Job":
        """Return it for another attempt, with half the amplitude if that is wanted."""
        one = self.experiment.scaled(0.5) if halved else self.experiment
        return Job(one, self.expected, self.attempt + 1, self.halvings + halved)

    @property
    def note(self) -> str:
        """What a person should know of its amplitude; empty where it is as planned."""
        if not self.halvings:
            return ""
        return f"measured with 1/{2**self.halvings} of the planned amplitude, after overloads"


@dataclass
class _Part:
    """A stretch of a stream that belongs to one experiment."""

    job: Job
    begin: int
    stop: int | None = None
    complete: bool = False
    given_up: bool = False
    notes: tuple[str, ...] = ()
    missing: list[int] = field(default_factory=list)
    """Rows, from its beginning."""

    @property
    def tail(self) -> int:
        """Rows after a missing one that it disturbs."""
        return self.job.experiment.tail or TAIL * self.job.experiment.settle

    def sound(self, passes: int) -> BoolArray:
        """Return which rows of so many passes are undisturbed, (passes, samples)."""
        one = self.job.experiment
        return sound_rows(self.missing, self.tail, one.settle, one.samples, passes)


class ExperimentStream:
    """Gives the targets of experiments that follow each other, and judges what the axes do."""

    def __init__(self, jobs: Sequence[Job], axes: Axes, later: Sequence[Job], tell: Tell) -> None:
        self._jobs, self._axes, self._later, self._tell = tuple(jobs), axes, later, tell
        self._step = jobs[0].experiment.cycle_time
        self._block = max(2, round(BLOCK_TIME / self._step))
        self._row = 0
        # made here, because between two cycles there is little time
        self._excitations = [Excitation.of(job.experiment) for job in jobs]
        self._voices: list[tuple[int, Excitation]] = []
        self._parts: list[_Part] = []
        self._with_torque = any(bool(np.any(job.experiment.torque)) for job in jobs)
        self._watch: GrowthWatch | None = None
        self._watched = 0
        """Rows of the stream that were watched, or came before the present experiment."""
        self._steps = self._script()
        self.left: list[Job] = list(later)
        """What is to be measured when the stream has ended."""
        self.verdict: Exception | None = None
        """Why the measurement can not go on."""

    @property
    def start(self) -> FloatArray:
        """Where it begins, from the centre, shape (M,)."""
        return self._jobs[0].experiment.start

    def __call__(self, before: Capture | None) -> FloatArray | Targets | None:
        """Return the next block; see ``drives.api.Source``."""
        try:
            return next(self._steps) if before is None else self._steps.send(before)
        except StopIteration:
            return None

    def experiments(self, capture: Capture, cut: str = "") -> list[Experiment]:
        """Return what was recorded; ``cut`` says why the stream did not end by itself."""
        return [
            experiment for part in self._parts for experiment in self._recorded(part, capture, cut)
        ]

    def _recorded(self, part: _Part, capture: Capture, cut: str) -> Iterator[Experiment]:
        """Yield an experiment; where it had to go on, as it came, and its whole periods.

        These have as many rows as without a disturbance: the last ones before them stand for the run-in.
        """
        one = part.job.experiment
        rows = np.arange(part.begin, min(part.stop or capture.rows, capture.rows))
        if rows.size < 2:
            return
        every = self._experiment(part, capture, rows, cut)
        passes = (rows.size - one.settle) // one.samples
        if not part.complete or passes == one.periods:
            yield every
            return
        whole = whole_periods(part.sound(passes), one.periods, one.settle)
        end = one.settle + int(whole.own[-1]) + 1
        taken, passed = rows[end - one.rows : end], rows[one.settle :]
        mended = self._experiment(part, capture, taken, cut)
        position, torque = (
            np.concatenate([values[taken[: -whole.own.size]], whole.filled(values[passed])])
            for values in (capture.position, capture.torque)
        )
        name = one.name + AS_IT_CAME
        why = f"{passes - one.periods} periods more, because cycles were late or samples missing"
        yield replace(
            every,
            name=name,
            kind="other",
            period=None,
            complete=False,
            note=_joined(every.note, why),
        )
        note = _joined(mended.note, _origin(whole, one))
        yield replace(mended, position=position, torque=torque, note=note)

    def _experiment(self, part: _Part, capture: Capture, rows: IntArray, cut: str) -> Experiment:
        job, one, names = part.job, part.job.experiment, self._axes.names
        notes = [job.note, *part.notes, "" if part.stop else cut]
        for name, torque in zip(names, capture.torque[rows].T, strict=True):
            clipped = clipped_samples(torque)
            if clipped:
                notes.append(f"torque of {name} was at its limit in {clipped} samples")
        offset = capture.torque_offset
        return Experiment(
            name=f"{one.name}, attempt {job.attempt}" if part.given_up else one.name,
            kind="other" if part.given_up else "multisine",
            driven=names,
            free=(),
            period=None if part.given_up else one.period,
            time=sample_times(rows.size, self._step),
            position=capture.position[rows],
            torque=capture.torque[rows],
            position_reference=capture.position_reference[rows],
            statusword=capture.statusword[rows],
            extra={}
            if offset is None
            else {f"{name}.torque_offset": offset[rows, k] for k, name in enumerate(names)},
            complete=part.complete,
            note=_joined(*notes),
        )

    def _script(self) -> Generator[FloatArray | Targets, Capture, None]:
        for number, job in enumerate(self._jobs):
            self._end_voice(job.experiment.fade)
            self._voices.append((self._row, self._excitations[number]))
            following = [*self._jobs[number + 1 :], *self._later]
            complete = yield from self._measure(job, following)
            if not complete:
                break
        unstable = isinstance(self.verdict, LoopUnstableError)
        self._end_voice(self._shortest_stop() if unstable else None)
        over = max(begin + (voice.over or 0) for begin, voice in self._voices)
        for n in _evenly(over - self._row, self._block):
            yield self._targets(n)
            self._tell(n, None, 0, self._rows_of(self.left))

    def _end_voice(self, most: int | None) -> None:
        """Let the last excitation fade out from now on, in so many cycles at most if given."""
        if self._voices:
            begin, voice = self._voices[-1]
            fade = voice.experiment.fade
            fade_out = fade if most is None else min(fade, most)
            self._voices[-1] = begin, voice.ending_at(self._row - begin, fade_out)

    def _measure(
        self, job: Job, following: list[Job]
    ) -> Generator[FloatArray | Targets, Capture, bool]:
        """Run one experiment; return whether it is complete."""
        one = job.experiment
        part = _Part(job, self._row)
        if self._parts:  # what was disturbed shortly before is so still
            earlier = self._parts[-1]
            before = [row + earlier.begin - part.begin for row in earlier.missing]
            part.missing += [row for row in before if row >= -part.tail]
        self._parts.append(part)
        self._watch, self._watched = self._watch_of(job), self._row
        clean = 0
        later = self._rows_of(following) + one.fade
        for stage, rows in enumerate(chain([one.settle], repeat(one.samples))):
            left = later + max(one.periods - clean, 1) * one.samples
            left += one.settle if stage == 0 else 0
            first = min(clean + 1, one.periods) if stage else 0
            for n in _evenly(rows, self._block):
                begin = self._row - part.begin
                capture = yield self._targets(n)
                left -= n
                self._tell(n, job, first, left)
                part.missing += [begin + row for row in capture.missing]
                if self._gives_up(part, capture, following):
                    return False
            if stage == 0:
                continue
            sound = part.sound(stage)
            clean = min(int(sound.sum(axis=0).min()), one.periods)
            in_a_row = sound_in_a_row(sound, one.periods)
            if in_a_row or (clean == one.periods and stage >= PREFERRED * one.periods):
                part.stop, part.complete = self._row, True
                return True
            if not sound.all() and self._ends_for_gaps(part, stage, following):
                return False
        raise AssertionError("periods never end")

    def _watch_of(self, job: Job) -> GrowthWatch:
        one, limits = job.experiment, self._axes.limits
        errors = np.array([axis.following_error for axis in limits])
        torques = np.array([axis.torque for axis in limits])
        most = MOST_PERIODS * one.periods + 2  # with the run-in
        rows = one.samples, one.fade
        return GrowthWatch(*rows, errors, torques, job.expected, self._step, most)

    def _gives_up(self, part: _Part, capture: Capture, following: list[Job]) -> bool:
        """Judge a block; where the experiment can not go on, say how it ends."""
        growth = self._watch_block(capture)
        overload = self._overload(capture)
        if growth is None and overload:
            growth = self._above_the_band(capture, part.job.experiment)
        if growth is not None:
            self.verdict = self._unstable(part.job, growth)
        elif overload and part.job.halvings >= HALVINGS:
            self.verdict = self._overloaded(part.job, overload)
        elif overload:
            part.given_up = True
            part.notes = (f"given up because {overload}; repeated with half the amplitude",)
            self.left = [part.job.again(halved=True), *following]
        else:
            return False
        part.stop = self._row
        if self.verdict is not None:
            part.notes = (str(self.verdict),)
        return True

    def _watch_block(self, capture: Capture) -> Growth | None:
        if self._watch is None:
            return None
        self._watched += capture.rows
        return self._watch.take(capture.position_reference - capture.position, capture.torque)

    def judge_cut(self, capture: Capture) -> LoopUnstableError | None:
        """Return what a growing oscillation has to do with it, if a limit stopped the stream."""
        rest = capture.rows - self._watched
        if self._watch is None or rest < 1 or self._parts[-1].stop is not None:
            return None
        error = capture.position_reference[-rest:] - capture.position[-rest:]
        growth = self._watch.take(error, capture.torque[-rest:])
        return None if growth is None else self._unstable(self._parts[-1].job, growth)

    def _above_the_band(self, capture: Capture, one: MultisineExperiment) -> Growth | None:
        """Return the oscillation, if the torque that overloads an axis is none of the excitation's."""
        highest = float(one.lines[-1]) / one.samples
        for k, limits in enumerate(self._axes.limits):
            torque = capture.torque[:, k]
            share = float(np.abs(torque).max()) / limits.torque
            if share > OVERLOAD:
                frequency = out_of_band(torque, highest)
                if frequency is not None:
                    return Growth(k, "torque", frequency / self._step, share)
        return None

    def _overload(self, capture: Capture) -> str:
        """Return in words what is above OVERLOAD of a limit; empty if nothing is."""
        torque = np.abs(capture.torque).max(axis=0)
        away = np.abs(capture.position - self._axes.centre).max(axis=0)
        for k, (name, limits) in enumerate(zip(self._axes.names, self._axes.limits, strict=True)):
            for what, value, limit in (
                ("torque", torque[k], limits.torque),
                ("distance from its centre", away[k], self._axes.room[k]),
            ):
                if value > OVERLOAD * limit:
                    return (
                        f"the {what} of {name}, {value:.4g}, was above {100 * OVERLOAD:.0f} % of its "
                        f"limit {limit:.4g}"
                    )
        return ""

    def _ends_for_gaps(self, part: _Part, done: int, following: list[Job]) -> bool:
        """Say how an experiment ends that has had a period with missing samples."""
        job, one = part.job, part.job.experiment
        most = MOST_PERIODS * one.periods
        if one.biased and job.attempt < MOST_ATTEMPTS + job.halvings:
            part.stop, part.given_up = self._row, True
            part.notes = ("given up because samples are missing; repeated",)
            self.left = [job.again(halved=False), *following]
            return True
        if done < most and not one.biased:
            return False
        tried = f"{job.attempt} attempts" if one.biased else f"{most}"
        self.verdict = NotEnoughDataError(
            f"experiment {one.name}: {one.periods} whole periods of {one.period:.3g} s without a "
            f"missing sample were not to be had in {tried}. All axes were stopped, and the raw data are "
            "kept. Check the bus (cables, terminators, load) and the computer's load, or plan shorter "
            "periods."
        )
        part.stop, part.notes = self._row, (str(self.verdict),)
        return True

    def _unstable(self, job: Job, growth: Growth) -> LoopUnstableError:
        name, limits = self._axes.names[growth.axis], self._axes.limits[growth.axis]
        unit = self._axes.unit(growth.axis)
        if growth.quantity == "torque":
            limit, unit = limits.torque, {"rad": "N m", "m": "N"}.get(unit, "")
        else:
            limit = limits.following_error
        return LoopUnstableError(
            f"{name}: its loop becomes unstable: in experiment {job.experiment.name} an oscillation at "
            f"{growth.frequency:.3g} Hz grew by itself until its {growth.quantity} was "
            f"{growth.share * limit:.3g} {unit}, {100 * growth.share:.0f} % of the limit. The "
            "excitation was ended, all axes are disabled, and the raw data are kept. Lower the drive's "
            "gains (velocity_p, velocity_i, then position_p) and measure again; if they have to stay, "
            "set a notch filter at that frequency.",
            axis=name,
            frequency=growth.frequency,
        )

    def _overloaded(self, job: Job, overload: str) -> SafetyStopError:
        return SafetyStopError(
            f"experiment {job.experiment.name}: {overload}, however small the excitation ({HALVINGS} "
            "times halved); all axes were stopped. Does something else load the axis, does its loop "
            "oscillate (then lower the drive's gains), or is its limit too low?",
            axis=next((name for name in self._axes.names if f" of {name}," in overload), None),
        )

    @staticmethod
    def _rows_of(jobs: Sequence[Job]) -> int:
        return sum(job.experiment.rows for job in jobs)

    def _shortest_stop(self) -> int:
        """Return the cycles in which the excitation can end at once, within the limits."""
        size = np.abs(self._voices[-1][1].tables[0]).max(axis=0)
        velocity, acceleration = (
            STOP_SHARE * np.array([getattr(limits, name) for limits in self._axes.limits])
            for name in ("velocity", "acceleration")
        )
        longest = max(
            STOP_TIME,
            float(np.max(1.875 * size / velocity)),
            float(np.max(np.sqrt(5.774 * size / acceleration))),
        )
        return int(np.ceil(longest / self._step))

    def _targets(self, n: int) -> FloatArray | Targets:
        position = np.tile(self._axes.centre, (n, 1))
        offset = np.zeros_like(position)
        for begin, voice in self._voices:
            position += voice.displacements(self._row - begin, n)
            if self._with_torque:
                offset += voice.torques(self._row - begin, n)
        self._row += n
        self._voices = [
            (begin, voice)
            for begin, voice in self._voices[:-1]
            if voice.over is None or self._row - begin < voice.over
        ] + self._voices[-1:]
        return Targets(position, offset) if self._with_torque else position


def _joined(*notes: str) -> str:
    return "; ".join(note for note in notes if note)


def _origin(whole: Whole, one: MultisineExperiment) -> str:
    """Say which of the measured periods these are."""
    last = (int(whole.own[-1]) + 1) // one.samples
    first = last - one.periods + 1
    which = f"period {first}" if first == last else f"periods {first} to {last}"
    if not whole.lent:
        return f"{which} of those that were measured"
    return f"{which} of those that were measured, {whole.lent} disturbed rows as in the others"


def _evenly(rows: int, block: int) -> list[int]:
    """Return the sizes of blocks of about the same length, near ``block`` rows, for these rows."""
    count = max(1, round(rows / block))
    edges = np.linspace(0, rows, count + 1).round().astype(int)
    return [int(n) for n in np.diff(edges) if n]
