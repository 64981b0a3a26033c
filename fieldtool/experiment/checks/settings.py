"""Judge what a drive is set to against what the machine profile allows; nothing is read here."""

from collections.abc import Callable

from drives.api import AxisLimits
from drives.canopen_drive.settings import DriveSettings
from fieldtool.experiment.checks.finding import Finding, Status

TORQUE_FACTOR = 5.0
"""Times the rated torque above which a torque limit looks like a wrong unit."""
COUNTS_OF_TRAVEL = 1000.0
"""Position units that a travel has at least, if the units are right."""
REVOLUTIONS_OF_TRAVEL = 1e5
TORQUE_AT_REST = 0.05
"""Share of the rated torque that a disabled drive may show."""
NEAR_END = 0.02
"""Share of the travel that an axis should stand away from its ends."""
COAST = 0
"""Value of 0x605A that lets the axis run out."""

Check = Callable[[DriveSettings, AxisLimits, str, str], tuple[Status, str, str]]
"""Gets settings, limits, units of position and torque; gives status, what was found, what to do."""


def _travel_limits(
    s: DriveSettings, limits: AxisLimits, unit: str, _t: str
) -> tuple[Status, str, str]:
    low, high = limits.travel
    profile = f"the profile allows {low:.4g} to {high:.4g} {unit}"
    if s.travel is None:
        return (
            "pass",
            f"the drive has none of its own (0x607D); {profile}, and the tool alone watches it",
            "",
        )
    found = f"the drive's own are {s.travel[0]:.4g} to {s.travel[1]:.4g} {unit} (0x607D); {profile}"
    slack = 2 * s.count
    if s.travel[0] > low + slack or s.travel[1] < high - slack:
        return (
            "fail",
            found,
            "The drive would refuse targets that the tool may send. Make the profile's travel smaller, "
            "or correct 0x607D if the machine allows it.",
        )
    return "pass", found, ""


def _velocity_limit(
    s: DriveSettings, limits: AxisLimits, unit: str, _t: str
) -> tuple[Status, str, str]:
    return _not_tighter("0x607F", s.velocity, limits.velocity, f"{unit}/s", "velocity")


def _acceleration_limit(
    s: DriveSettings, limits: AxisLimits, unit: str, _t: str
) -> tuple[Status, str, str]:
    return _not_tighter("0x60C5", s.acceleration, limits.acceleration, f"{unit}/s2", "acceleration")


def _torque_limit(
    s: DriveSettings, limits: AxisLimits, _u: str, unit: str
) -> tuple[Status, str, str]:
    return _not_tighter("0x6072", s.max_torque, limits.torque, unit, "torque")


def _following_error(
    s: DriveSettings, limits: AxisLimits, unit: str, _t: str
) -> tuple[Status, str, str]:
    return _not_tighter(
        "0x6065", s.following_error, limits.following_error, unit, "following_error"
    )


def _not_tighter(
    place: str, own: float | None, allowed: float, unit: str, key: str
) -> tuple[Status, str, str]:
    """Judge a limit of the drive: one that is tighter than the profile's acts first."""
    profile = f"the profile allows {allowed:.4g} {unit}"
    if own is None:
        return "pass", f"the drive has none of its own ({place}), or it is off; {profile}", ""
    found = f"the drive's own is {own:.4g} {unit} ({place}); {profile}"
    if own < allowed * (1 - 1e-3):
        return (
            "warn",
            found,
            f"The drive's own limit acts first and spoils the measurement: give `{key}` in the machine "
            f"profile {own:.4g} {unit} or less, or correct {place}.",
        )
    return "pass", found, ""


def _rated_torque(
    s: DriveSettings, limits: AxisLimits, _u: str, unit: str
) -> tuple[Status, str, str]:
    ratio = limits.torque / s.rated_torque
    found = (
        f"rated torque {s.rated_torque:.4g} {unit}; the profile's limit is {ratio:.2g} times that"
    )
    if ratio > TORQUE_FACTOR:
        return (
            "fail",
            found,
            "No motor gives that for long: is the rated torque's unit right (0x6076 and the drive "
            "profile), and the limit that of the motor side?",
        )
    return "pass", found, ""


def _resolution(
    s: DriveSettings, limits: AxisLimits, unit: str, _t: str
) -> tuple[Status, str, str]:
    counts = (limits.travel[1] - limits.travel[0]) / s.count
    found = f"one position unit is {s.count:.4g} {unit}, the travel {counts:.4g} of them"
    if counts < COUNTS_OF_TRAVEL:
        return (
            "fail",
            found,
            "Far too coarse: is the encoder's resolution (0x608F) that of the motor, and `kind` and "
            "`feed` right?",
        )
    return "pass", found, ""


