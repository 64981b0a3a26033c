"""What a motion sets for its time besides parameters: PDOs, mode of operation, torque offset.

A motion puts them back itself.  They are in the backup for the case that it could not, because the tool
was killed: they are no parameters, and are brought back after such a cut alone, since otherwise they
belong to whoever uses the bus.
"""

from collections.abc import Iterator, Sequence
from contextlib import suppress
from itertools import groupby
from pathlib import Path

from drives import objects
from drives.canopen_drive.setup import (
    NO_MODE,
    OUTPUTS,
    PDO_OFF,
    PDOS,
    cob_id_of,
    count_of,
    entry_of,
    kind_of,
    read_twice,
)
from drives.canopen_drive.torque_offset import TORQUE_OFFSET
from drives.errors import DrivesError, ProfileError, SdoAbortError
from drives.objects import ObjectAddress, ObjectInfo
from drives.parameters.values import HeldObject, ParameterDrive, same

MOST_ENTRIES = 64
"""That a PDO can map (CiA 301, clause 7.5.2.36)."""


def read_set_up(drive: ParameterDrive) -> tuple[HeldObject, ...]:
    """Read what a motion may change in a drive besides its parameters, in the order of bringing back.

    Raises
    ------
    NotSupportedError
        If an object is read as one value, and then as another.
    SdoError
        If the drive does not answer.
    """
    held = [*_held(drive, TORQUE_OFFSET), *_held(drive, objects.MODE)]
    for communication, mapping in PDOS:
        for other in range(3, 0, -1):
            held += _held(drive, cob_id_of(communication + other))
        first = _held(drive, cob_id_of(communication))
        if not first:
            continue
        held += [*first, *_held(drive, kind_of(communication))]
        count = [*_held(drive, count_of(mapping))]
        used = int(count[0].value) if count else 0
        for k in range(1, min(max(used, len(OUTPUTS)), MOST_ENTRIES) + 1):
            held += _held(drive, entry_of(mapping, k))
        held += count
    return tuple(held)


def _held(drive: ParameterDrive, info: ObjectInfo) -> Iterator[HeldObject]:
    """Yield what an object holds; nothing where the drive refuses to tell: then no motion changes it."""

    def read() -> int | None:
        with suppress(SdoAbortError):
            return drive.read_optional(info)
        return None

    value = read_twice(drive.axis, info, read, "Nothing was written.")
    if value is not None:
        yield HeldObject(info, value)


def check_set_up(axis: str, held: Sequence[HeldObject], path: Path) -> None:
    """Refuse a file that names other objects as set up than a motion changes, or in another order.

    Raises
    ------
    ProfileError
        With file, axis and object.
    """
    known = {info.address: info.type for info in _known()}
    for one in held:
        if known.get(one.info.address) != one.info.type:
            raise ProfileError(
                path,
                f"{axis}, object {one.info.address} ({one.info.name}), {one.info.type}, is nothing that "
                "a motion sets up; the backup was changed. Nothing was written.",
            )
    for pdo, part in groupby(held, _pdo_of):
        addresses = [one.info.address for one in part]
        mapping = [address for address in addresses if address.index != pdo]
        if pdo and (addresses[0] != ObjectAddress(pdo, 1) or (mapping and mapping[-1].subindex)):
            raise ProfileError(
                path,
                f"{axis}: the objects of the PDO 0x{pdo:04X} stand in another order than the tool reads "
                "them; the backup was changed. Nothing was written.",
            )


def _known() -> Iterator[ObjectInfo]:
    yield from (TORQUE_OFFSET, objects.MODE)
    for communication, mapping in PDOS:
        yield from (cob_id_of(communication + k) for k in range(4))
        yield from (kind_of(communication), count_of(mapping))
        yield from (entry_of(mapping, k) for k in range(1, MOST_ENTRIES + 1))


def bring_set_up_back(
    drive: ParameterDrive, wanted: Sequence[HeldObject]
) -> tuple[tuple[HeldObject, ...], dict[ObjectAddress, str]]:
    """Write what a motion had set and not put back; return what was written, and what failed.

    Parameters
    ----------
    drive
        Disabled.
    wanted
        As :func:`read_set_up` has read it.

    Raises
    ------
    SdoTimeoutError
        If the drive does not answer.
    """
    differs = [held for held in wanted if not _holds(drive, held)]
    if not differs:
        return (), {}
    drive.to_pre_operational()
    counts = {h.info.address.index: h.value for h in wanted if h.info.address.subindex == 0}
    refused: dict[ObjectAddress, str] = {}
    indexes = {_pdo_of(held) for held in differs}
    for pdo, part in groupby(wanted, _pdo_of):
        if pdo in indexes:
            for info, value in _writes(drive, pdo, list(part)):
                try:
                    drive.write(info, value)
                except DrivesError as error:
                    refused[info.address] = str(error)
    failed = {}
    for held in wanted:
        if not _holds(drive, held) and _matters(held, counts):
            address = held.info.address
            why = f" ({refused[address].rstrip('.')})" if address in refused else ""
            now = _read(drive, held)
            is_now = "not known" if now is None else str(now)
            failed[address] = f"{is_now}, was {held.value}{why}"
    return tuple(h for h in differs if h.info.address not in failed), failed


def _writes(
    drive: ParameterDrive, pdo: int, held: Sequence[HeldObject]
) -> Iterator[tuple[ObjectInfo, int | float | str]]:
    """Yield what has to be written, in order: a PDO is off while it is changed (CiA 301, 7.5.2.36)."""
    if not pdo:
        yield from ((one.info, one.value) for one in held)
        return
    identifier, rest = held[0], held[1:]
    was = int(identifier.value)
    yield identifier.info, drive.read_int(identifier.info) | PDO_OFF
    mapping = [one for one in rest if one.info.address.index != pdo]
    for one in rest:
        if one.info.address.index == pdo:
            yield one.info, one.value
    if mapping:
        yield mapping[-1].info, 0
        yield from ((one.info, one.value) for one in mapping)
    yield identifier.info, was | PDO_OFF
    yield identifier.info, was


def _pdo_of(held: HeldObject) -> int:
    """Return the communication object that something belongs to; 0 if to none."""
    index = held.info.address.index
    if index >= objects.MODE.address.index:
        return 0
    return index - 0x200 if index in (mapping for _, mapping in PDOS) else index


def _holds(drive: ParameterDrive, held: HeldObject) -> bool:
    value = _read(drive, held)
    return value is not None and same(held.info, value, held.value)


def _read(drive: ParameterDrive, held: HeldObject) -> int | float | str | None:
    """Return what an object holds; None where the drive refuses to tell."""
    try:
        return drive.read(held.info)
    except SdoAbortError:
        return None


def _matters(held: HeldObject, counts: dict[int, int | float | str]) -> bool:
    """Whether it is in use: entries beyond the mapping's count are not, and no drive obeys mode 0."""
    address = held.info.address
    if address == objects.MODE.address:
        return held.value != NO_MODE
    return address.subindex <= int(counts[address.index]) if address.index in counts else True
