"""What every effect of the library is: parameters, equation, signature, and how it extends the model.

An effect acts at one of four places, each a method that leaves everything as it is unless overridden:
the measured motion (encoder, delay), the machine's structure (springs, masses), a torque at the motor
that follows from the motion, and the torque as the drive reports it.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from fieldtool.criticise.simulate.motion import Motion
from fieldtool.criticise.simulate.structure import Structure
from fieldtool.records.model import MachineModel
from fieldtool.records.recording import AxisInfo

FloatArray = NDArray[np.float64]
Values = Mapping[str, float]


@dataclass(frozen=True)
class Parameter:
    """One number of an effect."""

    name: str
    unit: str
    start: float
    low: float
    high: float
    scale: float
    """Size of a change that matters, same unit; steps of derivatives are a thousandth of it."""
    linear: bool = False
    """Whether the torque is proportional to it, so that nothing acts while all of these are 0."""

    def clipped(self, value: float) -> float:
        """Return the nearest value within the bounds."""
        return float(min(max(value, self.low), self.high))


@dataclass(frozen=True)
class Mark:
    """What sets an effect apart from a relative: a number that is 0 for itself and 1 for the relative.

    The number is fitted beside the effect, to all data; only if it is known to be nearer to 0 the
    effect is named for sure.
    """

    relative: str
    """Name of the effect that leaves the same but for this."""
    words: str
    """What the data have to show, to stand after "not shown:"."""
    number: str
    """Of :attr:`beside`; without that, of the axis' variables of the machine."""
    whole: float
    """Value of the number where the effect is its relative."""
    beside: "Effect | None" = None
    """A form without a name, whose number bends the effect into its relative."""
    special: bool = False
    """Whether the effect is the relative's special case: it keeps its name until the number is not 0."""
    either_sign: bool = False
    """Whether a number below 0 speaks for the relative as well."""
    or_else: str = ""
    """What else than the relative the number may be of; then it decides nothing between both."""


@dataclass(frozen=True)
class Effect:
    """One effect at one place of the machine."""

    name: ClassVar[str]
    equation: ClassVar[str]
    source: ClassVar[str]
    signature: ClassVar[str]
    """What it must leave in the data."""
    contrary: ClassVar[str]
    """What it must not leave."""
    shows: ClassVar[tuple[str, ...]] = ()
    """Views of the error (:mod:`fieldtool.criticise.where.views`): one at least has to show it."""

    spreads: ClassVar[bool] = False
    """Whether couplings pass on what is unknown of it to all axes."""
    exact: ClassVar[bool] = False
    """Whether its form is no approximation of what machines have."""
    relatives: ClassVar[tuple[str, ...]] = ()
    """Effects on the same axis that are fitted wherever this one is: they leave nearly the same."""
    fits: ClassVar[float] = 0.95
    """Share of what is wrong of its axis that its form explains at least, where it is the only cause."""

    axis: int
    parameters: tuple[Parameter, ...]
    location: str = "motor"
    other: int | None = None
    """The second axis of what joins two."""
    replaces: tuple[str, ...] = field(default=())
    """Simpler effects on the same axis that this one contains."""
    number: int = 0
    """Of those that are alike but for their numbers, as two waves of the position."""

    @property
    def seen_by(self) -> tuple[str, ...]:
        """Views of which one has to show it; none for what reaches the motor through springs."""
        return () if self.location == "load" else self.shows

    @property
    def key(self) -> tuple[str, int, str, int | None, int]:
        """What tells it from all others: name, axis, location, other axis, number."""
        return self.name, self.axis, self.location, self.other, self.number

    def structure(self, structure: Structure, values: Values) -> Structure:
        """Return the structure with the effect in it."""
        return structure

    def motion(self, motion: Motion, values: Values) -> Motion:
        """Return the true motion for the measured one."""
        return motion

    def torque(self, motion: Motion, values: Values) -> FloatArray | None:
        """Return the torque that the motor needs besides, (n,); None for none."""
        return None

    def reported(self, torque: FloatArray, motion: Motion, values: Values) -> FloatArray:
        """Return what the drive reports where the axis needs ``torque``, (n,) each."""
        return torque

    def unknown(self, motion: Motion, values: Values) -> tuple[FloatArray, ...]:
        """Return torques at the motor whose size may differ from experiment to experiment, (n,) each."""
        return ()

    def far(self, instants: Sequence[float]) -> list[dict[str, float]]:
        """Return start values too far off for derivatives, to be simulated; ``instants`` differ, s."""
        return []

    def implausible(self, values: Values, context: "Context") -> str:
        """Say why these values are no physical answer; empty where they are."""
        return ""

    def marks(self, values: Values, context: "Context") -> tuple[Mark, ...]:
        """Return what sets the effect, at these values, apart from its relatives."""
        return ()

    def plain(self, values: Values) -> dict[str, tuple[float, str, tuple[str, ...]]]:
        """Return the numbers that are reported: name -> (value, unit, fitted ones it depends on)."""
        return {p.name: (values[p.name], p.unit, (p.name,)) for p in self.parameters}


