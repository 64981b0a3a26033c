"""Which rows are compared, which of them are kept unseen, and up to which frequency.

Experiments are kept unseen whole where others of their kind and size remain to fit from.  Where
there are none, each experiment is cut in time, and every third stretch is kept.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from fieldtool.criticise.simulate.motion import FEWEST_ROWS
from fieldtool.errors import NotEnoughDataError
from fieldtool.frf.multisine.period import samples_of_period, whole_periods
from fieldtool.records.recording import Experiment, Recording

Role = Literal["fit", "unseen"]
Split = Literal["experiments", "time"]
EXCITED = ("multisine", "stepped_sine")
"""Kinds of experiments beside which moves (checks of directions) are left out."""
SHORT = 3.0
"""s: moves shorter than this are left out where there is longer data."""
POWER = 0.9999
"""Share of the torque's power within the band."""
EXCITED_POWER = 0.99
"""The same up to the highest excited line of periodic data."""
BEYOND = 3.0
"""Band over the highest excited frequency of periodic data: third harmonics are seen."""
HIGHEST = 0.16
"""Of the sample rate: beyond it, what happens between samples matters."""
STRETCHES = 9
"""Stretches in time that an experiment is cut into; every third is kept unseen."""
LOUD = 2.0
"""Ratio of the torques of two experiments from which they count as of different size."""


@dataclass(frozen=True)
class Span:
    """Rows of one experiment that are compared together."""

    experiment: str
    start: int
    stop: int
    role: Role
    periods: int
    """Whole periods in it; 0 where it is not periodic."""


@dataclass(frozen=True)
class Spans:
    """All rows that are compared."""

    spans: tuple[Span, ...]
    split: Split
    top: float
    """Highest frequency compared, Hz."""
    excited: float
    """Frequency below which nearly all of the torque is, Hz."""

    @property
    def experiments(self) -> tuple[str, ...]:
        """Names in order, each once."""
        return tuple(dict.fromkeys(span.experiment for span in self.spans))

    def unseen(self) -> tuple[str, ...]:
        """Return what no fit sees, in words."""
        return tuple(
            span.experiment
            if self.split == "experiments"
            else f"{span.experiment}, rows {span.start} to {span.stop}"
            for span in self.spans
            if span.role == "unseen"
        )


def usable_experiments(recording: Recording) -> tuple[Experiment, ...]:
    """Return the experiments that can be simulated.

    Raises
    ------
    NotEnoughDataError
        If there is none.
    """
    whole = [e for e in recording.experiments if e.complete and e.samples >= FEWEST_ROWS]
    chosen = [e for e in whole if e.kind in EXCITED]
    if not chosen:
        chosen = [e for e in whole if e.kind == "moves"] or whole
        chosen = [e for e in chosen if e.samples * recording.sample_period >= SHORT] or chosen
    moved = [e for e in chosen if np.any(np.ptp(e.position, axis=0) > 0)]
    if not moved:
        raise NotEnoughDataError(
            f"the recording has no complete experiment of at least {FEWEST_ROWS} rows in which an axis "
            "moves: there is nothing to compare a simulation with. Measure with `fieldtool measure`."
        )
    return tuple(moved)


def spans_of(
    recording: Recording, experiments: Sequence[Experiment], contiguous: bool = False
) -> Spans:
    """Choose rows, band and what is kept unseen.

    Parameters
    ----------
    recording, experiments
    contiguous : bool
        Where there is nothing but a cut in time: keep the last third in one piece.
    """
    step = recording.sample_period
    rows = [_rows(e, step) for e in experiments]
    excited, top = _band(experiments, rows, step)
    roles = _roles(experiments)
    if "unseen" in roles:
        spans = [
            Span(e.name, start, stop, role, periods)
            for e, (start, stop, periods), role in zip(experiments, rows, roles, strict=True)
        ]
        return Spans(tuple(spans), "experiments", top, excited)
    cut = [
        span
        for e, bounds in zip(experiments, rows, strict=True)
        for span in _stretches(e.name, *bounds, contiguous)
    ]
    return Spans(tuple(cut), "time", top, excited)


