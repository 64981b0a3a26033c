"""What a design needs to know of a machine's drives and axes, from its profile and session folder."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from math import inf, isfinite, nan, pi
from pathlib import Path

import h5py
import numpy as np

from drives.canopen_drive.conversion import Conversion, unmet_conditions
from drives.canopen_drive.group import profile_of
from drives.errors import NotSupportedError, ProfileError
from drives.objects import ObjectAddress, ObjectInfo
from drives.parameters import DriveBackup, load_backup
from drives.parameters.filters import filter_not_known
from drives.profile import UNKNOWN, AxisProfile, DriveProfile, MachineProfile
from drives.profile.eds import range_at, read_eds
from fieldtool.design.drive_side import FEED_FORWARD, FILTERS, GAINS, DriveSide, Hold
from fieldtool.design.moves import JERK_SHARE, SHORTEST_JERK, TestMove, typical_move
from fieldtool.design.servo import CAUTIOUS_LAG, CAUTIOUS_PERIOD, Timing
from fieldtool.records.model import MachineModel
from fieldtool.records.session_folder import SessionFolder

SEEN = 20_000
"""Rows of a recording in which the steps of its encoders are looked for."""
REAL_LARGEST = {"REAL32": 3.4e38, "REAL64": 1.7e308}


def moves_of(
    machine: MachineProfile, model: MachineModel, recording: Path | None = None
) -> tuple[TestMove, ...]:
    """Return the typical move of each axis: the profile's, or one that follows from the limits.

    A move follows the unit of the limits; it never takes more than the axis' torque limit allows a
    rigid axis of the model's masses.  It starts where the axis stood when a recording began.
    """
    masses = {axis.name: axis.total_mass for axis in model.axes}
    stood = {} if recording is None else _stood(recording)
    return tuple(
        replace(_move(axis, masses[axis.name]), start=stood.get(axis.name)) for axis in machine.axes
    )


def _stood(recording: Path) -> dict[str, float]:
    """Return where each axis stood when a recording began, rad or m; of none where nobody knows."""
    try:
        with h5py.File(recording, "r") as file:
            names = [str(group.attrs.get("name", key)) for key, group in file["axes"].items()]
            first = next(iter(file["experiments"].values()))["position"][0]
            return {n: float(at) for n, at in zip(names, first, strict=True) if isfinite(at)}
    except (OSError, KeyError, ValueError, TypeError, StopIteration, IndexError):
        return {}


def _move(axis: AxisProfile, mass: float) -> TestMove:
    limits, wanted = axis.limits, axis.typical_move
    if wanted is None:
        return typical_move(
            axis.name,
            (limits.travel[0], limits.travel[1]),
            limits.velocity,
            limits.acceleration,
            limits.torque,
            mass,
        )
    rise = max(JERK_SHARE * wanted.velocity / wanted.acceleration, SHORTEST_JERK)
    return TestMove(
        axis.name,
        wanted.distance,
        wanted.velocity,
        wanted.acceleration,
        wanted.jerk or wanted.acceleration / rise,
        wanted.band or 0.0,
    )


def timing_of(profile: DriveProfile, cycle: float = 0.0) -> Timing:
    """Return when a drive's loops act; cautious numbers where its profile does not know.

    Parameters
    ----------
    profile
        Of the drive.
    cycle
        s, from one cyclic target to the next.
    """
    period = CAUTIOUS_PERIOD if profile.loop_period == UNKNOWN else float(profile.loop_period)
    return Timing(profile.torque_lag or CAUTIOUS_LAG, period, cycle)


@dataclass(frozen=True)
class _Kept:
    """What the session folder holds of one drive."""

    backup: DriveBackup | None
    why_not: str
    rated_torque: float
    """NaN where nobody kept it."""
    counts_per_rev: float
    step: float
    """Smallest change of position that was recorded, rad or m; NaN where nothing was."""


def drive_sides(
    folder: SessionFolder, machine: MachineProfile, cycle: float | None = None
) -> tuple[DriveSide, ...]:
    """Return what each axis' drive allows a design to use, and what it holds now.

    Present parameters are those of ``parameters-before.yaml``; where they can not be read, the
    axis' side says why.

    Parameters
    ----------
    folder
        Session folder.
    machine
        Its machine profile.
    cycle
        s, from one cyclic target to the next; None: that of the recording.
    """
    kept = _kept(folder, machine)
    sampled = _sample_period(folder.recording) if cycle is None else cycle
    return tuple(_side(axis, machine, kept[axis.name], sampled) for axis in machine.axes)


def _side(axis: AxisProfile, machine: MachineProfile, kept: _Kept, cycle: float) -> DriveSide:
    profile = profile_of(axis, machine)
    resolution = nan
    if axis.feed is not None and isfinite(kept.counts_per_rev):
        resolution = axis.feed / kept.counts_per_rev
    elif axis.kind == "rotary" and isfinite(kept.counts_per_rev):
        resolution = 2 * pi / kept.counts_per_rev
    else:
        resolution = kept.step
    conversion = _conversion(axis, profile, kept)
    present, why = _present(axis, profile, conversion, kept)
    return DriveSide(
        axis.name,
        profile.tunable,
        timing_of(profile, cycle),
        axis.limits.torque,
        resolution,
        _holds(profile, conversion),
        present,
        why,
        axis.kind,
        profile.structure == "pid",
        _unused(profile, kept),
        profile.by_hand,
    )


def _unused(profile: DriveProfile, kept: _Kept) -> dict[str, float | None]:
    """Return the feed-forward that no design chooses, and what the drive holds of it."""
    return {
        name: None if kept.backup is None else _held(kept.backup, profile.parameters[name].object)
        for name in profile.feed_forward
        if name not in FEED_FORWARD or name not in profile.tunable
    }


def _kept(folder: SessionFolder, machine: MachineProfile) -> dict[str, _Kept]:
    backups: dict[str, DriveBackup] = {}
    why = ""
    try:
        backups = {d.axis: d for d in load_backup(folder.parameters_before).drives}
    except (ProfileError, OSError) as error:
        why = f"{error}"
        if not folder.parameters_before.is_file():
            why = f"there is no {folder.parameters_before.name} in the session folder."
    numbers = _axes_of(folder.recording)
    out = {}
    for axis in machine.axes:
        rated, counts, step = numbers.get(axis.name, (nan, nan, nan))
        backup = backups.get(axis.name)
        lacking = why or f"{folder.parameters_before.name} has nothing of this axis."
        if axis.encoder_counts_per_rev is not None and not isfinite(counts):
            counts = float(axis.encoder_counts_per_rev)
        if backup is not None and not isfinite(counts):
            counts = _counts_per_rev(profile_of(axis, machine), backup)
        out[axis.name] = _Kept(backup, "" if backup else lacking, rated, counts, step)
    return out


def _counts_per_rev(profile: DriveProfile, backup: DriveBackup) -> float:
    """Return the position units of a motor revolution that a drive held; NaN where it tells none."""
    scale = profile.position
    if isinstance(scale, str) or isinstance(scale.counts, str):
        return nan
    revolutions = None if scale.revolutions is None else _held(backup, scale.revolutions)
    return (_held(backup, scale.counts) or nan) / (revolutions or 1)


def _held(backup: DriveBackup, address: ObjectAddress) -> float | None:
    for one in backup.held:
        if one.info.address == address and not isinstance(one.value, str):
            return float(one.value)
    return None


def _axes_of(recording: Path) -> dict[str, tuple[float, float, float]]:
    """Return rated torque, counts a revolution and step of each axis, as a recording keeps them."""
    try:
        with h5py.File(recording, "r") as file:
            steps = _steps(file)
            return {
                str(group.attrs.get("name", key)): (
                    float(group.attrs.get("rated_torque", nan)),
                    float(group.attrs.get("encoder_counts_per_rev", nan)),
                    steps[k] if k < len(steps) else nan,
                )
                for k, (key, group) in enumerate(file["axes"].items())
            }
    except (OSError, KeyError, ValueError, TypeError):
        return {}


def _steps(file: h5py.File) -> list[float]:
    """Return the smallest change of position of each axis in the first experiment."""
    for experiment in file["experiments"].values():
        moved = np.abs(np.diff(experiment["position"][:SEEN], axis=0))
        least = 1e-12 * max(float(moved.max(initial=0.0)), 1e-300)
        return [float(one[one > least].min(initial=inf)) for one in moved.T]
    return []


def _sample_period(recording: Path) -> float:
    try:
        with h5py.File(recording, "r") as file:
            return float(file.attrs["sample_period"])
    except (OSError, KeyError, ValueError, TypeError):
        return 0.0


def _conversion(axis: AxisProfile, profile: DriveProfile, kept: _Kept) -> Conversion:
    quantities: dict[str, float] = {}
    if isfinite(kept.rated_torque):
        quantities["rated_torque"] = kept.rated_torque
    if isfinite(kept.counts_per_rev):
        quantities["counts_per_rev"] = kept.counts_per_rev
    for name, quantity in profile.quantities.items():
        value = None if kept.backup is None else _held(kept.backup, quantity.object)
        if value is not None and quantity.scale != UNKNOWN:
            quantities[name] = value * float(quantity.scale)
    unmet = {} if kept.backup is None else unmet_conditions(profile, _whole_of(kept.backup))
    return Conversion(axis.name, profile, quantities, unmet)


def _whole_of(backup: DriveBackup) -> Callable[[ObjectInfo], int | None]:
    """Return what tells an object's value in a backup; None of one that it does not have."""

    def value_of(info: ObjectInfo) -> int | None:
        value = _held(backup, info.address)
        return None if value is None else int(value)

    return value_of


