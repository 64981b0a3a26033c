"""Write-back through the bus: nothing changes unasked, all or nothing, undoable, and told."""

import json
import re
import signal
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.resources import files

import can
import numpy as np
import pytest
import yaml

from drives.canopen_drive import CanopenDrive
from drives.errors import NotVerifiedError, SafetyStopError
from drives.sim.drive_faults import PowerLossWhileStoring
from drives.sim.faults import (
    Fault,
    NodeVanishes,
    PowerLoss,
    SdoRefused,
    SdoSilent,
    StoreFails,
    StoreForgets,
    WriteAltered,
)
from drives.sim.wire import unchanged
from fieldtool.errors import OutputError
from fieldtool.workflow import reporting
from tests.tunings import begun
from tests.untried import Stood

pytestmark = pytest.mark.usefixtures("untried")
TABLE, ARM = 11, 12
VELOCITY_P, VELOCITY_I, POSITION_P = (0x2010, 2), (0x2010, 3), (0x2010, 1)
NEW = {"velocity_p": 2.0, "velocity_i": 16.0, "position_p": 20.0}
NEW_RAW = {VELOCITY_P: 2000, VELOCITY_I: 16_000, POSITION_P: 20_000}


@pytest.fixture
def session(bench):
    """A session folder with a tuning for both axes."""
    bench.out.mkdir()
    (bench.out / "machine.yaml").write_text(bench.profile.read_text())
    write_tuning(bench, NEW)
    return bench


def write_tuning(bench, parameters, axes=("table", "arm")):
    tuning = {
        "format": "fieldtool-tuning/1",
        "axes": [
            {"axis": a, "parameters": dict(parameters), "sensitivity_peak": 1.4, "reason": "test"}
            for a in axes
        ],
    }
    (bench.out / "tuning.yaml").write_text(yaml.safe_dump(tuning))


def held(bench, node, *keys):
    return {key: bench.machine.node(node).dictionary.read(*key) for key in keys or NEW_RAW}


def old(bench, node):
    return {key: bench.before[node][key] for key in NEW_RAW}


def write(bench, *options):
    return bench.command("write", bench.out, "--yes", *options)


def power_cycle(bench):
    for node in bench.machine.nodes:
        node.power_cycle()


@dataclass(frozen=True)
class RefusedSecondTime(Fault):
    """The first write of an entry is taken, but altered; every later one is refused."""

    index: int = 0
    subindex: int = 0

    def set(self, machine, *, present):
        written = []

        def alter(value):
            written.append(value)
            machine.inject(SdoRefused(self.node_id, self.index, self.subindex, 0x08000022))
            return value + 1

        node = machine.node(self.node_id)
        node.dictionary.alterations[self.index, self.subindex] = alter


# --- asked and not asked -------------------------------------------------------------------------


@pytest.mark.usefixtures("quick_plan")
def test_a_whole_run_without_write_changes_nothing_in_any_drive(small_bench):
    """Every object of every node, but for targets, actual values and the error history."""
    bench = small_bench
    stored = bench.stored()
    outcome = bench.run("--json", "--yes", "--store")
    assert outcome.code == 0, outcome.err
    assert bench.changed() == {}
    assert bench.stored() == stored
    assert bench.powered() == {}
    rows = json.loads(outcome.out)["parameters"]
    assert rows
    assert all(row["read_back"] is None for row in rows)
    assert any(row["before"] != row["after"] for row in rows), "there was something to write"


@pytest.mark.usefixtures("quick_plan")
def test_a_whole_run_with_write_changes_the_parameters_and_nothing_else(small_bench):
    bench = small_bench
    outcome = bench.run("--json", "--write", "--yes")
    assert outcome.code == 0, outcome.err
    rows = json.loads(outcome.out)["parameters"]
    assert [r["read_back"] for r in rows] == [r["after"] for r in rows]
    changed = bench.changed()[TABLE]
    assert set(changed) <= {f"0x20{k}:{s:02X}" for k in (10, 20, 21) for s in range(1, 8)}
    assert "0x2010:02" in changed
    assert "working memory only" in outcome.err
    assert bench.stored() == {TABLE: {}}
    assert bench.command("restore", bench.out).code == 0
    assert bench.changed() == {}, "bit by bit"


def test_nobody_to_ask_means_nothing_is_written(session):
    outcome = session.command("write", session.out)
    assert outcome.code == 3
    assert "nobody to ask" in outcome.out + outcome.err
    assert "Nothing was written" in outcome.out + outcome.err
    assert session.changed() == {}


def test_written_parameters_are_read_back(session):
    outcome = write(session)
    assert outcome.code == 0, outcome.err
    assert held(session, TABLE) == held(session, ARM) == NEW_RAW
    assert set(session.changed()[TABLE]) == {"0x2010:01", "0x2010:02", "0x2010:03"}
    assert "working memory only" in outcome.out
    assert "--store" in outcome.out


