"""Write changed parameters in order and read them back: all or nothing."""

from collections.abc import Iterable, Mapping, Sequence

from drives.canopen_drive import CanopenDrive
from drives.canopen_drive.interrupts import uninterrupted
from drives.cia402 import PowerState
from drives.errors import (
    DriveFaultError,
    DrivesError,
    StoppedError,
    WriteBackError,
    WriteBackMixedError,
)
from drives.parameters.changes import Change, Written

DISABLED_STATES = (PowerState.SWITCH_ON_DISABLED, PowerState.READY_TO_SWITCH_ON)


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
    return Written(change, change.after)


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
