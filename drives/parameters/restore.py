"""Bring a backup back into the drives it was made on."""

from collections.abc import Sequence

from drives.canopen_drive import CanopenDrive
from drives.canopen_drive.interrupts import uninterrupted
from drives.errors import DrivesError, WriteBackMixedError, WrongDeviceError
from drives.parameters.backup import Backup, DriveBackup
from drives.parameters.values import HeldObject
from drives.parameters.write import check_disabled


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
