"""What makes a drive stop by itself when the host dies: 0x1016, 0x6007, 0x1029, 0x605A.

Required before anything is changed, armed before a motion, seen to be armed right before the drive is
enabled, and put back after it.
"""

from drives import objects
from drives.canopen_drive.drive import CanopenDrive
from drives.canopen_drive.setup import (
    COAST,
    DRIVE_HEARTBEAT,
    HOST_NODE_ID,
    QUICK_STOP_RAMP,
    TemporaryObjects,
)
from drives.errors import NotSupportedError
from drives.objects import ObjectAddress, ObjectInfo
from drives.profile import UNKNOWN

_GUARD_TIME = ObjectInfo(ObjectAddress(0x100C), "UNSIGNED16", "guard time")


def host_watched(seconds: float) -> int:
    """Return the entry of 0x1016 by which the host's heartbeat may stay away for so long."""
    return (HOST_NODE_ID << 16) | round(seconds * 1000)


def require_fail_safe(drive: CanopenDrive) -> None:
    """Refuse a drive that would not stop by itself; nothing is written.

    Node guarding (0x100C, 0x100D) is no substitute: its life time ends with the guarding, but CiA 301
    asks for the heartbeat instead, and the remote frames that it needs do not pass every adapter.
    Nor is a drive's own watch over SYNC, which goes on when only the targets end.

    Raises
    ------
    NotSupportedError
        If the drive has no heartbeat consumer, or it is not known what the drive does then.
    """
    if drive.read_optional(objects.CONSUMER_HEARTBEAT) is None:
        guarding = drive.read_optional(_GUARD_TIME) is not None
        instead = " Its node guarding (0x100C) is no substitute." if guarding else ""
        raise NotSupportedError(
            f"{drive.axis}: the drive has no heartbeat consumer 0x1016, so nothing would stop it when "
            f"the host dies.{instead} It may not be moved by this tool."
        )
    if drive.read_optional(objects.ABORT_CONNECTION) is None:
        raise NotSupportedError(
            f"{drive.axis}: the drive has no abort connection option 0x6007, so what it does when the "
            "host dies is not known. It may not be moved by this tool."
        )
    if drive.profile.heartbeat_reaction == UNKNOWN:
        raise NotSupportedError(
            f"{drive.axis}: drive profile {drive.profile.name} does not know which value of 0x6007 "
            "makes the drive stop when the host dies (`heartbeat_reaction`), so it may not be moved by "
            "this tool."
        )


def arm(drive: CanopenDrive, changes: TemporaryObjects, lost_after: float) -> None:
    """Make the drive stop by itself when the host's heartbeat is lost for so many seconds.

    A quick stop that would let the axis coast (0x605A = 0) becomes a ramp too.

    Raises
    ------
    NotSupportedError
        As :func:`require_fail_safe`, or if the drive does not keep a value.
    """
    require_fail_safe(drive)
    for info, value in _wanted(drive).items():
        changes.change(info, value)
    if drive.read_optional(objects.QUICK_STOP_OPTION) == COAST:
        changes.change(
            objects.QUICK_STOP_OPTION, QUICK_STOP_RAMP[drive.profile.quick_stop_reaction]
        )
    changes.change(objects.PRODUCER_HEARTBEAT, round(DRIVE_HEARTBEAT * 1000))
    changes.change(objects.CONSUMER_HEARTBEAT, host_watched(lost_after))


def see_armed(drive: CanopenDrive, lost_after: float) -> None:
    """See that everything still is as it was armed: right before the drive is enabled.

    Raises
    ------
    NotSupportedError
        If the drive has changed a value by itself, as by going operational.
    """
    watched = {objects.CONSUMER_HEARTBEAT: host_watched(lost_after)}
    for info, value in {**_wanted(drive), **watched}.items():
        found = drive.read_int(info)
        if found != value:
            raise NotSupportedError(
                f"{drive.axis}, object {info.address} ({info.name}): was set to {value} and is {found} "
                "now, so the drive would not stop by itself when the host dies. It was not enabled. "
                "Does another master configure it?"
            )


def _wanted(drive: CanopenDrive) -> dict[ObjectInfo, int]:
    """What 0x6007 has to be, and 0x1029 where there is one and the profile says something of it."""
    reaction, behaviour = drive.profile.heartbeat_reaction, drive.profile.error_behaviour
    wanted = {} if reaction == UNKNOWN else {objects.ABORT_CONNECTION: int(reaction)}
    if behaviour is not None and drive.read_optional(objects.ERROR_BEHAVIOUR) is not None:
        wanted[objects.ERROR_BEHAVIOUR] = behaviour
    return wanted
