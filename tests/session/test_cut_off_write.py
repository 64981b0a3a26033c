"""A write that is cut off is noticed by the next session, and taken back by ``fieldtool restore``."""

import json
import os
import shutil
import signal
from importlib.resources import files
from pathlib import Path

import pytest
import yaml

from drives.canopen_drive import CanopenDrive, connect
from drives.errors import SafetyStopError
from drives.parameters import Memory, Phase, Transaction, load_journal, save_journal
from drives.parameters.backup import checksum
from drives.profile import load_machine
from drives.sim.faults import DriveFault, NodeVanishes, PowerLoss
from fieldtool.writeback import unfinished
from fieldtool.writeback.temporary import backed_up

pytestmark = pytest.mark.usefixtures("untried")
TABLE, ARM = 11, 12
VELOCITY_P, VELOCITY_I, POSITION_P = (0x2010, 2), (0x2010, 3), (0x2010, 1)
NEW = {"velocity_p": 2.0, "velocity_i": 16.0, "position_p": 20.0}
CUT_OFF = "a write of parameters was cut off, and the drives may hold old and new ones mixed"
LONG_AGO = "2026-01-02T03:04:05+00:00"
PER_DRIVE = 3
"""Objects written to each drive."""


class HostDiedError(BaseException):
    """Nothing of the tool runs any more; only this process goes on."""


@pytest.fixture
def session(bench):
    """A session folder with a tuning for both axes; drives whose stored values are not factory's."""
    make_session(bench, bench.out)
    for node in bench.machine.nodes:
        node.dictionary.write(*VELOCITY_P, 1300)
        node.memory.save(node.dictionary)
    bench.before = bench.objects()
    return bench


def make_session(bench, folder, axes=("table", "arm")):
    folder.mkdir(parents=True)
    (folder / "machine.yaml").write_text(bench.profile.read_text())
    tuning = {
        "format": "fieldtool-tuning/1",
        "axes": [
            {"axis": a, "parameters": dict(NEW), "sensitivity_peak": 1.4, "reason": "test"}
            for a in axes
        ],
    }
    (folder / "tuning.yaml").write_text(yaml.safe_dump(tuning))


def die_at(monkeypatch, number):
    """Let the host die before its write of this number, from 1; storing counts as one."""
    read_object, write_object, count, dead = CanopenDrive.read, CanopenDrive.write, [0], [False]

    def write(drive, info, value, timeout=None):
        count[0] += 1
        dead[0] = dead[0] or count[0] == number
        if dead[0]:
            raise HostDiedError
        write_object(drive, info, value, timeout)

    def read(drive, info, timeout=None):
        if dead[0]:
            raise HostDiedError
        return read_object(drive, info, timeout)

    def save(journal, path):
        if dead[0]:
            raise HostDiedError
        save_journal(journal, path)

    with monkeypatch.context() as patch:
        patch.setattr(unfinished, "save_journal", save)
        patch.setattr(CanopenDrive, "write", write)
        patch.setattr(CanopenDrive, "read", read)
        yield


@pytest.fixture
def cut_off(session, monkeypatch):
    """Cut a write off; ``cut_off(number, store=False)``."""

    def cut(number, store=False):
        for _ in die_at(monkeypatch, number):
            with pytest.raises(HostDiedError):
                session.command("write", session.out, "--yes", *(["--store"] if store else []))
        return load_journal(session.out / "write-journal.yaml")

    return cut


def notes():
    return sorted(Path(os.environ["FIELDTOOL_STATE_DIR"]).glob("*.yaml"))


def power_cycle(bench):
    for node in bench.machine.nodes:
        node.power_cycle()


def in_one_line(text):
    return " ".join(text.split())


# --- journal -------------------------------------------------------------------------------------


def test_the_journal_is_on_the_disk_before_the_first_write(session):
    seen = []

    def look(_value):
        journal = load_journal(session.out / "write-journal.yaml")
        seen.append((journal, len(notes())))

    session.machine.node(TABLE).dictionary.guards[VELOCITY_P] = look
    assert session.command("write", session.out, "--yes").code == 0
    journal, noted = seen[0]
    assert journal.is_open
    assert noted == 2, "one note for each drive"
    assert [r.phase for r in journal.drives] == [Phase.WRITING, Phase.PLANNED]
    assert [r.serial_number for r in journal.drives] == [1011, 1012]
    entry = next(e for e in journal.drives[0].entries if e.info.name == "velocity_p")
    assert (entry.before, entry.after) == (1300, 2000)
    assert (session.out / journal.backup).is_file()
    ended = load_journal(session.out / "write-journal.yaml")
    assert not ended.is_open
    assert {r.phase for r in ended.drives} == {Phase.VERIFIED}
    assert notes() == []


