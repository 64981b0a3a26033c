"""A machine profile to begin with, from what was found on a bus; what nobody knows is left open."""

import json
from pathlib import Path

from drives import objects
from drives.objects import ObjectInfo
from drives.scan import ScannedNode
from fieldtool.errors import OutputError
from fieldtool.records.files import write_new
from fieldtool.workflow.scanning import ScanResult

OPEN = "FILL IN"
"""Stands where a person has to enter something; the profile is refused, with its line, until then."""
_LIMIT_OBJECTS: tuple[tuple[str, tuple[ObjectInfo, ...]], ...] = (
    ("travel", (objects.SOFTWARE_LIMIT_LOW, objects.SOFTWARE_LIMIT_HIGH)),
    ("velocity", (objects.MAX_PROFILE_VELOCITY, objects.MAX_MOTOR_SPEED)),
    ("acceleration", (objects.MAX_ACCELERATION,)),
    ("torque", (objects.MAX_TORQUE, objects.RATED_TORQUE)),
    ("following_error", (objects.FOLLOWING_ERROR_WINDOW,)),
)
_EXAMPLES = {
    "travel": "[-90 deg, 90 deg]",
    "velocity": "3 rad/s",
    "acceleration": "60 rad/s2",
    "torque": "12 N m",
    "following_error": "5 deg",
}


def skeleton(result: ScanResult, name: str) -> str:
    """Return a machine profile as YAML, with every drive that was found and no invented limit.

    The drives' own limits stand beside, as they are in the drives, for comparison only.
    """
    drives = [node for node in result.scan.nodes if _is_drive(node)]
    others = [node.node_id for node in result.scan.nodes if not _is_drive(node)]
    bus = result.bus
    channel = "" if bus.channel is None else f", channel: {json.dumps(bus.channel)}"
    lines = [
        f"# A machine profile to be completed: every {OPEN} stands for what only a person knows.",
        "# Limits are those of the machine, from its documents or its maker; nothing moves without",
        "# them. What is written behind them is only what the drive is set to now, in its own units.",
        "format: fieldtool-machine/1",
        f"name: {name}",
        f"bus: {{interface: {bus.interface}{channel}, bitrate: {bus.bitrate}}}",
        "",
        "axes:",
    ]
    for number, node in enumerate(drives, 1):
        lines += _axis(number, node)
    if others:
        ids = ", ".join(map(str, others))
        lines += ["", f"# Not taken up, as no CiA 402 drive answered there: node {ids}."]
    return "\n".join(lines) + "\n"


def write_skeleton(result: ScanResult, path: Path) -> tuple[int, int]:
    """Write :func:`skeleton` to a new file; return the numbers of axes and of open places.

    Raises
    ------
    OutputError
        If the file exists or can not be written, or no drive was found.
    """
    drives = sum(_is_drive(node) for node in result.scan.nodes)
    if not drives:
        raise OutputError(f"{path}: not written, because no CiA 402 drive was found on the bus.")
    name = "".join(c if c.isascii() and (c.isalnum() or c in "_-") else "-" for c in path.stem)
    name = (name if name[:1].isalpha() else f"m-{name}")[:32]
    text = skeleton(result, name)
    try:
        write_new(path, text)
    except FileExistsError:
        raise OutputError(f"{path}: exists, and is not overwritten. Choose another file.") from None
    body = [line.split("#")[0] for line in text.splitlines()]
    return drives, sum(line.count(OPEN) for line in body)


def _is_drive(node: ScannedNode) -> bool:
    return node.identity is not None and node.identity.device_type & 0xFFFF == 402


def _axis(number: int, node: ScannedNode) -> list[str]:
    identity, fit = node.identity, node.fit
    if identity is None:
        return []
    if fit is None:
        drive, why = f'"{OPEN}"', "no packaged drive profile fits; make one from the drive's EDS"
    else:
        drive, why = fit.profile, f"drive profile {fit.profile} {fit.verdict}: {fit.why}"
    lines = [
        f"  # {_plain(identity.device_name) or 'a drive'}, {_plain(identity.firmware)}",
        f"  # {_plain(why, 400)}",
        *(
            f"  # {need.found}: {need.what} ({need.shown})"
            + (f": {need.consequence}" if need.consequence else "")
            for need in node.needs
            if need.found != "there"
        ),
        f"  - name: axis{number}",
        f'    kind: "{OPEN}"    # rotary or linear',
        f"    node_id: {node.node_id}",
        f"    serial_number: {identity.serial_number}" if identity.serial_number else "",
        f"    drive: {drive}",
        "    limits:",
    ]
    for key, infos in _LIMIT_OBJECTS:
        value = f'["{OPEN}", "{OPEN}"]' if key == "travel" else f'"{OPEN}"'
        lines.append(f"      {key}: {value}    # such as {_EXAMPLES[key]}{_shown(node, infos)}")
    lines += [
        "    prior:    # the axis as last accepted, motor side first",
        f'      masses: ["{OPEN}"]    # kg m2 (kg on a linear axis); springs between them',
    ]
    return [line for line in lines if line]


def _shown(node: ScannedNode, infos: tuple[ObjectInfo, ...]) -> str:
    there = [(info, value) for info in infos if (value := node.number(info)) is not None]
    if not there:
        return ""
    return "; now in the drive: " + ", ".join(f"{info.address} = {value}" for info, value in there)


def _plain(text: str, longest: int = 60) -> str:
    """Return what can stand in a comment: drives may send anything as their name."""
    return "".join(c for c in text if c.isprintable())[:longest]
