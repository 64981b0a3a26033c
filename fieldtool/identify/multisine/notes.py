"""What a technician should know beside an identified machine, a sentence each."""

from collections.abc import Mapping, Sequence
from math import sqrt

import numpy as np

from fieldtool.errors import IdentificationError
from fieldtool.frf.multisine.matrix import JointResult
from fieldtool.identify.chains.block_reduction import BlockReduced
from fieldtool.identify.chains.modal_chain import reduce_modes
from fieldtool.identify.chains.order import OrderSelection
from fieldtool.identify.likelihood.record_data import RecordData
from fieldtool.identify.likelihood.refine import RefinedModel, machine_response
from fieldtool.identify.likelihood.response_data import ResponseMatrix
from fieldtool.identify.modes.model import ModalModel
from fieldtool.identify.multisine.dry_friction import SEEN, DryFriction
from fieldtool.identify.multisine.second_look import still_in_doubt, structure_still_in_doubt
from fieldtool.records.model import Kind, MachineModel
from fieldtool.records.recording import Recording

DISAGREEMENT = 5.0
"""Standard errors between two ways to one number above which a note is made."""
UNEXPLAINED = 1.5
"""Misfit over noise above which a note is made."""


def runner_up(order: OrderSelection, names: Sequence[str]) -> str:
    """Say which numbers of masses come next, and what speaks against them."""
    second = order.runner_up
    if second is None:
        return ""
    chosen = ", ".join(f"{name} {order.masses[name]}" for name in names)
    other = ", ".join(f"{name} {n}" for name, n in zip(names, second.masses, strict=True))
    return f"Number of masses, chosen on evidence: {chosen}. Runner-up: {other}; {second.why}."


def structure_notes(
    reduced: BlockReduced | None, fitted: RefinedModel, whole: RecordData | None
) -> list[str]:
    """Say what the modes tell of couplings in unexpected places, where the records do not deny it."""
    if reduced is None:
        return []
    if whole is None:
        return list(reduced.notes)
    return list(structure_still_in_doubt(reduced.structure, fitted, whole))


def mode_notes(
    order: OrderSelection | None, fitted: RefinedModel, whole: RecordData | None, lines: int
) -> list[str]:
    """Say which modes are in doubt, by the responses and by the whole records."""
    doubts = () if order is None else order.mode_doubts
    return [
        one.sentence for one in doubts if whole is None or still_in_doubt(one, fitted, whole, lines)
    ]


def transient_note(measured: JointResult, data: ResponseMatrix, fitted: RefinedModel) -> list[str]:
    """Say how far the model lies outside of the responses' bands, where transients may be why."""
    if not measured.transient:
        return []
    left = data.residuals(machine_response(fitted.model, data.omega, fitted.delay_values))
    outside = sqrt(float(left @ left) / left.size)
    if outside <= UNEXPLAINED:
        return []
    return [
        f"Transients of up to {100 * measured.transient:.0f} % of the signals were taken out of the "
        f"responses, whose bands are too narrow for it: the model differs from them by {outside:.1f} "
        "times their noise. More time (--time) would lessen them."
    ]


def friction_notes(friction: DryFriction, recording: Recording) -> list[str]:
    """Say how much dry friction was taken off, and what of it may be left."""
    notes = []
    for k in friction.seen(SEEN):
        one, unit = friction.torque[k], recording.axes[k].torque_unit
        notes.append(
            f"{friction.axes[k]}: dry friction of {one.value:.3g} +- {1.96 * one.std:.1g} {unit} "
            f"({100 * friction.share[k]:.1f} % of its torque) was taken off before the fit; its error "
            "is what may be left of it."
        )
    return notes


def misfit_note(fitted: RefinedModel) -> list[str]:
    """Say by how much measurement and model differ where noise does not explain it."""
    misfit = sqrt(fitted.chi2 / fitted.degrees_of_freedom)
    if misfit <= UNEXPLAINED:
        return []
    return [
        f"Measurement and model differ by {misfit:.1f} times the noise: something is not explained by "
        "masses, springs, dampers, couplings and friction. The intervals are widened by that factor."
    ]


def cross_check(modal: ModalModel, model: MachineModel, kinds: Mapping[str, Kind]) -> list[str]:
    """Compare with the paper's reduction, one axis at a time (equations 14 to 22)."""
    lengths = {axis.name: len(axis.masses) for axis in model.axes}
    try:
        single = reduce_modes(modal, lengths, kinds).model
    except (IdentificationError, ValueError) as error:
        return [f"The reduction of one axis at a time, for comparison, failed: {error}"]
    notes = []
    for one, other in zip(single.axes, model.axes, strict=True):
        for what, first, second in (
            ("mass", one.masses, other.masses),
            ("spring", one.springs, other.springs),
        ):
            for k, (a, b) in enumerate(zip(first, second, strict=True)):
                allowed = DISAGREEMENT * np.hypot(a.std, b.std) + 0.02 * b.value
                if abs(a.value - b.value) > allowed:
                    notes.append(
                        f"{one.name} {what} {k + 1}: {b.value:.4g} by the fit, {a.value:.4g} +- "
                        f"{1.96 * a.std:.2g} by the reduction of one axis at a time; they should agree."
                    )
    return notes
