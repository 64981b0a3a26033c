"""Multisine experiments as values: all axes at once, at many frequencies, under position control.

Nothing here knows a drive.  Source: Pintelon and Schoukens, System Identification, chapters 2 and 4
(odd random-phase multisines with detection lines); how experiments are orthogonal stands in ``phases``.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import groupby

import numpy as np

from fieldtool.experiment.multisine.excitation import Excitation, IntArray, signals
from fieldtool.experiment.multisine.phases import low_crest, orthogonal_phases
from fieldtool.records.closed_loop import ComplexArray
from fieldtool.records.model import FloatArray

Lines = tuple[IntArray, IntArray]
"""Numbers of the excited lines, (L,), and of those left out, (D,)."""
SHORTEST_SETTLE = 16
"""Cycles of run-in at least: below, the start is a jolt."""


@dataclass(frozen=True, eq=False)
class MultisineExperiment:
    """One periodic experiment that moves all axes at once."""

    name: str
    """Unique among the experiments of a session."""
    cycle_time: float
    """Seconds."""
    samples: int
    """Cycles in a period."""
    lines: IntArray
    """Numbers of the excited lines, (L,), odd, rising; line k is k periods in a period."""
    detection: IntArray
    """Odd lines inside the band that are left out on purpose, (D,): what is seen there is not linear."""
    reference: ComplexArray
    """Peak phasors of the position references, (L, M), rad or m."""
    torque: ComplexArray
    """Peak phasors of the torque offsets, (L, M), N m or N; zeros where not used."""
    periods: int
    """Periods that count."""
    settle: int
    """Cycles of excitation before them."""
    bias: FloatArray
    """Constant velocity added to each reference, (M,), rad/s or m/s."""
    tail: int = 0
    """Cycles after a late one that it disturbs; 0: as long as the run-in tells."""

    def __post_init__(self) -> None:
        fault = self._fault()
        if fault:
            raise ValueError(f"multisine {self.name}: {fault}")

    def _fault(self) -> str:
        lines, shape = self.lines, self.reference.shape
        if self.cycle_time <= 0 or self.samples < 4:
            return f"needs cycles in time, got {self.samples} of {self.cycle_time:g} s"
        if lines.ndim != 1 or lines.size == 0 or np.any(np.diff(lines) <= 0) or lines[0] < 1:
            return "the line numbers must be positive and rise"
        if 2 * lines[-1] >= self.samples:
            return f"line {lines[-1]} is not below half the sampling rate ({self.samples // 2})"
        both = np.concatenate([lines, self.detection])
        if np.any(both % 2 == 0) or np.unique(both).size < both.size:
            return "excited and detection lines must be odd, and differ"
        if len(shape) != 2 or shape[0] != lines.size or self.torque.shape != shape:
            return f"phasors must be ({lines.size}, M), got {shape} and {self.torque.shape}"
        if self.bias.shape != shape[1:]:
            return f"one bias velocity an axis is needed, got the shape {self.bias.shape}"
        if not all(np.all(np.isfinite(v)) for v in (self.reference, self.torque, self.bias)):
            return "phasors and bias velocities must be finite"
        if not (np.any(self.reference) or np.any(self.torque)):
            return "excites nothing"
        if self.periods < 1 or self.settle < SHORTEST_SETTLE:
            return (
                f"needs a period and {SHORTEST_SETTLE} cycles of run-in, got {self.periods} and "
                f"{self.settle}"
            )
        return ""

    @property
    def axes(self) -> int:
        """Number of axes M."""
        return int(self.reference.shape[1])

    @property
    def period(self) -> float:
        """Seconds."""
        return self.samples * self.cycle_time

    @property
    def frequencies(self) -> FloatArray:
        """Of the excited lines, (L,), Hz."""
        return self.lines / self.period

    @property
    def rows(self) -> int:
        """Cycles that are recorded: run-in and periods."""
        return self.settle + self.periods * self.samples

    @property
    def fade(self) -> int:
        """Cycles in which the excitation rises, and in which it ends.

        Half the run-in, but a period of the lowest line where the run-in has room for one.
        """
        lowest = int(np.ceil(self.samples / self.lines[0]))
        return min(max(self.settle // 2, lowest), self.settle)

    @property
    def duration(self) -> float:
        """Seconds of excitation, with the fade-out after the last period."""
        return (self.rows + self.fade) * self.cycle_time

    @property
    def biased(self) -> bool:
        """Whether an axis has a bias velocity."""
        return bool(np.any(self.bias))

    @property
    def bias_travel(self) -> FloatArray:
        """How far the bias velocities lead from start to end, (M,), rad or m."""
        return self.bias * self.cycle_time * self.rows

    @property
    def start(self) -> FloatArray:
        """Where it begins, from the centre, (M,), rad or m: half the bias' way before it."""
        return -self.bias_travel / 2

    def scaled(self, factor: float) -> "MultisineExperiment":
        """Return it with all phasors multiplied; the bias velocities stay."""
        return replace(self, reference=self.reference * factor, torque=self.torque * factor)

    def one_period(self) -> FloatArray:
        """Return a period of displacements, shape (samples, M), rad or m, without the bias."""
        return signals(self.reference, self.lines, self.samples)

    def one_period_of_torque(self) -> FloatArray:
        """Return a period of torque offsets, shape (samples, M), N m or N."""
        return signals(self.torque, self.lines, self.samples)

    def targets(self) -> FloatArray:
        """Return displacements from the centre, shape (rows, M): run-in and periods."""
        return Excitation.of(self).displacements(0, self.rows)

    def torque_targets(self) -> FloatArray:
        """Return torque offsets, shape (rows, M): run-in and periods."""
        return Excitation.of(self).torques(0, self.rows)

    def ending(self) -> FloatArray:
        """Return the displacements that follow the last period, shape (fade + 1, M), to rest."""
        return Excitation.of(self, self.rows).displacements(self.rows, self.fade + 1)


