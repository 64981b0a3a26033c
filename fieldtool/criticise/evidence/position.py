"""What an error of the torque makes of the position.

A torque d that the model does not know moves the motors by (Z + K)^-1 d, Z the dynamic stiffness of
the machine and K the loops' torque per position where the recording states the controllers; without
them the loop is open, and only lines with excitation are counted (below them a free axis drifts).
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from fieldtool.criticise.evidence.lines import Lines, unflat
from fieldtool.criticise.simulate.inverse import dynamic_stiffness
from fieldtool.criticise.simulate.structure import Structure
from fieldtool.records.closed_loop import AxisLoop
from fieldtool.records.recording import AxisInfo

FloatArray = NDArray[np.float64]
EXCITED = 0.01
"""Of the largest line of the torque: a line is excited from here on."""


def loops_of(axes: Sequence[AxisInfo]) -> tuple[AxisLoop | None, ...]:
    """Return the controllers that the recording states, None where it does not."""
    return tuple(
        AxisLoop(c.position_p, c.velocity_p, c.velocity_i) if (c := axis.controller) else None
        for axis in axes
    )


def position_error(
    structure: Structure,
    axes: Sequence[AxisInfo],
    parts: Sequence[tuple[Lines, FloatArray]],
) -> tuple[float, ...]:
    """Return RMS of the position's error over RMS of its motion, per axis.

    Parameters
    ----------
    structure : Structure
    axes : sequence of AxisInfo
    parts : sequence of (Lines, ndarray)
        Weighted errors of the torque.
    """
    loops = loops_of(axes)
    lost, whole = np.zeros(len(axes)), np.zeros(len(axes))
    for lines, values in parts:
        count = lines.weight.shape[0]
        seconds = (lines.span.stop - lines.span.start) * lines.motion.step
        omega: FloatArray = np.asarray(2 * np.pi / seconds * np.arange(1.0, count))
        torque = np.abs(lines.raw(lines.motion.torque)[1:])
        excited = np.any(torque > EXCITED * torque.max(axis=0), axis=1)
        if all(loop is not None for loop in loops):
            excited[:] = True
        if not excited.any():
            continue
        stiff = dynamic_stiffness(structure, omega[excited])
        for k, loop in enumerate(loops):
            if loop is not None:
                stiff[:, k, k] += [loop.gain(1j * w) for w in omega[excited]]
        weight = np.where(lines.weight > 0, lines.weight, np.inf)
        error = (unflat(values, len(axes)) / weight)[1:][excited]
        moved = np.linalg.solve(stiff, error[:, :, None])[:, :, 0]
        position = lines.raw(lines.motion.position - lines.motion.position.mean(axis=0))[1:]
        lost += np.sum(np.abs(moved) ** 2, axis=0)
        whole += np.sum(np.abs(position[excited]) ** 2, axis=0)
    ratio = np.sqrt(lost / np.where(whole > 0.0, whole, np.inf))
    return tuple(ratio.tolist())
