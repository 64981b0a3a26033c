"""Input shaping and jerk: what whatever makes the references can do against vibration that is left.

A shaper splits every command into a few impulses whose vibrations cancel.  Shapers: ZV and ZVD
(Singer and Seering, J. Dyn. Sys. Meas. Control 112, 1990), EI (Singhose, Seering, Singer 1994) and MZV,
a ZV of three impulses over three quarters of a period.
"""

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from fieldtool.records.model import FloatArray

TOLERANCE = 0.05
"""Of the vibration without a shaper: what EI leaves at the frequency itself, and what is good enough."""
NAMES = ("ZV", "MZV", "ZVD", "EI")
"""From the shortest on."""


@dataclass(frozen=True)
class Shaping:
    """Advice for the references of one axis."""

    axis: str
    frequency: float
    """Of the vibration that is left with the designed loops, Hz."""
    damping: float
    """Its damping ratio."""
    shaper: str
    """One of NAMES."""
    amplitudes: tuple[float, ...]
    """Of the impulses; their sum is 1."""
    times: tuple[float, ...]
    """s."""
    left: float
    """Vibration that is left, over that without a shaper, at the worst of the frequencies that the
    machine may have."""
    jerk: float
    """Alternative: a jerk of the typical move's acceleration over one period of the vibration, which
    leaves little of it, rad/s3 or m/s3."""
    unit: str = "rad"
    """Of positions of the axis."""

    def as_dict(self) -> dict[str, Any]:
        """Plain values."""
        return {**asdict(self), "amplitudes": list(self.amplitudes), "times": list(self.times)}

    @property
    def sentence(self) -> str:
        """The advice, for a person."""
        pairs = ", ".join(
            f"{a:.3f} at {1000 * t:.1f} ms"
            for a, t in zip(self.amplitudes, self.times, strict=True)
        )
        return (
            f"{self.axis}: {self.frequency:.3g} Hz is left to swing (damping ratio {self.damping:.2g}); "
            f"where moves are to end without it, shape the references with {self.shaper} ({pairs}), or "
            f"keep the jerk below {self.jerk:.3g} {self.unit}/s3."
        )


def impulses(name: str, frequency: float, damping: float) -> tuple[FloatArray, FloatArray]:
    """Return amplitudes (their sum is 1) and times (s) of a shaper for one vibration.

    Parameters
    ----------
    name
        One of NAMES.
    frequency, damping
        Undamped frequency in Hz and damping ratio, below 1.
    """
    root = np.sqrt(1 - damping**2)
    period = 1 / (frequency * root)
    k = np.exp(-damping * np.pi / root)
    if name == "ZV":
        a, t = np.array([1.0, k]), np.array([0.0, 0.5])
    elif name == "ZVD":
        a, t = np.array([1.0, 2 * k, k * k]), np.array([0.0, 0.5, 1.0])
    elif name == "EI":
        a = np.array(
            [0.25 * (1 + TOLERANCE), 0.5 * (1 - TOLERANCE) * k, 0.25 * (1 + TOLERANCE) * k * k]
        )
        t = np.array([0.0, 0.5, 1.0])
    elif name == "MZV":
        # three impulses three eighths of a period apart, whose vectors form a closed triangle
        k = np.exp(-0.75 * damping * np.pi / root)
        outer = 1 - 1 / np.sqrt(2)
        a, t = np.array([outer, (np.sqrt(2) - 1) * k, outer * k * k]), np.array([0.0, 0.375, 0.75])
    else:
        raise ValueError(f"no shaper {name!r}; there are {', '.join(NAMES)}")
    return a / a.sum(), t * period


def vibration_left(
    amplitudes: FloatArray, times: FloatArray, frequency: float, damping: float
) -> float:
    """Return the vibration after a shaper's last impulse, over that of one impulse at its time.

    Singer and Seering 1990, equation 8.
    """
    w = 2 * np.pi * frequency
    grown = amplitudes * np.exp(-damping * w * (times[-1] - times))
    phase = w * np.sqrt(1 - damping**2) * times
    return float(np.hypot((grown * np.cos(phase)).sum(), (grown * np.sin(phase)).sum()))


def best_shaper(
    axis: str, frequencies: FloatArray, damping: float, acceleration: float, unit: str = "rad"
) -> Shaping:
    """Return the shortest shaper that leaves little vibration at all of some frequencies.

    Parameters
    ----------
    axis
        Name.
    frequencies
        Hz, that the vibration may have; the first is the likeliest.
    damping
        Damping ratio.
    acceleration
        Of the axis' typical move.
    unit
        Of positions of the axis: rad or m.
    """
    frequency = float(frequencies[0])
    tried = []
    for name in NAMES:
        a, t = impulses(name, frequency, damping)
        left = max(vibration_left(a, t, float(f), damping) for f in frequencies)
        tried.append(
            Shaping(axis, frequency, damping, name, tuple(a.tolist()), tuple(t.tolist()), left,
                    acceleration * frequency, unit)
        )  # fmt: skip
    good = [one for one in tried if one.left <= TOLERANCE * 1.01]
    return good[0] if good else min(tried, key=lambda one: one.left)
