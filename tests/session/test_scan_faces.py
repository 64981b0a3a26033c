"""A scan among makers' drives: each is known by who it is, and what it lacks is said."""

import pytest

from drives.bus import open_bus
from drives.profile import load_drive, packaged
from drives.scan import ScannedNode, scan
from tests.faces import machine_of, simulated

PROFILES = {name: load_drive(name) for name in packaged("drives")}


def scanned(drive: str, folder) -> tuple[ScannedNode, dict]:
    """Scan a machine of this drive and a reference drive; return its node, and what was written."""
    machine = machine_of((drive, "reference"), folder)
    with simulated(machine) as running:
        before = [node.dictionary.parameters() for node in running.nodes]
        bus = open_bus(machine.bus)
        try:
            found = scan(bus, machine.bus.bitrate, PROFILES)
        finally:
            bus.shutdown()
        assert [node.dictionary.parameters() for node in running.nodes] == before
        first, second = found.nodes
        assert second.fit is not None
        assert second.fit.profile == "reference"
        return first, {need.what: need for need in first.lacking}


@pytest.mark.parametrize("drive", ["epos4", "elmo-gold", "elmo-simpliq", "prbt"])
def test_a_makers_drive_is_known_by_its_profile(tmp_path, drive: str) -> None:
    node, _ = scanned(drive, tmp_path)
    assert node.fit is not None
    print(drive, "->", node.fit.profile, node.fit.verdict, "|", node.fit.why)
    print(node.fit.differences)
    assert node.fit.profile.split("-dual")[0] == drive
    assert node.fit.asked == 0 or len(node.fit.differences) < node.fit.asked / 2


@pytest.mark.parametrize(
    ("drive", "lacks"),
    [
        ("prbt", {"mode cyclic position", "reaction to a lost host"}),
        ("elmo-simpliq", {"mode cyclic position"}),
    ],
)
def test_what_a_makers_drive_can_not_do_is_said(tmp_path, drive: str, lacks: set[str]) -> None:
    _, lacking = scanned(drive, tmp_path)
    assert lacks <= set(lacking), lacking
    assert all(lacking[what].blocks for what in lacks)
