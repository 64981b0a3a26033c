"""Where the fit to multisines begins: modes, the chains' lengths, and first numbers of everything."""

from collections.abc import Iterator, Mapping
from contextlib import suppress

from fieldtool.errors import IdentificationError
from fieldtool.identify.chains.block_reduction import BlockReduced, reduce_blocks
from fieldtool.identify.chains.modal_chain import reduce_modes
from fieldtool.identify.chains.order import OrderSelection, select_order
from fieldtool.identify.likelihood.response_data import ResponseMatrix
from fieldtool.identify.modes.fit import fit_modes
from fieldtool.identify.modes.model import ModalModel
from fieldtool.identify.modes.search import find_modes
from fieldtool.identify.multisine.notes import runner_up
from fieldtool.records.model import Kind, MachineModel


def known_order(
    data: ResponseMatrix,
    masses: Mapping[str, int],
    kinds: Mapping[str, Kind],
    prior: MachineModel | None,
    notes: list[str],
) -> tuple[ModalModel, MachineModel, BlockReduced | None]:
    """Return modes and chains of known lengths; the prior's numbers where the chains fail."""
    modes = sum(masses[name] - 1 for name in data.names)
    same = prior is not None and all(len(axis.masses) == masses[axis.name] for axis in prior.axes)
    modal = _modes(data, modes, prior if same else None)
    try:
        reduced = reduce_blocks(modal, masses, kinds)
    except IdentificationError as error:
        if prior is None or not same:
            raise
        notes.append(f"Block order reduction failed ({error}); the fit began at the prior model.")
        return modal, prior, None
    return modal, reduced.model, reduced


def _modes(data: ResponseMatrix, modes: int, prior: MachineModel | None) -> ModalModel:
    """Fit so many modes; a search that adds one after the other finds many of them more surely."""
    found = find_modes(data, modes, prior=prior).modal
    if found.omega.size == modes:
        return found
    return fit_modes(data, modes, fit_friction=True, fit_delay=True, prior=prior)


def chosen_order(
    data: ResponseMatrix,
    masses: Mapping[str, int],
    kinds: Mapping[str, Kind],
    prior: MachineModel | None,
    notes: list[str],
) -> OrderSelection | None:
    """Choose the chains' lengths on evidence; None where nothing fits but there is a prior model."""
    try:
        order = select_order(data, kinds, known=masses, prior=prior)
    except IdentificationError as error:
        if prior is None:
            raise
        notes.append(f"{error} The chains are as long as in the prior model.")
        return None
    notes += order.other_doubts
    if order.runner_up is not None:
        notes.append(runner_up(order, data.names))
    for axis in prior.axes if prior is not None else ():
        if order.masses[axis.name] != len(axis.masses):
            notes.append(
                f"{axis.name}: the data show {order.masses[axis.name]} masses, the prior model has "
                f"{len(axis.masses)}. Force it with --masses {axis.name}={len(axis.masses)} to compare."
            )
    return order


def starts(
    start: MachineModel,
    modal: ModalModel,
    prior: MachineModel | None,
    kinds: Mapping[str, Kind],
) -> Iterator[MachineModel]:
    """Where to begin, best guess first: blocks, one axis at a time, the machine as last accepted."""
    yield start
    lengths = {axis.name: len(axis.masses) for axis in start.axes}
    with suppress(IdentificationError, ValueError):
        yield reduce_modes(modal, lengths, kinds).model
    if prior is not None and {a.name: len(a.masses) for a in prior.axes} == lengths:
        yield prior