def _rows(experiment: Experiment, step: float) -> tuple[int, int, int]:
    """Rows to compare, and whole periods in them (0: not periodic)."""
    if experiment.kind == "multisine":
        try:
            period = samples_of_period(experiment, step)
            rows, periods = whole_periods(experiment, period)
        except NotEnoughDataError:
            return 0, experiment.samples, 0
        return rows.start, rows.stop, periods
    return 0, experiment.samples, 0


def _band(
    experiments: Sequence[Experiment], rows: Sequence[tuple[int, int, int]], step: float
) -> tuple[float, float]:
    """Frequencies below which 99 % and nearly all of every torque's power is, the noise taken off."""
    most = highest = 0.0
    for e, (start, stop, periods) in zip(experiments, rows, strict=True):
        torque = e.torque[start:stop] - e.torque[start:stop].mean(axis=0)
        window = np.hanning(stop - start)[:, None] if not periods else 1.0
        power = np.abs(np.fft.rfft(torque * window, axis=0)) ** 2
        frequency = np.fft.rfftfreq(stop - start, step)
        quiet = np.median(power[3 * power.shape[0] // 4 :], axis=0) / np.log(2)
        power = np.maximum(power - 3.0 * quiet, 0.0)
        share = np.cumsum(power, axis=0) / np.maximum(power.sum(axis=0), 1e-300)
        excited = frequency[np.argmax(share >= EXCITED_POWER, axis=0)]
        most = max(most, float(excited.max()))
        if periods:
            highest = max(highest, BEYOND * float(excited.max()))
        else:
            reached = frequency[np.argmax(share >= POWER, axis=0)]
            highest = max(highest, float(reached.max()))
    top = min(1.1 * highest, HIGHEST / step)
    return min(most, top), top


def _roles(experiments: Sequence[Experiment]) -> list[Role]:
    """Keep a third of each group of like experiments unseen, at least one of two."""
    roles: list[Role] = ["fit"] * len(experiments)
    groups: list[list[int]] = []
    sizes = [np.sqrt(np.mean(e.torque**2)) for e in experiments]
    for k, e in enumerate(experiments):
        for group in groups:
            first = experiments[group[0]]
            alike = (first.kind, first.driven, first.free) == (e.kind, e.driven, e.free)
            if alike and 1 / LOUD < sizes[k] / max(sizes[group[0]], 1e-300) < LOUD:
                group.append(k)
                break
        else:
            groups.append([k])
    if any(len(group) == 1 for group in groups) and len(groups) == len(experiments):
        return roles
    for group in groups:
        for k in group[len(group) - len(group) // 3 :] if len(group) > 2 else group[1:]:
            roles[k] = "unseen"
    return roles


def _stretches(name: str, start: int, stop: int, periods: int, contiguous: bool) -> list[Span]:
    if periods >= 3:
        edges = np.linspace(0, periods, min(STRETCHES, periods) + 1).round().astype(int)
        edges = start + edges * ((stop - start) // periods)
    else:
        edges = np.linspace(start, stop, STRETCHES + 1).round().astype(int)
    count = len(edges) - 1
    parts = []
    for k in range(count):
        late = k >= count - count // 3 if contiguous else k % 3 == 2
        role: Role = "unseen" if late else "fit"
        whole = round((edges[k + 1] - edges[k]) / ((stop - start) / periods)) if periods else 0
        parts.append(Span(name, int(edges[k]), int(edges[k + 1]), role, whole))
    return _joined(parts)


def _joined(parts: list[Span]) -> list[Span]:
    """Neighbours of one role as one span."""
    out: list[Span] = []
    for part in parts:
        if out and out[-1].role == part.role:
            last = out.pop()
            periods = last.periods + part.periods
            out.append(Span(part.experiment, last.start, part.stop, part.role, periods))
        else:
            out.append(part)
    return out
