"""Tool sets: kept from what was tried, compared, switched by the same all-or-nothing write."""

import json
import re
import shutil
import signal
from importlib.resources import files

import pytest
import yaml

from drives.canopen_drive import connect
from drives.parameters import Transaction
from drives.profile import load_machine
from drives.sim.faults import SdoRefused
from fieldtool.writeback.temporary import backed_up
from fieldtool.writeback.tool_sets import tools_folder
from tests.tunings import begun

TABLE, ARM = 11, 12
VELOCITY_P = (0x2010, 2)


@pytest.fixture
def session(bench):
    return begun(bench)


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
    assert "NOT tried" in " ".join(kept.out.split())
    new = {node: gain(session, node) for node in (TABLE, ARM)}
    assert new != old
    compared = tools(session, "compare", "bare", "gripper", "--json")
    differences = json.loads(compared.out)["differences"]
    assert {(d["axis"], d["name"]) for d in differences} >= {
        ("table", "velocity_p"),
        ("arm", "velocity_p"),
    }
    assert next(d for d in differences if d["name"] == "velocity_p")["values"] == {
        "bare": old[TABLE],
        "gripper": new[TABLE],
    }
    back = tools(session, "switch", "bare", "--yes", "--out", tmp_path / "one")
    assert back.code == 0, back.err
    assert session.changed() == {}, "bit by bit what it was"
    assert "was not tried" in " ".join((back.out + back.err).split())
    assert "--store" not in back.out
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


@pytest.mark.usefixtures("untried")
def test_a_set_may_have_the_name_of_a_key(session):
    """Its value took the place of the axis in what a program reads."""
    assert tools(session, "keep", "axis").code == 0
    old = gain(session, TABLE)
    assert session.command("write", session.out, "--yes").code == 0
    assert tools(session, "keep", "object", "--from", session.out).code == 0
    compared = json.loads(tools(session, "compare", "axis", "object", "--json").out)
    rows = [d for d in compared["differences"] if d["axis"] == "table"]
    (row,) = [d for d in rows if d["name"] == "velocity_p"]
    assert row == {
        "axis": "table",
        "name": "velocity_p",
        "object": "0x2010:02",
        "values": {"axis": old, "object": gain(session, TABLE)},
    }


@pytest.mark.parametrize("folder", ["one", "another"])
def test_a_set_that_stood_its_trial_says_so_and_may_be_stored(session, tmp_path, folder):
    assert session.command("write", session.out, "--yes").code == 0
    kept = tools(session, "keep", "gripper", "--from", session.out, "--json")
    assert json.loads(kept.out)["verified"] is True
    assert json.loads(kept.out)["figures"]["table"]["sensitivity_peak"] < 2.1
    assert session.command("restore", session.out).code == 0
    switched = tools(session, "switch", "gripper", "--yes", "--out", tmp_path / "one")
    named = re.search(
        r"To keep them: `fieldtool (restore [^`]*)`, then the same command with --store\.",
        " ".join(switched.out.split()),
    )
    assert named is not None, switched.out
    assert session.command(*named[1].split()).code == 0
    assert session.changed() == {}
    stored = tools(session, "switch", "gripper", "--yes", "--store", "--out", tmp_path / folder)
    assert stored.code == 0, stored.err
    power_cycle(session)
    new = session.changed()
    assert "0x2010:02" in new[TABLE]
    itself = tools(session, "switch", "gripper", "--yes", "--out", tmp_path / "same")
    assert "The drives held these values before" in " ".join(itself.out.split())
    assert "fieldtool restore" not in itself.out
    back = re.search(r"`fieldtool (restore [^`]*)` takes it back", " ".join(stored.out.split()))
    assert session.command(*back[1].split()).code == 0
    power_cycle(session)
    assert session.changed() == {}
    drive = yaml.safe_load((PACKAGED / "reference.yaml").read_text())
    give_drives(session, drive | {"store": "unknown"})
    kept = tools(session, "switch", "gripper", "--yes", "--out", tmp_path / "unknown")
    assert kept.code == 0, kept.err
    assert "working memory only" in " ".join(kept.out.split())
    assert "--store" not in kept.out