# --- power cycle ---------------------------------------------------------------------------------


def test_what_was_not_stored_is_gone_after_a_power_cycle_as_the_tool_said(session):
    assert "a power cycle brings back what was stored" in " ".join(write(session).out.split())
    power_cycle(session)
    assert held(session, TABLE) == old(session, TABLE)


def test_what_a_power_cycle_brings_after_an_earlier_store_is_what_the_tool_said(session):
    write(session, "--store")
    assert session.command("restore", session.out).code == 0
    outcome = write(session, "--no-verify")
    session.command("report", session.out)
    power_cycle(session)
    assert held(session, TABLE) == NEW_RAW
    page = re.sub(r"<[^>]*>", " ", (session.out / "report.html").read_text(encoding="utf-8"))
    for said in (outcome.out, page):
        assert "a power cycle brings back what was stored" in " ".join(said.split())


def test_what_was_stored_survives_a_power_cycle_as_the_tool_said(session):
    outcome = write(session, "--store")
    assert outcome.code == 0
    assert "survive a power cycle" in " ".join(outcome.out.split())
    power_cycle(session)
    assert held(session, TABLE) == held(session, ARM) == NEW_RAW
    assert set(session.changed()[ARM]) == {"0x2010:01", "0x2010:02", "0x2010:03"}, (
        "nothing temporary was stored with them"
    )


def test_a_drive_that_is_not_in_the_tuning_does_not_store(session):
    """Storing keeps all that its working memory holds: that is nobody's business here."""
    write_tuning(session, NEW, axes=("arm",))
    session.machine.node(TABLE).dictionary.write(0x6065, 0, 777)
    assert write(session, "--store").code == 0
    power_cycle(session)
    assert held(session, ARM) == NEW_RAW
    assert session.machine.node(TABLE).memory.stored == {}
    assert TABLE not in session.changed()


def test_a_store_that_fails_takes_the_others_back(session):
    """The one whose memory is broken is named; all work with their old values."""
    session.inject(StoreFails(ARM))
    outcome = write(session, "--store")
    assert outcome.code == 7
    assert "writing failed: arm, object 0x1010:01: the drive refused to write it" in outcome.err
    assert (
        "arm (node 12) holds the old values in working memory; what its non-volatile" in outcome.err
    )
    assert (
        "table (node 11) holds the old values; its non-volatile memory holds the old values too"
        in outcome.err
    )
    assert session.changed() == {}
    power_cycle(session)
    assert session.changed() == {}


def test_a_drive_that_refuses_to_store_takes_the_others_back(session):
    """It says that it has not stored, so all drives are known to hold their old values."""
    session.inject(StoreFails(ARM, 0x08000022))
    outcome = write(session, "--store")
    assert outcome.code == 6, outcome.err
    assert "table stored the old values again" in outcome.err
    assert session.changed() == {}
    power_cycle(session)
    assert session.changed() == {}


@contextmanager
def heard(session):
    """What is on the bus meanwhile."""
    with can.Bus(interface="fieldsim", channel=session.channel) as bus:
        frames = []

        def so_far():
            while (message := bus.recv(0)) is not None:
                frames.append(message)
            return frames

        yield so_far


@pytest.fixture
def restarting(session):
    """The same, with drives that show only after a restart what they have stored."""
    other_drives(session, "verify: answer", "verify: read-back after restart")
    return session


def other_drives(session, line, other):
    """Give the session drives of the reference's profile with one line changed."""
    shipped = files("profiles").joinpath("drives")
    text = shipped.joinpath("reference.yaml").read_text(encoding="utf-8")
    assert line in text
    text = text.replace(line, other)
    text = text.replace("eds: reference.eds", f"eds: {shipped.joinpath('reference.eds')}")
    own = session.out.parent / "own.yaml"
    own.write_text(text, encoding="utf-8")
    machine = session.out / "machine.yaml"
    machine.write_text(machine.read_text().replace("drive: reference", f"drive: {own}"))


def test_a_drive_that_tells_only_after_a_restart_is_restarted_and_read_back(restarting):
    table, arm = (restarting.machine.node(n) for n in (TABLE, ARM))
    with heard(restarting) as frames:
        outcome = write(restarting, "--store")
        resets = [bytes(m.data) for m in frames() if m.arbitration_id == 0]
    assert outcome.code == 0, outcome.err
    assert resets.count(bytes((0x81, TABLE))) == resets.count(bytes((0x81, ARM))) == 1
    assert held(restarting, TABLE) == held(restarting, ARM) == NEW_RAW
    for node in (table, arm):
        assert node.memory.stored[VELOCITY_P] == NEW_RAW[VELOCITY_P]