@dataclass(frozen=True, eq=False)
class Context:
    """What start values are taken from."""

    axes: tuple[AxisInfo, ...]
    model: MachineModel
    motions: tuple[Motion, ...]
    errors: tuple[FloatArray, ...]
    """Per experiment, torque measured less simulated in the band, (n, M)."""
    top: float
    """Highest frequency compared, Hz."""
    excited: float
    """Frequency below which nearly all of the torque is, Hz."""
    variable: frozenset[str]
    """Names of the model's numbers that are fitted beside."""
    fundamentals: tuple[tuple[float, float], ...] = ()
    """Of periodic excitation: its lowest frequency, and the distance of separate lines, Hz."""

    def fastest(self, axis: int) -> float:
        """Speed that 1 % of the rows exceed, rad/s or m/s."""
        return max(float(np.quantile(np.abs(m.velocity[:, axis]), 0.99)) for m in self.motions)

    def travel(self, axis: int) -> float:
        """Return the largest range of positions in an experiment."""
        return max(float(np.ptp(m.position[:, axis])) for m in self.motions)

    def torque_size(self, axis: int) -> float:
        """RMS of the measured torque about its mean."""
        return float(np.sqrt(np.mean([np.var(m.torque[:, axis]) for m in self.motions])))

    def largest_torque(self, axis: int) -> float:
        """Return the largest measured torque of either sign."""
        return max(float(np.abs(m.torque[:, axis]).max()) for m in self.motions)

    def error_size(self, axis: int) -> float:
        """RMS of the torque's error."""
        return float(np.sqrt(np.mean([np.mean(e[:, axis] ** 2) for e in self.errors])))

    def torque_unit(self, axis: int) -> str:
        """N m, N or A."""
        return self.axes[axis].torque_unit

    def per(self, axis: int, what: str) -> str:
        """Return the unit of a torque per something of the motion, as ``N m s/rad``."""
        torque, length = self.torque_unit(axis), self.axes[axis].position_unit
        return f"{torque} {what}/{length}" if what else f"{torque}/{length}"

    def length_unit(self, axis: int) -> str:
        """Rad or m."""
        return self.axes[axis].position_unit

    def masses(self, axis: int) -> int:
        """Return the number of masses of the chain."""
        return len(self.model.axes[axis].masses)

    def inertia(self, axis: int) -> float:
        """Sum of the chain's masses."""
        return self.model.axes[axis].total_mass

    def first_dof(self, axis: int) -> int:
        """Degree of freedom of the motor."""
        return int(self.model.first_masses[axis])

    def last_dof(self, axis: int) -> int:
        """Degree of freedom of the chain's last mass."""
        return int(self.model.last_masses[axis])

    def elongations(self, axis: int, spring: int) -> float:
        """RMS of a spring's elongation that the motion of the motor asks for, as of rigid masses."""
        chain = self.model.axes[axis]
        beyond = sum(m.value for m in chain.masses[spring + 1 :])
        size = np.sqrt(np.mean([np.mean(m.acceleration[:, axis] ** 2) for m in self.motions]))
        return max(float(beyond * size / chain.springs[spring].value), 1e-12)


def band_limited(values: FloatArray, step: float, top: float) -> FloatArray:
    """Cut a course (n, ...) at a frequency, Hz, without phase shift."""
    spectrum = np.fft.rfft(values, axis=0)
    frequency = np.fft.rfftfreq(values.shape[0], step)
    edge = np.clip(1.5 - frequency / (2 * top), 0.0, 1.0)
    spectrum *= edge.reshape(-1, *[1] * (values.ndim - 1))
    return np.asarray(np.fft.irfft(spectrum, values.shape[0], axis=0), dtype=np.float64)


Candidates = Sequence[Effect]