def test_the_event_of_a_write_names_the_options_that_it_used(session):
    assert session.command("write", session.out, "--yes").code == 0
    events = map(json.loads, (session.out / "events.jsonl").read_text().splitlines())
    options = [e["options"] for e in events if e["event"] == "session" and e["command"] == "write"]
    assert [sorted(one) for one in options] == [["store", "trace", "verify", "write"]]


def test_the_journal_says_what_non_volatile_memory_may_hold(cut_off):
    journal = cut_off(2 * PER_DRIVE + 2, store=True)  # before the second drive stores
    assert [r.phase for r in journal.drives] == [Phase.STORED, Phase.STORING]
    assert [r.memory for r in journal.drives] == [Memory.NEW, Memory.UNKNOWN]


def test_a_journal_that_can_not_be_kept_means_that_nothing_is_written(session, monkeypatch):
    blocked = session.folder / "file"
    blocked.write_text("")
    monkeypatch.setenv("FIELDTOOL_STATE_DIR", str(blocked / "notes"))
    outcome = session.command("write", session.out, "--yes")
    assert outcome.code == 3
    assert "the journal of the write can not be kept" in outcome.err
    assert session.changed() == {}


def test_a_restore_whose_journal_can_not_be_kept_says_what_helps(session, monkeypatch):
    """There is no other folder to choose: what is to be restored is in this one."""
    assert session.command("write", session.out, "--yes").code == 0
    copy = session.folder / "copy"
    shutil.copytree(session.out, copy)
    (session.out / "write-journal.yaml.part").mkdir()
    refused = session.command("restore", session.out)
    assert refused.code == 3
    said = in_one_line(refused.err)
    assert "Make the folder writable and make room on its disk, or copy it to where" in said
    assert "another folder" not in said
    assert "FIELDTOOL_STATE_DIR" not in said
    assert session.command("restore", copy).code == 0
    assert session.changed() == {}
    (session.folder / "a file").touch()
    monkeypatch.setenv("FIELDTOOL_STATE_DIR", str(session.folder / "a file"))
    said = in_one_line(session.command("restore", copy).err)
    assert "name another one for the notes in FIELDTOOL_STATE_DIR" in said
    assert "copy it" not in said


def test_a_restore_of_what_was_cut_off_does_not_advise_a_copy(session, cut_off):
    """A copy is refused as long as the folder itself has the open journal."""
    cut_off(PER_DRIVE)
    (session.out / "write-journal.yaml.part").mkdir()
    refused = session.command("restore", session.out)
    assert refused.code == 3
    said = in_one_line(refused.err)
    assert "Make the folder writable and make room on its disk. Then restore again." in said
    (session.out / "write-journal.yaml.part").rmdir()
    assert session.command("restore", session.out).code == 0


def test_a_disk_that_fills_up_in_the_middle_takes_everything_back(session):
    part = session.out / "write-journal.yaml.part"
    session.machine.node(ARM).dictionary.guards[VELOCITY_P] = lambda _: part.mkdir(exist_ok=True)
    outcome = session.command("write", session.out, "--yes")
    assert outcome.code == 6, outcome.err
    assert session.changed() == {}
    assert "run `fieldtool restore` once" in outcome.err, "the journal could not be closed"
    part.rmdir()
    assert session.command("restore", session.out).code == 0
    last = json.loads((session.out / "events.jsonl").read_text().splitlines()[-1])
    assert last["event"] == "restored"
    assert notes() == []


# --- cut off, and restored -----------------------------------------------------------------------


@pytest.mark.parametrize("number", range(1, 2 * PER_DRIVE + 3))
def test_restore_takes_a_write_back_that_was_cut_off_anywhere(session, cut_off, number):
    cut_off(number, store=True)
    power_cycle(session) if number % 2 else None
    outcome = session.command("restore", session.out)
    assert outcome.code == 0, outcome.err
    assert "had been cut off" in outcome.out
    assert "all drives hold the old values" in in_one_line(outcome.out)
    assert session.changed() == {}
    power_cycle(session)
    assert session.changed() == {}
    assert notes() == []


