"""Check a drive that stands still: who it is, what it can do, what it is set to; nothing is written."""

from drives.canopen_drive import CanopenDrive
from drives.canopen_drive.recovery import lost_its_host
from drives.canopen_drive.settings import read_settings
from drives.cia402 import Mode
from drives.profile import UNKNOWN
from drives.profile.match import Presented, match
from drives.scan.asking import Asked
from drives.scan.differences import with_objects
from fieldtool.experiment.checks.finding import Findings
from fieldtool.experiment.checks.settings import judge_fail_safe, judge_settings


def check_still(drive: CanopenDrive, findings: Findings) -> None:
    """Check one drive, as far as each finding allows the next.

    Raises
    ------
    BusError
        If the bus is gone.
    """
    axis = drive.axis
    with findings.failing("identity", axis) as went:
        _identity(drive, findings)
    if not went:
        return
    _objects(drive, findings)
    with findings.failing("power state", axis):
        _power_state(drive, findings)
    with findings.failing("modes", axis):
        _modes(drive, findings)
    with findings.failing("units", axis) as went:
        drive.read_scaling()
        drive.check_limits()
    if not went:
        return
    with findings.failing("settings", axis):
        settings = read_settings(drive)
        findings.add(
            judge_settings(axis, settings, drive.limits, drive.position_unit, drive.torque_unit)
        )
        reaction = drive.profile.heartbeat_reaction
        known = None if reaction == UNKNOWN else int(reaction)
        findings.add((judge_fail_safe(axis, settings, known),))


def _identity(drive: CanopenDrive, findings: Findings) -> None:
    identity = drive.identify()
    found = (
        f"node {drive.node_id}: {identity.device_name or 'no name'}, vendor "
        f"0x{identity.vendor_id:X}, product 0x{identity.product_code:X}, serial "
        f"{identity.serial_number}"
    )
    findings.note("identity", "pass", found, drive.axis)
    revision = drive.dictionary.device_information.revision_number
    same = not revision or revision == identity.revision
    findings.note(
        "firmware",
        "pass" if same else "warn",
        f"{identity.firmware or 'no version'}, revision 0x{identity.revision:X}"
        + ("" if same else f"; the EDS is of revision 0x{revision:X}"),
        drive.axis,
        "" if same else "Take the EDS of this firmware (`eds` of the axis).",
    )


def _power_state(drive: CanopenDrive, findings: Findings) -> None:
    code = lost_its_host(drive)
    if code is not None:
        findings.note(
            "power state",
            "warn",
            f"fault 0x{code:04X}: it lost its host, for an earlier session ended without a word",
            drive.axis,
            f"The next command that moves it resets the fault ({drive.profile.recovery}).",
        )
        return
    drive.check_idle()
    findings.note("power state", "pass", drive.power_state().words, drive.axis)


def _objects(drive: CanopenDrive, findings: Findings) -> None:
    identity = drive.identity
    presented = Presented(identity.device_type, identity.vendor_id, identity.product_code)
    fit = with_objects(match(drive.profile, presented), Asked(drive.node).read)
    findings.note(
        "objects",
        "warn" if fit.differences else "pass",
        f"{fit.asked - len(fit.differences)} of {fit.asked} objects of profile {fit.profile} are as "
        "its EDS says" + "".join(f"; {one}" for one in fit.differences),
        drive.axis,
        "Is the profile, or its EDS, that of another firmware?" if fit.differences else "",
    )


def _modes(drive: CanopenDrive, findings: Findings) -> None:
    drive.check_mode(Mode.CYCLIC_POSITION)
    floats = drive.axis_profile.may_float
    if floats:
        drive.check_mode(Mode.CYCLIC_TORQUE)
    found = f"cyclic position{' and cyclic torque, for floating' if floats else ''}"
    findings.note("modes", "pass", found, drive.axis)