def _present(
    axis: AxisProfile, profile: DriveProfile, conversion: Conversion, kept: _Kept
) -> tuple[dict[str, float] | None, str]:
    """Return what the drive holds now, or why nobody knows."""
    given = dict(axis.loop.model_dump()) if axis.loop is not None else None
    if kept.backup is None:
        return given, "" if given else kept.why_not
    values: dict[str, float] = {}
    try:
        for name, parameter in profile.parameters.items():
            raw = _held(kept.backup, parameter.object)
            if raw is not None and conversion.understood(name):
                values[name] = conversion.physical(name, raw, values)
        values = conversion.as_cascade(values)
    except NotSupportedError as error:
        return given, "" if given else str(error)
    if why := filter_not_known(values, profile) or _filter_at_no_frequency(values, axis, profile):
        return None, why
    if any(name not in values for name in GAINS):
        lacking = ", ".join(name for name in GAINS if name not in values)
        why = (
            f"{lacking} can not be read in SI units (drive profile {profile.name}); give them as `loop` "
            "at the axis in the machine profile."
            + "".join(f" {name}: {words}" for name, words in conversion.unmet.items())
        )
        return (values | given if given else None), "" if given else why
    return values, ""


def _filter_at_no_frequency(
    values: Mapping[str, float], axis: AxisProfile, profile: DriveProfile
) -> str:
    """Return which filter is on at 0 Hz and stays so, because it can not be set; empty: none."""
    settable = DriveSide(axis.name, profile.tunable).filters
    for k in FILTERS:
        on = values.get(f"filter{k}_type", 0.0) != 0
        if on and k not in settable and not values[f"filter{k}_frequency"] > 0:
            return (
                f"filter {k} is on, at {values[f'filter{k}_frequency']:g} Hz, and can not be set by "
                "this tool. Switch it off in the drive, or give it a frequency above 0 there."
            )
    return ""


def _holds(profile: DriveProfile, conversion: Conversion) -> dict[str, Hold]:
    """Return how the drive holds parameters of known units: within their types and the EDS' limits."""
    dictionary = None if profile.eds_path is None else read_eds(profile.eds_path)
    if dictionary is not None:
        profile = profile.with_types_of(dictionary)
    holds = {}
    for name, parameter in profile.parameters.items():
        if not conversion.understood(name) or parameter.told_type == UNKNOWN:
            continue
        times = {o: power for o, power in parameter.times.items() if o not in conversion.quantities}
        scale = conversion.physical(name, 1, dict.fromkeys(times, 1.0))
        if not (isfinite(scale) and scale > 0):
            continue
        taken = range_at(dictionary, ObjectInfo(parameter.object, parameter.type, name))
        whole = taken is not None
        if taken is not None:
            low, high = (float(n) for n in taken)
        else:
            high = REAL_LARGEST[parameter.type]
            low = -high
        holds[name] = Hold(
            scale,
            parameter.power,
            whole,
            low,
            high,
            -inf if parameter.minimum is None else parameter.minimum,
            inf if parameter.maximum is None else parameter.maximum,
            times,
        )
    return holds