def test_restore_says_what_each_drive_held_and_what_was_done(session, cut_off):
    cut_off(PER_DRIVE + 2)  # the second drive has taken one value
    outcome = session.command("restore", session.out, "--json")
    assert outcome.code == 0
    told = json.loads(outcome.out)
    assert told["state"] == "old"
    assert told["cut_off"] is True
    table, arm = told["drives"]
    assert (table["found"], arm["found"]) == ("new values", "old and new values mixed")
    assert (len(table["brought_back"]), len(arm["brought_back"])) == (3, 1)
    assert arm["non_volatile_memory"] == "untouched"
    assert "old and new values mixed" in in_one_line(outcome.err)


def test_values_that_are_neither_old_nor_new_are_said(session, cut_off):
    cut_off(PER_DRIVE + 2)
    session.machine.node(ARM).dictionary.write(*POSITION_P, 777)
    outcome = session.command("restore", session.out)
    assert "values that are neither old nor new" in in_one_line(outcome.out)
    assert session.changed() == {}


def test_a_drive_in_fault_is_restored_all_the_same(session, cut_off):
    cut_off(PER_DRIVE + 2)
    session.inject(DriveFault(ARM))
    assert session.command("restore", session.out).code == 0


def test_a_restore_that_is_not_whole_can_be_repeated(session, cut_off):
    cut_off(2 * PER_DRIVE + 2, store=True)
    arm = session.machine.node(ARM).dictionary
    arm.guards[VELOCITY_P] = lambda _: session.inject(NodeVanishes(ARM))
    outcome = session.command("restore", session.out)
    assert outcome.code == 7, outcome.err
    assert "arm (node 12) holds not known values" in outcome.err
    assert "table (node 11) holds the old values" in outcome.err
    assert session.command("restore", session.out).code == 3, "the node is absent"
    arm.guards.clear()
    session.machine.lift(NodeVanishes(ARM))
    assert session.command("restore", session.out).code == 0
    assert session.changed() == {}
    power_cycle(session)
    assert session.changed() == {}


# --- the next session ----------------------------------------------------------------------------


@pytest.mark.parametrize("command", ["write", "measure", "run"])
def test_the_next_session_is_refused_until_it_is_taken_back(session, cut_off, command):
    """In any folder: notes in the user's state folder say where the journal is."""
    cut_off(PER_DRIVE + 2)
    held = session.objects()
    other = session.folder / "far" / "away"
    make_session(session, other)
    where = {"write": [other, "--yes"]}
    arguments = where.get(command, [session.profile, "--yes", "--out", other])
    outcome = session.command(command, *arguments)
    assert outcome.code == 3
    assert f"fieldtool restore {session.out}" in outcome.err
    assert session.objects() == held, "nothing was written"
    assert session.machine.sync_count == 0, "nothing was moved"
    assert session.command("restore", session.out).code == 0
    assert session.command("write", other, "--yes").code == 0


def test_drives_that_are_simulated_anew_ask_for_no_restore(session, cut_off):
    """What was cut off in an earlier process ended with its simulated drives: a demo that was killed
    keeps no other from beginning."""
    cut_off(PER_DRIVE + 2)
    assert notes()
    anew = session.out.parent / "anew"
    make_session(session, anew)
    data = yaml.safe_load((anew / "machine.yaml").read_text())
    data["bus"]["channel"] = str(anew / "machine.yaml")  # no machine of this name is running
    (anew / "machine.yaml").write_text(yaml.safe_dump(data))
    outcome = session.command("write", anew, "--yes")
    assert outcome.code == 0, outcome.err
    assert not notes()


def test_another_user_finds_it_in_the_folder_beside(session, cut_off):
    cut_off(PER_DRIVE + 2)
    shutil.rmtree(os.environ["FIELDTOOL_STATE_DIR"])
    make_session(session, session.out.parent / "next")
    outcome = session.command("write", session.out.parent / "next", "--yes")
    assert outcome.code == 3
    assert f"fieldtool restore {session.out}" in outcome.err


def test_a_folder_that_was_moved_is_asked_for_and_works_where_it_is(session, cut_off):
    cut_off(PER_DRIVE + 2)
    moved = session.folder / "elsewhere" / "moved"
    moved.parent.mkdir()
    session.out.rename(moved)
    other = session.folder / "far" / "away"
    make_session(session, other)
    outcome = session.command("write", other, "--yes")
    assert outcome.code == 3
    assert "If the folder was moved" in outcome.err
    assert str(notes()[0]) in outcome.err
    assert session.command("restore", moved).code == 0
    assert session.changed() == {}
    assert session.command("write", other, "--yes").code == 0


