"""Store parameters in the drives' non-volatile memory (0x1010)."""

from collections.abc import Sequence

from drives.canopen_drive import CanopenDrive
from drives.canopen_drive.interrupts import uninterrupted
from drives.errors import DrivesError, NotSupportedError, StoppedError, WriteBackMixedError
from drives.objects import ObjectInfo
from drives.profile import Store

SAVE_SIGNATURE = int.from_bytes(b"save", "little")


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
        if not isinstance(drive.profile.store, Store):
            raise NotSupportedError(
                f"{drive.axis}: profile {drive.profile.name} does not say how this drive stores its "
                "parameters; nothing was stored."
            )
    stored: list[str] = []
    for drive in drives:
        how = drive.profile.store
        if isinstance(how, Store):
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
