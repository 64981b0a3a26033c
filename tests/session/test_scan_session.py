"""``fieldtool scan`` as a technician uses it."""

import json

import pytest
import yaml

from drives.errors import ProfileError
from drives.profile import load_machine
from drives.sim.faults import NodeVanishes


def words(text: str) -> str:
    """What was printed, however its lines were broken."""
    return " ".join(text.split())


def test_a_machine_that_is_as_its_profile_says(bench) -> None:
    outcome = bench.command("scan", bench.profile)
    assert outcome.code == 0
    assert f"Every node is as {bench.data['name']} says." in words(outcome.out)
    assert bench.changed() == {}


def test_json_is_one_object(bench) -> None:
    outcome = bench.command("scan", bench.profile, "--json")
    found = json.loads(outcome.out)
    assert outcome.code == 0
    assert [node["node_id"] for node in found["nodes"]] == [11, 12]
    assert {node["profiles"][0]["name"] for node in found["nodes"]} == {"reference"}
    assert found["machine"]["remarks"] == []
    assert found["bus"]["bitrate"] == 1_000_000


def test_what_differs_from_the_machine_profile_is_said(bench) -> None:
    bench.inject(NodeVanishes(11))
    bench.data["axes"][1]["serial_number"] = 4711
    bench.rewrite(bench.data)
    outcome = bench.command("scan", bench.profile)
    assert outcome.code == 0
    assert "table: node 11 is not there." in words(outcome.out)
    assert "arm: node 12 has serial number 1012, the machine profile says 4711" in words(
        outcome.out
    )


def test_a_node_of_no_axis_is_said(bench) -> None:
    del bench.data["axes"][1], bench.data["couplings"], bench.data["simulation"]
    bench.rewrite(bench.data)
    assert "node 12 belongs to no axis" in words(bench.command("scan", bench.profile).out)


def test_the_bus_can_be_given_without_a_machine(bench) -> None:
    outcome = bench.command("scan", "--interface", "fieldsim", "--channel", bench.channel)
    assert outcome.code == 0
    assert "2 nodes" in words(outcome.out)


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        ([], "--interface"),
        (["--interface", "fieldsim", "--channel", "x", "--bitrate", "7"], "--bitrate"),
        (["--interface", "fieldsim", "--channel", "x", "--listen", "0"], "--listen"),
    ],
)
def test_wrong_use(bench, arguments: list[str], word: str) -> None:
    outcome = bench.command("scan", *arguments)
    assert outcome.code == 2
    assert word in outcome.err


def test_a_bus_that_can_not_be_opened(bench) -> None:
    outcome = bench.command("scan", "--interface", "fieldsim", "--channel", "nowhere")
    assert outcome.code == 3
    assert "nowhere" in outcome.err


def test_a_bus_with_nobody_on_it(bench) -> None:
    outcome = bench.command(
        "scan", "--interface", "virtual", "--channel", "nobody", "--listen", "0.1"
    )
    assert outcome.code == 3
    assert "none of the 127 node ids answered" in words(outcome.out)


def filled_in(text: str) -> str:
    """Do what the person does who completes the profile."""
    for key, value in (
        ('kind: "FILL IN"', "kind: rotary"),
        ('["FILL IN", "FILL IN"]', "[-90 deg, 90 deg]"),
        ('velocity: "FILL IN"', "velocity: 3 rad/s"),
        ('acceleration: "FILL IN"', "acceleration: 60 rad/s2"),
        ('torque: "FILL IN"', "torque: 6 N m"),
        ('following_error: "FILL IN"', "following_error: 5 deg"),
        ('masses: ["FILL IN"]', "masses: [0.02]"),
    ):
        assert key in text
        text = text.replace(key, value)
    assert "FILL IN" not in yaml.safe_dump(yaml.safe_load(text))
    return text


def test_the_skeleton_moves_nothing_until_a_person_has_completed_it(bench) -> None:
    path = bench.folder / "found.yaml"
    outcome = bench.command("scan", bench.profile, "--profile", path)
    assert outcome.code == 0
    assert "2 axes, 16 places to fill in" in words(outcome.out)
    text = path.read_text(encoding="utf-8")
    assert text.count('"FILL IN"') == 16
    with pytest.raises(ProfileError, match=r"found\.yaml:1\d: axis axis1, kind"):
        load_machine(path)
    assert bench.command("run", path).code == 2

    path.write_text(filled_in(text), encoding="utf-8")
    machine = load_machine(path)
    assert [(a.node_id, a.serial_number, a.drive) for a in machine.axes] == [
        (11, 1011, "reference"),
        (12, 1012, "reference"),
    ]
    assert machine.bus.channel == bench.channel
    assert bench.command("scan", path).out.count("as found says.") == 1


def test_no_line_of_the_skeleton_is_ready_to_use_while_one_place_is_open(bench) -> None:
    path = bench.folder / "found.yaml"
    bench.command("scan", bench.profile, "--profile", path)
    full = filled_in(path.read_text(encoding="utf-8")).splitlines()
    raw = path.read_text(encoding="utf-8").splitlines()
    open_lines = [k for k, line in enumerate(raw) if '"FILL IN"' in line.split("#")[0]]
    assert len(open_lines) == 14
    for k in open_lines:
        path.write_text("\n".join([*full[:k], raw[k], *full[k + 1 :]]), encoding="utf-8")
        with pytest.raises(ProfileError, match=rf"found\.yaml:{k + 1}: "):
            load_machine(path)


def test_a_file_is_never_overwritten(bench) -> None:
    outcome = bench.command("scan", bench.profile, "--profile", bench.profile)
    assert outcome.code == 3
    assert "exists, and is not overwritten" in outcome.err


def test_a_drives_name_can_not_write_into_the_profile(bench) -> None:
    name = b"x\n    limits: {torque: 1 N m}\n[red]bold[/red]"
    for node in bench.machine.nodes:
        node.dictionary.force(0x1008, 0, name)
    path = bench.folder / "hostile.yaml"
    outcome = bench.command("scan", bench.profile, "--profile", path, "--json")
    assert outcome.code == 0
    assert json.loads(outcome.out)["nodes"][0]["identity"]["device_name"] == name.decode()
    load = yaml.safe_load(path.read_text(encoding="utf-8"))
    assert load["axes"][0]["limits"]["torque"] == "FILL IN"
    assert len(load["axes"][0]["limits"]) == 5
    shown = bench.command("scan", bench.profile)
    assert shown.code == 0
    assert "[red]bold" in shown.out.replace("\n", "").replace(" ", "")


def test_a_scan_can_be_traced(bench) -> None:
    trace = bench.folder / "scan.log"
    assert bench.command("scan", bench.profile, "--trace-file", trace).code == 0
    assert trace.read_text().count("#4000100000000000 T") >= 127
