"""What new parameters have to be by their model before they are tried: nothing moves until they are."""

from collections.abc import Mapping, Sequence

import numpy as np

from drives.canopen_drive import CanopenDrive
from fieldtool.design.predict import Prediction
from fieldtool.design.servo import Servo
from fieldtool.errors import PlanRefusedError
from fieldtool.experiment.verification.controller import locked_torque
from fieldtool.experiment.verification.steps import NUDGE_TORQUE
from fieldtool.workflow.trial_loops import drive_loop

NOT_AS_SAID, FASTER_THAN_SAID = 1.25, 1.25
"""Factors by which a peak of sensitivity, and a bandwidth, may be off what the tuning says."""
SETTLED_CYCLES = 24
"""After which the answer to one count has shown how large it is."""


def check_a_count(drive: CanopenDrive, servos: Sequence[Servo], limit: float, cycle: float) -> None:
    """Refuse loops that make more torque of one count of a target than the first moves may take."""
    path = np.zeros(SETTLED_CYCLES)
    path[2:] = abs(drive.scaling.position)
    for servo, whose in zip(servos, ("present", "new"), strict=True):
        torque = float(np.abs(locked_torque(drive_loop(drive, servo), path, cycle)).max())
        if torque > NUDGE_TORQUE * limit:
            unit = drive.torque_unit
            raise PlanRefusedError(
                f"{drive.axis}: with the {whose} parameters one count of its encoder, as a step of its "
                f"target from cycle to cycle, makes {torque:.3g} {unit}; its first careful moves may "
                f"take {NUDGE_TORQUE * limit:.3g} {unit}. Nothing was moved or written. The encoder is "
                "too coarse for its feed-forward of inertia, or for its gains: lower inertia_ff, or "
                "measure and design anew, so that the encoder's counts are known to the design."
            )


def check_as_designed(
    after: Prediction, stated: Mapping[str, float], designed: Prediction | None
) -> None:
    """Refuse parameters that are not what their tuning says of them: changed, or of another model."""
    promises = {} if designed is None else {a.axis: a.margins.bandwidth for a in designed.axes}
    for axis in after.axes:
        peak, said = axis.margins.sensitivity_peak, stated.get(axis.axis)
        wrong = ""
        if said is not None and not 1 / NOT_AS_SAID < peak / said < NOT_AS_SAID:
            wrong = f"the peak of sensitivity is {said:.3g}; now it would be {peak:.3g}"
        elif said is not None and 0 < (promised := promises.get(axis.axis, 0.0)) < np.inf:
            bandwidth = axis.margins.bandwidth
            if not 1 / FASTER_THAN_SAID < bandwidth / promised < FASTER_THAN_SAID:
                wrong = f"the bandwidth is {promised:.3g} Hz; now it would be {bandwidth:.3g} Hz"
        if wrong:
            raise PlanRefusedError(
                f"{axis.axis}: its tuning says that {wrong}, by the model. Either they were changed, or "
                "the model was. Nothing was moved or written. Design anew (`fieldtool design`)."
            )


def check_stable(after: Prediction, bound: float) -> None:
    """Refuse parameters that are not stable by the model, or far beyond the bound."""
    if not after.stable:
        raise PlanRefusedError(
            "with the new parameters the machine would not be stable by its model. Nothing was moved "
            "or written. Design anew (`fieldtool design`), or measure again if the machine was changed."
        )
    for axis in after.axes:
        peak = axis.margins.sensitivity_peak
        if peak > 1.2 * bound:
            raise PlanRefusedError(
                f"{axis.axis}: with the new parameters its peak of sensitivity would be {peak:.3g} at "
                f"{axis.margins.peak_frequency:.3g} Hz by the model, {bound:.3g} is allowed. Nothing "
                "was moved or written. Design anew (`fieldtool design`)."
            )
