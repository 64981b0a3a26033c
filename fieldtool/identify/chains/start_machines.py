"""Machines to start a fit from where modes give none."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np

from fieldtool.identify.modes.model import ModalModel
from fieldtool.records.model import AxisModel, Coupling, Estimate, Kind, MachineModel


def typical_machine(
    modal: ModalModel, lengths: Sequence[int], kinds: Mapping[str, Kind]
) -> MachineModel:
    """Chains of equal masses and springs with the measured rigid body: a start of last resort."""
    total = 1.0 / np.diag(modal.rigid)
    square = float(np.mean(modal.omega**2)) if modal.omega.size else 1.0
    axes = []
    for name, n, mass in zip(modal.names, lengths, total, strict=True):
        each = float(mass) / n
        axes.append(
            AxisModel(
                name,
                kinds.get(name, "rotary"),
                (Estimate(each),) * n,
                (Estimate(0.5 * each * square),) * (n - 1),
            )
        )
    return MachineModel(tuple(axes))


def rigid_machine(modal: ModalModel, kinds: Mapping[str, Kind]) -> MachineModel:
    """Axes of one mass each, with the couplings of the measured rigid body."""
    mass = np.linalg.pinv(modal.rigid, hermitian=True)
    diagonal = np.diag(mass)
    if not (diagonal > 0.0).all():
        return all_coupled(typical_machine(modal, (1,) * len(modal.names), kinds))
    axes = [
        AxisModel(name, kinds.get(name, "rotary"), (Estimate(float(each)),), ())
        for name, each in zip(modal.names, diagonal, strict=True)
    ]
    values = {
        (modal.names[i], modal.names[j]): float(mass[i, j])
        for i, j in zip(*np.triu_indices(len(axes), 1), strict=True)
    }
    couplings = tuple(Coupling(pair, value) for pair, value in values.items())
    coupled = MachineModel(tuple(axes), couplings)
    if np.linalg.eigvalsh(coupled.mass_matrix)[0] <= 0.0:
        return all_coupled(MachineModel(tuple(axes)))
    return coupled


def all_coupled(model: MachineModel) -> MachineModel:
    """The model with the couplings that it does not list, from zero."""
    listed = {frozenset(coupling.axes) for coupling in model.couplings}
    missing = tuple(
        Coupling((one, other), 0.0)
        for one, other in combinations(model.names, 2)
        if frozenset((one, other)) not in listed
    )
    return replace(model, couplings=(*model.couplings, *missing))
