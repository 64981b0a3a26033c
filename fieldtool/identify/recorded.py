"""Identify whatever a recording holds: choose the way by the kind of its experiments."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from fieldtool.errors import NoSuchAxisError, NotEnoughDataError
from fieldtool.frf.response import FrequencyResponse
from fieldtool.frf.stepped.responses import stepped_responses
from fieldtool.identify.chain import ChainResult, identify_chain
from fieldtool.identify.classic import identify_classic
from fieldtool.identify.likelihood.refine import RefinedModel
from fieldtool.identify.moves.identify import identify_moves
from fieldtool.identify.multisine.identify import effect_entry, identify_joint
from fieldtool.records.model import Correlation, Estimate, FloatArray, Kind, MachineModel
from fieldtool.records.recording import Recording

DECIMALS = 6
"""Of correlations."""


@dataclass(frozen=True, eq=False)
class Identified:
    """An identified machine, and how it was found."""

    model: MachineModel
    method: str
    """One sentence."""
    responses: Mapping[str, FrequencyResponse]
    damping_ratios: FloatArray
    """Of the resonances, rising frequency, shape (n,)."""
    notes: tuple[str, ...]
    torque_units: tuple[str, ...]
    """Of each axis' torque: N m, N, or A where only the motor current is known."""
    chain: ChainResult | None = None
    """Features of a single elastic axis."""
    fitted: RefinedModel | None = None
    """The fit with its covariance; None where the order reduction's result was kept."""


def identify_recording(
    recording: Recording,
    masses: Mapping[str, int],
    prior: MachineModel | None = None,
    motor_masses: Mapping[str, Estimate] | None = None,
) -> Identified:
    """Identify masses, springs, couplings and dampers from a recording.

    Parameters
    ----------
    recording
        Stepped sines, multisines or moves.
    masses
        Chain length by axis; where left out, the recording's own; where that is not known, it is
        chosen on evidence (multisines only).
    prior
        For start values of the modes' search.
    motor_masses
        From data sheets, instead of the high-frequency gain.

    Raises
    ------
    NoSuchAxisError
        If a length is given for an axis that was not recorded.
    NotEnoughDataError
        If there is nothing that can be identified, or a chain's length is not known.
    IdentificationError
        If the data contradict a machine of such chains.
    """
    unknown = set(masses) - set(recording.names)
    if unknown:
        raise NoSuchAxisError(
            f"the recording has no axis {', '.join(sorted(unknown))}; its axes are "
            f"{', '.join(recording.names)}."
        )
    known = {
        axis.name: count
        for axis in recording.axes
        if (count := masses.get(axis.name, axis.masses)) is not None
    }
    return _correlated(_identified(recording, known, prior, motor_masses))


def _correlated(found: Identified) -> Identified:
    """Keep with the model how its errors hang together, where a fit tells."""
    fitted = found.fitted
    if fitted is None:
        return found
    variance, numbers = np.diag(fitted.covariance), found.model.numbers
    told = [
        k
        for k, name in enumerate(fitted.names)
        if name in numbers and np.isfinite(variance[k]) and variance[k] > 0
    ]
    matrix = fitted.covariance[np.ix_(told, told)]
    matrix = np.clip(matrix / np.sqrt(np.outer(variance[told], variance[told])), -1.0, 1.0)
    rows = tuple(
        tuple(round(float(v), DECIMALS) for v in row[: k + 1]) for k, row in enumerate(matrix)
    )
    correlation = Correlation(tuple(fitted.names[k] for k in told), rows)
    return replace(found, model=replace(found.model, correlation=correlation))


