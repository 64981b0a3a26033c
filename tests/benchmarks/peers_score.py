"""How far results are from the truth, over all cases of a data set."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from peers_data import Case, ComplexArray, vibration_poles
from peers_found import Found
from scipy.optimize import linear_sum_assignment

from fieldtool.records.model import MachineModel

NEAR = 0.03
"""Relative distance up to which a mode counts as found."""
CRITERIA = ("frequency", "damping", "mass", "spring", "coupling")


@dataclass
class Row:
    """Results of one method on the cases of one data set."""

    errors: dict[str, list[float]] = field(default_factory=dict)
    """Per cent, by criterion."""
    sigmas: list[float] = field(default_factory=list)
    """Errors of masses, springs and couplings in the method's own standard errors."""
    machines: int = 0
    cases: int = 0
    missed: list[str] = field(default_factory=list)
    invented: list[str] = field(default_factory=list)
    remarks: list[str] = field(default_factory=list)
    seconds: list[tuple[float, float]] = field(default_factory=list)
    """Wall and processor, of each case."""

    def add(self, case: Case, found: Found, seconds: tuple[float, float]) -> None:
        """Judge a result by the truth."""
        self.cases += 1
        self.seconds.append(seconds)
        if found.why:
            self.remarks.append(found.why)
        if case.truth is None:
            raise ValueError(f"{case.name}: the truth is not known")
        self._add_poles(vibration_poles(case.truth), found.poles)
        if found.model is not None:
            self.machines += 1
            self._add_machine(case.truth, found.model)

    def _add_poles(self, true: ComplexArray, poles: ComplexArray) -> None:
        off = np.abs(np.abs(poles)[None, :] / np.abs(true)[:, None] - 1.0)
        rows, columns = linear_sum_assignment(np.minimum(off, 2 * NEAR))
        pairs = [(r, c) for r, c in zip(rows, columns, strict=True) if off[r, c] <= NEAR]
        for r, c in pairs:
            self._note("frequency", abs(poles[c]), abs(true[r]))
            damping, wanted = -poles[c].real / abs(poles[c]), -true[r].real / abs(true[r])
            self._note("damping", damping, wanted)
        left = set(range(true.size)) - {r for r, _ in pairs}
        more = set(range(poles.size)) - {c for _, c in pairs}
        self.missed += [f"{abs(true[r]) / (2 * np.pi):.2f}" for r in sorted(left)]
        self.invented += [f"{abs(poles[c]) / (2 * np.pi):.2f}" for c in sorted(more)]

    def _add_machine(self, truth: MachineModel, model: MachineModel) -> None:
        for axis, wanted in zip(model.axes, truth.axes, strict=True):
            for kind, one, other in (
                ("mass", axis.masses, wanted.masses),
                ("spring", axis.springs, wanted.springs),
            ):
                for a, b in zip(one, other, strict=True):
                    self._note(kind, a.value, b.value, a.std)
        for c, d in zip(model.couplings, truth.couplings, strict=True):
            self._note("coupling", c.value, d.value, c.std)

    def _note(self, what: str, value: float, wanted: float, std: float = np.nan) -> None:
        self.errors.setdefault(what, []).append(100 * (value / wanted - 1))
        if np.isfinite(std) and std > 0.0:
            self.sigmas.append((value - wanted) / std)

    def rms(self, what: str) -> float:
        """Root mean square error, per cent; nan where there is none."""
        values = self.errors.get(what)
        return float(np.sqrt(np.mean(np.square(values)))) if values else float("nan")

    def worst(self, what: str) -> float:
        """Largest error, per cent."""
        values = self.errors.get(what)
        return float(np.max(np.abs(values))) if values else float("nan")

    @property
    def wall(self) -> float:
        """Median, s."""
        return float(np.median([wall for wall, _ in self.seconds]))

    @property
    def processor(self) -> float:
        """Median, s: what the wall clock would show were this computer doing nothing else."""
        return float(np.median([processor for _, processor in self.seconds]))

    @property
    def whole(self) -> bool:
        """Whether every mode of every case was found and every machine came out."""
        return self.cases > 0 and not self.missed and self.machines == self.cases


def pair(row: Row, what: str) -> str:
    """Root mean square and worst error of one criterion."""
    if what not in row.errors:
        return "-"
    return f"{short(row.rms(what))} / {short(row.worst(what))}"


def short(value: float) -> str:
    """Per cent, short."""
    if value >= 1000:
        return f"{value:.0e}"
    if value >= 10:
        return f"{value:.0f}"
    return f"{value:.3f}" if value >= 0.1 else f"{value:.4f}"


def counted(values: Sequence[str]) -> str:
    """Each value once, with how often it is there."""
    counts = {value: values.count(value) for value in dict.fromkeys(values)}
    shown = [f"{v} ({n} times)" if n > 1 else v for v, n in list(counts.items())[:8]]
    more = len(counts) - len(shown)
    return ", ".join(shown) + (f" and {more} more" if more > 0 else "")
