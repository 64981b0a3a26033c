"""Models that a machine profile holds: as last accepted, and, where simulated, as it really is."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from drives.errors import ProfileError
from drives.profile import SIMULATED, MachineProfile
from fieldtool.errors import FileFormatError, IdentificationError, PlanRefusedError
from fieldtool.experiment.plausible import FAR_OFF
from fieldtool.records.model import AxisModel, Coupling, Estimate, FloatArray, MachineModel
from fieldtool.records.model_file import read_model
from fieldtool.records.same_axes import axes_differ
from fieldtool.workflow.session import Options


def prior_model(machine: MachineProfile) -> MachineModel:
    """Return the machine as last accepted.

    Raises
    ------
    ProfileError
        If its couplings are larger than its last masses allow.
    """
    model = _model([axis.prior for axis in machine.axes], machine.couplings, machine)
    ends = {axis.name: axis.masses[-1].value for axis in model.axes}
    for coupling in model.couplings:
        a, b = coupling.axes
        largest = np.sqrt(ends[a] * ends[b])
        if abs(coupling.value) >= largest:
            raise ProfileError(
                machine.path,
                f"the coupling {coupling.value:g} of {a} and {b} is more than their last masses allow: "
                f"it must stay below {largest:.4g}",
            )
    if np.linalg.eigvalsh(model.mass_matrix)[0] <= 0:
        raise ProfileError(
            machine.path,
            "the couplings together are more than the last masses allow: make them smaller",
        )
    return model


def model_of(machine: MachineProfile, path: Path) -> MachineModel:
    """Read a model that has to be one of this machine.

    Raises
    ------
    FileFormatError
        If it is no model, or its axes are not the machine's in name, kind and order.
    """
    model = read_model(path)
    if differ := axes_differ(model.axes, f"the machine {machine.name}", machine.axes):
        raise FileFormatError(path, f"{differ}, or identify the machine again.")
    return model


WHAT_MAY_BE_WRONG = (
    "Either the torque scale is wrong (rated torque 0x6076, torque constant, drive profile), "
    "or the machine profile's prior masses are. All axes are disabled, and the recording is kept. "
    "Correct what is wrong, and measure again."
)


def check_torque_scale(ratios: FloatArray, prior: MachineModel) -> None:
    """Refuse to go on where motion takes many times more or less torque than it did last time.

    Raises
    ------
    IdentificationError
        Naming the axis, the factor, and what may be wrong.
    """
    for axis, ratio in zip(prior.axes, ratios.tolist(), strict=True):
        if not 1 / FAR_OFF < ratio < FAR_OFF:
            raise IdentificationError(
                f"{axis.name}: its motion in the pilot takes {ratio:.2g} times the torque that it takes "
                f"by the prior model. {WHAT_MAY_BE_WRONG}"
            )


def check_believable(found: MachineModel, prior: MachineModel) -> None:
    """Refuse to go on with a machine that is many times heavier or lighter than it was last time.

    Raises
    ------
    IdentificationError
        Naming the axis, both numbers, and what may be wrong.
    """
    for now, before in zip(found.axes, prior.axes, strict=True):
        sums = [sum(mass.value for mass in axis.masses) for axis in (now, before)]
        factor = sums[0] / sums[1]
        if not 1 / FAR_OFF < factor < FAR_OFF:
            unit = "kg m2" if now.kind == "rotary" else "kg"
            raise IdentificationError(
                f"{now.name}: its masses come to {sums[0]:.3g} {unit} in all, the prior model has "
                f"{sums[1]:.3g} {unit}: a factor of {factor:.2g}. {WHAT_MAY_BE_WRONG}"
            )


def is_simulated(machine: MachineProfile) -> bool:
    """Whether its bus is that of a machine simulated in this process."""
    return machine.simulation is not None and machine.bus.interface == SIMULATED


def truth_model(machine: MachineProfile) -> MachineModel | None:
    """Return what a simulated machine really is; None where the machine is real."""
    if machine.simulation is None or not is_simulated(machine):
        return None
    return _model(machine.simulation.axes, machine.simulation.couplings, machine)


def simulated_words(machine: MachineProfile) -> str:
    """Return what has to stand above all that is said of a simulated machine; empty for a real one."""
    if not is_simulated(machine):
        return ""
    return "SIMULATED machine: nothing real is connected, and nothing real moves."


def data_sheet_masses(machine: MachineProfile, options: Options) -> dict[str, Estimate]:
    """Return the motors' masses from their data sheets, where they are to be used."""
    if options.motor_inertia == "measured":
        return {}
    missing = [axis.name for axis in machine.axes if axis.motor_inertia is None]
    if missing:
        raise PlanRefusedError(
            f"{', '.join(missing)}: the machine profile has no motor_inertia, which "
            "--motor-inertia data-sheet needs. Add it from the motor's data sheet."
        )
    return {
        axis.name: Estimate(m.value, m.value * m.tolerance / np.sqrt(3))
        for axis in machine.axes
        if (m := axis.motor_inertia) is not None
    }


def _model(chains: Any, couplings: Any, machine: MachineProfile) -> MachineModel:
    def exact(values: Sequence[float]) -> tuple[Estimate, ...]:
        return tuple(Estimate(v) for v in values)

    return MachineModel(
        tuple(
            AxisModel(
                axis.name,
                axis.kind,
                exact(chain.masses),
                exact(chain.springs),
                exact(chain.dampers),
                Estimate(chain.viscous_friction),
            )
            for axis, chain in zip(machine.axes, chains, strict=True)
        ),
        tuple(Coupling(c.axes, c.value) for c in couplings),
    )
