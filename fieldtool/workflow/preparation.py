"""What every measurement begins with: what planning has to know, and the recording's heading."""

from dataclasses import replace

import numpy as np

from drives.api import AxisLimits
from drives.canopen_drive import CanopenDrive, CanopenGroup
from drives.canopen_drive.settings import following_error_window
from drives.parameters import read_loop
from drives.profile import MachineProfile
from fieldtool.errors import PlanRefusedError
from fieldtool.experiment.axes import Axes
from fieldtool.experiment.forecast import Setting
from fieldtool.experiment.multisine.unit_inputs import smooth
from fieldtool.frf.held_targets import LINEAR_TARGETS
from fieldtool.records.closed_loop import AxisLoop, loop_from_parameters
from fieldtool.records.model import MachineModel
from fieldtool.records.recording import AxisInfo, Controller, Recording

SEEN_COUNTS = 4
"""Counts of its encoder that an axis has to move in any motion that is to tell something."""


def setting_of(machine: MachineProfile, group: CanopenGroup, model: MachineModel) -> Setting:
    """Return model, loops as they are in the drives now, limits, and centres.

    Where a drive's own following error window is tighter than the profile's, it is the limit.
    """
    loops = tuple(loop_from_parameters(read_loop(drive)) for drive in group.drives)
    return Setting(
        model,
        loops,
        tuple(_within_window(*pair) for pair in zip(group.drives, loops, strict=True)),
        np.array([sum(axis.limits.travel) / 2 for axis in machine.axes]),
    )


def without_feed_forward(drive: CanopenDrive, loop: AxisLoop) -> AxisLoop:
    """Return a drive's loop with that feed-forward off that can be switched off."""
    switched = drive.profile.feed_forward
    return replace(
        loop,
        velocity_ff=0.0 if "velocity_ff" in switched else loop.velocity_ff,
        viscous_ff=0.0 if "viscous_ff" in switched else loop.viscous_ff,
        inertia_ff=0.0 if "inertia_ff" in switched else loop.inertia_ff,
    )


def _within_window(drive: CanopenDrive, loop: AxisLoop) -> AxisLimits:
    """Limits of an axis within the drive's own window, feed-forward off: the error grows with speed."""
    limits, window = drive.limits, following_error_window(drive)
    if window is None or window >= limits.following_error:
        return limits
    velocity = (
        min(limits.velocity, window * loop.position_p) if loop.position_p else limits.velocity
    )
    return replace(limits, following_error=window, velocity=velocity)


def check_seen(drive: CanopenDrive, way: float, what: str) -> None:
    """Refuse a motion that its encoder would hardly see.

    Raises
    ------
    PlanRefusedError
        If it is shorter than SEEN_COUNTS of the encoder.
    """
    count = abs(drive.scaling.position)
    if way < SEEN_COUNTS * count:
        unit = drive.position_unit
        raise PlanRefusedError(
            f"{drive.axis}: within its limits {what} can be {way:.2g} {unit} at most, its encoder "
            f"counts {count:.2g} {unit}: less than {SEEN_COUNTS} counts tell nothing. Nothing was "
            "moved. Widen travel, velocity, acceleration, torque or following_error in the machine "
            "profile, as far as the machine allows."
        )


def window_notes(group: CanopenGroup, setting: Setting) -> tuple[str, ...]:
    """Say which drives' own windows are tighter than the profile's limits."""
    return tuple(
        f"{drive.axis}: the drive's own following error window (0x6065) is {own.following_error:.4g} "
        f"{drive.position_unit}, the profile allows {drive.limits.following_error:.4g} "
        f"{drive.position_unit}. The plan keeps within the drive's, at {own.velocity:.3g} "
        f"{drive.position_unit}/s or less; a wider window, if the machine allows one, tells more."
        for drive, own in zip(group.drives, setting.limits, strict=True)
        if own.following_error < drive.limits.following_error
    )


def recording_header(
    machine: MachineProfile, group: CanopenGroup, cycle_time: float, *, with_lengths: bool
) -> Recording:
    """Return a recording without experiments, with all that is known of the axes.

    ``with_lengths`` puts the prior model's numbers of masses into it; without, they are to be found.
    """
    axes = []
    for axis, drive in zip(machine.axes, group.drives, strict=True):
        values = read_loop(drive)
        rotary = axis.kind == "rotary"
        axes.append(
            AxisInfo(
                name=axis.name,
                kind=axis.kind,
                masses=len(axis.prior.masses) if with_lengths else None,
                motor_inertia=axis.motor_inertia.value if axis.motor_inertia else None,
                rated_torque=drive.rated_torque,
                encoder_counts_per_rev=(2 * np.pi / drive.scaling.position if rotary else None),
                controller=Controller(
                    values["position_p"],
                    values["velocity_p"],
                    values["velocity_i"],
                    axis.limits.torque,
                ),
                torque_unit="N m" if rotary else "N",
                position_unit="rad" if rotary else "m",
            )
        )
    source = {"machine": machine.name}
    linear = [
        _linear_targets(d)
        for d in group.drives
        if not smooth(loop_from_parameters(read_loop(d)), 2 * np.pi / cycle_time)
    ]
    if linear:
        source[LINEAR_TARGETS] = " ".join(linear)
    return Recording(cycle_time, tuple(axes), (), machine.description, source)


def _linear_targets(drive: CanopenDrive) -> str:
    """Return what a recording says of a drive that goes straight from target to target, or may."""
    known = drive.profile.interpolation == "linear"
    lag = f"{drive.axis}={drive.profile.torque_lag if known else '?'}"
    if "velocity_ff" in drive.profile.feed_forward:
        return lag  # it is switched off while frequency responses are measured
    share = read_loop(drive).get("velocity_ff", 0.0)
    return f"{lag}/{share!r}" if share else lag


def axes_of(group: CanopenGroup, setting: Setting) -> Axes:
    """Return what the runners have to know of the axes."""
    units = tuple(drive.position_unit for drive in group.drives)
    resolution = np.array([drive.scaling.position for drive in group.drives])
    inertia = np.array([sum(m.value for m in axis.masses) for axis in setting.model.axes])
    stiffness = np.array([loop.position_p * loop.velocity_p for loop in setting.loops])
    return Axes(
        group.axes,
        setting.limits,
        setting.centre,
        units,
        resolution,
        inertia,
        stiffness,
        np.array([loop.position_p for loop in setting.loops]),
        group.torque_offsets,
    )
