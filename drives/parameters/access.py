"""What some drives want besides writing an object: a password before, a latch after."""

from collections.abc import Iterable

from drives.errors import NotSupportedError, SdoError
from drives.objects import ObjectAddress, ObjectInfo
from drives.parameters.values import ParameterDrive

NOBODY = 0
"""User level of a drive that is locked."""


def needs_password(drive: ParameterDrive) -> bool:
    """Whether the drive's parameters are locked, as far as it tells."""
    return drive.profile.unlock is not None and _level(drive) in (None, NOBODY)


def unlock(drive: ParameterDrive) -> None:
    """Give the drive its password, where its profile says that it wants one; the drive forgets it.

    Raises
    ------
    NotSupportedError
        If the machine profile gives none, or the drive does not take it; nothing else was written.
    SdoError
        If the drive does not say whether it is locked.
    BusError, UserStopError
        As they came: neither says anything of the password.
    """
    how = drive.profile.unlock
    if how is None or not needs_password(drive):
        return
    password = drive.axis_profile.password
    if password is None:
        raise NotSupportedError(
            f"{drive.axis}: the drive's parameters are locked (drive profile {drive.profile.name}). "
            "Give `password` at the axis in the machine profile. Nothing was written."
        )
    info = ObjectInfo(how.object, "VISIBLE_STRING", "password")
    try:
        drive.write(info, password)
    except SdoError as error:
        raise NotSupportedError(
            f"{drive.axis}, object {how.object}: the drive does not take the password ({_kind(error)}). "
            "Nothing was written."
        ) from None
    if _level(drive) == NOBODY:
        raise NotSupportedError(
            f"{drive.axis}: the drive stays locked: the password is wrong. Nothing was written."
        )


def _level(drive: ParameterDrive) -> int | None:
    how = drive.profile.unlock
    if how is None or how.level is None:
        return None
    return drive.read_optional(ObjectInfo(how.level, "UNSIGNED8", "user level"))


def _kind(error: SdoError) -> str:
    """Return an error without its words, which may repeat what was written."""
    code = getattr(error, "code", None)
    return f"abort code 0x{code:08X}" if isinstance(code, int) else type(error).__name__


def take_over(drive: ParameterDrive, written: Iterable[ObjectAddress]) -> None:
    """Tell the drive to use what was written, where its profile names a latch for it.

    Raises
    ------
    SdoError
        If the drive refuses or does not answer.
    """
    objects = set(written)
    parameters = drive.profile.parameters
    for latch in drive.profile.latches:
        if objects.isdisjoint(parameters[name].object for name in latch.after):
            continue
        info = ObjectInfo(latch.object, latch.type, "latch")
        drive.write(info, drive.read_int(info) | latch.set_bits)
