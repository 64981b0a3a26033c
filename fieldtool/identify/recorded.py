"""Identify whatever a recording holds: choose the way by the kind of its experiments."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from fieldtool.errors import NotEnoughDataError
from fieldtool.frf.response import FrequencyResponse
from fieldtool.frf.stepped import stepped_responses
from fieldtool.identify.chain import ChainResult, identify_chain
from fieldtool.identify.classic import identify_classic
from fieldtool.records.model import Estimate, FloatArray, MachineModel
from fieldtool.records.recording import Recording


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
        Stepped sines of one or more axes, or multisines of one axis.
    masses
        Chain length by axis; where left out, the recording's own.
    prior
        For start values of the modes' search.
    motor_masses
        From data sheets, instead of the high-frequency gain.

    Raises
    ------
    NotEnoughDataError
        If there is nothing that can be identified, or a chain's length is not known.
    IdentificationError
        If the data contradict a machine of such chains.
    """
    unknown = set(masses) - set(recording.names)
    if unknown:
        raise NotEnoughDataError(
            f"the recording has no axis {', '.join(sorted(unknown))}; its axes are "
            f"{', '.join(recording.names)}."
        )
    lengths = {axis.name: masses.get(axis.name, axis.masses) for axis in recording.axes}
    missing = [name for name, count in lengths.items() if count is None]
    if missing:
        raise NotEnoughDataError(
            f"the number of masses of {', '.join(missing)} is not known. Give it with --masses "
            f"{missing[0]}=2, or as `masses` of the axis in the recording."
        )
    known = {name: count for name, count in lengths.items() if count is not None}
    kinds = {axis.name: axis.kind for axis in recording.axes}
    units = tuple(axis.torque_unit for axis in recording.axes)
    kinds_of_data = {e.kind for e in recording.experiments if e.segments or e.period}
    if "stepped_sine" in kinds_of_data:
        stepped = stepped_responses(recording)
        found = identify_classic(stepped, known, kinds, prior, motor_masses)
        return Identified(
            found.model,
            "stepped sines, order reduction of the paper (equations 2 to 22), dampers by a fit",
            stepped.responses,
            found.damping_ratios,
            found.notes,
            units,
        )
    if len(recording.axes) == 1 and "multisine" in kinds_of_data:
        chain = identify_chain(recording, known[recording.names[0]])
        return Identified(
            _with_delay(chain),
            "multisine, maximum likelihood fit of masses, springs, dampers, delay and friction",
            {chain.response.condition: chain.response},
            np.array([ratio.value for ratio in chain.features.damping_ratios]),
            chain.notes,
            units,
            chain,
        )
    raise NotEnoughDataError(
        "the recording has neither settled stepped sines nor a multisine of a single axis with its "
        f"`period`: its experiments are {sorted({e.kind for e in recording.experiments})}. Measure "
        "with `fieldtool measure`."
    )


def _with_delay(chain: ChainResult) -> MachineModel:
    effect = {
        "effect": "measurement_delay",
        "axis": chain.model.axes[0].name,
        "parameters": {"delay": {"value": chain.delay.value, "std": chain.delay.std, "unit": "s"}},
    }
    return replace(chain.model, effects=(*chain.model.effects, effect))
