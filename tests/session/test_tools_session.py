"""Tool sets: kept from what was tried, compared, switched by the same all-or-nothing write."""

import json

import pytest
import yaml

from drives.profile import load_machine
from drives.sim.faults import SdoRefused
from fieldtool.records.model_file import write_model
from fieldtool.workflow.models import truth_model
from fieldtool.writeback.tool_sets import tools_folder
from tests.session.test_verification_session import GOOD, write_tuning

TABLE, ARM = 11, 12
VELOCITY_P = (0x2010, 2)


@pytest.fixture
def session(bench):
    bench.out.mkdir()
    (bench.out / "machine.yaml").write_text(bench.profile.read_text())
    write_tuning(bench, GOOD)
    write_model(truth_model(load_machine(bench.profile)), bench.out / "model.yaml")
    return bench


def tools(bench, *words):
    return bench.command("tools", words[0], bench.profile, *words[1:])


def gain(bench, node):
    return bench.machine.node(node).dictionary.read(*VELOCITY_P)


@pytest.mark.usefixtures("untried")
def test_sets_are_kept_compared_and_switched_there_and_back(session, tmp_path):
    assert tools(session, "keep", "bare").code == 0
    old = {node: gain(session, node) for node in (TABLE, ARM)}
    assert session.command("write", session.out, "--yes").code == 0
    kept = tools(session, "keep", "gripper", "--from", session.out)
    assert kept.code == 0, kept.err
    assert "NOT tried" in kept.out
    new = {node: gain(session, node) for node in (TABLE, ARM)}
    assert new != old
    compared = tools(session, "compare", "bare", "gripper", "--json")
    differences = json.loads(compared.out)["differences"]
    assert {(d["axis"], d["name"]) for d in differences} >= {
        ("table", "velocity_p"),
        ("arm", "velocity_p"),
    }
    assert next(d for d in differences if d["name"] == "velocity_p")["bare"] == old[TABLE]
    back = tools(session, "switch", "bare", "--yes", "--out", tmp_path / "one")
    assert back.code == 0, back.err
    assert session.changed() == {}, "bit by bit what it was"
    assert "was not tried" in " ".join((back.out + back.err).split())
    again = tools(session, "switch", "gripper", "--yes", "--out", tmp_path / "two")
    assert again.code == 0, again.err
    assert {node: gain(session, node) for node in (TABLE, ARM)} == new
    assert session.command("restore", tmp_path / "two").code == 0
    assert session.changed() == {}
    listed = tools(session, "list", "--json")
    assert [(t["name"], t["verified"]) for t in json.loads(listed.out)["tools"]] == [
        ("bare", False),
        ("gripper", False),
    ]


def test_a_set_that_stood_its_trial_says_so_and_may_be_stored(session, tmp_path):
    assert session.command("write", session.out, "--yes").code == 0
    kept = tools(session, "keep", "gripper", "--from", session.out, "--json")
    assert json.loads(kept.out)["verified"] is True
    assert json.loads(kept.out)["figures"]["table"]["sensitivity_peak"] < 2.1
    assert session.command("restore", session.out).code == 0
    stored = tools(session, "switch", "gripper", "--yes", "--store", "--out", tmp_path / "one")
    assert stored.code == 0, stored.err
    for node in session.machine.nodes:
        node.power_cycle()
    assert "0x2010:02" in session.changed()[TABLE]


@pytest.mark.usefixtures("untried")
def test_what_was_not_tried_is_not_stored(session, tmp_path):
    tools(session, "keep", "bare")
    outcome = tools(session, "switch", "bare", "--yes", "--store", "--out", tmp_path / "one")
    assert outcome.code == 3
    assert "was not tried" in outcome.err
    assert session.changed() == {}


@pytest.mark.usefixtures("untried")
def test_parameters_changed_after_the_trial_are_not_verified(session):
    """What was tried is not what was written last."""
    session.command("write", session.out, "--yes")
    (session.out / "verification.yaml").write_text(
        yaml.safe_dump({"verdict": "verified", "parameters": [], "axes": []})
    )
    kept = tools(session, "keep", "gripper", "--from", session.out, "--json")
    assert json.loads(kept.out)["verified"] is False


@pytest.mark.usefixtures("untried")
def test_a_switch_that_fails_half_way_restores_all_drives(session, tmp_path):
    tools(session, "keep", "bare")
    session.command("write", session.out, "--yes")
    tools(session, "keep", "gripper", "--from", session.out)
    tools(session, "switch", "bare", "--yes", "--out", tmp_path / "one")
    session.inject(SdoRefused(ARM, *VELOCITY_P, 0x08000022))
    session.machine.node(ARM).sdo.aborting.clear()
    session.machine.node(ARM).dictionary.guards[VELOCITY_P] = lambda _: 0x08000022
    outcome = tools(session, "switch", "gripper", "--yes", "--out", tmp_path / "two")
    assert outcome.code == 6, outcome.err
    assert session.changed() == {}


@pytest.mark.usefixtures("untried")
@pytest.mark.parametrize(
    ("words", "code", "sentence"),
    [
        (("switch", "none", "--yes"), 2, "has no tool set 'none'"),
        (("keep", "../x"), 2, "is made of letters"),
        (("keep", "x", "--from", "."), 2, "nothing was written from this session"),
    ],
)
def test_wrong_use_is_one_sentence(session, words, code, sentence, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    outcome = tools(session, *words)
    assert outcome.code == code, outcome.err
    assert sentence in outcome.err
    assert session.changed() == {}


@pytest.mark.usefixtures("untried")
def test_a_set_of_other_drives_is_refused(session, make_bench, tmp_path):
    tools(session, "keep", "bare")
    other = make_bench(session.data | {}, serial=9999)
    outcome = tools(other, "switch", "bare", "--yes", "--out", tmp_path / "one")
    assert outcome.code == 3
    assert "serial number" in outcome.err
    assert other.changed() == {}


@pytest.mark.usefixtures("untried")
def test_a_damaged_set_is_refused(session, tmp_path):
    tools(session, "keep", "bare")
    path = tools_folder("bench") / "bare" / "parameters.yaml"
    path.write_text(path.read_text().replace("value: 1200", "value: 12000", 1))
    outcome = tools(session, "switch", "bare", "--yes", "--out", tmp_path / "one")
    assert outcome.code == 2
    assert "checksum" in outcome.err
    assert session.changed() == {}


@pytest.mark.usefixtures("untried")
def test_a_session_whose_write_was_restored_is_no_tool_set(session):
    session.command("write", session.out, "--yes")
    session.command("restore", session.out)
    outcome = tools(session, "keep", "gripper", "--from", session.out)
    assert outcome.code == 2
    assert "did not end with its parameters in the drives" in outcome.err
