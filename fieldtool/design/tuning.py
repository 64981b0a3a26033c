"""From the model to controller parameters, by a documented rule.

For each axis, with J the sum of its chain's masses and w_a the lowest antiresonance (its chain's
lowest mode with the motor held; infinite for a rigid axis)::

    w_v = 0.7 w_a            bandwidth that is aimed at, at most RIGID_BANDWIDTH
    velocity_p = J w_v       velocity_i = velocity_p w_v / 4        position_p = w_v / 4
    velocity_ff = 1          inertia_ff = J
    filter 1: notch at the dominating resonance, where the margin below allows it

The whole machine is then closed with these loops, couplings included.  Where the sensitivity's peak
of an axis is above 2 (6 dB), that axis' gains are lowered until it is not.  Source of the first
three lines: pole placement of the cascade on a rigid inertia (symmetrical ratio 4), with the
bandwidth kept below the lowest antiresonance, where motor and load still move together.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import eigh

from fieldtool.errors import FieldtoolError
from fieldtool.records.closed_loop import AxisLoop, Biquad, ClosedLoop
from fieldtool.records.model import AxisModel, FloatArray, MachineModel

BANDWIDTH_SHARE = 0.7
RIGID_BANDWIDTH = 2 * np.pi * 8.0
"""rad/s, for an axis without a spring or with a stiff one: the bandwidth that is aimed at, at most."""
RATIO = 4.0
SENSITIVITY_BOUND = 2.0
LOWERED = 0.85
MAX_STEPS = 25
NOTCH_ZERO_DAMPING, NOTCH_POLE_DAMPING = 0.1, 0.5
GRID = 500


class DesignError(FieldtoolError):
    """No parameters were found that keep the machine stable with the margin wanted."""


@dataclass(frozen=True)
class AxisTuning:
    """New parameters of one axis, by the names of drive profiles, physical units."""

    axis: str
    parameters: Mapping[str, float]
    sensitivity_peak: float
    """Of this axis' loop with all others closed, by the model."""
    reason: str
    """One sentence: how the numbers came about."""


@dataclass(frozen=True)
class Tuning:
    """New parameters of all axes."""

    axes: tuple[AxisTuning, ...]


def design(model: MachineModel, tunable: Mapping[str, frozenset[str]] | None = None) -> Tuning:
    """Return parameters for every axis of an identified machine.

    Parameters
    ----------
    model
        The machine.
    tunable
        Names of the parameters that each axis' drive has; an axis that is not named has all.  A
        notch is designed only where there is a filter for it.

    Raises
    ------
    DesignError
        If the model is no machine, the loops are not stable, or the margin can not be kept.
    """
    _check_masses(model)

    def has(axis: str, parameter: str) -> bool:
        return tunable is None or axis not in tunable or parameter in tunable[axis]

    loops = [_rule(axis) for axis in model.axes]
    loops = _within_bound(model, loops)
    for k, axis in enumerate(model.axes):
        if has(axis.name, "filter1_type"):
            loops = _with_notch(model, loops, k)
    closed = ClosedLoop(model, tuple(loops))
    if not closed.stable:
        raise DesignError(
            "the machine is not stable with the designed parameters; nothing is written. Check the "
            "model: are all masses and springs plausible?"
        )
    return Tuning(
        tuple(
            AxisTuning(
                axis.name,
                {n: v for n, v in as_parameters(loop).items() if has(axis.name, n)},
                sensitivity_peak(model, loops, k),
                _reason(axis, loop),
            )
            for k, (axis, loop) in enumerate(zip(model.axes, loops, strict=True))
        )
    )


def sensitivity_peak(model: MachineModel, loops: list[AxisLoop], axis: int) -> float:
    """Return max |1 / (1 + L)| of one axis with all other loops closed.

    The grid has GRID points from a hundredth of the lowest to ten times the highest mode, and more
    at every mode.
    """
    omega = _grid(model)
    compliance = ClosedLoop(model, tuple(loops)).compliance(omega, axis)
    gain = np.array([loops[axis].gain(1j * w) for w in omega])
    return float(np.max(1 / np.abs(1 + gain * compliance)))


def lowest_antiresonance(axis: AxisModel) -> float:
    """Return the lowest mode of a chain whose motor is held, rad/s; infinity for a rigid axis."""
    if not axis.springs:
        return float("inf")
    single = MachineModel((axis,))
    values = eigh(single.stiffness_matrix[1:, 1:], single.mass_matrix[1:, 1:], eigvals_only=True)
    return float(np.sqrt(values[0]))


