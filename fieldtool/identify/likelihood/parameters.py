"""The parameters of a machine as one named list, and back."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import nan
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from fieldtool.records.model import AxisModel, Estimate, MachineModel

FloatArray = NDArray[np.float64]
ParameterKind = Literal[
    "mass", "spring", "damper", "viscous_friction", "load_friction", "delay", "coupling"
]


@dataclass(frozen=True)
class Parameter:
    """One number of a machine."""

    name: str
    """``x.mass[1]``, ``x.spring[1]``, ``x.damper[1]`` (motor side first), ``x.viscous_friction``,
    ``x.load_friction``, ``x.delay``, ``coupling[x,y]``."""
    kind: ParameterKind
    dofs: tuple[int, ...]
    """Degrees of freedom it acts on; the axis' number for a delay."""
    axis: int
    """Number of the axis; of the coupling for couplings."""
    index: int
    """Position in its chain."""
    scale: float
    """SI unit of a change that matters, for what is not fitted by its logarithm."""

    @property
    def logarithmic(self) -> bool:
        """Whether it is positive, and fitted by its logarithm."""
        return self.kind in ("mass", "spring", "damper")


def machine_parameters(model: MachineModel, omega: FloatArray) -> tuple[Parameter, ...]:
    """List all parameters of a machine, axis after axis, then couplings.

    Parameters
    ----------
    model : MachineModel
    omega : array, shape (F,)
        Measured frequencies, rad/s; they set the scales of friction and delay.
    """
    listed: list[Parameter] = []
    for i, (axis, first) in enumerate(zip(model.axes, model.first_masses, strict=True)):
        a = int(first)
        pair = [(a + k, a + k + 1) for k in range(len(axis.springs))]
        listed += [
            Parameter(f"{axis.name}.mass[{k + 1}]", "mass", (a + k,), i, k, 1.0)
            for k in range(len(axis.masses))
        ]
        listed += [
            Parameter(f"{axis.name}.spring[{k + 1}]", "spring", d, i, k, 1.0)
            for k, d in enumerate(pair)
        ]
        if axis.dampers:
            listed += [
                Parameter(f"{axis.name}.damper[{k + 1}]", "damper", d, i, k, 1.0)
                for k, d in enumerate(pair)
            ]
        friction = axis.total_mass * float(omega.min())
        name = f"{axis.name}.viscous_friction"
        listed.append(Parameter(name, "viscous_friction", (a,), i, 0, friction))
        if len(axis.masses) > 1:  # of a rigid axis both frictions are one
            end = (a + len(axis.masses) - 1,)
            listed.append(
                Parameter(f"{axis.name}.load_friction", "load_friction", end, i, 0, friction)
            )
        listed.append(
            Parameter(f"{axis.name}.delay", "delay", (i,), i, 0, 1.0 / float(omega.max()))
        )
    ends = dict(zip(model.names, model.last_masses, strict=True))
    for c, coupling in enumerate(model.couplings):
        one, other = (int(ends[name]) for name in coupling.axes)
        masses = model.mass_matrix[[one, other], [one, other]]
        scale = float(np.sqrt(np.prod(masses)))
        name = f"coupling[{coupling.axes[0]},{coupling.axes[1]}]"
        listed.append(Parameter(name, "coupling", (one, other), c, 0, scale))
    return tuple(listed)


def parameter_values(
    model: MachineModel, parameters: Sequence[Parameter], delays: Sequence[float]
) -> FloatArray:
    """Values in the order of the list, SI, shape (P,).

    Raises
    ------
    ValueError
        If there is not one delay per axis.
    """
    if len(delays) != len(model.axes):
        raise ValueError(f"{len(model.axes)} axes need as many delays, got {len(delays)}")
    return np.array([_value(model, p, delays) for p in parameters], dtype=float)


def _value(model: MachineModel, p: Parameter, delays: Sequence[float]) -> float:
    if p.kind == "coupling":
        return model.couplings[p.axis].value
    if p.kind == "delay":
        return delays[p.axis]
    axis = model.axes[p.axis]
    if p.kind == "viscous_friction":
        return axis.viscous_friction.value
    if p.kind == "load_friction":
        return axis.load_friction.value
    chain = {"mass": axis.masses, "spring": axis.springs, "damper": axis.dampers}
    return chain[p.kind][p.index].value


def with_values(
    model: MachineModel,
    parameters: Sequence[Parameter],
    values: FloatArray,
    std: FloatArray | None = None,
) -> tuple[MachineModel, FloatArray]:
    """Put values into a machine of the same structure; return it and the delays, s, shape (M,)."""
    stds = np.full(values.size, nan) if std is None else std
    estimates = [Estimate(float(v), float(s)) for v, s in zip(values, stds, strict=True)]

    def of(axis: int, kind: ParameterKind) -> tuple[Estimate, ...]:
        return tuple(
            e
            for p, e in zip(parameters, estimates, strict=True)
            if p.axis == axis and p.kind == kind
        )

    axes = tuple(
        AxisModel(
            axis.name,
            axis.kind,
            of(i, "mass"),
            of(i, "spring"),
            of(i, "damper"),
            of(i, "viscous_friction")[0],
            next(iter(of(i, "load_friction")), axis.load_friction),
        )
        for i, axis in enumerate(model.axes)
    )
    couplings = tuple(
        replace(c, value=of(k, "coupling")[0].value, std=of(k, "coupling")[0].std)
        for k, c in enumerate(model.couplings)
    )
    delays = np.array([of(i, "delay")[0].value for i in range(len(axes))])
    return replace(model, axes=axes, couplings=couplings), delays
