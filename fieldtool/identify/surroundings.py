"""What one axis' response holds beside its chain: a weak spring to ground, and modes above the band.

    G'(w) = [1 / (1 / G + k) + r / (1 - (w / w3)**2)] exp(-j w d)

with G the chain's response at its motor.  The spring k stands for friction that has not broken away
(bristles, belts, cables, cogging) and shows at the lowest lines; the rest is what a mode at w3, above
the band, adds within it.  Left out, both bias masses and springs by more than noise.  Each is fitted
together with the chain and kept where the motor's side alone asks for it, by Schwarz' criterion.

Source: Ewins, Modal Testing, section 4.5 (residual terms of modes out of range).
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import least_squares

from fieldtool.identify.likelihood.parameters import (
    Parameter,
    machine_parameters,
    parameter_values,
    with_values,
)
from fieldtool.identify.likelihood.refine import RefinedModel, machine_response
from fieldtool.identify.likelihood.response_data import ResponseMatrix
from fieldtool.records.model import Estimate, FloatArray, Kind, MachineModel

NEAREST = 0.02
"""Of the highest line: so far above it a mode out of the band lies at least."""
FIRST = 0.3
"""The same, where the search begins."""
LEAST = 1e-3
"""Of its start, that a mass, spring or damper stays above."""
SMALL = 0.03
"""Of the response at the lowest and the highest line: where the search begins."""


@dataclass(frozen=True)
class Surroundings:
    """What was found beside the chain; None where the data do not ask for it."""

    spring: Estimate | None = None
    """To ground, at the motor, N m/rad or N/m."""
    upper_mode: Estimate | None = None
    """Frequency of the mode above the band, Hz, about."""

    def sentences(self, kind: Kind, torque_unit: str) -> tuple[str, ...]:
        """Say what was found, one sentence each."""
        said = []
        if self.spring is not None:
            unit = f"{torque_unit}/{'rad' if kind == 'rotary' else 'm'}"
            said.append(
                f"Beside the chain: a spring to ground of {self.spring.value:.3g} +- "
                f"{1.96 * self.spring.std:.1g} {unit} (friction before it breaks away, cables, cogging)."
            )
        if self.upper_mode is not None:
            said.append(
                f"Beside the chain: a mode above the band, at about {self.upper_mode.value:.3g} Hz."
            )
        return tuple(said)


def with_surroundings(
    start: RefinedModel, data: ResponseMatrix
) -> tuple[RefinedModel, Surroundings]:
    """Fit chain and surroundings together, and return the chain with as much of them as is needed.

    Parameters
    ----------
    start
        The chain as fitted alone.
    data
        Response of one axis.

    Returns
    -------
    fitted, surroundings
        Covariance and chi2 are those of the fit with the surroundings that were kept.
    """
    choices = [
        _Joint(start, data, spring, upper).fitted()
        for spring in (False, True)
        for upper in (False, True)
    ]
    excess = max(1.0, min(c.refined.chi2 / c.refined.degrees_of_freedom for c in choices))
    price = np.log(2.0 * data.omega.size)
    best = min(choices, key=lambda c: c.refined.chi2 / excess + price * c.more)
    return best.refined, best.surroundings


@dataclass(frozen=True, eq=False)
class _Choice:
    refined: RefinedModel
    surroundings: Surroundings
    more: int
    """Parameters beside those of the chain."""


class _Joint:
    """The fit of a chain with some surroundings; all parameters scaled to about 1."""

    def __init__(
        self, start: RefinedModel, data: ResponseMatrix, spring: bool, upper: bool
    ) -> None:
        self._start, self._data = start, data
        self._spring, self._upper = spring, upper
        self._listed = machine_parameters(start.model, data.omega)
        self._free = [k for k, p in enumerate(self._listed) if p.name in set(start.names)]
        self._begin = parameter_values(start.model, self._listed, start.delay_values.tolist())
        self._scale = np.array(
            [_scale(p, v) for p, v in zip(self._listed, self._begin, strict=True)]
        )
        size = np.abs(data.response[:, 0, 0])
        self._stiffness = SMALL / float(size[0])
        self._compliance = SMALL * float(size[-1])

    def fitted(self) -> _Choice:
        """Return the most likely one."""
        first = self._begin[self._free] / self._scale[self._free]
        first = np.concatenate(
            [first, [0.0] if self._spring else [], [0.0, np.log(FIRST)] if self._upper else []]
        )
        least = np.full(first.size, -np.inf)
        least[: len(self._free)] = [
            LEAST if self._listed[k].logarithmic else -np.inf for k in self._free
        ]
        found = least_squares(self._residuals, first, x_scale="jac", bounds=(least, np.inf))
        chi2, freedom = 2.0 * float(found.cost), max(1, found.fun.size - first.size)
        wide = max(1.0, chi2 / freedom)
        slope: FloatArray = np.asarray(found.jac, dtype=np.float64)
        covariance = (np.linalg.pinv(slope.T @ slope) * wide).astype(np.float64)
        return self._choice(found.x, covariance, chi2, freedom)

    def _residuals(self, x: FloatArray) -> FloatArray:
        model, delays, spring, compliance, upper = self._parts(x)
        omega = self._data.omega
        delayed = np.exp(-1j * omega * delays[0])
        alone = machine_response(model, omega)[:, 0, 0]
        response = alone / (1.0 + spring * alone) + compliance / (1.0 - (omega / upper) ** 2)
        error = response * delayed - self._data.response[:, 0, 0]
        white = error * np.sqrt(2.0) / self._data.std[:, 0, 0]
        return np.concatenate([white.real, white.imag])

    def _parts(self, x: FloatArray) -> tuple[MachineModel, FloatArray, float, float, float]:
        count = len(self._free)
        values = self._begin.copy()
        values[self._free] = x[:count] * self._scale[self._free]
        model, delays = with_values(self._start.model, self._listed, values)
        rest = list(x[count:])
        spring = float(rest.pop(0)) * self._stiffness if self._spring else 0.0
        compliance = float(rest[0]) * self._compliance if self._upper else 0.0
        above = NEAREST + float(np.exp(np.clip(rest[1], -20.0, 20.0))) if self._upper else 1.0
        return model, delays, spring, compliance, float(self._data.omega[-1]) * (1.0 + above)

    def _choice(self, x: FloatArray, covariance: FloatArray, chi2: float, freedom: int) -> _Choice:
        count, std = len(self._free), np.sqrt(np.maximum(np.diag(covariance), 0.0))
        scale = self._scale[self._free]
        values, errors = self._begin.copy(), np.zeros(self._begin.size)
        values[self._free], errors[self._free] = x[:count] * scale, std[:count] * scale
        model, _ = with_values(self._start.model, self._listed, values, errors)
        delays = tuple(
            Estimate(float(values[k]), float(errors[k]))
            for k, p in enumerate(self._listed)
            if p.kind == "delay"
        )
        refined = replace(
            self._start,
            model=model,
            delays=delays,
            names=tuple(self._listed[k].name for k in self._free),
            values=values[self._free],
            covariance=covariance[:count, :count] * np.outer(scale, scale),
            chi2=chi2,
            degrees_of_freedom=freedom,
        )
        return _Choice(refined, self._surroundings(x, std), x.size - count)

    def _surroundings(self, x: FloatArray, std: FloatArray) -> Surroundings:
        _, _, spring, _, upper = self._parts(x)
        place = len(self._free)
        held = Estimate(spring, float(std[place]) * self._stiffness) if self._spring else None
        mode = None
        if self._upper:
            slope = upper - float(self._data.omega[-1]) * (1.0 + NEAREST)
            mode = Estimate(upper / (2 * np.pi), float(std[-1]) * slope / (2 * np.pi))
        return Surroundings(held, mode)


def _scale(p: Parameter, value: float) -> float:
    return abs(value) if p.logarithmic and value else p.scale
