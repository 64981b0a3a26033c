"""What writing new controller parameters would change, checked before the first write."""

from collections.abc import Mapping
from dataclasses import dataclass
from math import isfinite

from drives.canopen_drive import CanopenDrive
from drives.canopen_drive.conversion import Conversion
from drives.errors import NotSupportedError
from drives.objects import COMMANDS, ObjectAddress, ObjectInfo
from drives.parameters.filters import filter_not_known
from drives.parameters.guard import parameter_types
from drives.parameters.values import Raw, same
from drives.profile import UNKNOWN, ParameterInfo
from drives.profile.drive import CASCADE_PARAMETERS
from drives.units import unit_on

COARSEST = 0.02
"""Relative change of a value by the drive's resolution above which it is not written."""


@dataclass(frozen=True)
class Change:
    """One parameter, old and new, in physical and in the drive's own units."""

    axis: str
    name: str
    unit: str
    info: ObjectInfo
    before: float
    after: float
    """Physical; ``after`` is what the drive can hold next to what was wanted."""
    before_raw: Raw
    after_raw: Raw

    @property
    def differs(self) -> bool:
        """Whether there is anything to write."""
        return not same(self.info, self.before_raw, self.after_raw)

    @property
    def wanted(self) -> str:
        """The new value with its unit."""
        return f"{self.after:.4g} {'' if self.unit == '1' else self.unit}".strip()


@dataclass(frozen=True)
class Written:
    """One parameter after a write: what was read back."""

    change: Change
    read_back: float


def read_parameters(drive: CanopenDrive) -> dict[str, float]:
    """Return the drive's controller parameters by name, physical units.

    Those whose unit the drive's profile does not know are left out.
    """
    conversion = drive.conversion()
    values: dict[str, float] = {}
    for name, parameter in drive.profile.parameters.items():
        if conversion.understood(name):
            values[name] = conversion.physical(name, _number(drive, parameter), values)
    return values


def read_loop(drive: CanopenDrive) -> dict[str, float]:
    """Return the parameters that tell what the drive does with a target: its cascade's gains, or more.

    Of a drive whose gains can not be read in SI they are those that the machine profile gives
    (``loop`` of the axis).

    Raises
    ------
    NotSupportedError
        If neither tells them, or not what a filter does: then nobody knows what a target would do.
    """
    conversion = drive.conversion()
    values = conversion.as_cascade(read_parameters(drive))
    for name, one in drive.profile.parameters.items():
        if name in values and one.follows in values and values[name] != values[one.follows]:
            raise NotSupportedError(
                f"{drive.axis}: {name} is {values[name]:g} and {one.follows} {values[one.follows]:g}; "
                "while they differ the drive changes its gains by itself, and what a target does is not "
                "predicted. Give both the same value first."
            )
    if why := filter_not_known(values, drive.profile):
        raise NotSupportedError(f"{drive.axis}: nobody knows what a target would do: {why}")
    lacking = [name for name in CASCADE_PARAMETERS if name not in values]
    if not lacking:
        return values
    loop = drive.axis_profile.loop
    if loop is None:
        raise NotSupportedError(
            f"{drive.axis}: {', '.join(lacking)} can not be read from the drive in SI units (drive "
            f"profile {drive.profile.name}), so nobody knows what a target would do. Read them with the "
            "maker's software and give them as `loop` at the axis in the machine profile."
        )
    return {**values, **loop.model_dump()}


