"""Score what criticism says against what was hidden: names, axes, and numbers in one language.

The plant and the model have other formulas, so each number of the plant is turned into the one that
the model states.  Where the formulas are no more than alike (a hyperbolic spring and a cubic one), the
truth is what fits the plant's law best over the twists that were in use.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from math import isfinite, pi

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from drives.sim.effects import ChainEffect, MachineEffect
from drives.sim.plant import Plant
from fieldtool.criticise.criticism import Cause, Criticism
from tests.hidden.hiding import Case, Hidden

FloatArray = NDArray[np.float64]
Part = ChainEffect | MachineEffect
CLOSE = 0.1
"""Relative error of a number that is right."""
INTERVAL = 1.96
"""Standard errors of a 95 % interval."""


@dataclass(frozen=True)
class Number:
    """One number of a cause: what it is, what is said, how sure that is."""

    truth: float
    value: float
    std: float

    @property
    def right(self) -> bool:
        """Within 10 %, or inside its 95 % interval."""
        error = abs(self.value - self.truth)
        if error <= CLOSE * abs(self.truth):
            return True
        return bool(isfinite(self.std) and error <= INTERVAL * self.std)


def is_of(hidden: Hidden, effect: str, axis: str | tuple[str, str]) -> bool:
    """Whether a name and an axis are those of what was hidden."""
    axes = (axis,) if isinstance(axis, str) else axis
    if effect != hidden.effect:
        return False
    if len(axes) == 2:
        return True
    return axes[0] == f"axis{hidden.axis + 1}"


def cause_of(hidden: Hidden, criticism: Criticism) -> Cause | None:
    """Return the cause that is what was hidden, if it was found."""
    for cause in criticism.causes:
        if is_of(hidden, cause.effect, cause.axis):
            return cause
    return None


def tie_with(hidden: Hidden, cause: Cause) -> bool:
    """Whether a cause with another name says that the right one explains as much."""
    return any(is_of(hidden, t.effect, t.axis) and t.experiment for t in cause.ties)


def numbers(case: Case, hidden: Hidden, cause: Cause) -> dict[str, Number]:
    """Return the numbers of a cause that have a truth."""
    told = TRUTHS[hidden.effect](hidden.part, case, hidden)
    return {
        name: Number(truth, cause.parameters[name].value, cause.parameters[name].std)
        for name, truth in told.items()
    }


def _cubic(law: Callable[[FloatArray], FloatArray], case: Case, hidden: Hidden) -> float:
    """Cube's share of a law, by least squares over the twists in use, beside a straight line."""
    part = hidden.part
    joint = part.joint  # type: ignore[union-attr]
    twist = twist_in_use(case, hidden.axis, joint)
    nodes, weights = np.polynomial.hermite_e.hermegauss(24)
    s = twist * nodes
    pull = law(s)
    rows = np.sqrt(weights)[:, None] * np.column_stack([s, s**3])
    return float(np.linalg.lstsq(rows, np.sqrt(weights) * pull, rcond=None)[0][1])


def twist_in_use(case: Case, axis: int, joint: int) -> float:
    """RMS twist of a joint in the multisines, rad, as the machine without anything hidden twists."""
    plant = Plant(case.machine.plant)
    sums, rows = 0.0, 0
    first = int(plant.motors[axis]) + joint - 1
    for experiment in case.recording.experiments:
        if experiment.period is None:
            continue
        torque = experiment.torque[-4000:]
        n = torque.shape[0]
        omega = 2 * pi * np.fft.rfftfreq(n, case.recording.sample_period)[8:]
        spectrum = np.fft.rfft(torque, axis=0)[8:] / n
        whole = (
            plant.stiffness_matrix + 1j * omega[:, None, None] * plant.damping_matrix
            - omega[:, None, None] ** 2 * plant.mass_matrix
        )  # fmt: skip
        forces = np.zeros((omega.size, plant.mass_matrix.shape[0], 1), dtype=complex)
        forces[:, plant.motors, 0] = spectrum
        moved = np.linalg.solve(whole, forces)[:, :, 0]
        sums += 2.0 * float(np.sum(np.abs(moved[:, first + 1] - moved[:, first]) ** 2))
        rows += 1
    return float(np.sqrt(sums / max(rows, 1)))


def _spring(case: Case, hidden: Hidden) -> float:
    joint = hidden.part.joint  # type: ignore[union-attr]
    return float(case.machine.plant.chains[hidden.axis].springs[joint - 1])


def _hardening(part: Part, case: Case, hidden: Hidden) -> dict[str, float]:
    k, a = _spring(case, hidden), part.stretch  # type: ignore[union-attr]
    return {"cubic": _cubic(lambda s: k * a * np.sinh(s / a), case, hidden)}


def _softening(part: Part, case: Case, hidden: Hidden) -> dict[str, float]:
    """The softening of the library's law that is nearest to the plant's over the twists in use."""
    k, a = _spring(case, hidden), part.stretch  # type: ignore[union-attr]
    twist = twist_in_use(case, hidden.axis, part.joint)  # type: ignore[union-attr]
    nodes, weights = np.polynomial.hermite_e.hermegauss(24)
    s = twist * nodes

    def off(numbers: FloatArray) -> FloatArray:
        stiffness, cubic = k * numbers[0], -k / (3 * a**2) * numbers[1]
        law = stiffness * s / np.sqrt(1 - 2 * cubic * s**2 / stiffness)
        return np.asarray(np.sqrt(weights) * (law - k * a * np.tanh(s / a)) / (k * twist))

    found = least_squares(off, [1.0, 1.0], bounds=([0.2, 1e-3], [5.0, 100.0])).x
    return {"cubic": float(-k / (3 * a**2) * found[1])}


Truth = Callable[..., Mapping[str, float]]
TRUTHS: Mapping[str, Truth] = {
    "coulomb_friction": lambda p, *_: {"torque": p.torque},
    "stribeck_friction": lambda p, *_: {
        "torque": p.torque, "breakaway": p.breakaway, "velocity": p.velocity
    },
    "asymmetric_friction": lambda p, *_: {
        "coulomb_positive": p.forward, "coulomb_negative": p.backward
    },
    "backlash": lambda p, *_: {"gap": p.play},
    "hardening_spring": _hardening,
    "softening_spring": _softening,
    "structural_damping": lambda p, *_: {"loss_factor": p.loss_factor},
    "stiffness_change": lambda p, *_: {"change": p.factor - 1.0},
    "gravity": lambda p, *_: {"torque": abs(p.torque)},
    "cogging": lambda p, *_: {"amplitude": p.torque, "order": p.periods},
    "periodic_disturbance": lambda p, *_: {"frequency": p.frequency},
    "extra_mode": lambda p, *_: {"mass": p.inertia, "frequency": p.frequency},
    "torque_scale": lambda p, *_: {"scale": p.factor},
    "torque_saturation": lambda p, *_: {"limit": p.torque},
    "torque_lag": lambda p, *_: {"time": p.time},
    "measurement_delay": lambda p, *_: {"delay": round(p.time * 8000) / 8000},
    "encoder_error": lambda p, *_: {"amplitude": p.amplitude, "order": p.periods},
    "coupling_spring": lambda p, *_: {"stiffness": p.spring},
    "coupling_inertia": lambda p, *_: {"inertia": p.inertia},
}  # fmt: skip
"""What the model should state, by effect."""