STORE = (
    'store: {object: "0x1010:01", timeout: 5 s, verify: answer, restart: false, states: disabled}'
)


def test_where_a_drive_is_not_known_to_store_no_command_is_said_to_keep_what_was_written(session):
    other_drives(session, STORE, "store: unknown")
    kept = write(session)
    assert kept.code == 0, kept.err
    assert "working memory only" in " ".join(kept.out.split())
    assert "--store" not in kept.out
    again = write(session)
    assert again.code == 3, again.err
    assert "fieldtool restore" in again.err
    assert "--store" not in again.err


def test_a_drive_that_says_it_has_stored_and_has_not_takes_the_others_back(restarting):
    restarting.inject(StoreForgets(ARM))
    outcome = write(restarting, "--store")
    assert outcome.code in (6, 7), outcome.err
    assert "arm, velocity_p, object 0x2010:02: wrote 2000, the drive holds 1200" in outcome.err
    assert restarting.changed() == {}
    power_cycle(restarting)
    assert restarting.changed() == {}


# --- refused, altered, vanished ------------------------------------------------------------------


def test_a_write_refused_in_the_middle_restores_every_drive(session):
    session.inject(SdoRefused(ARM, *VELOCITY_I, 0x08000022))
    session.machine.node(ARM).sdo.aborting.clear()
    seen = []
    dictionary = session.machine.node(ARM).dictionary
    dictionary.guards[VELOCITY_I] = lambda v: seen.append(v) or 0x08000022
    outcome = write(session)
    assert outcome.code == 6, outcome.err
    said = " ".join(outcome.err.split())
    assert re.search(
        r"arm, velocity_i, object 0x2010:03: the drive holds \d+ and refused to take \d+ "
        r"\([\d.]+ N m/rad\): not in the present state of the drive \(0x08000022\)",
        said,
    )
    assert "The drive takes velocity_i in another state" in said
    assert "Nothing was changed: all parameters were restored and read back" in outcome.err
    assert seen, "it came that far"
    assert session.changed() == {}


def test_a_value_beyond_what_the_drive_takes_names_parameter_value_unit_and_what_to_do(session):
    """The profile does not know the drive's own range: only the drive does."""
    session.machine.node(TABLE).dictionary.guards[0x2010, 2] = lambda _: 0x06090031
    outcome = write(session)
    assert outcome.code == 6, outcome.err
    said = " ".join(outcome.err.split())
    assert re.search(
        r"table, velocity_p, object 0x2010:02: the drive holds \d+ and refused to take 2000 "
        r"\(2 N m s/rad\): the value is too high \(0x06090031\)",
        said,
    )
    assert "`minimum` and `maximum` of velocity_p in the drive profile, and design anew" in said
    assert session.changed() == {}


def test_a_value_kept_differently_restores_every_drive(session):
    before = session.before[ARM][POSITION_P]
    session.inject(WriteAltered(ARM, *POSITION_P, before))
    outcome = write(session)
    assert outcome.code == 6
    assert (
        f"arm, position_p, object 0x2010:01: wrote 20000, the drive holds {before} (in its own units; "
        "20 1/s was wanted)" in " ".join(outcome.err.split())
    )
    assert session.changed() == {}


def test_what_can_not_be_restored_is_named_with_node_and_object(session):
    session.inject(RefusedSecondTime(ARM, *POSITION_P))
    outcome = write(session)
    assert outcome.code == 7
    assert "arm (node 12), position_p, 0x2010:01" in outcome.err
    assert "fieldtool restore" in outcome.err
    assert session.changed().keys() == {ARM}, "all that could be was restored"
    assert set(session.changed()[ARM]) == {"0x2010:01"}
    session.machine.node(ARM).sdo.aborting.clear()
    session.machine.node(ARM).dictionary.alterations.clear()
    assert session.command("restore", session.out).code == 0
    assert session.changed() == {}


def test_a_drive_that_vanishes_while_it_is_written_is_named(session):
    dictionary = session.machine.node(ARM).dictionary
    dictionary.guards[VELOCITY_I] = lambda _: session.inject(NodeVanishes(ARM))
    outcome = write(session)
    assert outcome.code == 7
    assert "arm (node 12) holds not known values of velocity_p 0x2010:02" in outcome.err
    assert TABLE not in session.changed(), "the other drive was restored"


def test_a_drive_that_is_away_for_some_seconds_is_waited_for(session):
    """A real drive that lost its supply takes its time to boot."""

    def unplug(_value):
        del node.dictionary.guards[VELOCITY_I]
        session.inject(NodeVanishes(ARM))
        session.machine.scheduler.add(4.0, session.machine.lift, (NodeVanishes(ARM),))

    node = session.machine.node(ARM)
    node.dictionary.guards[VELOCITY_I] = unplug
    outcome = write(session)
    assert outcome.code == 6, outcome.err
    assert session.changed() == {}