def as_parameters(loop: AxisLoop) -> dict[str, float]:
    """Return a loop as parameters by name; filter 2 is switched off."""
    parameters = {
        "position_p": loop.position_p,
        "velocity_p": loop.velocity_p,
        "velocity_i": loop.velocity_i,
        "velocity_ff": loop.velocity_ff,
        "inertia_ff": loop.inertia_ff,
        "filter1_type": 0.0,
        "filter2_type": 0.0,
    }
    if loop.filters:
        (n2, n1, n0), (d1, d0) = loop.filters[0].numerator, loop.filters[0].denominator
        w = float(np.sqrt(n0 / n2))
        parameters |= {
            "filter1_type": 1.0,
            "filter1_frequency": w / (2 * np.pi),
            "filter1_zero_damping": n1 / (2 * w * n2),
            "filter1_pole_damping": d1 / (2 * float(np.sqrt(d0))),
        }
    return parameters


def _check_masses(model: MachineModel) -> None:
    smallest = float(np.linalg.eigvalsh(model.mass_matrix)[0])
    if smallest <= 0:
        raise DesignError(
            f"the model's mass matrix is not positive definite (smallest eigenvalue {smallest:.3g}); "
            "nothing is written. Check the model: a mass is not positive, or a coupling is larger than "
            "the last masses that it joins allow."
        )


def _rule(axis: AxisModel) -> AxisLoop:
    w = min(BANDWIDTH_SHARE * lowest_antiresonance(axis), RIGID_BANDWIDTH)
    total = axis.total_mass
    return AxisLoop(w / RATIO, total * w, total * w * w / RATIO, 1.0, total)


def _within_bound(model: MachineModel, loops: list[AxisLoop]) -> list[AxisLoop]:
    for _ in range(MAX_STEPS):
        peaks = [sensitivity_peak(model, loops, k) for k in range(len(loops))]
        stable = ClosedLoop(model, tuple(loops)).stable
        if stable and max(peaks) <= SENSITIVITY_BOUND:
            return loops
        loops = [
            _slower(loop) if peak > SENSITIVITY_BOUND or not stable else loop
            for loop, peak in zip(loops, peaks, strict=True)
        ]
    raise DesignError(
        f"no gains keep the peak of sensitivity below {SENSITIVITY_BOUND:g} on every axis; nothing is "
        "written. Check the model's dampers and couplings."
    )


def _slower(loop: AxisLoop) -> AxisLoop:
    return replace(
        loop,
        position_p=loop.position_p * LOWERED,
        velocity_p=loop.velocity_p * LOWERED,
        velocity_i=loop.velocity_i * LOWERED**2,
    )


def _with_notch(model: MachineModel, loops: list[AxisLoop], k: int) -> list[AxisLoop]:
    """Put a notch at the resonance that dominates the axis' response, if the margin allows it."""
    resonance = _dominating_resonance(model, k)
    if resonance is None:
        return loops
    notch = Biquad.notch(resonance / (2 * np.pi), NOTCH_ZERO_DAMPING, NOTCH_POLE_DAMPING)
    tried = list(loops)
    tried[k] = replace(loops[k], filters=(notch,))
    if not ClosedLoop(model, tuple(tried)).stable:
        return loops
    peaks = [sensitivity_peak(model, tried, i) for i in range(len(loops))]
    return tried if max(peaks) <= SENSITIVITY_BOUND else loops


def _dominating_resonance(model: MachineModel, k: int) -> float | None:
    """Return the resonance with the largest share in the axis' response to torque, rad/s."""
    values, shapes = eigh(model.stiffness_matrix, model.mass_matrix)
    motor = model.first_masses[k]
    elastic = values > 1e-9 * max(float(values[-1]), 1e-300)
    if not elastic.any():
        return None
    share = np.where(elastic, shapes[motor] ** 2, 0.0)
    if share.max() < 1e-12 * np.sum(shapes[motor] ** 2):
        return None  # a rigid axis, not coupled: the machine's resonances are not its own
    return float(np.sqrt(values[int(np.argmax(share))]))


def _grid(model: MachineModel) -> FloatArray:
    values = eigh(model.stiffness_matrix, model.mass_matrix, eigvals_only=True)
    modes = np.sqrt(values[values > 1e-9 * max(float(values[-1]), 1e-300)])
    if modes.size == 0:
        modes = np.array([RIGID_BANDWIDTH])
    beside = np.concatenate([modes * (1 + d) for d in np.linspace(-0.03, 0.03, 25)])
    every = np.concatenate([np.geomspace(modes[0] / 100, 10 * modes[-1], GRID), beside])
    grid: FloatArray = np.sort(every)
    return grid


def _reason(axis: AxisModel, loop: AxisLoop) -> str:
    lowest = lowest_antiresonance(axis)
    aim = (
        f"lowest antiresonance {lowest / (2 * np.pi):.3g} Hz"
        if np.isfinite(lowest)
        else "a rigid axis"
    )
    bandwidth = loop.velocity_p / axis.total_mass
    notch = (
        "a notch at the dominating resonance"
        if loop.filters
        else "no notch (the margin does not allow it)"
    )
    return (
        f"total inertia {axis.total_mass:.4g}, {aim}: velocity bandwidth "
        f"{bandwidth / (2 * np.pi):.3g} Hz, {notch}."
    )
