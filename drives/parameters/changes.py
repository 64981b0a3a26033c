"""What writing new controller parameters would change, checked before the first write."""

from collections.abc import Mapping
from dataclasses import dataclass
from math import isfinite

from drives.canopen_drive import CanopenDrive
from drives.errors import NotSupportedError
from drives.objects import ObjectInfo
from drives.parameters.values import Raw
from drives.profile import ParameterInfo
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
        return self.before_raw != self.after_raw


@dataclass(frozen=True)
class Written:
    """One parameter after a write: what was read back."""

    change: Change
    read_back: float


def read_parameters(drive: CanopenDrive) -> dict[str, float]:
    """Return the drive's controller parameters by name, physical units."""
    return {
        name: _number(drive, parameter) * parameter.scale
        for name, parameter in drive.profile.parameters.items()
    }


def planned_changes(drive: CanopenDrive, wanted: Mapping[str, float]) -> tuple[Change, ...]:
    """Return what writing these physical values would change, in the order of writing.

    Raises
    ------
    NotSupportedError
        If the drive has no such parameter, or the value does not fit its range.
    """
    unknown = set(wanted) - set(drive.profile.parameters)
    if unknown:
        raise NotSupportedError(
            f"{drive.axis}: drive profile {drive.profile.name} has no parameter "
            f"{', '.join(sorted(unknown))}; it has {', '.join(drive.profile.parameters)}."
        )
    changes = []
    for name, parameter in drive.profile.parameters.items():
        if name not in wanted:
            continue
        value = float(wanted[name])
        unit = unit_on(drive.axis_profile.kind, parameter.unit)
        if not isfinite(value):
            raise NotSupportedError(
                f"{drive.axis}, {name}: {value} is no number that a drive can hold. Design the "
                "parameters again."
            )
        low, high = parameter.minimum, parameter.maximum
        if (low is not None and value < low) or (high is not None and value > high):
            raise NotSupportedError(
                f"{drive.axis}, {name}: {value:g} {unit} is outside the drive's range "
                f"{low} to {high} {unit}. Nothing was written."
            )
        info = _info(parameter, name)
        exact = value / parameter.scale
        raw: Raw = exact if parameter.type.startswith("REAL") else round(exact)
        try:
            held = info.decode(info.encode(raw))
        except ValueError as error:
            raise NotSupportedError(
                f"{drive.axis}, {name}, object {parameter.object}: {value:g} {unit} does not fit "
                f"the drive ({error}). Nothing was written."
            ) from None
        if abs(float(held) * parameter.scale - value) > COARSEST * abs(value):
            raise NotSupportedError(
                f"{drive.axis}, {name}, object {parameter.object}: the drive holds it in steps of "
                f"{parameter.scale:g} {unit}, which is too coarse for {value:.3g} {unit}. Nothing was "
                "written."
            )
        before = _number(drive, parameter)
        changes.append(
            Change(
                drive.axis,
                name,
                unit,
                info,
                before * parameter.scale,
                float(held) * parameter.scale,
                before,
                held,
            )
        )
    return tuple(changes)


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
