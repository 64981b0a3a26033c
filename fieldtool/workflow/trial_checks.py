"""What new parameters have to be by their model before they are tried: nothing moves until they are."""

from collections.abc import Mapping, Sequence

import numpy as np

from drives.canopen_drive import CanopenDrive
from fieldtool.design.predict import Prediction
from fieldtool.design.servo import Servo
from fieldtool.design.verdict import CYCLES, SLOWER, TIME_DOUBT
from fieldtool.errors import PlanRefusedError
from fieldtool.experiment.multisine.excitation import signals
from fieldtool.experiment.multisine.plan import MultisinePlan
from fieldtool.experiment.verification.controller import locked_torque
from fieldtool.experiment.verification.steps import NUDGE_TORQUE
from fieldtool.workflow.trial_loops import drive_loop

NOT_AS_SAID, FASTER_THAN_SAID = 1.25, 1.25
"""Factors by which a peak of sensitivity, and a bandwidth, may be off what the tuning says."""
BEYOND = 1.1
"""Times the bound that a peak of sensitivity may be by the model: a measured one would be taken back."""
EDGE = 1.1
"""Times the band about the target: what leaves this one does not leave the band by chance."""
FEWEST_STEPS = 2.0
"""Of a drive's torque, or of its encoder, that an excitation has at least, zero to peak."""
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


def check_excited(excitation: MultisinePlan, drives: Sequence[CanopenDrive]) -> None:
    """Refuse an excitation that is so small that drives round it away."""
    one = excitation.experiments[0]
    for k, drive in enumerate(drives):
        by_torque = bool(np.any(one.torque[:, k]))
        phasors = one.torque if by_torque else one.reference
        step = abs(drive.scaling.torque if by_torque else drive.scaling.position)
        size = float(np.abs(signals(phasors[:, [k]], one.lines, one.samples)).max())
        if size >= FEWEST_STEPS * step:
            continue
        what, unit = (
            ("torque", drive.torque_unit) if by_torque else ("position", drive.position_unit)
        )
        raise PlanRefusedError(
            f"{drive.axis}: within the limits in the machine profile its {what} may be excited by "
            f"{size:.2g} {unit}, and its drive takes it in steps of {step:.2g} {unit}. Allow it more, "
            "above all following_error, if the machine bears it."
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


def check_present(before: Prediction) -> None:
    """Refuse a machine that swings by its model as its drives are now."""
    if not before.stable:
        raise PlanRefusedError(
            "with the parameters that are in the drives now the machine is not stable by its model, so "
            "they are not tried, and nothing can be compared with them. Nothing was moved or written. "
            "Lower gains by hand (velocity_i, then position_p and velocity_p), and measure and design "
            "anew: `fieldtool run`. Or write without a trial (--no-verify); then nothing can be stored."
        )


def check_no_worse(before: Prediction, after: Prediction, cycle: float) -> None:
    """Refuse parameters of which the model says already that the trial would take them back."""
    for old, new in zip(before.axes, after.axes, strict=True):
        if old.move is None or new.move is None or new.curves is None:
            continue
        was = old.move.settling_time
        now = new.curves.figures(EDGE * new.move.band).settling_time
        if now > (1 + TIME_DOUBT) * SLOWER * was + CYCLES * cycle:
            settles = f"settle in {now:.3g} s" if np.isfinite(now) else "not settle"
            raise PlanRefusedError(
                f"{new.axis}: after the trial's move it would {settles} with the new parameters by the "
                f"model, in {was:.3g} s with those that are in the drives. Nothing was moved or "
                "written. Design anew (`fieldtool design`), or write without a trial (--no-verify)."
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
        if peak > BEYOND * bound:
            raise PlanRefusedError(
                f"{axis.axis}: with the new parameters its peak of sensitivity would be {peak:.3g} at "
                f"{axis.margins.peak_frequency:.3g} Hz by the model, {bound:.3g} is allowed. Nothing "
                "was moved or written. Design anew (`fieldtool design`)."
            )