@dataclass(frozen=True, eq=False)
class MultisinePlan:
    """All experiments of the fast plan, and the cycle time of the bus."""

    cycle_time: float
    """Seconds."""
    experiments: tuple[MultisineExperiment, ...]
    notes: tuple[str, ...] = ()
    """Choices that a person should see, one sentence each."""

    def __post_init__(self) -> None:
        if not self.experiments:
            raise ValueError("a plan needs an experiment")
        names = [one.name for one in self.experiments]
        if len(set(names)) < len(names):
            raise ValueError(f"experiments must have names of their own, got {names}")
        if len({one.axes for one in self.experiments}) > 1:
            raise ValueError("all experiments must have the same axes")
        if any(one.cycle_time != self.cycle_time for one in self.experiments):
            raise ValueError(f"all experiments must have the plan's cycle, {self.cycle_time:g} s")

    @property
    def streams(self) -> tuple[tuple[MultisineExperiment, ...], ...]:
        """Experiments that follow each other without a pause: those without bias velocity.

        The one before ends while the next one begins, in its run-in.
        """
        return streams(self.experiments)

    @property
    def duration(self) -> float:
        """Seconds of excitation, all that is streamed but for positioning."""
        rows = sum(sum(one.rows for one in row) + row[-1].fade + 1 for row in self.streams)
        return rows * self.cycle_time

    @property
    def frequencies(self) -> FloatArray:
        """Of all lines that an experiment excites, Hz, rising."""
        every: FloatArray = np.unique(np.concatenate([e.frequencies for e in self.experiments]))
        return every

    @property
    def lines(self) -> IntArray:
        """Numbers of all lines that an experiment excites, rising; ValueError if periods differ."""
        if len({one.samples for one in self.experiments}) > 1:
            raise ValueError("experiments with periods of different length have no lines in common")
        every: IntArray = np.unique(np.concatenate([e.lines for e in self.experiments]))
        return every

    @property
    def uses_torque(self) -> bool:
        """Whether an experiment has torque offsets."""
        return any(bool(np.any(one.torque)) for one in self.experiments)

    def scaled(self, factor: float) -> "MultisinePlan":
        """Return it with all phasors multiplied; bias velocities stay."""
        return replace(self, experiments=tuple(one.scaled(factor) for one in self.experiments))


def streams(
    experiments: tuple[MultisineExperiment, ...],
) -> tuple[tuple[MultisineExperiment, ...], ...]:
    """Return experiments in groups that follow each other without a pause; a biased one is alone."""
    numbered = enumerate(experiments)
    groups = groupby(numbered, key=lambda item: item[0] if item[1].biased else -1)
    return tuple(tuple(one for _, one in group) for _, group in groups)


