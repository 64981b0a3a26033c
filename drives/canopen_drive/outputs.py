"""Blocks of targets on their way to the bus: checked against the limits, rounded to drive units.

A block is refused as a whole: nothing of it is sent where one row leaves a limit.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drives.api import FloatArray, Targets
from drives.canopen_drive.channel import Channel
from drives.canopen_drive.torque_offset import LARGEST
from drives.cia402 import Controlword
from drives.errors import SafetyStopError

OUTPUT_ROW = np.dtype([("controlword", "<u2"), ("position", "<i4"), ("torque", "<i2")])


@dataclass(frozen=True, eq=False)
class Outputs:
    """A block as it is sent; n rows, M axes."""

    position: FloatArray
    """Target positions as they were asked for, shape (n, M), rad or m."""
    units: NDArray[np.int32]
    """Target positions as they are sent, shape (n, M), position units."""
    offset_units: NDArray[np.int16]
    """Torque offsets as they are sent, shape (n, M), per mille of the rated torque."""
    torque_offset: FloatArray
    """The same, N m or N."""
    frames: tuple[bytes, ...]
    """Each axis' PDOs, 8 bytes a row."""


def outputs_of(block: FloatArray | Targets, channels: Sequence[Channel], cycle: int) -> Outputs:
    """Return a block as it is sent, with every axis enabled.

    Parameters
    ----------
    block
        Targets, shape (n, M), SI; torque offsets are 0 where none are given.
    channels
        The M axes.
    cycle
        Number of the block's first cycle, for errors.

    Raises
    ------
    SafetyStopError
        If a target is outside the travel, or further from the one before than a following error
        may be; if a torque offset is above the torque limit, or its axis takes none.
    ValueError
        If the shape is wrong, or a value not finite.
    """
    if isinstance(block, Targets):
        targets, offsets = block.position, block.torque_offset
    else:
        targets, offsets = block, np.zeros_like(block, dtype=np.float64)
    n, m = targets.shape[0], len(channels)
    if targets.shape != (n, m) or not np.all(np.isfinite(targets)):
        raise ValueError(f"targets must be finite, of shape (n, {m}), got {targets.shape}")
    if not np.all(np.isfinite(offsets)):
        row, k = np.argwhere(~np.isfinite(offsets))[0].tolist()
        raise ValueError(
            f"{channels[k].drive.axis}: torque offset {offsets[row, k]} in row {row} of a block is "
            "not finite"
        )
    units, offset_units = np.empty((n, m), dtype=np.int32), np.empty((n, m), dtype=np.int16)
    frames: list[bytes] = []
    for k, channel in enumerate(channels):
        rows = np.zeros(n, dtype=OUTPUT_ROW)
        rows["controlword"] = Controlword.ENABLE_OPERATION
        units[:, k] = (
            channel.position if channel.free else _positions(channel, targets[:, k], cycle)
        )
        offset_units[:, k] = _offsets(channel, offsets[:, k], cycle)
        rows["position"], rows["torque"] = units[:, k], offset_units[:, k]
        frames.append(rows.tobytes())
    scales = np.array([c.drive.scaling.torque for c in channels])
    return Outputs(targets, units, offset_units, offset_units * scales, tuple(frames))


def _positions(channel: Channel, targets: FloatArray, cycle: int) -> FloatArray:
    wanted: FloatArray = np.rint(targets / channel.drive.scaling.position)
    _check_inside(channel, wanted, cycle)
    _check_steps(channel, wanted, cycle)
    return wanted


def _check_inside(channel: Channel, wanted: FloatArray, cycle: int) -> None:
    outside = wanted[(wanted < channel.low) | (wanted > channel.high)]
    if outside.size:
        drive = channel.drive
        raise SafetyStopError(
            f"{drive.axis}: a target of {outside[0] * drive.scaling.position:.4g} "
            f"{drive.position_unit} is outside the travel {drive.limits.travel[0]:g} to "
            f"{drive.limits.travel[1]:g} {drive.position_unit}; it was not sent, and all axes "
            "were stopped.",
            axis=drive.axis,
            cycle=cycle,
        )


def _check_steps(channel: Channel, wanted: FloatArray, cycle: int) -> None:
    """Refuse a target further from the one before than a following error may be."""
    begin = channel.position if channel.hold is None else channel.hold
    steps = np.abs(np.diff(wanted, prepend=float(begin)))
    if steps.size and steps.max() > channel.window:
        drive = channel.drive
        scale, unit = drive.scaling.position, drive.position_unit
        raise SafetyStopError(
            f"{drive.axis}: a target would jump by {steps.max() * scale:.4g} {unit} from one cycle "
            f"to the next, more than the following error {channel.window * scale:.4g} {unit} that "
            "is allowed; it was not sent, and all axes were stopped.",
            axis=drive.axis,
            cycle=cycle,
        )


def _offsets(channel: Channel, offsets: FloatArray, cycle: int) -> FloatArray:
    """Return torque offsets in per mille, refusing what is above the limit before or after rounding."""
    drive = channel.drive
    if not channel.takes_offset and np.any(offsets):
        worst = float(offsets[np.argmax(np.abs(offsets))])
        raise SafetyStopError(
            f"{drive.axis}: a torque offset of {worst:.4g} {drive.torque_unit} was asked for, but in "
            "this motion the axis takes none; it was not sent, and all axes were stopped. Give it "
            "position targets alone.",
            axis=drive.axis,
            cycle=cycle,
        )
    scale, limit = drive.scaling.torque, drive.limits.torque
    wanted: FloatArray = np.rint(offsets / scale)
    sizes = np.maximum(np.abs(offsets), np.abs(wanted) * scale)
    allowed, named = limit, "the torque limit"
    if LARGEST * scale < limit:
        allowed, named = LARGEST * scale, "the most that object 0x60B2 holds,"
    if sizes.size and sizes.max() > allowed * (1 + 1e-9):
        raise SafetyStopError(
            f"{drive.axis}: a torque offset of {sizes.max():.4g} {drive.torque_unit} is above {named} "
            f"{allowed:.4g} {drive.torque_unit}; it was not sent, and all axes were stopped. Make the "
            "excitation smaller.",
            axis=drive.axis,
            cycle=cycle,
        )
    return wanted
