"""Spread the fast plan's inputs so that they tell most of the machine, within its limits."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from fieldtool.experiment.multisine.unit_inputs import Shape, UnitInputs
from fieldtool.identify.best_input import best_powers, weighted_error
from fieldtool.identify.likelihood.expected import Noise, input_information
from fieldtool.records.model import FloatArray

SIMPLE = Shape(-0.5)
SIMPLE_SHARE = 0.15
"""Of the power, spread by a simple rule: no line is left out because the model at hand, which may be
wrong, says that it tells nothing."""


@dataclass(frozen=True, eq=False)
class BestSpread:
    """Least sum over the parameters of expected error over wanted error."""

    noise: Noise
    samples: int
    """That the mean of an experiment's periods rests on."""
    wanted: Mapping[str, float]
    """Relative errors by kind of parameter; other kinds do not count."""

    def __call__(self, inputs: UnitInputs) -> "Best":
        """Return the spreading of some inputs."""
        model, omega = inputs.setting.model, inputs.omega
        told = input_information(model, omega, inputs.torque, self.samples, self.noise)
        weights = [
            abs(step / value) / self.wanted[p.kind] if value and p.kind in self.wanted else 0.0
            for p, value, step in zip(told.parameters, told.values, told.steps, strict=True)
        ]
        experiments = inputs.torque.shape[2]  # each input is in all of them
        return Best(inputs, np.sqrt(experiments) * told.rows, np.array(weights))


@dataclass(frozen=True, eq=False)
class Best:
    """The best spreading of some inputs."""

    inputs: UnitInputs
    rows: FloatArray
    """What a unit of power of each input tells, (L, M, R, P)."""
    weights: FloatArray
    """(P,)."""

    def sizes(self, share: float, crest: FloatArray) -> FloatArray:
        """Return inputs (L, M), peak, that use a share of the limits with crest factors (5, M)."""
        L, M, R, P = self.rows.shape
        power = self.inputs.power.transpose(0, 2, 1, 3) * (crest / share)[:, :, None, None] ** 2
        best = best_powers(
            self.rows.reshape(L * M, R, P), self.weights, power.reshape(5 * M, L * M)
        )
        simple = SIMPLE(self.inputs).sizes(share, crest)
        mixed = (1 - SIMPLE_SHARE) * best.reshape(L, M) + SIMPLE_SHARE * simple**2
        size: FloatArray = np.sqrt(mixed)
        return size

    def loss(self, size: FloatArray) -> float:
        """Return the sum over the parameters of expected error over wanted error."""
        rows = self.rows.reshape(size.size, *self.rows.shape[2:])
        return weighted_error(rows, self.weights, size.ravel() ** 2)
