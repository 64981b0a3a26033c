"""One elastic axis from periodic data: masses, springs, dampers, delay and friction.

Start values come from a fit of modes and order reduction; then maximum likelihood.  Where the
misfit is more than noise explains, the model's own error is taken as a constant share of the
response, the share that makes the misfit what it should be, so that neither the strong lines nor
the weak ones decide alone, and the standard errors are honest.
"""

from dataclasses import dataclass

import numpy as np

from fieldtool.errors import NotEnoughDataError
from fieldtool.frf.matrix import column_responses
from fieldtool.frf.multisine.single_axis import analyse_multisine
from fieldtool.frf.response import FrequencyResponse
from fieldtool.identify.chains.modal_chain import reduce_modes
from fieldtool.identify.features import ChainFeatures, chain_features
from fieldtool.identify.likelihood.refine import RefinedModel, refine
from fieldtool.identify.likelihood.response_data import ResponseMatrix
from fieldtool.identify.modes.fit import fit_modes
from fieldtool.records.model import Estimate, MachineModel
from fieldtool.records.recording import Recording

START_SHARE = 0.05
"""Of the response: model error reckoned with while start values are sought."""
SHARES = (0.0, 0.003, 0.01, 0.02, 0.03, 0.05, 0.1)
"""Of the response: model errors to try, the smallest that explains the misfit is taken."""


@dataclass(frozen=True, eq=False)
class ChainResult:
    """One elastic axis."""

    model: MachineModel
    delay: Estimate
    """From torque to position, s."""
    features: ChainFeatures
    model_error: float
    """Share of the response that the model can not explain."""
    response: FrequencyResponse
    notes: tuple[str, ...]
    fitted: RefinedModel

    @property
    def sentences(self) -> tuple[str, ...]:
        """The features, one sentence each, with standard errors."""
        features = self.features
        lines = [f"inertia ratio load / motor {_shown(features.inertia_ratio)}"]
        for name, values, unit in (
            ("antiresonance", features.antiresonances, " Hz"),
            ("resonance", features.resonances, " Hz"),
            ("damping ratio of the resonance", features.damping_ratios, ""),
        ):
            lines += [f"{name} {_shown(value)}{unit}" for value in values]
        delay = Estimate(1e3 * self.delay.value, 1e3 * self.delay.std)
        return (*lines, f"delay from torque to position {_shown(delay)} ms")


def identify_chain(recording: Recording, masses: int) -> ChainResult:
    """Identify the only axis of a recording from its multisine experiments.

    Parameters
    ----------
    recording
        One axis; at least one experiment with a ``period``.
    masses
        Length of its chain.

    Raises
    ------
    NotEnoughDataError
        If there is no periodic experiment, or too few excited lines.
    IdentificationError
        If the response can not come from such a chain.
    """
    periodic = [e for e in recording.experiments if e.kind == "multisine" and e.period]
    if not periodic or len(recording.axes) != 1:
        raise NotEnoughDataError(
            "a multisine of a single axis with its `period` is needed; the recording has "
            f"{len(recording.axes)} axes and {len(periodic)} periodic experiments."
        )
    phasors = [analyse_multisine(recording, e).phasors for e in periodic]
    response = next(iter(column_responses(phasors).values()))
    start = _start(response, masses, recording)
    share, fitted = _fitted(response, start)
    notes = [u.reason for u in fitted.unknown]
    if share >= 0.01:
        notes.append(
            f"{100 * share:.2g} % of the response is not explained by masses, springs, dampers, delay "
            "and viscous friction; noise is far below that."
        )
    return ChainResult(
        model=fitted.model,
        delay=fitted.delays[0],
        features=chain_features(fitted),
        model_error=share,
        response=response,
        notes=tuple(notes),
        fitted=fitted,
    )


def _matrix(response: FrequencyResponse, share: float) -> ResponseMatrix:
    std = np.hypot(response.complex_std, share * np.abs(response.response))
    return ResponseMatrix(response.axes, 2 * np.pi * response.frequencies, response.response, std)


def _start(response: FrequencyResponse, masses: int, recording: Recording) -> MachineModel:
    modal = fit_modes(_matrix(response, START_SHARE), masses - 1, fit_friction=True, fit_delay=True)
    name, kind = response.axes[0], recording.axes[0].kind
    return reduce_modes(modal, {name: masses}, {name: kind}).model


def _fitted(response: FrequencyResponse, start: MachineModel) -> tuple[float, RefinedModel]:
    """Return the smallest model error that explains the misfit, and the fit with it."""
    best: tuple[float, RefinedModel] | None = None
    for share in SHARES:
        found = refine(
            start,
            _matrix(response, share),
            fit_delay=True,
            fit_friction=True,
            fit_load_friction=True,
        )
        best = (share, found)
        start = found.model
        if found.chi2 <= found.degrees_of_freedom:
            break
    if best is None:
        raise NotEnoughDataError("nothing was fitted")
    return best


def _shown(value: Estimate) -> str:
    digits = max(0, 1 - int(np.floor(np.log10(value.std)))) if value.std > 0 else 4
    return f"{value.value:.{digits}f} ± {value.std:.{digits}f}"