def power_cycle(session):
    for node in session.machine.nodes:
        node.power_cycle()


PACKAGED = files("profiles") / "drives"


def give_drives(session, profile):
    """Have all drives of the machine's profile described by this one."""
    (session.folder / "reference.eds").write_bytes((PACKAGED / "reference.eds").read_bytes())
    (session.folder / "own.yaml").write_text(yaml.safe_dump(profile, sort_keys=False))
    for axis in session.data["axes"]:
        axis["drive"] = "own.yaml"
    session.rewrite(session.data)


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
@pytest.mark.usefixtures("untried")
def test_the_command_that_keeps_a_set_that_is_missing_works_as_it_is_told(session, tmp_path):
    assert session.command("write", session.out, "--yes").code == 0
    missing = tools(session, "switch", "grip", "--yes")
    assert missing.code == 2, missing.err
    told = re.search(r"`fieldtool (tools keep .*) --from SESSION`", " ".join(missing.err.split()))
    kept = session.command(*told[1].split(), "--from", session.out)
    assert kept.code == 0, kept.err
    switched = tools(session, "switch", "grip", "--yes", "--out", tmp_path / "switched")
    assert switched.code == 0, switched.err


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


# --- files that were changed, or are none --------------------------------------------------------


def tool_file(name):
    return tools_folder("bench") / name / "tool.yaml"


@pytest.mark.usefixtures("untried")
@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("verified: false", "verified: true"),
        ("machine: bench", "machine: other"),
        ("name: bare", "name: gripper"),
        ("source: drives", "source: elsewhere"),
    ],
)
def test_words_about_a_set_that_were_changed_are_not_believed(session, tmp_path, old, new):
    tools(session, "keep", "bare")
    text = tool_file("bare").read_text()
    assert old in text
    tool_file("bare").write_text(text.replace(old, new))
    outcome = tools(session, "switch", "bare", "--yes", "--store", "--out", tmp_path / "one")
    assert outcome.code == 2, outcome.err
    assert "checksum" in outcome.err
    assert session.stored() == {TABLE: {}, ARM: {}}


@pytest.mark.usefixtures("untried")
@pytest.mark.parametrize("what", ["parameters", "both"])
def test_another_sets_files_under_this_name_are_refused(session, tmp_path, what):
    tools(session, "keep", "bare")
    session.command("write", session.out, "--yes")
    tools(session, "keep", "gripper", "--from", session.out)
    written = session.changed()
    for name in ("parameters.yaml", "tool.yaml")[: 1 if what == "parameters" else 2]:
        shutil.copy(tool_file("bare").with_name(name), tool_file("gripper").with_name(name))
    outcome = tools(session, "switch", "gripper", "--yes", "--out", tmp_path / "one")
    assert outcome.code == 2, outcome.err
    assert session.changed() == written


@pytest.mark.usefixtures("untried")
def test_bad_sets_are_listed_as_bad_and_do_not_hide_the_others(session):
    tools(session, "keep", "good")
    tools(session, "keep", "bad")
    tool_file("bad").write_text("[]")
    odd = tool_file("bad").parent.with_name("we ird")
    odd.mkdir()
    shutil.copy(tool_file("good"), odd / "tool.yaml")
    listed = tools(session, "list")
    assert listed.code == 0, listed.err
    assert "good" in listed.out
    assert "we ird: can not be used" in " ".join(listed.out.split())
    found = json.loads(tools(session, "list", "--json").out)
    assert [t["name"] for t in found["tools"]] == ["good"]
    assert [t["name"] for t in found["bad"]] == ["bad", "we ird"]