@pytest.mark.parametrize("text", ["", "[", "format: x", "format: fieldtool-unfinished/1"])
def test_a_note_that_can_not_be_read_is_named(session, cut_off, text):
    cut_off(PER_DRIVE + 2)
    notes()[0].write_text(text)
    other = session.folder / "far" / "away"
    make_session(session, other)
    outcome = session.command("write", other, "--yes")
    assert outcome.code == 3
    assert str(notes()[0]) in outcome.err


def test_notes_of_a_write_that_has_ended_are_forgotten(session, cut_off):
    cut_off(PER_DRIVE + 2)
    kept = {note: note.read_text() for note in notes()}
    session.command("restore", session.out)
    for note, text in kept.items():
        note.write_text(text)
    other = session.folder / "far" / "away"
    make_session(session, other)
    assert session.command("write", other, "--yes").code == 0
    assert notes() == []


# --- the restore of another folder ---------------------------------------------------------------


@pytest.fixture
def other(session):
    """A folder of an earlier session with the same machine, far from the one that is cut off."""
    folder = session.folder / "far" / "earlier"
    make_session(session, folder)
    assert session.command("write", folder, "--yes").code == 0
    assert session.command("restore", folder).code == 0
    assert session.changed() == {}
    assert notes() == []
    return folder


def cut_off_in_the_middle_of_storing(cut_off):
    """One drive has stored new values; the other has old ones in its non-volatile memory."""
    journal = cut_off(2 * PER_DRIVE + 2, store=True)
    assert [r.memory for r in journal.drives] == [Memory.NEW, Memory.UNKNOWN]


def refused(session, *restore):
    """Return why a restore is refused; nothing is written then, and no note is touched."""
    held_then, noted = session.objects(), {note: note.read_bytes() for note in notes()}
    outcome = session.command("restore", *restore)
    assert outcome.code == 3, outcome.err
    assert session.objects() == held_then
    assert {note: note.read_bytes() for note in notes()} == noted
    return in_one_line(outcome.err)


def begun_long_ago(folder):
    """Let a journal, and the notes about it, be of another second than what follows."""
    journal = folder / "write-journal.yaml"
    began = load_journal(journal).begun
    forged(journal, lambda data: data.update(begun=LONG_AGO))
    for note in notes():
        note.write_text(note.read_text().replace(began, LONG_AGO))


@pytest.mark.parametrize("options", [(), ("--store",), ("--without", "arm")])
@pytest.mark.parametrize("source", [".", "parameters-before.yaml"])
def test_the_restore_of_another_folder_takes_nothing_back(session, cut_off, other, options, source):
    """It does not know what the drives have stored: they would be mixed after a power cycle."""
    cut_off_in_the_middle_of_storing(cut_off)
    said = refused(session, other / source, *options)
    assert f"table: {CUT_OFF}. Take it back first: fieldtool restore {session.out}." in said
    assert session.command("write", other, "--yes").code == 3, "the next session is still refused"
    assert session.command("restore", session.out).code == 0
    assert session.command("restore", other / source, *options).code == 0
    power_cycle(session)
    assert session.changed() == {}


def test_a_drive_that_is_left_out_keeps_its_note(session, cut_off, other):
    """What is noted of a drive that is gone is not lost by a restore of another folder without it."""
    cut_off_in_the_middle_of_storing(cut_off)
    assert session.command("restore", session.out, "--without", "arm").code == 0
    assert len(notes()) == 1
    assert f"arm: {CUT_OFF}" in refused(session, other, "--without", "arm")
    assert session.command("restore", session.out).code == 0
    assert session.command("restore", other, "--without", "arm").code == 0


def test_a_copy_is_refused_as_long_as_its_original_is_there(session, cut_off):
    cut_off_in_the_middle_of_storing(cut_off)
    copy = session.folder / "copies" / "copy"
    shutil.copytree(session.out, copy)
    assert f"fieldtool restore {session.out}." in refused(session, copy)
    shutil.rmtree(session.out)
    assert session.command("restore", copy).code == 0
    power_cycle(session)
    assert session.changed() == {}
    assert notes() == []