def _identified(
    recording: Recording,
    known: Mapping[str, int],
    prior: MachineModel | None,
    motor_masses: Mapping[str, Estimate] | None,
) -> Identified:
    kinds_of_data = {e.kind for e in recording.experiments if e.complete}
    if "stepped_sine" in kinds_of_data:
        return _classic(recording, known, prior, motor_masses)
    if "multisine" in kinds_of_data:
        if len(recording.axes) == 1 and not _has_references(recording):
            return _chain(recording, known)
        return _joint(recording, known, prior, motor_masses)
    if kinds_of_data & {"moves", "other"}:
        return _moves(recording, known, prior)
    raise NotEnoughDataError(
        "the recording has no complete experiment to identify from: its experiments are "
        f"{sorted({e.kind for e in recording.experiments})}. Measure with `fieldtool measure`."
    )


def _has_references(recording: Recording) -> bool:
    """Whether multisines were asked for as positions, as the fast plan does."""
    return all(
        e.position_reference is not None and bool(np.all(np.isfinite(e.position_reference)))
        for e in recording.experiments
        if e.kind == "multisine"
    )


def _units(recording: Recording) -> tuple[str, ...]:
    return tuple(axis.torque_unit for axis in recording.axes)


def _kinds(recording: Recording) -> dict[str, Kind]:
    return {axis.name: axis.kind for axis in recording.axes}


def _check_known(recording: Recording, known: Mapping[str, int]) -> None:
    missing = [name for name in recording.names if name not in known]
    if missing:
        raise NotEnoughDataError(
            f"the number of masses of {', '.join(missing)} is not known. Give it with --masses "
            f"{missing[0]}=2, or as `masses` of the axis in the recording."
        )


def _classic(
    recording: Recording,
    known: Mapping[str, int],
    prior: MachineModel | None,
    motor_masses: Mapping[str, Estimate] | None,
) -> Identified:
    _check_known(recording, known)
    stepped = stepped_responses(recording)
    found = identify_classic(stepped, known, _kinds(recording), prior, motor_masses)
    return Identified(
        found.model,
        "stepped sines, order reduction of the paper (equations 2 to 22), dampers by a fit",
        stepped.responses,
        found.damping_ratios,
        found.notes,
        _units(recording),
    )


def _chain(recording: Recording, known: Mapping[str, int]) -> Identified:
    _check_known(recording, known)
    chain = identify_chain(recording, known[recording.names[0]])
    return Identified(
        _with_effects(chain, recording.axes[0].torque_unit),
        "multisine, maximum likelihood fit of masses, springs, dampers, delay and friction",
        {chain.response.condition: chain.response},
        np.array([ratio.value for ratio in chain.features.damping_ratios]),
        chain.notes,
        _units(recording),
        chain=chain,
        fitted=chain.fitted,
    )


def _joint(
    recording: Recording,
    known: Mapping[str, int],
    prior: MachineModel | None,
    motor_masses: Mapping[str, Estimate] | None,
) -> Identified:
    found = identify_joint(recording, known, _kinds(recording), prior, motor_masses)
    return Identified(
        found.model,
        "multisines of all axes, block order reduction, maximum likelihood fit of everything",
        found.responses,
        found.modal.zeta,
        found.notes,
        _units(recording),
        fitted=found.fitted,
    )


def _moves(
    recording: Recording, known: Mapping[str, int], prior: MachineModel | None
) -> Identified:
    _check_known(recording, known)
    found = identify_moves(recording, known, _kinds(recording), prior)
    responses = {} if found.response is None else {found.response.condition: found.response}
    return Identified(
        found.model,
        "moves, maximum likelihood fit to the spectra of positions and torques",
        responses,
        np.zeros(0),
        found.notes,
        _units(recording),
        fitted=found.refined,
    )


def _with_effects(chain: ChainResult, torque_unit: str) -> MachineModel:
    """Put the delay, and a spring to ground where there is one, among the model's effects."""
    axis = chain.model.axes[0].name
    effects = [effect_entry("measurement_delay", axis, "delay", chain.delay, "s")]
    if chain.beside.spring is not None:
        unit = f"{torque_unit}/{'rad' if chain.model.axes[0].kind == 'rotary' else 'm'}"
        effects.append(
            effect_entry("coulomb_friction", axis, "stiffness", chain.beside.spring, unit)
        )
    return replace(chain.model, effects=(*chain.model.effects, *effects))
