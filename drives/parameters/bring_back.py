"""Bring the old values back into one drive's working memory."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from enum import StrEnum

from drives.cia402 import PowerState
from drives.errors import DriveFaultError, DrivesError, SdoTimeoutError
from drives.objects import DEVICE_TYPE, ObjectAddress
from drives.parameters.access import take_over, unlock
from drives.parameters.backup import DriveBackup
from drives.parameters.guard import DISABLED_STATES
from drives.parameters.journal import DriveRecord
from drives.parameters.set_up import bring_set_up_back
from drives.parameters.values import HeldObject, ParameterDrive, Raw, same

PATIENCE = 10.0
"""Seconds that a drive is given to boot, or to finish storing."""
STOPPING, LOOK = 2.0, 0.1
"""Seconds that a drive may still take to switch off by itself, and from one look at it to the next."""
PASSES = 3
"""Times that values are written at most: some drives take one only after another."""
_POWERLESS = (*DISABLED_STATES, PowerState.NOT_READY_TO_SWITCH_ON)
"""One that boots has no power either."""


class Found(StrEnum):
    """What a drive was found to hold of the parameters of a write."""

    OLD = "old values"
    NEW = "new values"
    MIXED = "old and new values mixed"
    OTHER = "values that are neither old nor new"
    SILENT = "no answer"


@dataclass(frozen=True)
class BroughtBack:
    """What came of one drive."""

    found: Found
    written: tuple[HeldObject, ...]
    """What differed and was written; all of it was read back."""
    failed: Mapping[ObjectAddress, str]
    """What the drive holds instead, in words, by object."""


class SilentDriveError(DrivesError):
    """The drive does not answer at all."""


def look(drive: ParameterDrive, record: DriveRecord) -> Found:
    """Read the parameters of a write, and say which of its values they are.

    Raises
    ------
    SilentDriveError
        If the drive does not answer.
    """
    seen = set()
    for entry in record.entries:
        try:
            value = drive.read(entry.info)
        except DrivesError as error:
            _refuse_silent(drive, error)
            seen.add(Found.OTHER)
            continue
        if same(entry.info, entry.before, entry.after):
            kind = None if same(entry.info, value, entry.before) else Found.OTHER
        elif same(entry.info, value, entry.before):
            kind = Found.OLD
        else:
            kind = Found.NEW if same(entry.info, value, entry.after) else Found.OTHER
        if kind is not None:
            seen.add(kind)
    if Found.OTHER in seen:
        return Found.OTHER
    if len(seen) == 2:
        return Found.MIXED
    return seen.pop() if seen else Found.OLD


def bring_back(
    drive: ParameterDrive, record: DriveRecord, backup: DriveBackup, *, set_up: bool
) -> BroughtBack:
    """Write every old value that the drive does not hold, and read all of them back.

    All of the backup is compared: a drive that lost its supply has lost more than what was written.

    Parameters
    ----------
    drive
        Disabled, or about to be: one that could not be switched off after a motion stops by itself once
        it misses the host.
    record
        Whose entries come back in any case.
    backup
        Every parameter of the drive.
    set_up
        Bring back what a motion had set up too, where the backup holds that, and have the drive take
        all of its parameters over: bringing back may have been cut off before.

    Raises
    ------
    SilentDriveError
        If the drive does not answer.
    DriveFaultError
        If it stays enabled: nothing was written, and its fail-safe objects are what they were.
    """
    if not drive.wakes(PATIENCE):
        raise SilentDriveError(_why_silent(drive))
    _see_disabled(drive)
    found = look(drive, record)
    unlock(drive)
    was_set_up, not_set_up = bring_set_up_back(drive, backup.set_up) if set_up else ((), {})
    wanted = {held.info.address: held for held in backup.held}
    wanted |= {entry.info.address: HeldObject(entry.info, entry.before) for entry in record.entries}
    left = _in_order(drive, wanted.values())
    written: list[HeldObject] = []
    failed: dict[ObjectAddress, str] = {}
    for _ in range(PASSES):
        before = len(left)
        left, failed = _one_pass(drive, left, written)
        if not left or len(left) == before:
            break
    # Not what was written now alone: what was written before a cut may wait for its latch.
    to_take = {e.info.address for e in record.entries if not same(e.info, e.before, e.after)}
    take_over(drive, to_take | {h.info.address for h in (wanted.values() if set_up else written)})
    # Only what was read back in the end counts: a later value may have changed an earlier one.
    for held in tuple(written):
        for _ in range(2):  # one answer that is wrong says nothing of the drive
            value = _read(drive, held)
            if isinstance(value, _Unread) or _same(drive, held, value):
                break
        else:
            failed[held.info.address] = f"{value}, was {held.value}"
    kept = tuple(held for held in written if held.info.address not in failed)
    return BroughtBack(found, (*was_set_up, *kept), {**not_set_up, **failed})


class _Unread(str):
    """Why an object could not be read or written."""

    __slots__ = ()


def _one_pass(
    drive: ParameterDrive, wanted: Iterable[HeldObject], written: list[HeldObject]
) -> tuple[list[HeldObject], dict[ObjectAddress, str]]:
    """Write what differs; return what is left, and what the drive holds there instead."""
    left, failed = [], {}
    for held in wanted:
        value = _read(drive, held)
        if isinstance(value, _Unread) or not _same(drive, held, value):
            refusal = _write(drive, held)
            value = _read(drive, held)
            if isinstance(value, _Unread):
                failed[held.info.address] = f"not known ({refusal or value})"
            elif not _same(drive, held, value):
                failed[held.info.address] = f"{value}, was {held.value}"
            else:
                written.append(held)
                continue
            left.append(held)
    return left, failed


def _same(drive: ParameterDrive, held: HeldObject, value: Raw) -> bool:
    """Whether an object holds its old value; a latch is a command, whatever its bits show."""
    for latch in drive.profile.latches:
        if latch.object == held.info.address:
            return not (int(value) ^ int(held.value)) & ~latch.set_bits
    return same(held.info, value, held.value)


def _read(drive: ParameterDrive, held: HeldObject) -> Raw | _Unread:
    try:
        return drive.read(held.info)
    except DrivesError as error:
        _refuse_silent(drive, error)
        return _Unread(error)


def _write(drive: ParameterDrive, held: HeldObject) -> str:
    try:
        drive.write(held.info, held.value)
    except DrivesError as error:
        _refuse_silent(drive, error)
        return str(error)
    return ""


def _see_disabled(drive: ParameterDrive) -> None:
    """Wait until a drive shows that its power is off: until then its fail-safe objects may be all that
    stops it, and no gains change under a motor that is held.

    It is not told to switch off: that was tried, and would only cut short the ramp that it is in.
    """
    shown = ""
    for k in range(round(STOPPING / LOOK)):
        if k:
            drive.wait(LOOK)
        try:
            state = drive.power_state()
        except DrivesError as error:  # one answer that is lost says nothing of the drive
            _refuse_silent(drive, error)
            shown = f"its state is not known: {str(error).rstrip('.')}"
            continue
        if state in _POWERLESS:
            return
        shown = f"the drive is in {state.words} and does not switch off by itself"
    raise DriveFaultError(
        f"{drive.axis}: {shown}; its parameters are brought back only while it is disabled. Switch it "
        "off and on"
    )


def _why_silent(drive: ParameterDrive) -> str:
    """Return what is wrong with the answers of a drive that does not wake."""
    silence = f"{drive.axis}: node {drive.node_id} does not answer"
    try:
        drive.read(DEVICE_TYPE)
    except SdoTimeoutError:
        return silence
    except DrivesError as error:
        return str(error)
    return silence


def _refuse_silent(drive: ParameterDrive, error: DrivesError) -> None:
    if isinstance(error, SdoTimeoutError) and not drive.answers():
        raise SilentDriveError(f"{drive.axis}: node {drive.node_id} does not answer") from error


def _in_order(drive: ParameterDrive, wanted: Iterable[HeldObject]) -> list[HeldObject]:
    """Sort by the profile's order of writing; what it does not name comes behind, by address."""
    order = {p.object: k for k, p in enumerate(drive.profile.parameters.values())}
    return sorted(wanted, key=lambda h: (order.get(h.info.address, len(order)), h.info.address))
