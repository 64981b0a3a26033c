"""Lead a drive out of the fault that a lost host leaves behind; other faults are a person's."""

from drives import objects
from drives.canopen_drive.drive import CanopenDrive
from drives.cia402 import Controlword, PowerState
from drives.errors import DriveFaultError, SdoAbortError
from drives.objects import ObjectAddress, ObjectInfo
from drives.profile import UNKNOWN

HOST_LOST = (0x8130, 0x8120)
"""Emergency codes: heartbeat (or life guarding) lost, CAN in error passive mode.  CiA 301."""
RESET_COMMUNICATION = 0x82
BOOT_TIME, RESET_TIME = 5.0, 1.0
"""Seconds that a node may take to boot, and a drive to leave its fault."""
_COMMUNICATION = 0x81
"""High byte of the emergency codes of the communication."""
_HARMLESS = 0x11
"""Bits of the error register 0x1001 that a lost host sets: generic error, communication."""
_ERROR_CODE = ObjectInfo(ObjectAddress(0x603F), "UNSIGNED16", "error code")


def lost_its_host(drive: CanopenDrive) -> int | None:
    """Return the error code of a drive whose fault :func:`recover` ends; None if it is in no such one.

    None too where the drive shows any other error, now or in its history: a fault that came before
    or after the host's loss is a person's.  Nothing is written.
    """
    if drive.profile.recovery == UNKNOWN or drive.power_state() is not PowerState.FAULT:
        return None
    try:
        register = drive.read_optional(objects.ERROR_REGISTER) or 0
        shown = drive.read_optional(_ERROR_CODE)
        history = drive.error_history()
    except SdoAbortError:
        return None
    if not history or history[0] not in HOST_LOST:
        return None
    if register & ~_HARMLESS or (shown is not None and shown not in HOST_LOST):
        return None
    others = any(code >> 8 != _COMMUNICATION for code in history)
    return None if others else history[0]


def recover(drive: CanopenDrive) -> str | None:
    """End the fault of a drive that lost its host, as its profile says; return what was done.

    None if the drive is in no fault, in another one, or its profile does not know the way: then
    nothing was sent.  Nothing moves: the power stage stays off.

    Raises
    ------
    DriveFaultError
        If the drive stays in the fault.
    """
    how, code = drive.profile.recovery, lost_its_host(drive)
    if code is None:
        return None
    if how == "communication reset":
        drive.node.nmt.send_command(RESET_COMMUNICATION)
        drive.line.wait(BOOT_TIME, drive.answers)
    drive.write(objects.CONTROLWORD, Controlword.DISABLE_VOLTAGE)
    drive.write(objects.CONTROLWORD, Controlword.FAULT_RESET)  # its rising edge counts
    left = drive.line.wait(RESET_TIME, lambda: drive.power_state() is not PowerState.FAULT)
    drive.write(objects.CONTROLWORD, Controlword.DISABLE_VOLTAGE)
    if not left:
        raise DriveFaultError(
            f"{drive.axis}: the drive stays in the fault 0x{code:04X} (it lost its host) after a {how}. "
            "Switch it off and on."
        )
    return (
        f"{drive.axis}: was in fault 0x{code:04X} because it lost its host: an earlier session ended "
        f"without a word. The fault was reset ({how})."
    )
