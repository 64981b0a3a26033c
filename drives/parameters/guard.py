"""What is made sure of before anything is written: which drive it is, its state, which objects."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Protocol

from drives.canopen_drive import CanopenDrive
from drives.cia402 import PowerState
from drives.errors import DriveFaultError, ProfileError, WrongDeviceError
from drives.objects import COMMANDS, DataType, ObjectAddress, ObjectInfo
from drives.parameters.values import ParameterDrive

DISABLED_STATES = (PowerState.SWITCH_ON_DISABLED, PowerState.READY_TO_SWITCH_ON, PowerState.FAULT)


class Recorded(Protocol):
    """Who a drive was when a file about it was made."""

    @property
    def axis(self) -> str:
        """Name of the axis."""

    @property
    def node_id(self) -> int:
        """CANopen node id."""

    @property
    def vendor_id(self) -> int:
        """0x1018:01."""

    @property
    def product_code(self) -> int:
        """0x1018:02."""

    @property
    def serial_number(self) -> int:
        """0x1018:04; 0 where the drive has none."""


def check_disabled(drives: Iterable[ParameterDrive]) -> None:
    """Refuse to touch parameters while a drive is enabled or in fault reaction.

    Raises
    ------
    DriveFaultError
        With axis and state.
    """
    for drive in drives:
        state = drive.power_state()
        if state not in DISABLED_STATES:
            raise DriveFaultError(
                f"{drive.axis}: the drive is in {state.words}; parameters are written only while it "
                "is disabled. Nothing was written."
            )


def other_number(part: Recorded, drive: ParameterDrive) -> tuple[str, int, int] | None:
    """Return name, recorded and present value of the first number by which it is another drive."""
    now = drive.identity
    numbers = (
        ("vendor-ID", part.vendor_id, now.vendor_id),
        ("product code", part.product_code, now.product_code),
        ("serial number", part.serial_number, now.serial_number),
    )
    return next((one for one in numbers if one[1] != one[2]), None)


def check_same_drives(
    drives: Sequence[ParameterDrive],
    recorded: Sequence[Recorded],
    what: str,
    *,
    trusted: bool = False,
) -> None:
    """Refuse a file that was made on other drives.

    Parameters
    ----------
    drives
        Those of the machine.
    recorded
        Those of the file.
    what
        Name of the file in messages: ``backup`` or ``write journal``.
    trusted
        The user's word that drives without a serial number are the same.

    Raises
    ------
    WrongDeviceError
        Naming axis and what differs, or what can not be told.
    """
    by_axis = {drive.axis: drive for drive in drives}
    for part in recorded:
        drive = by_axis.get(part.axis)
        if drive is None:
            raise WrongDeviceError(
                f"the {what} holds axis {part.axis}, which this machine does not have; its axes are "
                f"{', '.join(by_axis)}."
            )
        if part.node_id != drive.node_id:
            other: tuple[str, int, int] | None = ("node id", part.node_id, drive.node_id)
        else:
            other = other_number(part, drive)
        if other is not None:
            number, was, now = other
            raise WrongDeviceError(
                f"{part.axis}: the {what} was made on a drive with {number} {was}, this one has "
                f"{now}. It is not restored onto another drive."
            )
    if not trusted:
        nameless = [p for p in recorded if not by_axis[p.axis].identity.serial_number]
        if nameless:
            places = ", ".join(f"{part.axis} (node {part.node_id})" for part in nameless)
            raise WrongDeviceError(
                f"{places}: no serial number, so it can not be told whether the {what} was made on "
                "the drive that is there now. If you know that no drive was exchanged, say so with "
                "--same-drives. Nothing was written."
            )


def check_objects(drive: CanopenDrive, infos: Iterable[ObjectInfo], path: Path, what: str) -> None:
    """Refuse a file that names objects which are no parameters of this drive, or other types.

    No file can so make the tool write commands, outputs or the set-up of the bus.

    Raises
    ------
    ProfileError
        With file, axis, object and type.
    """
    known = parameter_types(drive)
    for info in infos:
        place = f"{drive.axis}, object {info.address} ({info.name})"
        wanted = known.get(info.address)
        if info.address.index in COMMANDS or wanted is None:
            raise ProfileError(
                path,
                f"{place} is no parameter of this drive; the {what} was changed, or made with another "
                "drive profile. Nothing was written.",
            )
        if wanted != info.type:
            raise ProfileError(
                path,
                f"{place} is {wanted} in this drive, the {what} says {info.type}. Nothing was "
                "written.",
            )


def parameter_types(drive: CanopenDrive) -> Mapping[ObjectAddress, DataType]:
    """Return the type of every object of a drive that is a parameter, by its address."""
    known = {info.address: info.type for info in drive.writable_parameters()}
    for parameter in drive.profile.parameters.values():
        known.setdefault(parameter.object, parameter.type)
    return known
