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
            "numbers with the maker's software, or, where objects hold them, complete `parameters` in a "
            "drive profile of your own."
        )
    notes += _unused(side)
    if side.unreadable:
        notes.append(f"{axis}: its present parameters can not be compared: {side.unreadable}")
    return notes


def _unused(side: DriveSide) -> list[str]:
    """Return what feed-forward stays as it is, and whether predictions are right all the same."""
    off = [name for name, value in side.unused.items() if value == 0]
    notes = [
        f"{side.axis}: {name} is 0 in the drive and stays so: a design does not use it."
        for name in off
    ]
    present = side.present or {}
    for name, value in side.unused.items():
        if name in off:
            continue
        known = "not known" if value is None else f"{value:.6g} in the drive's own units"
        held = side.words(name, present[name]) if name in present else known
        notes.append(
            f"{side.axis}: {name} ({held}) stays as it is in the drive: a design does not choose it, "
            "and what is predicted of moves does not have it (margins do not depend on it). For moves "
            "as predicted set it to 0 with the maker's software, and measure anew."
        )
    return notes