def planned_changes(drive: CanopenDrive, wanted: Mapping[str, float]) -> tuple[Change, ...]:
    """Return what writing these physical values would change, in the order of writing.

    Raises
    ------
    NotSupportedError
        If the drive has no such parameter, its profile does not know how it is written or what its
        unit is worth, or the value does not fit its range.
    """
    profile = drive.profile
    wanted = {k: v for k, v in wanted.items() if k in profile.parameters or not _is_off(k, v)}
    if wanted and profile.gains_via in NOT_WRITTEN:
        raise NotSupportedError(
            f"{drive.axis}: {NOT_WRITTEN[profile.gains_via].format(profile=profile.name)} "
            f"Enter {', '.join(wanted)} with the maker's software. Nothing was written."
        )
    conversion = drive.conversion()
    held = _with_followers(drive, conversion.as_held(wanted))
    _check_names(drive, held)
    changes = []
    old: dict[str, float] = {}
    new: dict[str, float] = {}
    for name, parameter in profile.parameters.items():
        needed = name in held or any(name in other.times for other in profile.parameters.values())
        if not needed:
            continue
        before = _number(drive, parameter)
        if name not in held:
            if conversion.understood(name):
                old[name] = new[name] = conversion.physical(name, before, old)
            continue
        old[name] = conversion.physical(name, before, old)
        change = _change(drive, conversion, name, float(held[name]), new, before, old[name])
        new[name] = change.after
        changes.append(change)
    return tuple(changes)


def changes_back_to(drive: CanopenDrive, held: Mapping[ObjectAddress, Raw]) -> tuple[Change, ...]:
    """Return what bringing the drive's parameters to values that it held before would change.

    Parameters
    ----------
    drive
        Identified.
    held
        What objects held, in the drive's own units; only the parameters of its profile count.

    Raises
    ------
    NotSupportedError
        If one that would change may not be written, has another unit in this drive now, or is outside
        its range.
    """
    conversion = drive.conversion()
    changes = []
    old: dict[str, float] = {}
    new: dict[str, float] = {}
    for name, parameter in drive.profile.parameters.items():
        before = _number(drive, parameter)
        after = held.get(parameter.object, before)
        if isinstance(after, str):
            raise NotSupportedError(
                f"{drive.axis}, object {parameter.object}: {after!r} is no number"
            )
        known = conversion.understood(name)
        if known:
            old[name] = conversion.physical(name, before, old)
            new[name] = conversion.physical(name, after, new)
        if parameter.object in held:
            unit = unit_on(drive.axis_profile.kind, parameter.unit) if known else "drive units"
            values = (old[name], new[name]) if known else (float(before), float(after))
            change = Change(drive.axis, name, unit, _info(parameter, name), *values, before, after)
            changes.append(change)
            if change.differs:
                if drive.profile.gains_via in NOT_WRITTEN:
                    why = NOT_WRITTEN[drive.profile.gains_via].format(profile=drive.profile.name)
                    raise NotSupportedError(
                        f"{drive.axis}: {why} Enter {name} with the maker's software. "
                        "Nothing was written."
                    )
                if name in conversion.unmet:  # the same number may be another gain now
                    raise NotSupportedError(
                        f"{drive.axis}, {name}: {conversion.unmet[name]} Nothing was written."
                    )
                _check_write_known(drive, name, parameter)
                if known:
                    _check_range(drive, name, parameter, change.after)
    return tuple(changes)


NOT_WRITTEN = {
    "interpreter": "the drive's gains are reached only through its own language, not through objects "
    "(drive profile {profile}).",
    "none": "drive profile {profile} knows no gains of this drive.",
    "read-only": "the drive's gains can be read but not written (drive profile {profile}).",
    "unknown": "drive profile {profile} does not know how the drive's gains are written.",
}
"""Ways to gains (``gains_via``) by which this tool writes nothing, in a sentence each."""


def _with_followers(drive: CanopenDrive, held: Mapping[str, float]) -> dict[str, float]:
    """Add the parameters that always get the value of another one."""
    parameters = drive.profile.parameters
    followers = {
        name: held[one.follows]
        for name, one in parameters.items()
        if one.follows is not None and one.follows in held
    }
    return {**followers, **held}


def _is_off(name: str, value: float) -> bool:
    """Whether this switches a filter off: done already on a drive that has none."""
    return name.startswith("filter") and name.endswith("_type") and value == 0