def test_the_restore_of_a_moved_folder_can_be_cut_off_and_repeated(session, cut_off, monkeypatch):
    """Also between its journal and its notes, which still say where the folder was."""
    cut_off_in_the_middle_of_storing(cut_off)
    begun_long_ago(session.out)
    moved = session.folder / "elsewhere" / "moved"
    moved.parent.mkdir()
    session.out.rename(moved)

    def die(*_):
        raise HostDiedError

    with monkeypatch.context() as patch, pytest.raises(HostDiedError):
        patch.setattr(unfinished.JournalKeeper, "_note", die)
        session.command("restore", moved)
    assert all(str(moved) not in note.read_text() for note in notes())
    for number in (1, 3):
        for _ in die_at(monkeypatch, number):
            with pytest.raises(HostDiedError):
                session.command("restore", moved)
        assert all(str(moved) in note.read_text() for note in notes())
    assert session.command("restore", moved).code == 0
    power_cycle(session)
    assert session.changed() == {}
    assert notes() == []


def test_another_restore_that_was_cut_off_does_not_pass_for_the_moved_folder(
    session, cut_off, other, monkeypatch
):
    """A folder that is moved is known by when its write began, not by being open."""
    for _ in die_at(monkeypatch, 1):
        with pytest.raises(HostDiedError):
            session.command("restore", other, "--store")
    assert load_journal(other / "write-journal.yaml").is_open
    begun_long_ago(other)
    for note in notes():  # of a computer that has not seen it
        note.unlink()
    cut_off_in_the_middle_of_storing(cut_off)
    session.out.rename(session.folder / "moved")
    assert "If the folder was moved" in refused(session, other)


def test_a_folder_that_is_gone_for_good_leaves_a_way_out(session, cut_off, other):
    cut_off_in_the_middle_of_storing(cut_off)
    shutil.rmtree(session.out)
    for note in notes():
        said = refused(session, other)
        assert f"If it is gone, delete {note};" in said
        assert "fieldtool restore BACKUP --store" in said
        note.unlink()
    assert session.command("restore", other, "--store").code == 0
    power_cycle(session)
    assert session.changed() == {}


def test_a_folder_that_can_not_be_restored_leaves_a_way_out(session, cut_off, other):
    cut_off_in_the_middle_of_storing(cut_off)
    (session.out / "parameters-before.yaml").write_text("damaged")
    assert session.command("restore", session.out).code == 2
    for note in notes():
        assert f"delete {note} and use --store" in refused(session, other)
        note.unlink()
    assert session.command("restore", other, "--store").code == 0
    power_cycle(session)
    assert session.changed() == {}


def test_a_note_that_can_not_be_read_keeps_only_the_others_from_being_restored(
    session, cut_off, other
):
    cut_off_in_the_middle_of_storing(cut_off)
    for note in notes():
        note.write_text("[")
    assert str(notes()[0]) in refused(session, other)
    assert session.command("restore", session.out).code == 0
    assert session.command("restore", other).code == 0
    assert notes() == []


def test_a_note_of_what_has_ended_keeps_no_folder_from_being_restored(session, cut_off, other):
    cut_off_in_the_middle_of_storing(cut_off)
    kept = {note: note.read_text() for note in notes()}
    assert session.command("restore", session.out).code == 0
    for note, text in kept.items():
        note.write_text(text)
    assert session.command("restore", other).code == 0
    assert notes() == []


def test_another_machine_with_the_same_node_ids_is_restored(session, cut_off, make_bench):
    cut_off_in_the_middle_of_storing(cut_off)
    noted = {note: note.read_bytes() for note in notes()}
    second = make_bench(session.data | {}, serial=9999)
    folder = session.folder / "second" / "machine"
    make_session(second, folder)
    assert second.command("write", folder, "--yes").code == 0
    assert second.command("restore", folder).code == 0
    assert {note: note.read_bytes() for note in notes()} == noted


def test_a_journal_removes_no_note_about_another_folder(session, cut_off, other):
    cut_off_in_the_middle_of_storing(cut_off)
    noted = notes()
    ended = load_journal(other / "write-journal.yaml")
    assert {r.phase for r in ended.drives} == {Phase.ROLLED_BACK}
    keeper = unfinished.JournalKeeper(other / "write-journal.yaml")
    keeper(ended)
    keeper.settle(ended)
    keeper.forget(ended, None)
    assert notes() == noted


# --- files are not trusted -----------------------------------------------------------------------


def forged(path, change):
    """Change a file as somebody would who knows how its checksum is made."""
    data = yaml.safe_load(path.read_text())
    change(data)
    body = {key: value for key, value in data.items() if key not in ("format", "checksum")}
    journal = data["format"].startswith("fieldtool-write-journal")
    data["checksum"] = checksum(body if journal else data["drives"])
    path.write_text(yaml.safe_dump(data, sort_keys=False))


