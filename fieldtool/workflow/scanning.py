"""What is on a bus, and how it compares with a machine profile."""

from collections.abc import Mapping
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from drives.bus import close_bus, open_bus
from drives.profile import BusProfile, DriveProfile, MachineProfile, load_drive, packaged
from drives.scan import Scan, ScannedNode
from drives.scan import scan as scan_bus
from drives.scan.scanning import LISTEN, Progress
from drives.trace import traced
from fieldtool.writeback.alone import alone_on


@dataclass(frozen=True)
class ScanResult:
    """What is on a bus."""

    bus: BusProfile
    scan: Scan
    machine: MachineProfile | None = None
    remarks: tuple[str, ...] = ()
    """How it compares with the machine profile, a sentence each."""

    def as_dict(self) -> dict[str, Any]:
        """Plain values, as ``--json`` prints them."""
        traffic = self.scan.traffic
        return {
            "bus": {
                "interface": self.bus.interface,
                "channel": self.bus.channel,
                "bitrate": self.bus.bitrate,
            },
            "heard": {
                "seconds": traffic.seconds,
                "frames": traffic.frames,
                "error_frames": traffic.errors,
                "extended_frames": traffic.extended,
                "commands": list(traffic.commands),
                "sync_period_s": traffic.sync_period,
            },
            "asked": self.scan.asked,
            "nodes": [_node_dict(node) for node in self.scan.nodes],
            "problems": list(self.scan.problems),
            "machine": None
            if self.machine is None
            else {"name": self.machine.name, "remarks": list(self.remarks)},
        }


def scan(
    bus: BusProfile,
    machine: MachineProfile | None = None,
    *,
    listen: float = LISTEN,
    ask: bool | None = None,
    trace: Path | None = None,
    progress: Progress = lambda _what, _share: None,
) -> ScanResult:
    """Listen to a bus, ask who is there, and compare with drive profiles; nothing is written.

    Parameters
    ----------
    bus
        Where it is.
    machine
        Profile of the machine that should be there, if there is one.
    listen, ask, progress
        As of ``drives.scan.scan``.
    trace
        File that every frame is noted in.

    Raises
    ------
    ProfileError
        If a drive profile that the machine names is wrong.
    BusError
        If the bus can not be opened, or does not take frames.
    UnfinishedWriteError
        If another process of the tool uses it.
    """
    profiles = {name: load_drive(name) for name in packaged("drives")}
    if machine is not None:
        for axis in machine.axes:
            one = load_drive(axis.drive, machine.path)
            profiles[one.name] = one
    with nullcontext() if ask is False else alone_on(bus):
        opened = open_bus(bus)
        try:
            with traced(opened, trace) as used:
                found = scan_bus(
                    used, bus.bitrate, profiles, listen=listen, ask=ask, progress=progress
                )
        finally:
            close_bus(opened)
    remarks = () if machine is None else compared_with(machine, found, profiles)
    return ScanResult(bus, found, machine, remarks)


def compared_with(
    machine: MachineProfile, found: Scan, profiles: Mapping[str, DriveProfile]
) -> tuple[str, ...]:
    """Return how what was found differs from a machine profile, a sentence each."""
    remarks = []
    nodes = {node.node_id: node for node in found.nodes}
    for axis in machine.axes:
        node = nodes.pop(axis.node_id, None)
        if node is None or not node.answers:
            how = "was not heard" if node is None else "was heard, but not asked"
            if found.asked or node is None:
                how = "is not there" if node is None else "does not answer"
            remarks.append(f"{axis.name}: node {axis.node_id} {how}.")
            continue
        identity = node.identity
        wanted = axis.serial_number
        if identity is not None and wanted is not None and identity.serial_number != wanted:
            remarks.append(
                f"{axis.name}: node {axis.node_id} has serial number {identity.serial_number}, the "
                f"machine profile says {wanted}: another drive, or node ids exchanged?"
            )
        name = next((p.name for k, p in profiles.items() if axis.drive in (k, p.name)), axis.drive)
        if all(fit.profile != name for fit in node.fits if fit.fits):
            remarks.append(
                f"{axis.name}: node {axis.node_id} is not what drive profile {axis.drive} describes."
            )
    remarks += [f"node {node_id} belongs to no axis of the profile." for node_id in sorted(nodes)]
    return tuple(remarks)


def _node_dict(node: ScannedNode) -> dict[str, Any]:
    heard, identity = node.heard, node.identity
    return {
        "node_id": node.node_id,
        "answers": node.answers,
        "heard": {
            "nmt_state": heard.state or None,
            "heartbeat_s": heard.heartbeat,
            "boot_up": heard.booted,
            "pdos": list(heard.pdos),
            "emergencies": list(heard.emergencies),
        },
        "identity": None
        if identity is None
        else {
            "device_type": identity.device_type,
            "vendor_id": identity.vendor_id,
            "product_code": identity.product_code,
            "revision": identity.revision,
            "serial_number": identity.serial_number,
            "device_name": identity.device_name,
            "firmware": identity.firmware,
        },
        "modes": None if node.modes is None else list(node.modes),
        "power_state": node.power or None,
        "profiles": [
            {
                "name": fit.profile,
                "verdict": fit.verdict,
                "why": fit.why,
                "differences": list(fit.differences),
            }
            for fit in node.fits
        ],
        "needs": [
            {
                "what": need.what,
                "found": need.found,
                "shown": need.shown,
                "consequence": need.consequence or None,
                "blocks_motion": need.blocks and need.found == "missing",
            }
            for need in node.needs
        ],
        "problem": node.problem or None,
    }