def test_a_drive_that_somebody_stopped_is_woken_and_restored(session):
    """A node in NMT stopped answers no SDO."""
    stop_arm = can.Message(arbitration_id=0, data=[0x02, ARM], is_extended_id=False)

    def stop(_value):
        del node.dictionary.guards[VELOCITY_I]
        with can.Bus(interface="fieldsim", channel=session.channel) as other:
            other.send(stop_arm)

    node = session.machine.node(ARM)
    node.dictionary.guards[VELOCITY_I] = stop
    outcome = write(session)
    assert outcome.code == 6, outcome.err
    assert session.changed() == {}


def test_a_drive_that_reboots_while_it_is_written_holds_old_values_in_the_end(session):
    dictionary = session.machine.node(ARM).dictionary
    dictionary.alterations[VELOCITY_I] = lambda v: session.inject(PowerLoss(ARM)) or v
    outcome = write(session)
    assert outcome.code == 6, outcome.err
    assert session.changed() == {}


def test_a_drive_that_reboots_while_it_is_written_gets_back_what_was_not_stored_too(session):
    """Its stored gains are the old ones, so that they do not show what it has lost."""
    node = session.machine.node(ARM)
    node.dictionary.write(0x2010, 6, 777_000)
    session.before = session.objects()

    def reboot(value):
        del node.dictionary.alterations[VELOCITY_I]
        session.inject(PowerLoss(ARM))
        return value

    node.dictionary.alterations[VELOCITY_I] = reboot
    outcome = write(session)
    assert outcome.code == 6, outcome.err
    assert "Nothing was changed: all parameters were restored" in " ".join(outcome.err.split())
    assert session.changed() == {}


@pytest.mark.parametrize("number", range(1, 10))
def test_one_wrong_answer_is_never_written_back(session, number):
    """It may be any of those about a gain; the write fails at another one, so all is taken back."""
    seen = []

    def alter(cob_id, data):
        if cob_id == 0x580 + ARM and data[0] >> 5 == 2 and data[1:4] == b"\x10\x20\x02":
            seen.append(data)
            if len(seen) == number:
                data = data[:4] + bytes((data[4], data[5] ^ 4)) + data[6:]
        return unchanged(cob_id, data)

    session.machine.wire.from_nodes["wrong answer"] = alter
    session.machine.node(ARM).dictionary.guards[POSITION_P] = lambda _: 0x08000022
    outcome = write(session)
    said = " ".join(outcome.err.split())
    assert len(seen) >= number, "there was such an answer"
    assert outcome.code in (3, 6), said
    if outcome.code == 3:
        assert "arm, " in said
        assert "object 0x2010:02" in said
        assert "1200" in said
        assert "176" in said
        assert "Nothing was written" in said
        assert not (session.out / "parameters-before.yaml").exists()
    assert session.changed() == {}
    del session.machine.wire.from_nodes["wrong answer"]
    assert session.command("restore", session.out).code in (0, 2)
    assert session.changed() == {}


@pytest.mark.parametrize("presses", [1, 3])
def test_ctrl_c_while_writing_restores_everything(session, monkeypatch, presses):
    """However often it is pressed, also while old values are being restored."""
    write_object, seen = CanopenDrive.write, []

    def pressing(drive, info, value, timeout=None):
        write_object(drive, info, value, timeout)
        seen.append(info.address)
        if 4 <= len(seen) < 4 + presses:
            signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(CanopenDrive, "write", pressing)
    outcome = write(session)
    assert outcome.code == 130, outcome.err
    assert session.changed() == {}


def test_an_enabled_drive_is_not_written(session):
    node = session.machine.node(ARM)
    for word in (0x06, 0x07, 0x0F):
        node.motion.write_controlword(word)
    assert session.powered() == {ARM: "OPERATION_ENABLED"}
    outcome = write(session)
    assert outcome.code == 3
    assert "arm" in outcome.err
    assert "enabled" in outcome.err
    assert session.changed() == {}


@pytest.mark.parametrize(
    ("parameters", "axes", "sentence"),
    [
        ({"velocity_p": -1.0}, ("table",), "table, velocity_p, object 0x2010:02: -1"),
        ({"velocity_p": 1e300}, ("table",), "does not fit the drive"),
        ({"speed": 1.0}, ("arm",), "has no parameter speed"),
        ({"velocity_p": 1.0}, ("leg",), "axis leg, which this machine does not have"),
    ],
)
def test_a_tuning_that_does_not_fit_is_refused_before_any_write(
    session, parameters, axes, sentence
):
    write_tuning(session, parameters, axes)
    outcome = write(session)
    assert outcome.code == 3, outcome.err
    assert sentence in outcome.err
    assert session.changed() == {}


