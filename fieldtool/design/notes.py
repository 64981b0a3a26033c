"""What a drive's ranges, steps and limits mean for a design: sentences for a technician."""

from collections.abc import Mapping

from drives.units import unit_on
from fieldtool.design.drive_side import DriveSide
from fieldtool.design.predict import AxisPrediction

ABOVE = 1.001
"""Times its torque limit from which a move is told to take more."""


def drive_notes(
    side: DriveSide, predicted: AxisPrediction, parameters: Mapping[str, float]
) -> list[str]:
    """Return what an axis' drive does to the design, a sentence each.

    Parameters
    ----------
    side
        The drive.
    predicted
        What the axis will do on its move.
    parameters
        New ones, as the drive holds them; empty where the present ones are kept.
    """
    axis, notes = side.axis, []
    if most := side.largest(parameters):
        notes.append(
            f"{axis}: the largest that its drive holds: {', '.join(most)}. More would serve: choose "
            "other units or ranges in the drive."
        )
    if least := side.smallest(parameters):
        notes.append(
            f"{axis}: one step of its drive, which holds nothing between this and 0: "
            f"{', '.join(least)}. Less may serve better: choose finer units in the drive."
        )
    if predicted.peak_torque > ABOVE * side.torque_limit:
        unit = unit_on(side.kind, "N m")
        notes.append(
            f"{axis}: its move is predicted to take {predicted.peak_torque:.3g} {unit} with friction "
            f"and feedback, above its torque limit of {side.torque_limit:.3g} {unit}: ask for less "
            "acceleration (`typical_move` in the machine profile), or raise the limit if motor and "
            "drive bear it."
        )
    if side.missing:
        notes.append(
            f"{axis}: its drive profile has no {', '.join(side.missing)} that can be written; enter the "
            "numbers with the maker's software, or complete `parameters` in a drive profile of your own."
        )
    if side.unreadable:
        notes.append(f"{axis}: its present parameters can not be compared: {side.unreadable}")
    return notes