def random_odd_lines(
    first: int, last: int, detection_share: float, rng: np.random.Generator
) -> Lines:
    """Return the odd lines of a band, one at random of each group of them left out.

    Parameters
    ----------
    first, last
        Band, line numbers, both included; even ones move inwards.
    detection_share
        Share of the lines to be left out, 0 to 0.5: the groups have 1 / share lines.  A group at
        the end that is not full is excited whole.
    rng
        Random numbers.

    Returns
    -------
    lines, detection
        Excited lines (L,) and lines left out (D,), rising.

    Raises
    ------
    ValueError
        If the band holds no odd line, or the share is not in its range.

    Notes
    -----
    A quadratic non-linearity shows at even lines, a cubic one at the odd lines left out (Pintelon
    and Schoukens, section 4.3).
    """
    odd = np.arange(max(first, 1) | 1, last + 1, 2, dtype=np.int_)
    if odd.size == 0:
        raise ValueError(f"no odd line from {first} to {last}")
    return _parted(odd, detection_share, lambda group: int(rng.integers(0, group.size)))


def least_needed_out(odd: IntArray, need: FloatArray, detection_share: float) -> Lines:
    """Part odd lines as :func:`random_odd_lines`, but leave out those with the least need, (L,)."""
    return _parted(odd, detection_share, lambda group: int(np.argmin(need[group])))


def _parted(odd: IntArray, detection_share: float, choose: Callable[[IntArray], int]) -> Lines:
    """Leave out one line of each group; what it chooses from are the places of a group."""
    if not 0 <= detection_share <= 0.5:
        raise ValueError(f"detection share must be 0 to 0.5, got {detection_share:g}")
    if detection_share == 0:
        return odd, np.empty(0, dtype=np.int_)
    size = round(1 / detection_share)
    groups = np.arange(odd.size // size * size).reshape(-1, size)
    left_out = np.array([group[choose(group)] for group in groups], dtype=np.intp)
    detection = odd[left_out]
    return np.setdiff1d(odd, detection), detection


def orthogonal_experiments(
    lines: IntArray,
    detection: IntArray,
    amplitude: FloatArray,
    *,
    cycle_time: float,
    samples: int,
    periods: int,
    settle: int,
    seed: int,
    name: str = "multisine",
    torque: ComplexArray | None = None,
    bias: FloatArray | None = None,
    weights: ComplexArray | None = None,
    experiments: int | None = None,
) -> tuple[MultisineExperiment, ...]:
    """Return as many experiments as axes, with inputs that are orthogonal at every line.

    Parameters
    ----------
    lines, detection
        Excited lines (L,) and odd lines left out (D,).
    amplitude
        Of each axis' reference, shape (L, M), rad or m, peak.
    cycle_time, samples, periods, settle
        As in :class:`MultisineExperiment`.
    seed
        Of the random phases; another one gives another realisation.
    name
        Of the experiments; they are numbered from 1.
    torque
        Torque offset that goes with each axis' reference, shape (L, M), N m or N; its argument is the
        phase by which it leads the reference.  An axis' input is both together.
    bias
        Bias velocities, shape (M,), rad/s or m/s; none without.
    weights
        What must not have peaks, as in :func:`low_crest`, per unit of the axes' inputs: as large as
        ``amplitude``, or as the torque's modulus at lines where the amplitude is 0.
    experiments
        How many, at least M; M without.

    Raises
    ------
    ValueError
        If there are fewer experiments than axes, or shapes do not fit.
    """
    M = amplitude.shape[1]
    mixing = orthogonal_phases(M, M if experiments is None else experiments)
    offset = np.zeros(amplitude.shape, dtype=np.complex128) if torque is None else torque
    size = np.where(amplitude > 0, amplitude, np.abs(offset))
    turned = np.exp(1j * low_crest(lines, size, seed, weights, mixing))
    return tuple(
        MultisineExperiment(
            f"{name} {e + 1}",
            cycle_time,
            samples,
            lines,
            detection,
            amplitude * turned * mixing[:, e],
            offset * turned * mixing[:, e],
            periods,
            settle,
            np.zeros(M) if bias is None else bias,
        )
        for e in range(mixing.shape[1])
    )