def test_a_tuning_with_numbers_that_are_none_is_refused_with_its_line(session):
    write_tuning(session, {"velocity_p": float("nan")}, ("table",))
    outcome = write(session)
    assert outcome.code == 2
    assert "tuning.yaml:4: 'axis number 1, parameters.velocity_p'" in outcome.err
    assert session.changed() == {}


@pytest.mark.parametrize("text", ["", "[", "format: x", "format: fieldtool-tuning/1\naxes: 3"])
def test_a_file_that_is_no_tuning_is_refused(session, text):
    (session.out / "tuning.yaml").write_text(text)
    outcome = write(session)
    assert outcome.code == 2
    assert "tuning.yaml" in outcome.err
    assert session.changed() == {}


# --- backup and restore --------------------------------------------------------------------------


def test_a_second_write_does_not_lose_the_first_backup(session):
    """The backup holds what the drives held before the tool changed anything."""
    assert write(session).code == 0
    write_tuning(session, {"velocity_p": 3.0})
    assert write(session).code == 0
    assert (session.out / "parameters-before-2.yaml").is_file()
    outcome = session.command("restore", session.out)
    assert outcome.code == 0
    assert "6 parameters differed" in outcome.out
    assert session.changed() == {}


def test_where_a_later_write_fails_the_way_back_to_the_first_backup_is_named(session, monkeypatch):
    """Once more written, what the drives hold would be compared with itself: that is refused."""
    assert write(session).code == 0
    first = session.changed()
    write_tuning(session, {"velocity_p": 3.0})
    monkeypatch.setattr(Stood, "prove", unproven)
    outcome = write(session)
    assert outcome.code == 6, outcome.err
    assert session.changed() == first
    named = re.search(r"not what is in .*`fieldtool (restore [^`]*)` brings that", outcome.err)
    assert named is not None, outcome.err
    write_tuning(session, NEW)
    again = write(session)
    assert again.code == 3, again.err
    assert "with themselves" in again.err
    assert session.command(*named[1].split()).code == 0
    assert session.changed() == {}
    failed = write(session)
    assert failed.code == 6, failed.err
    assert "not what is in" not in failed.err, "all is as it was before the first write"


def test_the_way_to_the_old_values_stores_them_where_new_ones_are_stored(session):
    assert "--store" not in named_restore(write(session).out)
    assert session.command("restore", session.out).code == 0
    assert write(session, "--store").code == 0
    assert "--store" in named_restore(write(session).err)
    assert session.command("restore", session.out).code == 0, "in working memory"
    assert "--store" in named_restore(write(session).out)


def named_restore(said):
    return re.search(r"`fieldtool (restore [^`]*)`", " ".join(said.split()))[1]


def test_no_backup_no_write(session):
    (session.out / "parameters-before.yaml.part").mkdir()
    outcome = write(session)
    assert outcome.code == 3
    assert "backup" in outcome.err
    assert "can not be written" in outcome.err
    assert session.changed() == {}


def test_restore_says_whether_it_is_stored(session):
    write(session, "--store")
    assert "working memory only" in session.command("restore", session.out).out
    power_cycle(session)
    assert held(session, TABLE) == NEW_RAW, "restored in memory only"
    assert "stored too" in session.command("restore", session.out, "--store").out
    power_cycle(session)
    assert session.changed() == {}


def test_restore_brings_back_objects_that_the_tool_never_writes(session):
    write(session)
    node = session.machine.node(ARM)
    node.dictionary.write(0x6065, 0, 777)
    node.dictionary.write(0x605A, 0, 5)
    outcome = session.command("restore", session.out / "parameters-before.yaml")
    assert outcome.code == 0, outcome.err
    assert "8 parameters differed" in outcome.out
    assert session.changed() == {}


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("parameters-before.yaml", "afterwards the old ones were brought back"),
        (
            "parameters-before-2.yaml",
            "afterwards what parameters-before-2.yaml holds was brought back",
        ),
    ],
)
def test_the_report_knows_of_a_restore_from_a_file_of_the_session(session, name, said):
    assert write(session).code == 0
    write_tuning(session, {"velocity_p": 3.0})
    assert write(session).code == 0
    assert session.command("restore", session.out / name).code == 0
    assert session.command("report", session.out).code == 0
    text = re.sub(r"<[^>]*>|\s+", " ", (session.out / "report.html").read_text(encoding="utf-8"))
    assert said in text