def entry(data, **changes):
    data["drives"][1]["parameters"][0].update(changes)


def held(data, **changes):
    data["drives"][1]["objects"][0].update(changes)


@pytest.mark.parametrize(
    ("file", "change"),
    [
        ("write-journal.yaml", lambda d: entry(d, object="0x6040", type="UNSIGNED16", before=15)),
        ("write-journal.yaml", lambda d: entry(d, object="0x1600:01")),
        ("write-journal.yaml", lambda d: entry(d, object="0x5FFF:01")),
        ("write-journal.yaml", lambda d: entry(d, type="REAL32")),
        ("write-journal.yaml", lambda d: entry(d, type="UNSIGNED33")),
        ("write-journal.yaml", lambda d: entry(d, before=float("nan"))),
        ("write-journal.yaml", lambda d: entry(d, before=True)),
        ("write-journal.yaml", lambda d: entry(d, before=-1)),
        ("write-journal.yaml", lambda d: entry(d, before="1000")),
        ("write-journal.yaml", lambda d: d.update(backup="../parameters-before.yaml")),
        ("write-journal.yaml", lambda d: d.update(state="whatever")),
        ("write-journal.yaml", lambda d: d.update(drives=[])),
        ("write-journal.yaml", lambda d: d["drives"][1].update(phase=["writing"])),
        ("write-journal.yaml", lambda d: d["drives"].pop() and d["drives"].append("arm")),
        ("parameters-before.yaml", lambda d: held(d, object="0x6040", type="UNSIGNED16", value=15)),
        ("parameters-before.yaml", lambda d: held(d, object="0x60FF", type="INTEGER32", value=9)),
        ("parameters-before.yaml", lambda d: held(d, object="0x1A00:01", value=0)),
        ("parameters-before.yaml", lambda d: held(d, type="REAL64", value=0.5)),
        ("parameters-before.yaml", lambda d: held(d, value=float("inf"))),
        ("parameters-before.yaml", lambda d: d["drives"][1].update(serial_number="1012")),
        ("parameters-before.yaml", lambda d: d["drives"].pop()),
    ],
)
def test_no_file_can_write_what_is_no_parameter(session, cut_off, file, change):
    cut_off(PER_DRIVE + 2)
    forged(session.out / file, change)
    before = session.objects()
    outcome = session.command("restore", session.out)
    assert outcome.code == 2, outcome.err
    assert file in outcome.err
    assert session.objects() == before


@pytest.mark.parametrize("damage", ["", "a: &a [*a]", "{}", "x" * 4_000_000, "\x00"])
def test_without_its_journal_a_backup_comes_back_if_all_is_stored(session, cut_off, damage):
    """What memory holds is then known only by storing anew, so that word is asked for."""
    cut_off(2 * PER_DRIVE + 2, store=True)
    (session.out / "write-journal.yaml").write_text(damage)
    for source in (session.out, session.out / "parameters-before.yaml"):
        outcome = session.command("restore", source)
        assert outcome.code == 2, outcome.err
        assert "write-journal.yaml" in outcome.err
        assert "parameters-before.yaml --store" in outcome.err
    outcome = session.command("restore", session.out / "parameters-before.yaml", "--store")
    assert outcome.code == 0, outcome.err
    power_cycle(session)
    assert session.changed() == {}
    assert notes() == []


def test_a_journal_of_other_drives_is_refused(session, cut_off, make_bench):
    cut_off(PER_DRIVE + 2)
    other = make_bench(session.data | {}, serial=9999)
    other.rewrite(other.data)
    outcome = other.command("restore", session.out, "--machine", other.profile)
    assert outcome.code == 3
    assert "serial number 1011, this one has 9999" in outcome.err
    assert other.changed() == {}


def test_drives_without_a_serial_number_need_the_users_word(make_bench, monkeypatch):
    bench = make_bench(serial=0)
    make_session(bench, bench.out)
    for _ in die_at(monkeypatch, PER_DRIVE + 2):
        with pytest.raises(HostDiedError):
            bench.command("write", bench.out, "--yes")
    assert len(notes()) == 2
    assert bench.command("write", bench.out, "--yes").code == 3
    held_then = bench.objects()
    outcome = bench.command("restore", bench.out)
    assert outcome.code == 3
    assert "table (node 11), arm (node 12): no serial number" in outcome.err
    assert "--same-drives" in outcome.err
    assert bench.objects() == held_then
    assert bench.command("restore", bench.out, "--same-drives").code == 0
    assert bench.changed() == {}
    assert notes() == []


