"""The numbers of a machine's chains as a vector that can be fitted, and back."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fieldtool.records.model import Estimate, MachineModel

FloatArray = NDArray[np.float64]
LIGHT = 0.01
"""Damping ratio that scales a damper whose value is zero."""
OFFSET = 0.001
"""Of the largest torque: standard error of the zero of a torque measurement.  Drives null their current
sensors when they are switched on; thrice as much is seldom and told."""
KNOWN = 1.0
"""Relative standard error of what is known of each other number beforehand: its size."""
SMALLEST = 0.05
"""Of its start value: no mass and no spring becomes smaller in a fit."""


@dataclass(frozen=True)
class Variable:
    """One number of the model: where it stands, and its size."""

    name: str
    """``axis.mass1``, ``axis.spring1``, ``axis.damper1``, ``axis.viscous_friction``,
    ``a+b.coupling``, ``axis.offset``."""
    value: float
    scale: float
    """Its own size, or of what would matter where it is zero."""
    known: float
    """Standard error with which it is known beforehand, over ``scale``."""
    positive: bool
    """Masses and springs are above zero; friction and dampers may come out at zero or, in
    a fit, below."""


@dataclass(frozen=True)
class Machine:
    """A model and the numbers of it that are fitted."""

    model: MachineModel
    variables: tuple[Variable, ...]

    @classmethod
    def of(cls, model: MachineModel, largest_torque: FloatArray) -> "Machine":
        """List masses, springs, dampers, couplings, the frictions that the model has, and offsets.

        Parameters
        ----------
        model : MachineModel
        largest_torque : ndarray
            (M,): largest torque of each axis, which an offset is a part of.
        """
        out: list[Variable] = []
        for axis in model.axes:
            for kind, values in (("mass", axis.masses), ("spring", axis.springs)):
                out += [
                    Variable(
                        f"{axis.name}.{kind}{k + 1}", e.value, abs(e.value), KNOWN, positive=True
                    )
                    for k, e in enumerate(values)
                ]
            for k, e in enumerate(axis.dampers or (Estimate(0.0),) * len(axis.springs)):
                light = 2 * LIGHT * np.sqrt(axis.springs[k].value * axis.masses[k + 1].value)
                size = max(abs(e.value), float(light))
                out.append(
                    Variable(f"{axis.name}.damper{k + 1}", e.value, size, KNOWN, positive=False)
                )
            for name in ("viscous_friction", "load_friction"):
                value = getattr(axis, name).value
                if value != 0.0:
                    out.append(
                        Variable(f"{axis.name}.{name}", value, abs(value), KNOWN, positive=False)
                    )
        for c in model.couplings:
            ends = [model.axes[model.names.index(name)].masses[-1].value for name in c.axes]
            size = max(abs(c.value), 0.1 * float(np.sqrt(ends[0] * ends[1])))
            out.append(
                Variable(f"{'+'.join(c.axes)}.coupling", c.value, size, KNOWN, positive=False)
            )
        for name, largest in zip(model.names, largest_torque, strict=True):
            size = max(float(largest), 1e-12)
            out.append(Variable(f"{name}.offset", 0.0, size, OFFSET, positive=False))
        return cls(model, tuple(out))

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the variables in order."""
        return tuple(v.name for v in self.variables)

    @property
    def start(self) -> FloatArray:
        """Values in order."""
        return np.array([v.value for v in self.variables])

    @property
    def scales(self) -> FloatArray:
        """Sizes in order."""
        return np.array([v.scale for v in self.variables])

    def clipped(self, values: FloatArray) -> FloatArray:
        """Keep masses and springs above zero."""
        least = np.array([SMALLEST * v.value if v.positive else -np.inf for v in self.variables])
        return np.asarray(np.maximum(values, least), dtype=np.float64)

    def with_values(self, values: FloatArray, std: FloatArray | None = None) -> MachineModel:
        """Return the model with other values, and standard errors where they are known."""
        errors = np.full(values.size, np.nan) if std is None else std
        known = {
            name: Estimate(float(value), float(error))
            for name, value, error in zip(self.names, values, errors, strict=True)
        }
        axes = []
        for axis in self.model.axes:
            n = len(axis.springs)

            def get(what: str, old: Estimate, name: str = axis.name) -> Estimate:
                return known.get(f"{name}.{what}", old)

            axes.append(
                replace(
                    axis,
                    masses=tuple(get(f"mass{k + 1}", m) for k, m in enumerate(axis.masses)),
                    springs=tuple(get(f"spring{k + 1}", s) for k, s in enumerate(axis.springs)),
                    dampers=tuple(get(f"damper{k + 1}", Estimate(0.0)) for k in range(n)),
                    viscous_friction=get("viscous_friction", axis.viscous_friction),
                    load_friction=get("load_friction", axis.load_friction),
                )
            )
        couplings = tuple(
            replace(c, value=e.value, std=e.std)
            for c in self.model.couplings
            for e in [known[f"{'+'.join(c.axes)}.coupling"]]
        )
        return replace(self.model, axes=tuple(axes), couplings=couplings, effects=())

    def offsets(self, values: FloatArray) -> FloatArray:
        """Return the constant that each torque measurement is off, (M,)."""
        return np.asarray(values[-len(self.model.axes) :], dtype=np.float64)

    def physical(self, values: FloatArray) -> bool:
        """Whether the mass matrix has positive energy."""
        try:
            matrix = self.with_values(values).mass_matrix
        except ValueError:
            return False
        return bool(np.linalg.eigvalsh(matrix)[0] > 0.0)