def test_a_report_after_a_write_that_was_taken_back_says_so(session):
    session.machine.node(ARM).dictionary.guards[VELOCITY_I] = lambda _: 0x08000022
    assert write(session, "--no-verify").code == 6
    assert session.command("report", session.out).code == 0
    html = (session.out / "report.html").read_text(encoding="utf-8")
    assert "Written into the drives and taken back: the drives hold what they held before." in html
    assert "nothing was written" not in html


def test_the_report_says_what_a_power_cycle_brings_after_a_restore(session):
    def lead(*options):
        assert session.command("restore", session.out, *options).code == 0
        assert session.command("report", session.out).code == 0
        html = (session.out / "report.html").read_text(encoding="utf-8")
        return re.sub(r"<[^>]*>|\s+", " ", html)

    assert write(session).code == 0
    not_stored = lead()
    assert "a power cycle brings back what was stored" in not_stored
    assert "holds new parameters" not in not_stored
    assert write(session, "--store").code == 0
    in_memory = lead()
    assert "In table and arm it is in working memory only" in in_memory
    assert "The non-volatile memory of table and arm holds new parameters." in in_memory
    assert "Their non-volatile memory holds it too." in lead("--store")
    power_cycle(session)
    assert session.changed() == {}


def page_of(session):
    html = (session.out / "report.html").read_text(encoding="utf-8")
    return re.sub(r"<[^>]*>|\s+", " ", html)


def test_a_report_that_is_there_is_renewed_by_write_and_restore(session, monkeypatch):
    assert write(session).code == 0
    assert not (session.out / "report.html").exists(), "none is made where there was none"
    assert session.command("restore", session.out).code == 0
    assert session.command("report", session.out).code == 0
    assert "afterwards the old ones were brought back" in page_of(session)
    assert write(session).code == 0
    assert "afterwards the old ones were brought back" not in page_of(session)
    assert session.command("restore", session.out).code == 0
    assert "afterwards the old ones were brought back" in page_of(session)
    guards = session.machine.node(ARM).dictionary.guards
    monkeypatch.setitem(guards, VELOCITY_I, lambda _: 0x08000022)
    assert write(session, "--no-verify").code == 6
    assert "The session ended: arm, velocity_i, object 0x2010:03: the drive holds" in page_of(
        session
    )


def test_a_report_that_can_not_be_renewed_hides_nothing(session, monkeypatch):
    assert session.command("report", session.out).code == 0
    before = (session.out / "report.html").read_bytes()

    def fails(*_):
        raise OutputError("no room")

    monkeypatch.setattr("fieldtool.workflow.reporting.write_page", fails)
    outcome = write(session)
    assert outcome.code == 0, outcome.err
    assert "The report was not renewed" in outcome.out
    assert "no room" in outcome.out
    guards = session.machine.node(ARM).dictionary.guards
    monkeypatch.setitem(guards, VELOCITY_I, lambda _: 0x08000022)
    write_tuning(session, {"velocity_i": 3.0})
    outcome = write(session, "--no-verify")
    assert outcome.code == 6
    assert "arm, velocity_i, object 0x2010:03: the drive holds" in outcome.err
    assert "The report was not renewed" in outcome.err
    assert (session.out / "report.html").read_bytes() == before


def pressing_while_renewing(monkeypatch):
    """Have Ctrl-C pressed when a report is renewed, so long after a motion that nothing polls."""
    monkeypatch.setattr("fieldtool.cli.stop_key.ASKED_WITHIN", -1.0)
    write_page = reporting.write_page

    def pressing(*arguments):
        signal.raise_signal(signal.SIGINT)
        write_page(*arguments)

    monkeypatch.setattr(reporting, "write_page", pressing)


def test_a_stop_while_the_report_is_renewed_hides_nothing(session, monkeypatch):
    assert session.command("report", session.out).code == 0
    before = (session.out / "report.html").read_bytes()
    to_renew = f"To renew it: `fieldtool report {session.out}`"
    pressing_while_renewing(monkeypatch)
    outcome = write(session, "--json")
    assert outcome.code == 0, outcome.err
    assert json.loads(outcome.out)["written"]
    said = " ".join(outcome.err.split())
    assert to_renew in said
    assert "working memory only" in said
    outcome = session.command("restore", session.out, "--json")
    assert outcome.code == 0, outcome.err
    assert json.loads(outcome.out)["drives"]
    said = " ".join(outcome.err.split())
    assert to_renew in said
    assert "parameters differed and were restored" in said
    guards = session.machine.node(ARM).dictionary.guards
    monkeypatch.setitem(guards, VELOCITY_I, lambda _: 0x08000022)
    outcome = write(session, "--no-verify")
    assert outcome.code == 6
    assert "arm, velocity_i, object 0x2010:03: the drive holds" in outcome.err
    assert to_renew in outcome.err
    assert (session.out / "report.html").read_bytes() == before