@pytest.mark.usefixtures("untried")
@pytest.mark.parametrize(
    "figures",
    ["{a: 3}", "{a: {b: .nan}}", "[]", "null", "{1: {b: 2}}", "{a: {b: 1" + "0" * 400 + "}}"],
)
def test_figures_that_are_none_are_one_sentence(session, figures):
    tools(session, "keep", "bare")
    path = tool_file("bare")
    path.write_text(path.read_text().replace("figures: {}", f"figures: {figures}"))
    found = json.loads(tools(session, "list", "--json").out)
    assert found["tools"] == []
    assert "figures" in found["bad"][0]["problem"]
    outcome = tools(session, "compare", "bare", "bare")
    assert outcome.code == 2
    assert len(outcome.err) < 1000


VERIFIED = "format: fieldtool-verification/1\nverdict: verified\nmodel: identified\nbound: 2\n"


@pytest.mark.usefixtures("untried")
@pytest.mark.parametrize(
    "text",
    [
        "[]",
        "null",
        VERIFIED + "parameters: null\naxes: []\n",
        VERIFIED + "parameters: 3\naxes: []\n",
        VERIFIED + "parameters: [1]\naxes: []\n",
        VERIFIED + "parameters:\n- {axis: table}\naxes: []\n",
        VERIFIED + "parameters: []\n",
        VERIFIED + "parameters: []\naxes: [{axis: table, after: {settling_time: .inf}}]\n",
        VERIFIED.replace("2", ".nan") + "parameters: []\naxes: []\n",
    ],
)
def test_a_verification_that_is_none_is_one_sentence(session, text):
    session.command("write", session.out, "--yes")
    (session.out / "verification.yaml").write_text(text)
    outcome = tools(session, "keep", "gripper", "--from", session.out)
    assert outcome.code == 2, outcome.err
    assert "verification.yaml" in outcome.err
    assert len(outcome.err) < 1000


@pytest.mark.usefixtures("untried")
@pytest.mark.parametrize(
    ("was", "now", "verified"),
    [("", "", True), ("bound: 2", "bound: 2.5", False), ("identified", "prior", False)],
)
def test_what_may_not_be_stored_is_not_kept_as_verified(session, was, now, verified):
    session.command("write", session.out, "--yes")
    journal = yaml.safe_load((session.out / "write-journal.yaml").read_text())
    tried = [
        {"axis": drive["axis"], "object": p["object"], "raw": p["after"]}
        for drive in journal["drives"]
        for p in drive["parameters"]
    ]
    text = VERIFIED.replace(was, now) + yaml.safe_dump({"parameters": tried, "axes": []})
    (session.out / "verification.yaml").write_text(text)
    kept = tools(session, "keep", "gripper", "--from", session.out, "--json")
    assert json.loads(kept.out)["verified"] is verified


@pytest.mark.usefixtures("untried")
def test_what_a_measurement_that_was_cut_off_left_in_the_drives_is_no_tool_set(session):
    with connect(load_machine(session.profile)) as group:
        held = backed_up("bench", group.drives, session.out / "parameters-before.yaml")
        held.__enter__()  # and never ended, as of a process that was killed
        held.gen.gi_frame.f_locals["keeper"].__exit__()
    outcome = tools(session, "keep", "bare")
    assert outcome.code == 3, outcome.err
    assert "fieldtool restore" in outcome.err
    assert not tool_file("bare").exists()


@pytest.mark.usefixtures("untried")
def test_a_stop_while_a_set_is_written_takes_it_back(session, tmp_path, monkeypatch):
    """Also right after the tool has asked for one."""
    heed = Transaction._heed_stop

    def pressed(one):
        assert not one._stop_requested()
        signal.raise_signal(signal.SIGINT)
        heed(one)

    tools(session, "keep", "bare")
    session.command("write", session.out, "--yes")
    written = session.changed()
    monkeypatch.setattr(Transaction, "_heed_stop", pressed)
    outcome = tools(session, "switch", "bare", "--yes", "--out", tmp_path / "one")
    assert outcome.code == 130, outcome.err
    assert "what was written is taken back" in outcome.err
    assert "All drives hold the old values" in outcome.err
    assert session.changed() == written


