"""Controller parameters: back up, compare, write in order, read back, restore, store.

Nothing here writes to a drive that is enabled.  Before the first write everything that could be
written is in a backup, and whatever fails during a write, all drives get their old values back.
"""

import hashlib
import json
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from math import isfinite
from pathlib import Path
from typing import Any

import yaml

from drives.canopen_drive import CanopenDrive
from drives.canopen_drive.interrupts import uninterrupted
from drives.cia402 import PowerState
from drives.errors import (
    DriveFaultError,
    DrivesError,
    NotSupportedError,
    ProfileError,
    SdoAbortError,
    StoppedError,
    WriteBackError,
    WriteBackMixedError,
    WrongDeviceError,
)
from drives.objects import DATA_TYPES, ObjectAddress, ObjectInfo
from drives.profile import ParameterInfo, read_yaml
from drives.units import unit_on

FORMAT = "fieldtool-parameters/1"
MAX_BACKUP_BYTES = 30_000_000
"""A drive has some thousand objects of 100 bytes here; a machine at most 32 drives."""
_DUMPER: Any = getattr(yaml, "CSafeDumper", yaml.SafeDumper)
SAVE_SIGNATURE = int.from_bytes(b"save", "little")
DISABLED_STATES = (PowerState.SWITCH_ON_DISABLED, PowerState.READY_TO_SWITCH_ON)
COARSEST = 0.02
"""Relative change of a value by the drive's resolution above which it is not written."""
Raw = int | float | str


@dataclass(frozen=True)
class HeldObject:
    """What one object of a drive held."""

    info: ObjectInfo
    value: Raw


@dataclass(frozen=True)
class DriveBackup:
    """Every writable parameter of one drive, and who the drive is."""

    axis: str
    node_id: int
    vendor_id: int
    product_code: int
    serial_number: int
    held: tuple[HeldObject, ...]


@dataclass(frozen=True)
class Backup:
    """Every writable parameter of all drives of a machine."""

    machine: str
    taken: str
    """UTC, ISO 8601."""
    drives: tuple[DriveBackup, ...]


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


# --- backup ------------------------------------------------------------------------------------


def back_up(machine: str, drives: Iterable[CanopenDrive]) -> Backup:
    """Read every writable parameter of every drive.

    Left out are write-only objects, and those whose value could not be written again: numbers that
    are not finite, text that is no ASCII.
    """
    parts = []
    for drive in drives:
        held = []
        for info in drive.writable_parameters():
            try:
                one = HeldObject(info, drive.read(info))
            except SdoAbortError as error:
                if error.code not in (0x06010001, 0x06020000, 0x06090011):
                    raise
                continue
            if _can_be_written(one):
                held.append(one)
        identity = drive.identity
        parts.append(
            DriveBackup(
                drive.axis,
                drive.node_id,
                identity.vendor_id,
                identity.product_code,
                identity.serial_number,
                tuple(held),
            )
        )
    return Backup(machine, datetime.now(UTC).isoformat(timespec="seconds"), tuple(parts))


def _can_be_written(held: HeldObject) -> bool:
    try:
        held.info.encode(held.value)
    except ValueError:
        return False
    return True


def save_backup(backup: Backup, path: Path) -> None:
    """Write a backup to a YAML file, and see that it is read back the same.

    Raises
    ------
    OSError
        If the file can not be written; what was there before is unchanged.
    ProfileError
        If what was written is not read back the same.
    """
    parts = [_drive_as_dict(d) for d in backup.drives]
    data = {
        "format": FORMAT,
        "machine": backup.machine,
        "taken": backup.taken,
        "checksum": _checksum(parts),
        "drives": parts,
    }
    temporary = path.with_name(path.name + ".part")
    try:
        with temporary.open("w", encoding="utf-8") as file:
            yaml.dump(data, file, Dumper=_DUMPER, sort_keys=False, width=120)
            file.flush()
            os.fsync(file.fileno())
        if load_backup(temporary) != backup:
            raise ProfileError(path, "the backup is not read back as it was written")
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def _drive_as_dict(drive: DriveBackup) -> dict[str, Any]:
    return {
        "axis": drive.axis,
        "node_id": drive.node_id,
        "vendor_id": drive.vendor_id,
        "product_code": drive.product_code,
        "serial_number": drive.serial_number,
        "objects": [
            {
                "object": str(held.info.address),
                "name": held.info.name,
                "type": held.info.type,
                "value": held.value,
            }
            for held in drive.held
        ],
    }


