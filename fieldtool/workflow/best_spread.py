"""Spread the fast plan's inputs so that they tell most of the machine, within its limits."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from fieldtool.experiment.multisine.unit_inputs import Shape, UnitInputs
from fieldtool.identify.best_input import best_powers
from fieldtool.identify.likelihood.expected import InputInformation, Noise, input_information
from fieldtool.records.model import FloatArray

SIMPLE = Shape(-0.5)
SIMPLE_SHARE = 0.15
"""Of the power, spread by a simple rule: no line is left out because the model at hand, which may be
wrong, says that it tells nothing."""


@dataclass(frozen=True, eq=False)
class BestSpread:
    """Least sum over the parameters of expected error over wanted error, squared."""

    noise: Noise
    samples: int
    """That the mean of an experiment's periods rests on."""
    wanted: Mapping[str, float]
    """Relative errors by kind of parameter; other kinds do not count."""

    def __call__(self, inputs: UnitInputs, share: float, crest: FloatArray) -> FloatArray:
        """Return inputs, peak, shape (L, M)."""
        simple = SIMPLE(inputs, share, crest)
        told = input_information(
            inputs.setting.model, inputs.omega, inputs.torque, self.samples, self.noise
        )
        L, M, R, P = told.rows.shape
        loads = inputs.power.transpose(0, 2, 1, 3) * (crest / share)[:, :, None, None] ** 2
        best = best_powers(
            np.sqrt(M) * told.rows.reshape(L * M, R, P),  # each input is in all M experiments
            self._weights(told),
            loads.reshape(5 * M, L * M),
        )
        power = (1 - SIMPLE_SHARE) * best.reshape(L, M) + SIMPLE_SHARE * simple**2
        size: FloatArray = np.sqrt(power)
        return size

    def _weights(self, told: InputInformation) -> FloatArray:
        return np.array(
            [
                abs(step / value) / self.wanted[p.kind] if value and p.kind in self.wanted else 0.0
                for p, value, step in zip(told.parameters, told.values, told.steps, strict=True)
            ]
        )
