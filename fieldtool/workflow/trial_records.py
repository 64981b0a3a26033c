"""What the records of a trial come to: each axis before, as predicted, and after, on one scale."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from fieldtool.design.excited import Periodic, excited
from fieldtool.design.loops import Loops
from fieldtool.design.machine import Machine, machine_of, respond
from fieldtool.design.measured import (
    AxisFigures,
    Excited,
    Sensitivity,
    axis_figures,
    measured_move,
    measured_sensitivity,
)
from fieldtool.design.predict import Prediction
from fieldtool.design.servo import Servo
from fieldtool.design.verdict import Comparison, Step
from fieldtool.experiment.axes import Axes
from fieldtool.experiment.verification.excitation import Lines
from fieldtool.experiment.verification.trial import Tried
from fieldtool.records.model import FloatArray, MachineModel
from fieldtool.report.verification_picture import History
from fieldtool.workflow.trial_plan import TrialPlan

INSIDE = 0.9
"""Of the band: a predicted swing that leaves this much may leave the band on the machine."""
HIDDEN = 0.9
"""Share of the loop's own peak of sensitivity below which friction hides it from a small excitation."""


@dataclass(frozen=True, eq=False)
class TrialRecords:
    """Reads figures from what was recorded of a plan."""

    plan: TrialPlan
    axes: Axes
    model: MachineModel
    """That predicts."""

    def compared(self, old: Tried | None, new: Tried | None) -> tuple[Comparison, ...]:
        """Return every axis with the old and with the new parameters; None: not tried."""
        return tuple(self._comparison(k, old, new) for k in range(len(self.plan.moves)))

    def notes(self, compared: Sequence[Comparison]) -> tuple[str, ...]:
        """Return what has to be known of a comparison besides its figures, a sentence each."""
        found = []
        for one in compared:
            shown, own = one.sensitivity_predicted, one.loop_peak
            if shown is None or own is None:
                continue
            if one.rubs:
                found.append(
                    f"{one.axis}: dry friction holds it in the small excitation and makes the peak of "
                    f"sensitivity that this should show, {shown.peak:.3g}; the loop's own is {own:.3g} "
                    "by the model. What was measured is not compared with it."
                )
            elif shown.peak < HIDDEN * own:
                found.append(
                    f"{one.axis}: dry friction holds it in the small excitation. Its peak of "
                    f"sensitivity is compared with what that should show, {shown.peak:.3g}; the loop's "
                    f"own is {own:.3g} by the model, and is seen in the move alone."
                )
        return tuple(found)

    def history(self, tried: Tried | None, k: int) -> History:
        """Return time, reference, position of an axis' own move, from where it began."""
        one = None if tried is None else tried.move(self.axes.names[k])
        if one is None or one.position_reference is None:
            return None
        reference = one.position_reference[:, k]
        return one.time, reference - reference[0], one.position[:, k] - reference[0]

    def _comparison(self, k: int, old: Tried | None, new: Tried | None) -> Comparison:
        plan = self.plan
        move = plan.moves[k]
        old_curve = self._sensitivity(old, k, plan.old[k])
        new_curve = self._sensitivity(new, k, plan.new[k])
        frequency = None
        for curve in (new_curve, old_curve):
            if curve is not None:
                frequency = curve.frequency
        expected = None if frequency is None else self._predicted(k, frequency)
        return Comparison(
            move.axis,
            self.axes.unit(k),
            move.distance,
            move.duration,
            move.settling_band,
            self._figures(old, k, old_curve),
            self._foreseen(k, expected),
            self._figures(new, k, new_curve),
            old_curve,
            expected,
            new_curve,
            plan.after.axes[k].margins.sensitivity_peak,
            _step(plan.before, k),
            _step(plan.after, k),
        )

    def _sensitivity(self, tried: Tried | None, k: int, servo: Servo) -> Sensitivity | None:
        plan, lines = self.plan, self.plan.lines
        if tried is None or lines is None:
            return None
        one = tried.excitation
        if one is None or not one.complete or one.period is None:
            return None
        own = lines.axis == k
        name = self.axes.names[k]
        offset = one.extra.get(f"{name}.torque_offset") if np.all(lines.by_torque[own]) else None
        step = plan.trial.cycle_time
        rows = slice(-(one.samples // lines.samples - 1) * lines.samples, None)
        return measured_sensitivity(
            Excited(
                lines.number[own],
                lines.samples,
                step,
                one.position[rows, k],
                one.torque[rows, k],
                None if offset is None else offset[rows],
                plan.lags[k],
            ),
            servo,
        )

    def _predicted(self, k: int, frequency: FloatArray) -> Sensitivity:
        """Return what the new parameters should show: with dry friction, what is seen of them."""
        machine, lines, servos = machine_of(self.model), self.plan.lines, self.plan.new
        if machine.dry and lines is not None:
            return self._rubbing(machine, lines, k)
        response = respond(machine, 2 * np.pi * frequency)
        sensitivity = Loops(response, servos).sensitivity[:, k]
        return Sensitivity.of(frequency, sensitivity.astype(np.complex128))

    def _rubbing(self, machine: Machine, lines: Lines, k: int) -> Sensitivity:
        excitation = self.plan.trial.excitation
        if excitation is None:
            raise AssertionError("lines are those of an excitation")
        one, own = excitation.experiments[0], lines.axis == k
        sent = Periodic(lines.number, lines.samples, one.cycle_time, one.reference, one.torque)
        servos = self.plan.new if np.all(lines.by_torque) else self.plan.bare
        position, torque = excited(machine, servos, sent, k)
        offset = sent.signals(one.torque[:, [k]])[:, 0] if np.all(lines.by_torque[own]) else None
        return measured_sensitivity(
            Excited(lines.number[own], lines.samples, one.cycle_time, position, torque, offset),
            self.plan.new[k],
        )

    def _watched(self, k: int) -> float:
        """Return how long an axis is watched after its move, s."""
        trial = self.plan.trial
        return next(m.rest for m in trial.moves if m.axis == k) * trial.cycle_time

    def _figures(
        self, tried: Tried | None, k: int, curve: Sensitivity | None
    ) -> AxisFigures | None:
        move = self.plan.moves[k]
        one = None if tried is None else tried.move(move.axis)
        if one is None or one.position_reference is None or not one.complete:
            return None
        moves = measured_move(
            one.time,
            one.position_reference[:, k],
            one.position[:, k],
            move.settling_band,
            self._watched(k),
        )
        torque = one.torque[:, k]
        return axis_figures(moves, float(np.abs(torque - torque[0]).max()), curve)

    def _foreseen(self, k: int, curve: Sensitivity | None) -> AxisFigures | None:
        axis = self.plan.after.axes[k]
        if axis.move is None:
            return None
        if axis.curves is None:
            return axis_figures([axis.move], axis.peak_torque, curve, axis.move.settling_time)
        # narrower, it tells what touches the edge; cut short, what swings in the time that is watched
        narrow = axis.curves.figures(INSIDE * axis.move.band)
        latest = max(axis.move.settling_time, narrow.settling_time)
        vibration = axis.curves.figures(axis.move.band, self._watched(k)).residual_peak
        moved = replace(axis.move, residual_peak=vibration)
        return axis_figures([moved], axis.peak_torque, curve, latest)


def _step(prediction: Prediction, k: int) -> Step | None:
    axis = prediction.axes[k]
    if axis.step is None or axis.curves is None:
        return None
    return Step(axis.step, axis.curves.step_time, axis.curves.step)
