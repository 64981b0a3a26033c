"""Steady phasors of multisines, experiment by experiment, however few there are."""

from collections.abc import Sequence

from fieldtool.frf.multisine.inputs import joint_input, with_lines
from fieldtool.frf.multisine.lines import LinePhasors, line_phasors
from fieldtool.frf.phasors import Phasors
from fieldtool.records.recording import Experiment, Recording


def phasors_of(recording: Recording, experiments: Sequence[Experiment]) -> tuple[Phasors, ...]:
    """Return the steady phasors of each experiment at its excited lines, however few there are."""
    return tuple(one.phasors(recording.names) for one in lines_of(recording, experiments))


def lines_of(recording: Recording, experiments: Sequence[Experiment]) -> tuple[LinePhasors, ...]:
    """Return the steady phasors of each experiment at all lines, however few there are."""
    if not experiments:
        return ()
    inputs = [with_lines(recording, joint_input(recording, one)) for one in experiments]
    return tuple(line_phasors(recording, inputs))