def _checksum(parts: Any) -> str:
    """Return the SHA-256 of the drives' part of a backup, in one spelling of its values."""
    text = json.dumps(parts, sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()


def load_backup(path: Path) -> Backup:
    """Read a backup file.

    Raises
    ------
    ProfileError
        If the file is no backup, or not whole: with file and line.
    """
    data, lines = read_yaml(path, MAX_BACKUP_BYTES)
    if data.get("format") != FORMAT:
        raise ProfileError(path, f"format must be {FORMAT}, got {data.get('format')!r}", 1)
    place: list[str | int] = []
    try:
        backup = Backup(
            str(data["machine"]),
            str(data["taken"]),
            tuple(
                _drive_backup(drive, k, place) for k, drive in enumerate(_listed(data["drives"]))
            ),
        )
    except (KeyError, TypeError, AttributeError, ValueError, ArithmeticError) as error:
        what = f"key {error} is missing" if isinstance(error, KeyError) else str(error)
        line = lines.get(tuple(place), 1)
        raise ProfileError(path, f"is no parameter backup: {what}", line) from None
    if data.get("checksum") != _checksum(data["drives"]):
        raise ProfileError(
            path,
            "is not whole: its checksum does not fit what stands in it. It was cut short or changed; "
            "use another copy",
            lines.get(("checksum",), 1),
        )
    return backup


def _listed(value: Any) -> list[Any]:
    if not isinstance(value, list):
        raise TypeError(f"a list was expected, got {value!r}")
    return value


def _drive_backup(drive: Mapping[str, Any], k: int, place: list[str | int]) -> DriveBackup:
    place[:] = ["drives", k]
    held: dict[ObjectAddress, HeldObject] = {}
    for j, item in enumerate(_listed(drive["objects"])):
        place[:] = ["drives", k, "objects", j]
        one = _held(item)
        if one.info.address in held:
            raise ValueError(f"object {one.info.address} stands here a second time")
        held[one.info.address] = one
    place[:] = ["drives", k]
    return DriveBackup(
        str(drive["axis"]),
        int(drive["node_id"]),
        int(drive["vendor_id"]),
        int(drive["product_code"]),
        int(drive["serial_number"]),
        tuple(held.values()),
    )


def _held(item: Mapping[str, Any]) -> HeldObject:
    if item["type"] not in DATA_TYPES:
        raise ValueError(f"unknown type {item['type']!r}")
    info = ObjectInfo(ObjectAddress.parse(item["object"]), item["type"], str(item["name"]))
    info.encode(item["value"])
    return HeldObject(info, item["value"])


# --- write -------------------------------------------------------------------------------------


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


def write(drives: Sequence[CanopenDrive], changes: Sequence[Change]) -> tuple[Written, ...]:
    """Write what differs, in order, and read everything back; all or nothing.

    Raises
    ------
    DriveFaultError
        If a drive is enabled; nothing was written.
    WriteBackError
        If a drive refused or holds another value afterwards; all drives hold their old values.
    WriteBackMixedError
        If the old values could not be brought back either; says which drive holds what.
    """
    by_axis = {d.axis: d for d in drives}
    check_disabled(drives)
    started: list[Change] = []
    try:
        for change in changes:
            if change.differs:
                started.append(change)
                by_axis[change.axis].write(change.info, change.after_raw)
        written = tuple(_read_back(by_axis[change.axis], change) for change in changes)
    except BaseException as error:
        with uninterrupted():
            _roll_back(by_axis, started, error)
        if isinstance(error, DrivesError) and not isinstance(error, StoppedError):
            raise WriteBackError(
                f"{error} Nothing was changed: all parameters were restored and read back."
            ) from error
        raise
    return written


def _read_back(drive: CanopenDrive, change: Change) -> Written:
    found = drive.read(change.info)
    if found != change.after_raw:
        raise _MismatchError(
            f"{change.axis}, {change.name}, object {change.info.address}: wrote {change.after_raw}, "
            f"the drive holds {found}."
        )
    return Written(change, float(found) * drive.profile.parameters[change.name].scale)


class _MismatchError(DrivesError):
    """A drive holds something else than what was written."""


def _roll_back(
    by_axis: Mapping[str, CanopenDrive], started: Sequence[Change], cause: BaseException
) -> None:
    """Bring old values back, newest first; then see that all of them are there."""
    holds = {}
    for change in reversed(started):
        try:
            by_axis[change.axis].write(change.info, change.before_raw)
        except DrivesError:
            continue  # reading shows what the drive holds
    for change in started:
        drive = by_axis[change.axis]
        place = f"{change.axis} (node {drive.node_id}), {change.name}, {change.info.address}"
        try:
            found = drive.read(change.info)
        except DrivesError as error:
            holds[place] = f"not known ({error})"
            continue
        if found != change.before_raw:
            holds[place] = f"{found}, was {change.before_raw}"
    if holds:
        listed = "; ".join(f"{place} holds {what}" for place, what in holds.items())
        raise WriteBackMixedError(
            f"writing failed ({cause}) and not everything could be restored: {listed}. Do not run "
            "the machine; use `fieldtool restore` with the backup once the drives answer again.",
            holds,
        ) from cause


def check_disabled(drives: Iterable[CanopenDrive]) -> None:
    """Refuse to touch parameters while a drive is enabled or in fault reaction."""
    for drive in drives:
        state = drive.power_state()
        if state not in (*DISABLED_STATES, PowerState.FAULT):
            raise DriveFaultError(
                f"{drive.axis}: the drive is in {state.words}; parameters are written only while it "
                "is disabled. Nothing was written."
            )


# --- restore and store -------------------------------------------------------------------------


def check_same_drives(drives: Sequence[CanopenDrive], backup: Backup) -> None:
    """Refuse a backup that was made on other drives.

    Raises
    ------
    WrongDeviceError
        Naming axis and what differs.
    """
    by_axis = {d.axis: d for d in drives}
    for part in backup.drives:
        drive = by_axis.get(part.axis)
        if drive is None:
            raise WrongDeviceError(
                f"the backup holds axis {part.axis}, which this machine does not have; its axes are "
                f"{', '.join(by_axis)}."
            )
        identity = drive.identity
        for what, was, now in (
            ("node id", part.node_id, drive.node_id),
            ("vendor-ID", part.vendor_id, identity.vendor_id),
            ("product code", part.product_code, identity.product_code),
            ("serial number", part.serial_number, identity.serial_number),
        ):
            if was != now:
                raise WrongDeviceError(
                    f"{part.axis}: the backup was made on a drive with {what} {was}, this one has "
                    f"{now}. It is not restored onto another drive."
                )


def restore(drives: Sequence[CanopenDrive], backup: Backup) -> tuple[HeldObject, ...]:
    """Bring every parameter of the backup back, and return those that had to be written.

    Raises
    ------
    WrongDeviceError, DriveFaultError
        Before anything is written.
    WriteBackMixedError
        If a value could not be restored; every other one was.
    """
    check_same_drives(drives, backup)
    check_disabled(drives)
    by_axis = {d.axis: d for d in drives}
    written: list[HeldObject] = []
    holds: dict[str, str] = {}
    with uninterrupted():
        for part in backup.drives:
            done, failed = _restore_drive(by_axis[part.axis], part)
            written += done
            holds |= failed
        if holds:  # said before a stop that was asked for meanwhile
            listed = "; ".join(f"{place} holds {what}" for place, what in holds.items())
            raise WriteBackMixedError(
                f"not everything could be restored: {listed}. Everything else was. Do not run the "
                "machine; try again once the drives answer.",
                holds,
            )
    return tuple(written)


def _restore_drive(
    drive: CanopenDrive, part: DriveBackup
) -> tuple[list[HeldObject], dict[str, str]]:
    """Return what was written, and what could not be restored, by its place."""
    written: list[HeldObject] = []
    holds: dict[str, str] = {}
    order = {p.object: k for k, p in enumerate(drive.profile.parameters.values())}
    for held in sorted(
        part.held, key=lambda h: (order.get(h.info.address, len(order)), h.info.address)
    ):
        place = f"{part.axis} (node {part.node_id}), {held.info.name}, {held.info.address}"
        try:
            if drive.read(held.info) == held.value:
                continue
            drive.write(held.info, held.value)
            found = drive.read(held.info)
        except DrivesError as error:
            holds[place] = f"not known ({error})"
            continue
        if found == held.value:
            written.append(held)
        else:
            holds[place] = f"{found}, the backup has {held.value}"
    return written, holds


def store(drives: Sequence[CanopenDrive]) -> None:
    """Store all parameters of all drives in non-volatile memory (0x1010).

    Raises
    ------
    NotSupportedError
        If a drive's profile does not know how; nothing was stored then.
    WriteBackMixedError
        If a drive refuses or does not answer in time: says which drives have stored and which
        have not.  All of them work with what is in their memory.
    """
    for drive in drives:
        if drive.profile.store is None:
            raise NotSupportedError(
                f"{drive.axis}: profile {drive.profile.name} does not say how this drive stores its "
                "parameters; nothing was stored."
            )
    stored: list[str] = []
    for drive in drives:
        how = drive.profile.store
        if how is not None:
            info = ObjectInfo(how.object, "UNSIGNED32", "store parameters")
            try:
                with uninterrupted():
                    drive.write(info, SAVE_SIGNATURE, timeout=how.timeout)
                    stored.append(drive.axis)
            except DrivesError as error:
                if isinstance(error, StoppedError) and len(stored) == len(drives):
                    raise
                raise _not_stored(drives, stored, error) from error


def _not_stored(
    drives: Sequence[CanopenDrive], stored: Sequence[str], cause: DrivesError
) -> WriteBackMixedError:
    holds = {
        f"{d.axis} (node {d.node_id})": (
            "stored: survives a power cycle"
            if d.axis in stored
            else "in working memory only, not stored"
        )
        for d in drives
    }
    listed = "; ".join(f"{place}: {what}" for place, what in holds.items())
    return WriteBackMixedError(
        f"storing failed ({cause}) All drives work with the parameters that are in their memory. "
        f"{listed}. A power cycle brings back what those that have not stored held before; store "
        "again, or use `fieldtool restore` with the backup.",
        holds,
    )


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