# --- drives that are gone ------------------------------------------------------------------------


def test_a_drive_that_was_exchanged_is_left_out_and_the_others_come_back(session, cut_off):
    """Its serial number stays noted: if the same drive comes back, it is brought in order then."""
    cut_off(2 * PER_DRIVE + 2, store=True)
    arm = session.machine.node(ARM).dictionary
    arm.force(0x1018, 4, 4242)
    refused = session.command("restore", session.out)
    assert refused.code == 3
    assert "serial number 1012, this one has 4242" in refused.err
    outcome = session.command("restore", session.out, "--without", "arm", "--json")
    assert outcome.code == 0, outcome.err
    assert json.loads(outcome.out)["left_out"] == ["arm"]
    assert "Left as they are: arm" in in_one_line(outcome.err)
    assert session.changed(ARM) == {}, "the table has its old values"
    assert ARM in session.changed(), "the arm was not touched"
    other = session.folder / "far" / "away"
    make_session(session, other)
    assert session.command("write", other, "--yes").code == 0, "this arm is in nobody's journal"
    arm.force(0x1018, 4, 1012)
    again = session.folder / "far" / "again"
    make_session(session, again)
    assert f"fieldtool restore {session.out}" in session.command("write", again, "--yes").err
    assert session.command("restore", session.out).code == 0
    power_cycle(session)
    assert session.changed() == {}
    assert notes() == []


def test_a_drive_that_is_dead_is_left_out_and_the_others_come_back(session, cut_off):
    cut_off(PER_DRIVE + 2)
    session.inject(NodeVanishes(ARM))
    assert session.command("restore", session.out).code == 3
    assert session.command("restore", session.out, "--without", "arm").code == 0
    assert session.changed(ARM) == {}
    assert session.command("restore", session.out, "--without", "leg").code == 2
    outcome = session.command("restore", session.out, "--without", "arm", "--without", "table")
    assert outcome.code in (2, 3)


def test_a_session_at_work_is_not_taken_for_one_that_was_cut_off(bench):
    """While a living process has the journal open, neither a new session nor a restore goes on."""
    assert bench.measure("--time", "12", plan="fast").code == 0
    folder = bench.out
    with (
        connect(load_machine(bench.profile)) as group,
        backed_up("bench", group.drives, folder / "parameters-before.yaml"),
    ):
        other = bench.command("measure", bench.profile, "--out", bench.folder / "other")
        back = bench.command("restore", folder)
    for outcome in (other, back):
        assert outcome.code == 3
        assert "another fieldtool is at work" in outcome.err
        assert "cut off" not in outcome.err
    assert bench.command("restore", folder).code == 0


def test_a_measurement_in_which_a_drive_rebooted_has_to_be_restored(bench):
    """What was not stored in it is lost; all that the measurement had set is put back."""
    bench.machine.node(ARM).dictionary.write(0x2010, 6, 777_000)
    bench.before = bench.objects()
    folder = bench.out
    folder.mkdir()
    (folder / "machine.yaml").write_text(bench.profile.read_text())
    with connect(load_machine(bench.profile)) as group:

        def rebooted():
            with backed_up("bench", group.drives, folder / "parameters-before.yaml"):
                bench.inject(PowerLoss(ARM))
                group.drives[1].wait(0.1)
                raise SafetyStopError("it rebooted")

        with pytest.raises(SafetyStopError) as ended:
            rebooted()
    (note,) = ended.value.__notes__
    assert note.startswith("arm: not everything is as it was before.")
    assert note.endswith(f"fieldtool restore {folder}")
    other = bench.command("measure", bench.profile, "--out", bench.folder / "other")
    assert other.code == 3
    assert f"fieldtool restore {folder}" in in_one_line(other.err)
    assert set(bench.changed()[ARM]) == {"0x2010:06"}
    assert bench.command("restore", folder).code == 0
    assert bench.changed() == {}
    assert notes() == []


# --- what was stored before ----------------------------------------------------------------------

STORED_NEW = {"table": "new", "arm": "new"}


def told_memory(outcome):
    assert outcome.code == 0, outcome.err
    return {d["axis"]: d["non_volatile_memory"] for d in json.loads(outcome.out)["drives"]}


def retune(session, **gains):
    path = session.out / "tuning.yaml"
    tuning = yaml.safe_load(path.read_text())
    for axis in tuning["axes"]:
        axis["parameters"].update(gains)
    path.write_text(yaml.safe_dump(tuning))


