"""Torque offset 0x60B2: whether a drive takes it in every cycle, together with target positions."""

from canopen.objectdictionary import ODVariable

from drives.canopen_drive.drive import CanopenDrive
from drives.objects import ObjectAddress, ObjectInfo

TORQUE_OFFSET = ObjectInfo(ObjectAddress(0x60B2), "INTEGER16", "torque offset")
"""Per mille of the rated torque, added to the drive's own torque reference."""
LARGEST = 2**15 - 1
"""Largest offset that its type holds, either way."""
_READ_AND_RECEIVED = ("rw", "rww")
"""Access types, in EDS files, of objects that can be read and that an RPDO may carry."""


def why_not(drive: CanopenDrive) -> str:
    """Return why torque offsets can not be streamed to this drive; empty if they can.

    Raises
    ------
    SdoError
        If the drive does not answer.
    """
    profile, address = drive.profile, TORQUE_OFFSET.address
    if profile.torque_offset is not True:
        return f"{drive.axis}: drive profile {profile.name} does not say `torque_offset: true`"
    variable = drive.dictionary.get_variable(address.index, address.subindex)
    info = drive.info(address)
    if info is None or not isinstance(variable, ODVariable):
        return f"{drive.axis}: {profile.eds} has no torque offset {address}"
    if info.type != TORQUE_OFFSET.type:
        return (
            f"{drive.axis}: {profile.eds} has torque offset {address} as {info.type}, the tool's PDO "
            f"needs {TORQUE_OFFSET.type}"
        )
    if not variable.pdo_mappable or variable.access_type not in _READ_AND_RECEIVED:
        return f"{drive.axis}: {profile.eds} lets no PDO carry torque offset {address}"
    if drive.read_optional(info) is None:
        return f"{drive.axis}: the drive has no torque offset {address}, though {profile.eds} has"
    return ""
