"""From the model to controller parameters."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from fieldtool.design.rule import (
    DesignError,
    lowest_antiresonance,
    rule_with_notches,
    sensitivity_peak,
)
from fieldtool.records.closed_loop import AxisLoop, ClosedLoop
from fieldtool.records.model import AxisModel, MachineModel


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

    def has(axis: str, parameter: str) -> bool:
        return tunable is None or axis not in tunable or parameter in tunable[axis]

    loops = rule_with_notches(model)
    loops = [
        loop if has(axis.name, "filter1_type") else replace(loop, filters=())
        for axis, loop in zip(model.axes, loops, strict=True)
    ]
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
