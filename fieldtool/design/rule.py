"""A documented rule from the model to gains: where the search for better ones begins.

For each axis, with J the sum of its chain's masses and w_a the lowest antiresonance (its chain's
lowest mode with the motor held; infinite for a rigid axis)::

    w_v = 0.7 w_a            bandwidth that is aimed at, at most RIGID_BANDWIDTH
    velocity_p = J w_v       velocity_i = velocity_p w_v / 4        position_p = w_v / 4
    velocity_ff = 1          inertia_ff = J

The whole machine is then closed with these loops, couplings included.  Where the sensitivity's peak
of an axis is above 2 (6 dB), that axis' gains are lowered until it is not.  Source of the first
three lines: pole placement of the cascade on a rigid inertia (symmetrical ratio 4), with the
bandwidth kept below the lowest antiresonance, where motor and load still move together.
"""

from dataclasses import replace

import numpy as np
from scipy.linalg import eigh

from fieldtool.errors import FieldtoolError
from fieldtool.records.closed_loop import AxisLoop, ClosedLoop
from fieldtool.records.model import AxisModel, FloatArray, MachineModel

BANDWIDTH_SHARE = 0.7
RIGID_BANDWIDTH = 2 * np.pi * 8.0
"""rad/s, for an axis without a spring or with a stiff one: the bandwidth that is aimed at, at most."""
RATIO = 4.0
SENSITIVITY_BOUND = 2.0
LOWERED = 0.85
MAX_STEPS = 25
GRID = 500


class DesignError(FieldtoolError):
    """No parameters were found that keep the machine stable with the margin wanted."""


def rule(model: MachineModel) -> list[AxisLoop]:
    """Return the rule's loops, one an axis, lowered until the margin is kept.

    Raises
    ------
    DesignError
        If the model is no machine, or no gains keep the margin.
    """
    check_masses(model)
    return _within_bound(model, [_rule(axis) for axis in model.axes])


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


def check_masses(model: MachineModel) -> None:
    """Refuse a model whose mass matrix is none of a machine."""
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


def _grid(model: MachineModel) -> FloatArray:
    values = eigh(model.stiffness_matrix, model.mass_matrix, eigvals_only=True)
    modes = np.sqrt(values[values > 1e-9 * max(float(values[-1]), 1e-300)])
    if modes.size == 0:
        modes = np.array([RIGID_BANDWIDTH])
    beside = np.concatenate([modes * (1 + d) for d in np.linspace(-0.03, 0.03, 25)])
    every = np.concatenate([np.geomspace(modes[0] / 100, 10 * modes[-1], GRID), beside])
    grid: FloatArray = np.sort(every)
    return grid