def _torque_at_rest(
    s: DriveSettings, _l: AxisLimits, _u: str, unit: str
) -> tuple[Status, str, str]:
    mean = sum(s.torque) / len(s.torque)
    share = abs(mean) / s.rated_torque
    found = f"{mean:.3g} {unit} while disabled, {100 * share:.2g} % of the rated torque"
    if share > TORQUE_AT_REST:
        return (
            "fail",
            found,
            "A disabled drive gives no torque: is it really off, its current offset adjusted, and is "
            "0x6077 what the profile says?",
        )
    return "pass", found, ""


def _position(s: DriveSettings, limits: AxisLimits, unit: str, _t: str) -> tuple[Status, str, str]:
    low, high = limits.travel
    room = min(s.position - low, high - s.position)
    found = f"stands at {s.position:.4g} {unit}; the travel is {low:.4g} to {high:.4g} {unit}"
    if room < 0:
        return (
            "fail",
            found,
            "Move it inside by hand or with the machine's own controller; was it homed, and is the "
            "profile's zero the drive's?",
        )
    if room < NEAR_END * (high - low):
        return "warn", found, "It stands at the end of its travel: move it away from there."
    return "pass", f"{found}: {room:.3g} {unit} to the nearer end", ""


def _drive_warnings(s: DriveSettings, _l: AxisLimits, _u: str, _t: str) -> tuple[Status, str, str]:
    said = [
        text
        for bit, text in (
            (s.warning, "a warning (bit 7)"),
            (s.internal_limit, "an active internal limit (bit 11)"),
        )
        if bit
    ]
    if said:
        return (
            "warn",
            f"the statusword shows {' and '.join(said)}",
            "Look at the drive's own display or software for the cause.",
        )
    return "pass", "none in the statusword", ""


DRIVE_CHECKS: tuple[tuple[str, Check], ...] = (
    ("position", _position),
    ("torque at rest", _torque_at_rest),
    ("torque unit", _rated_torque),
    ("position unit", _resolution),
    ("travel limits", _travel_limits),
    ("velocity limit", _velocity_limit),
    ("acceleration limit", _acceleration_limit),
    ("torque limit", _torque_limit),
    ("following error limit", _following_error),
    ("warnings", _drive_warnings),
)
"""Name and judgement, in the order in which they are shown."""


def judge_settings(
    axis: str, settings: DriveSettings, limits: AxisLimits, position_unit: str, torque_unit: str
) -> tuple[Finding, ...]:
    """Return what all checks of ``DRIVE_CHECKS`` find on one axis."""
    findings = []
    for name, check in DRIVE_CHECKS:
        status, found, todo = check(settings, limits, position_unit, torque_unit)
        findings.append(Finding(name, status, found, axis, todo))
    return tuple(findings)


def judge_fail_safe(axis: str, settings: DriveSettings, reaction: int | None) -> Finding:
    """Judge whether the drive can stop by itself when the host dies.

    Parameters
    ----------
    axis
        Name.
    settings
        Of its drive.
    reaction
        What 0x6007 is set to while the machine moves; None if the drive profile does not know it.
    """
    check, lacking = "stops by itself", []
    if settings.consumer_heartbeat is None:
        lacking.append("heartbeat consumer (0x1016)")
    if settings.abort_connection is None:
        lacking.append("abort connection option (0x6007)")
    if lacking:
        return Finding(
            check,
            "fail",
            f"the drive has no {' and no '.join(lacking)}",
            axis,
            "Nothing would stop it when this computer dies: it may not be moved by this tool.",
        )
    if reaction is None:
        return Finding(
            check,
            "fail",
            "the drive profile does not know which abort connection option (0x6007) makes it stop",
            axis,
            "Find it in the drive's manual, and enter `heartbeat_reaction` in a drive profile of your "
            "own.",
        )
    there = ["heartbeat consumer (0x1016)", "abort connection option (0x6007)"]
    if settings.error_behaviour is not None:
        there.append("error behaviour (0x1029)")
    coast = "; its quick stop would let it coast (0x605A = 0), a ramp is set for the time of motion"
    return Finding(
        check,
        "pass",
        f"{', '.join(there)} are there; they are set while it moves, then put back"
        + (coast if settings.quick_stop == COAST else ""),
        axis,
    )