@pytest.mark.usefixtures("untried")
@pytest.mark.parametrize("command", ["write", "switch"])
def test_who_answers_no_gets_130_and_the_drives_as_they_were(
    session, command, monkeypatch, tmp_path
):
    tools(session, "keep", "bare")
    session.command("write", session.out, "--yes")
    assert tools(session, "keep", "gripper", "--from", session.out).code == 0
    session.command("restore", session.out)
    monkeypatch.setattr("fieldtool.cli.asking.somebody_there", lambda: True)
    asked = []
    monkeypatch.setattr("typer.confirm", lambda text, **_: asked.append(text))
    if command == "write":
        outcome = session.command("write", session.out, "--no-verify")
    else:
        outcome = tools(session, "switch", "gripper", "--out", tmp_path / "one")
    assert outcome.code == 130
    assert "not written, as you answered" in outcome.err
    assert len(asked) == 1
    assert session.changed() == {}


@pytest.mark.usefixtures("untried")
def test_a_second_switch_in_the_same_folder_names_its_own_backup(session, tmp_path):
    """What it prints brings back what was there before it, not before the first switch."""
    tools(session, "keep", "bare")
    session.command("write", session.out, "--yes")
    tools(session, "keep", "gripper", "--from", session.out)
    written, out = session.changed(), tmp_path / "one"
    tools(session, "switch", "bare", "--yes", "--out", out)
    for name, before in (("gripper", {}), ("bare", written)):
        switched = tools(session, "switch", name, "--yes", "--out", out)
        words = "".join(switched.out.split())
        path = words.rpartition("`fieldtoolrestore")[2].partition("`takesitback")[0]
        assert session.command("restore", path).code == 0, path
        assert session.changed() == before
        tools(session, "switch", name, "--yes", "--out", tmp_path / "other")


@pytest.mark.usefixtures("untried")
@pytest.mark.parametrize("how", ["unknown state", "read-only", "range"])
def test_a_switch_writes_nothing_that_the_drive_profile_forbids(session, tmp_path, how):
    """Where values differ; a set that changes nothing is no harm."""
    tools(session, "keep", "bare")
    session.command("write", session.out, "--yes")
    written = session.changed()
    drive = yaml.safe_load((PACKAGED / "reference.yaml").read_text())
    one = drive["parameters"]["velocity_p"]
    if how == "unknown state":
        one["write"] = "unknown"
    elif how == "read-only":
        drive["gains_via"] = "read-only"
    else:
        one["minimum"] = 1.9
    give_drives(session, drive)
    outcome = tools(session, "switch", "bare", "--yes", "--out", tmp_path / "one")
    assert outcome.code == 3, outcome.err
    assert "Nothing was written" in outcome.err
    assert session.changed() == written
    assert session.command("restore", session.out).code == 0
    assert session.changed() == {}
    assert tools(session, "switch", "bare", "--yes", "--out", tmp_path / "two").code == 0


@pytest.mark.usefixtures("untried")
@pytest.mark.parametrize("full_at", ["parameters.yaml", "tool.yaml"])
def test_a_full_disk_leaves_the_set_that_was_kept_before(session, monkeypatch, full_at):
    tools(session, "keep", "bare")
    before = json.loads(tools(session, "list", "--json").out)
    files_before = sorted(tool_file("bare").parent.iterdir())
    session.command("write", session.out, "--yes")

    def full(*_):
        raise OSError(28, "No space left on device")

    name = "save_backup" if full_at == "parameters.yaml" else "write_tool_file"
    monkeypatch.setattr(f"fieldtool.writeback.tool_sets.{name}", full)
    outcome = tools(session, "keep", "bare")
    assert outcome.code != 0
    assert "can not be kept" in outcome.err
    assert json.loads(tools(session, "list", "--json").out) == before
    assert sorted(tool_file("bare").parent.iterdir()) == files_before
