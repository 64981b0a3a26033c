"""One elastic axis from periodic data: masses, springs, dampers, delay and friction.

Start values come from a fit of modes and order reduction; then maximum likelihood, weighted with the
noise.  Where the misfit is more than noise explains, friction, play and the torque's own distortion
change each line by chance; how much, the lines themselves tell: by the scatter of each about a smooth
local response of its neighbours.  The fit is then weighted with that scatter, line by line, and what is
beside the chain (see ``surroundings``) is fitted too where the data ask for it.  What is left widens
the intervals.

Source: Pintelon and Schoukens, System Identification, chapters 3 and 7 (stochastic non-linear
distortion of a best linear approximation, from the scatter of its neighbouring lines).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from fieldtool.errors import NotEnoughDataError
from fieldtool.frf.matrix import column_responses
from fieldtool.frf.multisine.single_axis import analyse_multisine, between_lines
from fieldtool.frf.phasors import Phasors
from fieldtool.frf.response import FrequencyResponse
from fieldtool.identify.chains.modal_chain import reduce_modes
from fieldtool.identify.features import ChainFeatures, chain_features
from fieldtool.identify.likelihood.refine import RefinedModel, machine_response, refine
from fieldtool.identify.likelihood.response_data import ResponseMatrix
from fieldtool.identify.modes.fit import fit_modes
from fieldtool.identify.surroundings import Surroundings, with_surroundings
from fieldtool.records.model import Estimate, MachineModel
from fieldtool.records.recording import Recording

START_SHARE = 0.05
"""Of the response: model error reckoned with while start values are sought."""
EXPLAINED = 1.5
"""Chi-squared over degrees of freedom up to which noise explains a misfit."""
NEIGHBOURS = 11
"""Lines whose median scatter is that of the one in the middle."""
FEWEST_LINES = 24
"""Of an experiment, from which its scatter is told."""
WORTH_A_WORD = 0.01
"""Share of the response that is not explained and is said."""


@dataclass(frozen=True, eq=False)
class ChainResult:
    """One elastic axis."""

    model: MachineModel
    delay: Estimate
    """From torque to position, s."""
    features: ChainFeatures
    model_error: float
    """Share of the response that the chain does not explain, median over the lines."""
    response: FrequencyResponse
    notes: tuple[str, ...]
    fitted: RefinedModel
    beside: Surroundings

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
    response = _response(phasors)
    start = _start(response, masses, recording)
    fitted, beside = _refined(start, response), Surroundings()
    if fitted.chi2 > EXPLAINED * fitted.degrees_of_freedom:
        response = _response([_with_scatter(one) for one in phasors])
        fitted, beside = with_surroundings(_refined(fitted.model, response), _matrix(response, 0.0))
    share = _unexplained(response, fitted)
    notes = [u.reason for u in fitted.unknown]
    notes += beside.sentences(recording.axes[0].kind, recording.axes[0].torque_unit)
    if share >= WORTH_A_WORD:
        notes.append(
            f"{100 * share:.2g} % of the response (median over the lines) is not explained by masses, "
            "springs, dampers, delay and viscous friction; noise is far below that."
        )
    return ChainResult(
        model=fitted.model,
        delay=fitted.delays[0],
        features=chain_features(fitted),
        model_error=share,
        response=response,
        notes=tuple(notes),
        fitted=fitted,
        beside=beside,
    )


def _response(phasors: Sequence[Phasors]) -> FrequencyResponse:
    return next(iter(column_responses(phasors).values()))


def _with_scatter(one: Phasors) -> Phasors:
    """Return phasors whose errors of position hold what the lines scatter about a smooth response."""
    f, response = one.frequencies, one.position[:, 0] / one.torque[:, 0]
    if f.size < FEWEST_LINES:
        return one
    others = ~np.eye(f.size, dtype=np.bool_)
    smooth = np.array([between_lines(f[o], response[o], f[[k]])[0] for k, o in enumerate(others)])
    power = np.abs((smooth - response) / response) ** 2
    near = np.argsort(np.abs(f[:, None] - f), axis=1, kind="stable")[:, :NEIGHBOURS]
    scatter = np.median(power[near], axis=1) / np.log(
        2
    )  # the median of an exponential distribution
    covariance = one.covariance.copy()
    covariance[:, 0, 0] += scatter * np.abs(one.position[:, 0]) ** 2
    return replace(one, covariance=covariance)


def _unexplained(response: FrequencyResponse, fitted: RefinedModel) -> float:
    """Median share of the response that the chain differs by."""
    measured = response.response[:, 0, 0]
    chain = machine_response(fitted.model, 2 * np.pi * response.frequencies, fitted.delay_values)[
        :, 0, 0
    ]
    return float(np.median(np.abs(chain - measured) / np.abs(measured)))


def _matrix(response: FrequencyResponse, share: float) -> ResponseMatrix:
    std = np.hypot(response.complex_std, share * np.abs(response.response))
    return ResponseMatrix(response.axes, 2 * np.pi * response.frequencies, response.response, std)


def _start(response: FrequencyResponse, masses: int, recording: Recording) -> MachineModel:
    modal = fit_modes(_matrix(response, START_SHARE), masses - 1, fit_friction=True, fit_delay=True)
    name, kind = response.axes[0], recording.axes[0].kind
    return reduce_modes(modal, {name: masses}, {name: kind}).model


def _refined(start: MachineModel, response: FrequencyResponse) -> RefinedModel:
    return refine(
        start, _matrix(response, 0.0), fit_delay=True, fit_friction=True, fit_load_friction=True
    )


def _shown(value: Estimate) -> str:
    digits = max(0, 1 - int(np.floor(np.log10(value.std)))) if value.std > 0 else 4
    return f"{value.value:.{digits}f} ± {value.std:.{digits}f}"
