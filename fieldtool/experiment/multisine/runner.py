"""Run the fast plan: all axes at once, block after block, watched as it goes.

Experiments without bias velocity follow each other in one stream, the one before ending in the run-in
of the next.  Whatever ends the measurement, the axes are brought to rest, the drives are disabled, and
what was recorded is kept.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace

from drives.api import Capture, FloatArray, Motion
from drives.errors import SafetyStopError, StoppedError
from fieldtool.errors import LoopUnstableError
from fieldtool.experiment.axes import (
    Axes,
    Keep,
    Mover,
    bring_to_centre,
    come_to_rest,
    keep_all,
    keep_whatever_happens,
)
from fieldtool.experiment.multisine.plan import MultisinePlan, streams
from fieldtool.experiment.multisine.stream import ExperimentStream, Job
from fieldtool.records.recording import Experiment


@dataclass(frozen=True)
class MultisineProgress:
    """Where a measurement is."""

    experiment: int
    """Counted from 1."""
    experiments: int
    name: str
    period: int
    """Of those that count, from 1; 0 in the run-in."""
    periods: int
    done: float
    """Share of the excitation, 0 to 1; never falls."""
    seconds_left: float
    """Of excitation; rises when something has to be measured again."""
    machine_time: float
    """Seconds of excitation so far."""

    @property
    def text(self) -> str:
        """What is measured, in words."""
        where = f"period {self.period} of {self.periods}" if self.period else "run-in"
        return f"experiment {self.experiment}/{self.experiments}: {self.name}, {where}"


Report = Callable[[MultisineProgress], None]


def _silent(_: MultisineProgress) -> None:
    return


def run_multisine(
    group: Mover,
    plan: MultisinePlan,
    axes: Axes,
    keep: Keep,
    report: Report = _silent,
    expected_errors: FloatArray | None = None,
) -> float:
    """Run every experiment of a plan; return the seconds of excitation.

    Parameters
    ----------
    group
        Gives enabled axes.
    plan
        A plan that was checked by ``forecast_multisine``.
    axes
        Names, limits, centres.
    keep
        Gets each experiment's raw data once the drives are off, also when it was cut short.  A
        complete one is the ``settle`` rows of its run-in, then ``periods * samples`` rows: whole
        periods without a disturbed row.  Where it went on for longer to have them, what came last
        before them stands for the run-in, and all rows in their order come before it, of kind
        ``other``.  One that was given up, to be repeated, is of that kind, too.
    report
        Called after every block.
    expected_errors
        Largest following errors by the forecast, shape (E, M): without them the watch for loops that
        become unstable sees less until an experiment's second period.

    Raises
    ------
    StoppedError
        If a limit was passed, a drive failed, or the user stopped; all axes are disabled.
    LoopUnstableError
        If an oscillation grows by itself.
    NotEnoughDataError
        If too many periods lack samples.
    """
    expected: Sequence[FloatArray | None] = (
        [None] * len(plan.experiments) if expected_errors is None else list(expected_errors)
    )
    jobs = [Job(*item) for item in zip(plan.experiments, expected, strict=True)]
    teller = _Teller(report, plan)
    finished: list[_Streamed] = []
    verdict: Exception | None = None
    try:
        with _enabled(group, plan) as motion:
            while jobs and verdict is None:
                row = jobs[: len(streams(tuple(job.experiment for job in jobs))[0])]
                stream = ExperimentStream(row, axes, jobs[len(row) :], teller.tell)
                _follow(motion, stream, axes, finished)
                jobs, verdict = stream.left, stream.verdict
            if verdict is None and finished and finished[-1][1].rows:
                come_to_rest(motion, axes, finished[-1][1].position_reference[-1])
        if verdict is not None:
            raise verdict
    except BaseException as error:
        keep_whatever_happens(_experiments(finished), keep, error)
        raise
    keep_all(_experiments(finished), keep)  # the disk may be slow: not while axes are enabled
    return teller.seconds


def _enabled(group: Mover, plan: MultisinePlan) -> AbstractContextManager[Motion]:
    if plan.uses_torque:
        return group.motion(plan.cycle_time, torque_offset=True)
    return group.motion(plan.cycle_time)


_Streamed = tuple[ExperimentStream, Capture, str]
"""A stream, what was recorded of it, and why it did not end by itself."""


def _experiments(finished: Sequence[_Streamed]) -> Iterator[Experiment]:
    for stream, capture, cut in finished:
        yield from stream.experiments(capture, cut)


def _follow(
    motion: Motion, stream: ExperimentStream, axes: Axes, finished: list[_Streamed]
) -> None:
    bring_to_centre(motion, replace(axes, centre=axes.centre + stream.start))
    try:
        finished.append((stream, motion.stream(stream), ""))
    except StoppedError as error:
        if not isinstance(error.capture, Capture):
            raise
        finished.append((stream, error.capture, str(error)))
        unstable = _named_instability(stream, error, error.capture)
        if unstable is None:
            raise
        raise unstable from error


def _named_instability(
    stream: ExperimentStream, error: StoppedError, capture: Capture
) -> LoopUnstableError | None:
    """Return the growing oscillation that led to a safety stop, if that was its cause.

    What a drive may still do (the error's notes) comes first: then the oscillation joins the notes.
    """
    if not isinstance(error, SafetyStopError):
        return None
    known = stream.verdict
    unstable = known if isinstance(known, LoopUnstableError) else stream.judge_cut(capture)
    if unstable is None:
        return None
    if getattr(error, "__notes__", ()):
        error.add_note(str(unstable))
        return None
    unstable.add_note(f"what stopped the axes: {error}")
    return unstable


class _Teller:
    """Turns a block's end into a progress report."""

    def __init__(self, report: Report, plan: MultisinePlan) -> None:
        self._report, self._step = report, plan.cycle_time
        self._names = [one.name for one in plan.experiments]
        self._rows, self._done = 0, 0.0

    @property
    def seconds(self) -> float:
        return self._rows * self._step

    def tell(self, rows: int, job: Job | None, period: int, rows_left: int) -> None:
        self._rows += rows
        if job is None:
            return
        one = job.experiment
        self._done = max(self._done, self._rows / (self._rows + rows_left))
        self._report(
            MultisineProgress(
                self._names.index(one.name) + 1,
                len(self._names),
                one.name,
                period,
                one.periods,
                self._done,
                rows_left * self._step,
                self.seconds,
            )
        )
