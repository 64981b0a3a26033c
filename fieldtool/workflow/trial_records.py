"""What the records of a trial come to: each axis before, as predicted, and after, on one scale."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fieldtool.design.loops import Loops
from fieldtool.design.machine import machine_of, respond
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
from fieldtool.design.verdict import Comparison
from fieldtool.experiment.axes import Axes
from fieldtool.experiment.verification.trial import Tried
from fieldtool.records.model import FloatArray, MachineModel
from fieldtool.report.verification_picture import History
from fieldtool.workflow.trial_plan import TrialPlan


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
        expected = None if frequency is None else self._predicted(plan.new, k, frequency)
        return Comparison(
            move.axis,
            self.axes.unit(k),
            move.distance,
            move.duration,
            move.settling_band,
            _figures(old, k, move.axis, move.settling_band, old_curve),
            _foreseen(plan.after, k, expected),
            _figures(new, k, move.axis, move.settling_band, new_curve),
            old_curve,
            expected,
            new_curve,
        )

    def _sensitivity(self, tried: Tried | None, k: int, servo: Servo) -> Sensitivity | None:
        lines = self.plan.lines
        if tried is None or lines is None:
            return None
        one = tried.excitation
        if one is None or not one.complete or one.period is None:
            return None
        own = lines.axis == k
        name = self.axes.names[k]
        offset = one.extra.get(f"{name}.torque_offset") if np.all(lines.by_torque[own]) else None
        step = self.plan.trial.cycle_time
        rows = slice(-(one.samples // lines.samples - 1) * lines.samples, None)
        return measured_sensitivity(
            Excited(
                lines.number[own],
                lines.samples,
                step,
                one.position[rows, k],
                one.torque[rows, k],
                None if offset is None else offset[rows],
            ),
            servo,
        )

    def _predicted(self, servos: Sequence[Servo], k: int, frequency: FloatArray) -> Sensitivity:
        response = respond(machine_of(self.model), 2 * np.pi * frequency)
        return Sensitivity(
            frequency, np.abs(Loops(response, tuple(servos)).sensitivity[:, k]).astype(np.float64)
        )


def _figures(
    tried: Tried | None, k: int, name: str, band: float, curve: Sensitivity | None
) -> AxisFigures | None:
    one = None if tried is None else tried.move(name)
    if one is None or one.position_reference is None or not one.complete:
        return None
    moves = measured_move(one.time, one.position_reference[:, k], one.position[:, k], band)
    torque = one.torque[:, k]
    return axis_figures(moves, float(np.abs(torque - torque[0]).max()), curve)


def _foreseen(prediction: Prediction, k: int, curve: Sensitivity | None) -> AxisFigures | None:
    axis = prediction.axes[k]
    if axis.move is None:
        return None
    return axis_figures([axis.move], axis.peak_torque, curve)
