"""Store one drive's parameters in its non-volatile memory (0x1010), and know how that ended."""

from drives.errors import (
    DrivesError,
    NodeAbsentError,
    NotSupportedError,
    SdoAbortError,
    SdoTimeoutError,
)
from drives.objects import ObjectAddress, ObjectInfo
from drives.parameters.values import ParameterDrive
from drives.profile import Store

NOT_BEGUN = (0x0503, 0x0504, 0x0601, 0x0602, 0x0607, 0x0609, 0x0800)
"""Upper halves of the abort codes with which a drive refuses to store.  CiA 301, object 0x1010: a
drive that refuses answers 0x0800002x, one whose storing failed answers 0x06060000 (hardware)."""
BOOT_TIME = 5.0
"""Seconds that a node may take to boot."""
POLLING = 0.02
"""Seconds between two looks at a status."""
TIMED_OUT = 0x05040000
"""The code among them that says nothing about what was done."""


class StoreRefusedError(DrivesError):
    """The drive says that it has not stored anything: its memory is what it was."""


def can_store(drive: ParameterDrive) -> bool:
    """Whether it is known how a drive stores."""
    return isinstance(drive.profile.store, Store)


def check_can_store(drive: ParameterDrive) -> None:
    """Refuse a drive of which it is not known how it stores.

    Raises
    ------
    NotSupportedError
        Naming axis and profile; nothing was written.
    """
    if not can_store(drive):
        raise NotSupportedError(
            f"{drive.axis}: profile {drive.profile.name} does not say how this drive stores its "
            "parameters; nothing was written."
        )


def store(drive: ParameterDrive) -> None:
    """Store all parameters of a drive as they stand in its working memory, and wait for the end.

    A drive that shows only after a restart what it has stored is restarted: what is read from it then
    is what its non-volatile memory holds.

    Raises
    ------
    StoreRefusedError
        If it says that it has not stored.
    DrivesError
        If storing failed midway or was not confirmed: then nobody knows what the memory holds.
    """
    how = drive.profile.store
    if not isinstance(how, Store):
        raise StoreRefusedError(
            f"{drive.axis}: profile {drive.profile.name} does not say how it stores."
        )
    info = ObjectInfo(how.object, "UNSIGNED32", "store parameters")
    try:
        drive.write(info, how.signature_value, timeout=how.timeout)
    except SdoAbortError as error:
        if error.code >> 16 in NOT_BEGUN and error.code != TIMED_OUT:
            raise StoreRefusedError(str(error)) from error
        raise
    if how.status is not None and how.status_done is not None:
        _wait_for_status(drive, how.status, how.status_done, how.timeout)
    if how.verify == "read-back after restart" and not drive.restart(max(how.timeout, BOOT_TIME)):
        raise NodeAbsentError(
            f"{drive.axis}: node {drive.node_id} does not come back after the restart that shows what "
            "it has stored. Switch it off and on."
        )


def _wait_for_status(
    drive: ParameterDrive, status: ObjectAddress, done: int, timeout: float
) -> None:
    info = drive.info(status) or ObjectInfo(status, "UNSIGNED32", "store status")
    for _ in range(max(1, round(timeout / POLLING))):
        if (shown := drive.read(info)) == done:
            return
        drive.wait(POLLING)
    raise SdoTimeoutError(
        drive.axis,
        status.index,
        status.subindex,
        f"shows {shown} {timeout:g} s after storing began; {done} would be done.",
    )
