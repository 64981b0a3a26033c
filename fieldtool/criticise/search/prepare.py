"""From a recording and a model to what can be fitted and tested."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fieldtool.criticise.effects.base import Context, band_limited
from fieldtool.criticise.evidence.lines import Lines, lines_of, with_shared_noise
from fieldtool.criticise.evidence.spans import Spans, spans_of, usable_experiments
from fieldtool.criticise.search.hypothesis import Hypothesis, Simulator, unknown_courses
from fieldtool.criticise.search.machine import Machine
from fieldtool.criticise.simulate.inverse import HiddenSystem
from fieldtool.criticise.simulate.motion import Motion, motions_of
from fieldtool.errors import NotEnoughDataError
from fieldtool.records.model import MachineModel
from fieldtool.records.recording import AxisInfo, Recording
from fieldtool.records.same_axes import axes_differ

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Prepared:
    """Everything that a search needs."""

    recording: Recording
    spans: Spans
    motions: dict[str, Motion]
    simulator: Simulator
    start: Hypothesis
    accepted: FloatArray | None = None
    """The machine's numbers as last accepted; None where they are not known."""

    def context(self, hypothesis: Hypothesis) -> Context:
        """Return what start values are taken from, with the errors that a hypothesis leaves."""
        errors = self.simulator.errors(hypothesis)
        motions = tuple(self.motions.values())
        return Context(
            self.recording.axes,
            hypothesis.machine.with_values(hypothesis.base),
            motions,
            tuple(
                band_limited(self.cleaned(errors[m.experiment], m), m.step, self.spans.top)
                for m in motions
            ),
            self.spans.top,
            self.spans.excited,
            frozenset(hypothesis.machine.names),
            tuple(
                {
                    (s.periods / length, 1 / length)
                    for s in self.spans.spans
                    if s.periods > 1
                    for length in [(s.stop - s.start) * motions[0].step]
                }
            ),
        )

    def cleaned(self, error: FloatArray, motion: Motion) -> FloatArray:
        """Count an error only where it is known and compared, less free motions."""
        out = np.zeros_like(error)
        for lines in self.simulator.lines:
            if lines.span.experiment == motion.experiment:
                out[lines.span.start : lines.span.stop] = lines.less_unknown(error)
        return np.asarray(out * motion.counted)


def prepare(recording: Recording, model: MachineModel, contiguous: bool = False) -> Prepared:
    """Choose rows and band, differentiate the motion, find the noise.

    Parameters
    ----------
    recording : Recording
    model : MachineModel
        Its chains, couplings and viscous frictions are what is criticised.
    contiguous : bool
        See :func:`fieldtool.criticise.evidence.spans.spans_of`.

    Raises
    ------
    NotEnoughDataError
        If there is nothing to compare, or the model is of other axes.
    """
    if differ := axes_differ(model.axes, "the recording", recording.axes):
        raise NotEnoughDataError(f"the model {differ}, or identify the recording again.")
    experiments = usable_experiments(recording)
    spans = spans_of(recording, experiments, contiguous)
    motions = {m.experiment: m for m in motions_of(recording, experiments, spans.top)}
    largest = np.max([np.abs(m.torque).max(axis=0) for m in motions.values()], axis=0)
    machine = Machine.of(model, largest)
    start = Hypothesis(machine, machine.start)
    prepared = Prepared(recording, spans, motions, Simulator(motions, ()), start)
    return reweighted(prepared, start)


def reweighted(prepared: Prepared, hypothesis: Hypothesis) -> Prepared:
    """Return the same with the noise that is left by a hypothesis."""
    system = HiddenSystem.of(hypothesis.structure)
    errors = prepared.simulator.errors(hypothesis)
    free: dict[str, list[FloatArray]] = {}
    lines: list[Lines] = []
    for span in prepared.spans.spans:
        motion = prepared.motions[span.experiment]
        if span.experiment not in free and system.structure.hidden.size:
            free[span.experiment] = list(system.free_torques(motion.step, motion.rows))
        lines.append(
            lines_of(
                span,
                motion,
                errors[span.experiment],
                prepared.spans.top,
                system.structure,
                _from(free.get(span.experiment, []), span.start, motion.rows),
                unknown_courses(hypothesis, motion),
            )
        )
    simulator = Simulator(prepared.motions, tuple(with_shared_noise(lines)))
    return replace(prepared, simulator=simulator)


def _from(courses: list[FloatArray], start: int, rows: int) -> list[FloatArray]:
    """Free motions that begin at a row."""
    out = []
    for course in courses:
        moved = np.zeros((rows, course.shape[1]))
        moved[start : start + course.shape[0]] = course[: rows - start]
        out.append(moved)
    return out


def axes_of(prepared: Prepared) -> tuple[AxisInfo, ...]:
    """Return what is known of the axes."""
    return prepared.recording.axes
