"""A plan is a value: what will be moved, how far, and how long it takes.

A *tone* is a sine of the driven axis' position reference; a *sweep* is a row of tones with the
same axes floating; a *plan* is a row of sweeps.  Nothing here knows a drive.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np

from fieldtool.records.model import FloatArray

BLOCK_CYCLES = 250
"""So many cycles let the frequency of a block come within 0.2 % of what was wanted."""

SweepKind = Literal["direct, others free", "direct, others locked", "cross-coupled"]


@dataclass(frozen=True)
class Tone:
    """One sine of the position reference, with a whole number of periods a block."""

    periods: int
    """Whole periods in a block."""
    samples: int
    """Cycles in a block."""
    cycle_time: float
    """Seconds."""
    amplitude: float
    """rad or m."""

    @property
    def frequency(self) -> float:
        """Hz."""
        return self.periods / self.block_time

    @property
    def block_time(self) -> float:
        """Seconds."""
        return self.samples * self.cycle_time


@dataclass(frozen=True)
class Sweep:
    """Tones of one axis, one after the other, while the others float or hold their position."""

    kind: SweepKind
    driven: str
    free: tuple[str, ...]
    tones: tuple[Tone, ...]
    label: str = ""
    """Tells sweeps of one kind apart, such as those of a second pass."""
    blocks: int = 3
    """Settled blocks to be recorded at each tone."""
    settle_blocks: int = 30
    """Blocks after which a tone that has not settled is recorded as it is, and marked."""

    @property
    def name(self) -> str:
        """Short name, unique among the sweeps of a session."""
        floating = f" ({' '.join(self.free)})" if self.kind == "cross-coupled" else ""
        label = f", {self.label}" if self.label else ""
        return f"{self.driven} {self.kind}{floating}{label}"


@dataclass(frozen=True)
class SweepPlan:
    """All sweeps, and the cycle time of the bus."""

    cycle_time: float
    sweeps: tuple[Sweep, ...]
    notes: tuple[str, ...] = ()
    """Choices that a person should see, one sentence each."""

    @property
    def tones(self) -> int:
        """Number of tones in all sweeps."""
        return sum(len(sweep.tones) for sweep in self.sweeps)

    def expected_duration(self, settle_time: float) -> float:
        """Return seconds of excitation, if each tone takes so long to settle."""
        return sum(
            settle_time + (sweep.blocks + 1) * tone.block_time
            for sweep in self.sweeps
            for tone in sweep.tones
        )


def tone_near(frequency: float, amplitude: float, cycle_time: float) -> Tone:
    """Return the tone next to a frequency whose block has whole periods and whole cycles.

    Parameters
    ----------
    frequency
        Hz; must stay below a quarter of the sampling rate.
    amplitude
        rad or m.
    cycle_time
        Seconds.  A block has at least BLOCK_CYCLES cycles and one period.

    Raises
    ------
    ValueError
        If the frequency is not positive or too high for the cycle.
    """
    if not 0 < frequency <= 0.25 / cycle_time:
        raise ValueError(
            f"frequency {frequency:g} Hz must be positive and at most a quarter of the sampling "
            f"rate, {0.25 / cycle_time:g} Hz"
        )
    periods = max(1, int(np.ceil(BLOCK_CYCLES * cycle_time * frequency)))
    samples = round(periods / (frequency * cycle_time))
    return Tone(periods, samples, cycle_time, amplitude)


def tone_blocks(tone: Tone, before: Tone | None) -> Iterator[FloatArray]:
    """Yield the reference's blocks for ever: first the way from the tone before, then whole blocks.

    Frequency and amplitude go smoothly from one tone to the next, and the phase is continuous, so
    that the transients stay small.  Every block after the first starts at phase zero.

    Yields
    ------
    ndarray
        Displacements of the driven axis, shape (n,), rad or m.
    """
    yield transition(tone, before)
    phase = 2 * np.pi * tone.frequency * tone.cycle_time * np.arange(tone.samples)
    block = tone.amplitude * np.sin(phase)
    while True:
        yield block


def transition(tone: Tone | None, before: Tone | None) -> FloatArray:
    """Return the way from one tone (None: from rest) to the next (None: to rest), shape (n,).

    It starts where a block of the tone before ends, and ends where a block of the next one begins:
    at phase zero, and with the velocity of that block.

    Raises
    ------
    ValueError
        If both are None.
    """
    known = tone or before
    if known is None:
        raise ValueError("a transition needs a tone on one side at least")
    a, b = before or known, tone or known
    mean = (a.frequency + b.frequency) / 2
    whole = max(1, round(1.5 * mean * max(1 / a.frequency, 1 / b.frequency, 0.25)))
    n = max(2, round(whole / mean / known.cycle_time))
    blend = 0.5 - 0.5 * np.cos(np.pi * np.arange(n) / n)
    frequency = a.frequency + (b.frequency - a.frequency) * blend
    turns = np.concatenate([[0.0], np.cumsum(frequency) * known.cycle_time])
    phase = 2 * np.pi * (turns[:-1] + (whole - turns[-1]) * blend)  # what rounding to cycles left
    low = before.amplitude if before else 0.0
    high = tone.amplitude if tone else 0.0
    displacement: FloatArray = (low + (high - low) * blend) * np.sin(phase)
    return displacement


def smooth_move(
    distance: float, velocity: float, acceleration: float, step: float, shortest: float = 0.0
) -> FloatArray:
    """Return a rest-to-rest move as displacements, shape (n,), ending exactly at ``distance``.

    Minimum-jerk polynomial: peak velocity is 1.875 distance / T, peak acceleration
    5.774 distance / T^2.
    """
    if distance == 0:
        return np.zeros(1)
    size = abs(distance)
    duration = max(
        1.875 * size / velocity, np.sqrt(5.774 * size / acceleration), 4 * step, shortest
    )
    n = int(np.ceil(duration / step))
    u = np.arange(1, n + 1) / n
    move: FloatArray = distance * u**3 * (10 - 15 * u + 6 * u * u)
    return move
