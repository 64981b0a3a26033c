"""Back up every writable parameter of every drive to a file, and read such a file."""

import hashlib
import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any

import yaml

from drives.canopen_drive import CanopenDrive
from drives.canopen_drive.setup import read_twice
from drives.errors import DriveFaultError, ProfileError, SdoAbortError
from drives.objects import DATA_TYPES, ObjectAddress, ObjectInfo
from drives.parameters.durable import write_durably
from drives.parameters.set_up import read_set_up
from drives.parameters.values import HeldObject, Raw, checked_value
from drives.profile import read_yaml

FORMAT = "fieldtool-parameters/1"
MAX_BACKUP_BYTES = 30_000_000
"""A drive has some thousand objects of 100 bytes here; a machine at most 32 drives."""
_DUMPER: Any = getattr(yaml, "CSafeDumper", yaml.SafeDumper)


@dataclass(frozen=True)
class DriveBackup:
    """Every writable parameter of one drive, and who the drive is."""

    axis: str
    node_id: int
    vendor_id: int
    product_code: int
    serial_number: int
    """0 where the drive has none."""
    revision_number: int
    """0 where the drive has none, or the backup does not say."""
    held: tuple[HeldObject, ...]
    set_up: tuple[HeldObject, ...] = ()
    """What a motion changes besides, and puts back: brought back only where it was cut off."""


@dataclass(frozen=True)
class Backup:
    """Every writable parameter of all drives of a machine."""

    machine: str
    taken: str
    """UTC, ISO 8601."""
    drives: tuple[DriveBackup, ...]


def back_up(machine: str, drives: Iterable[CanopenDrive]) -> Backup:
    """Read every writable parameter of every drive.

    Left out are write-only objects, and those whose value could not be written again: numbers that
    are not finite, text that is no ASCII.

    Raises
    ------
    NotSupportedError
        If an object is read as one value, and then as another.
    DriveFaultError
        If a drive restarts meanwhile: what was not stored in it is lost.
    SdoError
        If a drive does not answer.
    """
    parts = []
    for drive in drives:
        held, boots = [], drive.boots
        for info in drive.writable_parameters():
            value = read_twice(drive.axis, info, partial(_read, drive, info), _CHANGES)
            if value is not None:
                held.append(HeldObject(info, value))
        identity = drive.identity
        parts.append(
            DriveBackup(
                drive.axis,
                drive.node_id,
                identity.vendor_id,
                identity.product_code,
                identity.serial_number,
                identity.revision,
                tuple(held),
                read_set_up(drive),
            )
        )
        if drive.boots != boots:
            raise DriveFaultError(
                f"{drive.axis}: node {drive.node_id} has restarted while its parameters were read, and "
                "lost what was not stored in it. Check its supply, and try again. Nothing was written."
            )
    return Backup(machine, datetime.now(UTC).isoformat(timespec="seconds"), tuple(parts))


_CHANGES = (
    "If the drive changes it by itself, add it to `volatile_commands` in the drive profile. "
    "Nothing was written."
)


def _read(drive: CanopenDrive, info: ObjectInfo) -> Raw | None:
    """Return what an object holds; None where that could not be written again."""
    try:
        value = drive.read(info)
        info.encode(value)
    except SdoAbortError as error:
        if error.code not in (0x06010001, 0x06020000, 0x06090011):
            raise
        return None
    except ValueError:
        return None
    return value


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
        "checksum": checksum(parts),
        "drives": parts,
    }
    text = yaml.dump(data, Dumper=_DUMPER, sort_keys=False, width=120)

    def check(written: Path) -> None:
        if load_backup(written) != backup:
            raise ProfileError(path, "the backup is not read back as it was written")

    write_durably(path, text.encode(), check)


def _drive_as_dict(drive: DriveBackup) -> dict[str, Any]:
    return {
        "axis": drive.axis,
        "node_id": drive.node_id,
        "vendor_id": drive.vendor_id,
        "product_code": drive.product_code,
        "serial_number": drive.serial_number,
        "revision_number": drive.revision_number,
        "objects": [_held_as_dict(held) for held in drive.held],
        "set_up": [_held_as_dict(held) for held in drive.set_up],
    }


def _held_as_dict(held: HeldObject) -> dict[str, Any]:
    return {
        "object": str(held.info.address),
        "name": held.info.name,
        "type": held.info.type,
        "value": held.value,
    }


def checksum(parts: Any) -> str:
    """Return the SHA-256 of plain values, in one spelling of them."""
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
            tuple(_drive_backup(drive, k, place) for k, drive in enumerate(listed(data["drives"]))),
        )
    except (KeyError, TypeError, AttributeError, ValueError, ArithmeticError) as error:
        what = f"key {error} is missing" if isinstance(error, KeyError) else str(error)
        line = lines.get(tuple(place), 1)
        raise ProfileError(path, f"is no parameter backup: {what}", line) from None
    if data.get("checksum") != checksum(data["drives"]):
        raise ProfileError(
            path,
            "is not whole: its checksum does not fit what stands in it. It was cut short or changed; "
            "use another copy",
            lines.get(("checksum",), 1),
        )
    return backup


def whole(value: Any, highest: int = 2**32 - 1) -> int:
    """Return a value of a file that must be a whole number from 0; raise ValueError if it is none."""
    if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value <= highest:
        raise ValueError(f"a whole number from 0 to {highest} was expected, got {value!r}")
    return value


def listed(value: Any) -> list[Any]:
    """Return a value of a file that must be a list; raise TypeError if it is none."""
    if not isinstance(value, list):
        raise TypeError(f"a list was expected, got {value!r}")
    return value


def _drive_backup(drive: Mapping[str, Any], k: int, place: list[str | int]) -> DriveBackup:
    place[:] = ["drives", k]
    held = _all_held(drive["objects"], [*place, "objects"], place)
    set_up = _all_held(drive.get("set_up", []), ["drives", k, "set_up"], place)
    place[:] = ["drives", k]
    return DriveBackup(
        str(drive["axis"]),
        whole(drive["node_id"], 127),
        whole(drive["vendor_id"]),
        whole(drive["product_code"]),
        whole(drive["serial_number"]),
        whole(drive.get("revision_number", 0)),
        held,
        set_up,
    )


def _all_held(items: Any, where: list[str | int], place: list[str | int]) -> tuple[HeldObject, ...]:
    """Read a list of objects; ``place`` becomes where in the file it is at work."""
    held: dict[ObjectAddress, HeldObject] = {}
    for j, item in enumerate(listed(items)):
        place[:] = [*where, j]
        one = _held(item)
        if one.info.address in held:
            raise ValueError(f"object {one.info.address} stands here a second time")
        held[one.info.address] = one
    return tuple(held.values())


def _held(item: Mapping[str, Any]) -> HeldObject:
    if item["type"] not in DATA_TYPES:
        raise ValueError(f"unknown type {item['type']!r}")
    info = ObjectInfo(ObjectAddress.parse(item["object"]), item["type"], str(item["name"]))
    return HeldObject(info, checked_value(info, item["value"]))