def unproven(_):
    raise NotVerifiedError("the new parameters do not stand their trial: test")


def test_a_design_after_a_write_says_of_when_its_present_parameters_are(bench, monkeypatch):
    def since():
        outcome = bench.command("design", bench.out, "--response", "soft", "--json")
        assert outcome.code == 0, outcome.err
        found = json.loads(outcome.out)
        assert found["present"] is not None
        said = [note for note in found["notes"] if note.startswith("Before, and present")]
        return len(said)

    begun(bench)
    assert write(bench).code == 0
    assert since() == 1
    with monkeypatch.context() as patch:
        patch.setattr(Stood, "prove", unproven)
        assert write(bench).code == 6, "the drives keep what the first write brought"
    assert bench.changed() != {}
    assert since() == 1
    assert bench.command("restore", bench.out).code == 0
    assert since() == 0
    assert write(bench).code == 0
    assert since() == 1


def test_a_restore_from_a_file_elsewhere_leaves_no_log_there(session):
    assert write(session).code == 0
    elsewhere = session.folder / "elsewhere"
    elsewhere.mkdir()
    copy = elsewhere / "backup.yaml"
    copy.write_bytes((session.out / "parameters-before.yaml").read_bytes())
    assert session.command("restore", copy, "--machine", session.profile).code == 0
    assert not (elsewhere / "events.jsonl").exists()


def test_a_backup_of_another_drive_is_refused(session, make_bench):
    write(session)
    backup = session.out / "parameters-before.yaml"
    other = make_bench(session.data | {}, serial=9999)
    other.rewrite(other.data)
    outcome = other.command("restore", backup, "--machine", other.profile)
    assert outcome.code == 3
    assert "serial number 1011, this one has 9999" in outcome.err
    assert other.changed() == {}


def test_node_ids_that_were_swapped_since_the_measurement_are_seen(session):
    """What was designed for one drive is not written into another."""
    assert session.command("write", session.out, "--yes").code == 0
    assert session.command("restore", session.out).code == 0
    for node, serial in ((11, 1012), (12, 1011)):
        session.machine.node(node).dictionary.force(0x1018, 4, serial)
    held = session.objects()
    outcome = session.command("write", session.out, "--yes")
    assert outcome.code == 3
    assert "table: this session was begun on a drive with serial number 1011" in outcome.err
    assert "node 11 now has 1012" in " ".join(outcome.err.split())
    assert session.objects() == held