def measured(session, *, killed):
    """Hold what a measurement holds, and end it, or leave everything as a dead process would."""
    with connect(load_machine(session.profile)) as group:
        held = backed_up("bench", group.drives, session.out / "parameters-before.yaml")
        held.__enter__()
        if not killed:
            held.__exit__(None, None, None)
            return
        held.gen.gi_frame.f_locals["keeper"].__exit__()  # the lock of a dead process is free
        session.killed = held  # not ended by the garbage collector either


def test_a_trial_does_not_forget_what_an_earlier_write_stored(session):
    assert session.command("write", session.out, "--yes", "--store").code == 0
    journal = (session.out / "write-journal.yaml").read_bytes()
    measured(session, killed=False)
    assert (session.out / "write-journal.yaml").read_bytes() == journal
    assert told_memory(session.command("restore", session.out, "--json")) == STORED_NEW
    power_cycle(session)
    assert session.changed() != {}, "as it was said"


def test_a_trial_that_was_killed_does_not_forget_it_either(session):
    assert session.command("write", session.out, "--yes", "--store").code == 0
    measured(session, killed=True)
    first = session.command("restore", session.out, "--json")
    assert told_memory(first) == {"table": "untouched", "arm": "untouched"}, "by the measurement"
    assert json.loads(first.out)["cut_off"] is True
    assert told_memory(session.command("restore", session.out, "--json")) == STORED_NEW
    assert session.changed() == {}


@pytest.mark.parametrize("how", ["not stored", "refused", "cut off"])
def test_a_later_write_carries_on_what_the_first_stored(session, cut_off, how):
    assert session.command("write", session.out, "--yes", "--store").code == 0
    retune(session, velocity_p=2.2)
    if how == "cut off":
        cut_off(1)
        assert session.command("restore", session.out).code == 0
    else:
        if how == "refused":
            session.machine.node(ARM).dictionary.guards[VELOCITY_P] = lambda _: 0x08000022
        code = session.command("write", session.out, "--yes").code
        assert code == (6 if how == "refused" else 0)
        session.machine.node(ARM).dictionary.guards.clear()
    assert told_memory(session.command("restore", session.out, "--json")) == STORED_NEW
    assert session.changed() == {}
    back = session.command("restore", session.out, "--store", "--json")
    assert told_memory(back) == {"table": "old", "arm": "old"}
    power_cycle(session)
    assert session.changed() == {}


def test_a_lost_journal_makes_a_later_one_say_that_it_does_not_know(session):
    assert session.command("write", session.out, "--yes", "--store").code == 0
    (session.out / "write-journal.yaml").write_text("damaged")
    assert session.command("write", session.out, "--yes").code == 0
    told = told_memory(session.command("restore", session.out, "--json"))
    assert told == {"table": "unknown", "arm": "unknown"}


def test_a_locked_drive_without_password_is_refused_before_anything_is_touched(session, cut_off):
    """A session folder keeps no password; the sentence says how to give it."""
    cut_off(PER_DRIVE + 2)
    packaged = files("profiles") / "drives"
    drive = yaml.safe_load((packaged / "reference.yaml").read_text())
    (session.folder / "reference.eds").write_bytes((packaged / "reference.eds").read_bytes())
    drive["unlock"] = {"object": "0x2000:01"}
    (session.folder / "locked.yaml").write_text(yaml.safe_dump(drive, sort_keys=False))
    for axis in session.data["axes"]:
        axis["drive"] = "locked.yaml"
    session.rewrite(session.data)
    journal, held_then = (session.out / "write-journal.yaml").read_bytes(), session.objects()
    outcome = session.command("restore", session.out, "--machine", session.profile)
    assert outcome.code == 3, outcome.err
    assert "--machine FILE" in in_one_line(outcome.err)
    assert (session.out / "write-journal.yaml").read_bytes() == journal
    assert session.objects() == held_then
    assert session.command("restore", session.out).code == 0
    assert session.changed() == {}


def test_a_stop_while_all_is_brought_back_says_that_it_is(session, cut_off, monkeypatch):
    cut_off(PER_DRIVE + 2)
    again = Transaction._back_again

    def pressed(one, *arguments, **options):
        signal.raise_signal(signal.SIGINT)
        again(one, *arguments, **options)

    monkeypatch.setattr(Transaction, "_back_again", pressed)
    outcome = session.command("restore", session.out)
    assert outcome.code == 130, outcome.err
    assert "all drives hold the old values" in in_one_line(outcome.err)
    assert session.changed() == {}
    assert notes() == []
