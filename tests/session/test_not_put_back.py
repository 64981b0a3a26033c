"""What a session had set for its time and a drive does not take back: all is done, and the exit is 7.

A script that goes by exit codes must not take such a machine for one that is as it was.
"""

import json

import pytest

from drives.sim.faults import Abort, SdoSilent
from fieldtool.errors import NotEnoughDataError
from tests.session.conftest import axis, one_axis, simulated
from tests.tunings import begun

TABLE, ARM = 11, 12
FEED_FORWARD = (0x2010, 4)
ABORT_CONNECTION = (0x6007, 0)
GAINS = [b"\x10\x20" + bytes([k]) for k in (1, 2, 3)]
READ = 0x40
REFUSED = "table, object 0x2010:04: the drive refused"
LEFT = "table: not everything is as it was before. Once all drives can be reached again: "


def refuse(bench, place, refused):
    """Have the table refuse such values of an object; return what undoes it."""
    guards = bench.machine.node(TABLE).dictionary.guards
    own = guards.get(place, lambda _: None)
    guards[place] = lambda value: own(value) or (Abort.WRONG_STATE if refused(value) else None)
    return lambda: guards.update({place: own})


def keep_it_off(bench):
    """Have the table let its feed-forward be switched off, and not on again; return what undoes it."""
    return refuse(bench, FEED_FORWARD, bool)


@pytest.fixture
def stuck(make_bench):
    """A rigid table whose drive keeps its feed-forward off once it was switched off."""
    profile = one_axis()
    profile["axes"] = [axis("table", TABLE, [0.02], [])]
    profile["simulation"]["axes"] = [simulated([0.02], [])]
    bench = make_bench(profile)
    bench.heal = keep_it_off(bench)
    return bench


def left_until_restored(bench, outcome, folder):
    """The command ended with 7, and the next is refused until `restore` has brought all back."""
    assert outcome.code == 7, outcome.err
    assert bench.changed().keys() == {TABLE}
    assert bench.powered() == {}
    assert bench.command("measure", bench.profile, "--out", bench.folder / "next").code == 3
    bench.heal()
    assert bench.command("restore", folder).code == 0
    assert bench.changed() == {}


def test_a_measurement_is_kept_and_ends_with_7(stuck):
    outcome = stuck.measure("--json")
    assert stuck.recording().experiments[-1].complete
    data = json.loads(outcome.out)
    assert data["not_put_back"] == ["table"]
    assert data["folder"] == str(stuck.out)
    assert REFUSED in outcome.err
    assert outcome.err.rstrip().endswith(
        f"fieldtool: {LEFT}fieldtool restore {stuck.out}. All else was done."
    )
    left_until_restored(stuck, outcome, stuck.out)


def test_a_run_is_done_to_its_report_and_ends_with_7(stuck):
    outcome = stuck.run("--json")
    data = json.loads(outcome.out)
    assert data["not_put_back"] == ["table"]
    assert f"{LEFT}fieldtool restore {stuck.out}" in data["warnings"]
    assert f"could not be put back: {REFUSED}" in " ".join(data["warnings"])
    assert data["parameters"]
    assert "not everything is as it was before" in (stuck.out / "report.html").read_text()
    left_until_restored(stuck, outcome, stuck.out)


def test_nothing_is_written_into_drives_that_are_not_as_they_were(stuck):
    outcome = stuck.run("--write", "--yes")
    assert f"{LEFT}fieldtool restore {stuck.out}. Nothing was written." in outcome.err
    assert REFUSED in outcome.err
    assert stuck.changed()[TABLE].keys() == {"0x2010:04"}
    left_until_restored(stuck, outcome, stuck.out)


def test_nothing_is_written_after_a_trial_of_the_old_parameters_that_left_something(bench):
    begun(bench)
    bench.heal = refuse(bench, ABORT_CONNECTION, lambda value: value == 1)
    bench.listen()
    outcome = bench.command("write", bench.out, "--yes")
    asked = [f.data for f in bench.heard() if f.cob_id in (0x600 + TABLE, 0x600 + ARM)]
    assert {data[0] for data in asked if data[1:4] in GAINS} == {READ}
    assert f"{LEFT}fieldtool restore {bench.out}. Nothing was written." in outcome.err
    assert "Try the old parameters" in outcome.out
    assert "Try the new parameters" not in outcome.out
    assert bench.changed()[TABLE] == {"0x6007:00": (1, 3)}
    left_until_restored(bench, outcome, bench.out)


def test_another_error_keeps_its_own_code_and_says_what_is_left(stuck, monkeypatch):
    def fails(*_):
        raise NotEnoughDataError("noise")

    monkeypatch.setattr("fieldtool.workflow.stages.identify_recording", fails)
    outcome = stuck.run()
    assert outcome.code == 5, outcome.err
    assert REFUSED in outcome.err
    assert outcome.err.count(f"{LEFT}fieldtool restore {stuck.out}") == 1


def test_a_check_ends_with_7(stuck, monkeypatch):
    monkeypatch.chdir(stuck.folder)
    outcome = stuck.command("check", stuck.profile, "--move", "--json")
    data = json.loads(outcome.out)
    assert data["verdict"] == "fail"
    assert data["not_put_back"] == ["table"]
    (found,) = (f for f in data["findings"] if f["check"] == "put back")
    assert REFUSED in found["found"]
    (folder,) = (stuck.folder / "sessions").iterdir()
    assert f"fieldtool restore sessions/{folder.name}" in found["todo"]
    left_until_restored(stuck, outcome, folder)


def test_a_session_that_put_all_back_ends_with_0(small_bench):
    outcome = small_bench.measure("--json")
    assert outcome.code == 0, outcome.err
    assert json.loads(outcome.out)["not_put_back"] == []


def test_a_stop_for_safety_stays_4(bench):
    bench.in_sweep.append((SdoSilent(TABLE, 0x6007), 0))
    outcome = bench.measure()
    assert outcome.code == 4, outcome.err
    assert f"fieldtool restore {bench.out}" in outcome.err