@pytest.mark.parametrize(
    "damage",
    [
        lambda text: text[: len(text) // 2],
        lambda text: text[: text.rindex("- object:")],
        lambda text: text.replace("value: 1200\n", "value: 1300\n", 1),
        lambda text: text.replace("UNSIGNED32", "UNSIGNED33", 1),
        lambda text: text.replace("drives:", "drive:"),
        lambda text: text.replace("checksum:", "sum:"),
        lambda text: text.replace("value: 1200\n", "value: [1]\n", 1),
        lambda text: text.replace("object: 0x2010:02", "object: 12", 1),
        lambda text: text.replace("node_id: 11", "node_id: .inf"),
        lambda text: text.replace("fieldtool-parameters/1", "fieldtool-parameters/9"),
        lambda _: "",
        lambda _: "\x00\x01",
        lambda _: "a: &a [*a]",
    ],
)
def test_a_damaged_backup_is_refused_whole(session, damage):
    write(session)
    backup = session.out / "parameters-before.yaml"
    text = backup.read_text()
    assert damage(text) != text
    backup.write_text(damage(text))
    before = session.changed()
    outcome = session.command("restore", backup)
    assert outcome.code == 2, outcome.err
    assert "parameters-before.yaml" in outcome.err
    assert session.changed() == before, "nothing was written"


def test_a_restore_that_can_not_be_whole_names_what_is_missing(session):
    write(session)
    session.inject(SdoSilent(ARM, *VELOCITY_P))
    outcome = session.command("restore", session.out)
    assert outcome.code == 7
    assert "arm (node 12)" in outcome.err
    assert "0x2010:02 holds not known" in outcome.err
    assert "table (node 11) holds the old values" in outcome.err
    assert set(session.changed()) == {ARM}
    assert set(session.changed()[ARM]) == {"0x2010:02"}


def test_no_backup_to_restore(session):
    outcome = session.command("restore", session.out)
    assert outcome.code == 2
    assert "parameters-before.yaml" in outcome.err


# --- power lost while storing --------------------------------------------------------------------


@pytest.mark.parametrize("bank", ["old", "new", "corrupted"])
@pytest.mark.parametrize("node", [TABLE, ARM])
def test_a_supply_that_fails_while_storing_leaves_old_values_everywhere(session, node, bank):
    """Working memory and, after another power cycle, what was stored: the old values."""
    for each in session.machine.nodes:
        each.dictionary.write(*VELOCITY_P, 1300)  # not the factory's: those would show
        each.memory.save(each.dictionary)
    session.before = session.objects()
    session.inject(PowerLossWhileStoring(node, bank=bank))
    outcome = write(session, "--store")
    assert outcome.code == 6, outcome.err
    assert "did not answer" in outcome.err
    assert session.changed() == {}
    power_cycle(session)
    assert session.changed() == {}


# --- a trial that leaves a drive enabled ----------------------------------------------------------


FAIL_SAFE_AND_GAINS = {0x1016, 0x1029, 0x6007, 0x2010}


class Deaf(Stood):
    """A trial in which the table's drive leaves its PDOs behind, and does not obey 0x6040 by SDO."""

    def __init__(self, _session, group, *_, **__):
        self._group = group

    def prove(self):
        machine = self.bench.machine

        def source(before):
            if before is not None:
                machine.inject(SdoSilent(TABLE, 0x6040))
                machine.receive(0x000, bytes([0x80, TABLE]))  # somebody's NMT command
            return np.tile(motion.position, (50, 1))

        try:
            with self._group.motion(0.002) as motion:
                motion.stream(source)
        except SafetyStopError as error:
            failed = NotVerifiedError(f"the new parameters do not stand their trial: {error}")
            for note in error.__notes__:
                failed.add_note(note)
            raise failed from error


@pytest.fixture
def deaf_while_tried(make_bench, monkeypatch):
    """Make a session whose trial leaves the table enabled, with its quick stop option code 0x605A."""

    def make(option):
        bench = make_bench(objects={TABLE: {(0x605A, 0): option}})
        bench.out.mkdir()
        (bench.out / "machine.yaml").write_text(bench.profile.read_text())
        write_tuning(bench, NEW)
        monkeypatch.setattr(Deaf, "bench", bench, raising=False)
        monkeypatch.setattr("fieldtool.workflow.writing.Verification", Deaf)
        return bench

    return make


def written_while_powered(bench, monkeypatch):
    """Return where objects are noted that the host writes while the table's drive has power."""
    node, seen, receive = bench.machine.node(TABLE), [], bench.machine.receive

    def heard(cob_id, data):
        if cob_id == 0x600 + TABLE and data[0] & 0xE0 == 0x20 and node.motion.powered:
            seen.append(int.from_bytes(data[1:3], "little"))
        return receive(cob_id, data)

    monkeypatch.setattr(bench.machine, "receive", heard)
    return seen


def test_a_drive_that_stops_by_itself_after_its_trial_is_taken_back_once_it_is_off(
    deaf_while_tried, monkeypatch
):
    """Until then its fail-safe objects may be all that stops it, and its gains hold a motor."""
    bench = deaf_while_tried(2)
    seen = written_while_powered(bench, monkeypatch)
    outcome = write(bench)
    assert outcome.code == 6
    assert "Nothing was changed: all parameters were restored" in outcome.err
    assert "table: node 11 does not answer after it was told to switch off" in outcome.err
    assert "table: since then the drive has shown that it is off" in outcome.err
    assert 0x6040 in seen, "it was told to switch off"
    assert not set(seen) & FAIL_SAFE_AND_GAINS
    assert bench.powered() == {}
    assert bench.changed() == {}


def test_a_drive_that_never_switches_off_after_its_trial_is_left_as_it_is(
    deaf_while_tried, monkeypatch
):
    """It stays in quick stop: new gains, fail-safe armed; the arm goes back, and restore ends it."""
    bench = deaf_while_tried(6)
    seen = written_while_powered(bench, monkeypatch)
    outcome = write(bench)
    assert outcome.code == 7
    assert (
        "table: the drive is in quick stop active and does not switch off by itself" in outcome.err
    )
    assert "MAY STILL BE ENABLED" in outcome.err
    assert "arm (node 12) holds the old values" in outcome.err
    assert "since then the drive has shown that it is off" not in outcome.err
    assert 0x6040 in seen, "it was told to switch off"
    assert not set(seen) & FAIL_SAFE_AND_GAINS
    assert set(bench.changed()) == {TABLE}
    assert bench.machine.node(TABLE).dictionary.read(0x1016, 1) != 0
    assert held(bench, TABLE) == NEW_RAW
    bench.machine.lift(SdoSilent(TABLE, 0x6040))
    power_cycle(bench)
    refused = write(bench)
    assert refused.code == 3
    assert f"fieldtool restore {bench.out}" in refused.err
    assert bench.command("restore", bench.out).code == 0
    assert bench.changed() == {}
