"""The main experiments, adapted to what the pilot showed beside its model: friction, noise, torques."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from fieldtool.errors import PlanRefusedError
from fieldtool.experiment.forecast import Setting
from fieldtool.experiment.multisine.design import LEAST_FACTOR, with_bias
from fieldtool.experiment.multisine.forecast import (
    TORQUE,
    allowed_peaks,
    experiment_peaks,
    forecast_multisine,
)
from fieldtool.experiment.multisine.plan import MultisinePlan
from fieldtool.identify.likelihood.expected import Noise, expected_accuracy
from fieldtool.identify.multisine.dry_friction import DryFriction
from fieldtool.identify.multisine.pilot import FRICTION_SEEN
from fieldtool.records.model import FloatArray
from fieldtool.records.recording import Experiment
from fieldtool.workflow.planning import PlannedFast, excitations

TORQUE_KEPT = 0.95
"""Share of its torque limit that excitation, friction and noise of an axis may take together."""
BESIDE_GROWS = 1.15
"""By how much the largest torque beside the model is larger in the main experiments, which last longer:
that of Gaussian noise in 10 000 samples over that in 1000."""


def freed_of_friction(
    planned: PlannedFast, setting: Setting, noise: Noise, friction: DryFriction | None
) -> PlannedFast:
    """Return the plan with a bias velocity where dry friction was seen and the travel allows one.

    Otherwise the two amplitude levels (the pilot's and this one's) tell friction from elasticity.
    """
    seen = () if friction is None else friction.seen(FRICTION_SEEN)
    if friction is None or not seen:
        return planned
    names = ", ".join(friction.axes[k] for k in seen)
    biased = with_bias(planned.plan, setting, seen)
    if biased is not None:
        plan, factor = biased
        found = _checked(replace(planned, plan=plan), setting, noise)
        if found is not None and found.reached <= 1.0:
            note = (
                f"{names}: dry friction; a constant velocity is added, so that the axes do not reverse "
                f"(excitation {100 * factor:.0f} % of what the limits allow)."
            )
            return replace(found, plan=replace(plan, notes=(*plan.notes, note)))
    note = (
        f"{names}: dry friction, and the travel is too short for a constant velocity that would keep it "
        "out; it is told from elasticity by two amplitude levels and by the lines between, and what is "
        "left of it is said."
    )
    plan = replace(planned.plan, notes=(*planned.plan.notes, note))
    return replace(planned, plan=plan)


def with_room_for_torque(
    planned: PlannedFast, setting: Setting, noise: Noise, beside: FloatArray
) -> PlannedFast:
    """Return the plan, made weaker where torques beside it would pass a limit.

    Parameters
    ----------
    planned, setting, noise
        The plan, what it rests on, and the noise of single samples.
    beside
        Largest torques that friction and noise made beside what the model foresaw, N m or N, (M,).
    """
    limits, grown = allowed_peaks(setting)[TORQUE], BESIDE_GROWS * beside
    room = TORQUE_KEPT * limits - grown
    torques = np.array([one.torque for one in planned.moves])
    shares = room / np.maximum(torques, 1e-300)
    k = int(np.argmin(shares))
    if shares[k] >= 1.0:
        return planned
    factor = max(float(shares[k]), LEAST_FACTOR)
    found = _checked(replace(planned, plan=planned.plan.scaled(factor)), setting, noise)
    if found is None:
        return planned
    axis = setting.model.axes[k]
    unit = "N m" if axis.kind == "rotary" else "N"
    note = (
        f"{axis.name}: friction and noise made torques of up to {beside[k]:.2g} {unit} in the pilot "
        f"beside what its model foresees; the excitation is {100 * factor:.0f} % of what it would be "
        "without."
    )
    return replace(found, plan=replace(found.plan, notes=(*found.plan.notes, note)))


def _checked(planned: PlannedFast, setting: Setting, noise: Noise) -> PlannedFast | None:
    """Return the plan with its moves and accuracy; None if it would leave a limit."""
    try:
        moves = forecast_multisine(planned.plan, setting)
    except PlanRefusedError:
        return None
    accuracy = expected_accuracy(setting.model, excitations(planned.plan, setting), noise)
    return replace(planned, moves=moves, accuracy=accuracy)


def torques_of(experiments: Sequence[Experiment]) -> FloatArray:
    """Return the largest torques of the axes in complete multisines, beside their means, (M,), SI."""
    done = [e for e in experiments if e.kind == "multisine" and e.complete]
    taken: FloatArray = np.max(
        [np.abs(e.torque - e.torque.mean(axis=0)).max(axis=0) for e in done], axis=0
    )
    return taken


def torques_foreseen(plan: MultisinePlan, setting: Setting) -> FloatArray:
    """Return the largest torques of the axes in a plan by its model, (M,), SI."""
    foreseen: FloatArray = experiment_peaks(plan, setting)[:, TORQUE, :].max(axis=0)
    return foreseen
