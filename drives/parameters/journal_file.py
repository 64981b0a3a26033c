"""The journal as a YAML file: on the disk before the first write, whole at every instant."""

from collections.abc import Mapping
from enum import StrEnum
from pathlib import Path
from typing import Any, TypeVar

import yaml

from drives.errors import ProfileError
from drives.objects import DATA_TYPES, ObjectAddress, ObjectInfo
from drives.parameters.backup import checksum, listed, whole
from drives.parameters.durable import write_durably
from drives.parameters.journal import (
    DriveRecord,
    Goal,
    Journal,
    JournalEntry,
    Memory,
    Phase,
    State,
    Storing,
)
from drives.parameters.values import checked_value
from drives.profile import read_yaml

FORMAT = "fieldtool-write-journal/1"
MAX_JOURNAL_BYTES = 3_000_000
MAX_DRIVES = 127
_DUMPER: Any = getattr(yaml, "CSafeDumper", yaml.SafeDumper)
Word = TypeVar("Word", bound=StrEnum)


def save_journal(journal: Journal, path: Path) -> None:
    """Bring a journal to the disk before this returns.

    Raises
    ------
    OSError
        If it can not be written; the one before is unchanged.
    """
    body = _body(journal)
    data = {"format": FORMAT, "checksum": checksum(body), **body}
    write_durably(path, yaml.dump(data, Dumper=_DUMPER, sort_keys=False, width=160).encode())


def load_journal(path: Path) -> Journal:
    """Read a journal.

    Raises
    ------
    ProfileError
        If it is none, is not whole, or was changed: with file and line.
    """
    data, lines = read_yaml(path, MAX_JOURNAL_BYTES)
    if data.get("format") != FORMAT:
        raise ProfileError(path, f"format must be {FORMAT}, got {data.get('format')!r}", 1)
    place: list[str | int] = []
    try:
        journal = _journal(data, place)
    except (KeyError, TypeError, AttributeError, ValueError, ArithmeticError) as error:
        what = f"key {error} is missing" if isinstance(error, KeyError) else str(error)
        raise ProfileError(
            path, f"is no write journal: {what}", lines.get(tuple(place), 1)
        ) from None
    body = {key: value for key, value in data.items() if key not in ("format", "checksum")}
    if data.get("checksum") != checksum(body):
        raise ProfileError(
            path,
            "is not whole: its checksum does not fit what stands in it; it was changed",
            lines.get(("checksum",), 1),
        )
    return journal


def _body(journal: Journal) -> dict[str, Any]:
    return {
        "machine": journal.machine,
        "begun": journal.begun,
        "backup": journal.backup,
        "state": journal.state.value,
        "goal": journal.goal.value,
        "storing": journal.storing.value,
        "drives": [
            {
                "axis": record.axis,
                "node_id": record.node_id,
                "vendor_id": record.vendor_id,
                "product_code": record.product_code,
                "revision_number": record.revision_number,
                "serial_number": record.serial_number,
                "phase": record.phase.value,
                "memory": record.memory.value,
                "memory_before": record.memory_before.value,
                "memory_earlier": record.earlier.value,
                "parameters": [
                    {
                        "name": entry.info.name,
                        "object": str(entry.info.address),
                        "type": entry.info.type,
                        "before": entry.before,
                        "after": entry.after,
                    }
                    for entry in record.entries
                ],
            }
            for record in journal.drives
        ],
    }


def _journal(data: Mapping[str, Any], place: list[str | int]) -> Journal:
    backup = _text(data["backup"])
    if Path(backup).name != backup or backup in ("", ".", ".."):
        raise ValueError(f"backup {backup!r} is no name of a file in the same folder")
    place[:] = ["drives"]
    items = listed(data["drives"])
    if not 1 <= len(items) <= MAX_DRIVES:
        raise ValueError(f"{len(items)} drives, 1 to {MAX_DRIVES} were expected")
    records = []
    for k, item in enumerate(items):
        place[:] = ["drives", k]
        records.append(_record(item, place))
    place[:] = ["drives"]
    for what in ("axis", "node_id"):
        if len({getattr(record, what) for record in records}) != len(records):
            raise ValueError(f"two drives have the same {what}")
    place[:] = []
    return Journal(
        _text(data["machine"]),
        _text(data["begun"]),
        backup,
        _word(Storing, data["storing"]),
        tuple(records),
        _word(Goal, data["goal"]),
        _word(State, data["state"]),
    )


def _record(item: Mapping[str, Any], place: list[str | int]) -> DriveRecord:
    where = tuple(place)
    entries: dict[ObjectAddress, JournalEntry] = {}
    for j, parameter in enumerate(listed(item["parameters"])):
        place[:] = [*where, "parameters", j]
        if parameter["type"] not in DATA_TYPES:
            raise ValueError(f"unknown type {parameter['type']!r}")
        address = ObjectAddress.parse(_text(parameter["object"]))
        info = ObjectInfo(address, parameter["type"], _text(parameter["name"]))
        if address in entries:
            raise ValueError(f"object {address} stands here a second time")
        entries[address] = JournalEntry(
            info, checked_value(info, parameter["before"]), checked_value(info, parameter["after"])
        )
    place[:] = where
    return DriveRecord(
        _text(item["axis"]),
        whole(item["node_id"], 127),
        whole(item["vendor_id"]),
        whole(item["product_code"]),
        whole(item["revision_number"]),
        whole(item["serial_number"]),
        tuple(entries.values()),
        _word(Phase, item["phase"]),
        _word(Memory, item["memory"]),
        _word(Memory, item["memory_before"]),
        _word(Memory, item.get("memory_earlier", Memory.UNTOUCHED.value)),
    )


def _text(value: Any) -> str:
    if not isinstance(value, str):
        raise TypeError(f"a text was expected, got {value!r}")
    return value


def _word(kind: type[Word], value: Any) -> Word:
    try:
        return kind(value)
    except ValueError:
        words = ", ".join(kind)
        raise ValueError(f"{value!r} is none of {words}") from None