def _check_names(drive: CanopenDrive, held: Mapping[str, float]) -> None:
    parameters = drive.profile.parameters
    unknown = [name for name in held if name not in parameters]
    if unknown:
        raise NotSupportedError(
            f"{drive.axis}: drive profile {drive.profile.name} has no parameter "
            f"{', '.join(sorted(unknown))}; it has {', '.join(parameters)}."
        )
    types = parameter_types(drive)
    for name, parameter in parameters.items():
        known = types.get(parameter.object, parameter.type)
        if name in held and (parameter.object.index in COMMANDS or known != parameter.type):
            what = "a command" if parameter.object.index in COMMANDS else f"{known} in its EDS"
            raise NotSupportedError(
                f"{drive.axis}, {name}, object {parameter.object}: is {what}, drive profile "
                f"{drive.profile.name} says a parameter of {parameter.type}. Correct the profile. "
                "Nothing was written."
            )
        if name in held:
            _check_write_known(drive, name, parameter)
        moved = [other for other in parameter.times if other in held]
        if moved and name not in held:
            raise NotSupportedError(
                f"{drive.axis}: writing {', '.join(moved)} would change {name} as well, because the "
                "drive holds one by the other. Write them together. Nothing was written."
            )


def _check_write_known(drive: CanopenDrive, name: str, parameter: ParameterInfo) -> None:
    if parameter.write == UNKNOWN:
        raise NotSupportedError(
            f"{drive.axis}, {name}, object {parameter.object}: drive profile {drive.profile.name} "
            "does not know in which state it may be written (`write`). Nothing was written."
        )


def _check_range(drive: CanopenDrive, name: str, parameter: ParameterInfo, value: float) -> None:
    low, high = parameter.minimum, parameter.maximum
    if (low is not None and value < low) or (high is not None and value > high):
        unit = unit_on(drive.axis_profile.kind, parameter.unit)
        raise NotSupportedError(
            f"{drive.axis}, {name}: {value:g} {unit} is outside the drive's range "
            f"{low} to {high} {unit}. Nothing was written."
        )


def _change(
    drive: CanopenDrive,
    conversion: Conversion,
    name: str,
    value: float,
    others: Mapping[str, float],
    before_raw: Raw,
    before: float,
) -> Change:
    parameter = drive.profile.parameters[name]
    unit = unit_on(drive.axis_profile.kind, parameter.unit)
    if not isfinite(value):
        raise NotSupportedError(
            f"{drive.axis}, {name}: {value} is no number that a drive can hold. Design the "
            "parameters again."
        )
    _check_range(drive, name, parameter, value)
    info = _info(parameter, name)
    try:
        held = info.decode(info.encode(conversion.raw(name, value, others)))
    except ValueError as error:
        raise NotSupportedError(
            f"{drive.axis}, {name}, object {parameter.object}: {value:g} {unit} does not fit "
            f"the drive ({error}). Nothing was written."
        ) from None
    after = conversion.physical(name, held, others)
    if abs(after - value) > COARSEST * abs(value):
        raise NotSupportedError(
            f"{drive.axis}, {name}, object {parameter.object}: the drive would hold {after:.3g} "
            f"{unit} for {value:.3g} {unit}; its steps are too coarse. Nothing was written."
        )
    return Change(drive.axis, name, unit, info, before, after, before_raw, held)


def _info(parameter: ParameterInfo, name: str) -> ObjectInfo:
    return ObjectInfo(parameter.object, parameter.type, name)


def _number(drive: CanopenDrive, parameter: ParameterInfo) -> int | float:
    value = drive.read(_info(parameter, str(parameter.object)))
    if isinstance(value, str):
        raise NotSupportedError(f"{drive.axis}, object {parameter.object}: holds text {value!r}.")
    if not isfinite(value):
        raise NotSupportedError(
            f"{drive.axis}, object {parameter.object}: holds {value}, which is no number. Give the "
            "drive's parameter a value first."
        )
    return value
