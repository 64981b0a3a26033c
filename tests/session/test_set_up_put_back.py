"""What a motion sets up in drives comes back: after a kill, and after a bus that was lost, by `restore`.

Nothing of the tool's own process survives a kill; here its note is kept from being removed, and the
host's frames reach nobody any more.
"""

from dataclasses import replace

import pytest

from drives.objects import ObjectAddress
from drives.parameters import load_backup, load_journal, save_backup
from drives.sim.faults import Fault
from drives.sim.host_faults import BusOff, HostKilled
from fieldtool.writeback.unfinished import JournalKeeper
from tests.faults.bench import ARM, TABLE, Bench, Moment, command

OWN = {
    (0x1400, 1): 0x80000321,
    (0x1400, 2): 254,
    (0x1801, 1): 0x400002A1,
    (0x1A00, 0): 0,
    (0x1A00, 1): 0x60640020,
    (0x60B2, 0): 7,
    (0x6060, 0): 1,
}
"""What somebody else's controller may have set up in the table: other identifiers, other mappings."""


def of_another_master(bench: Bench) -> None:
    """Set up the table as another master would, and take that for what was there."""
    dictionary = bench.machine.node(TABLE).dictionary
    dictionary.write(0x1400, 1, 0x8000020B)
    dictionary.write(0x1800, 1, 0xC000018B)
    for key, value in OWN.items():
        dictionary.write(*key, value)
    dictionary.write(0x1A00, 0, 1)
    dictionary.write(0x1800, 1, 0x400001A1)
    bench.before = {n.node_id: bench._objects(n) for n in bench.machine.nodes}


@pytest.mark.parametrize("moment", [Moment.STILL, Moment.SWEEP])
@pytest.mark.parametrize("fault", [HostKilled(), BusOff()], ids=["killed", "bus off"])
def test_a_motion_that_was_cut_off_is_taken_back_whole(tmp_path, monkeypatch, moment, fault: Fault):
    """By `restore`, which the next session asks for: every object of every drive is as before."""
    if isinstance(fault, HostKilled):
        monkeypatch.setattr(JournalKeeper, "forget", lambda *_: None)
    with Bench(tmp_path, moment, lambda _: (fault,)) as bench:
        of_another_master(bench)
        code, said = command("measure", bench.profile, "--yes", "--out", bench.out)
        assert code == 4, said
        changed = bench._all_changed()
        for node in (TABLE, ARM):
            assert {"0x1400:02", "0x1600:00", "0x1A00:03", "0x1016:01"} <= changed[node].keys()
        if isinstance(fault, BusOff):
            assert f"fieldtool restore {bench.out}" in said
        bench.machine.lift(fault)
        code, said = command("measure", bench.profile, "--yes", "--out", tmp_path / "next")
        assert code == 3, said
        assert f"fieldtool restore {bench.out}" in said
        code, said = command("restore", bench.out)
        assert code == 0, said
        assert bench._all_changed() == {}
        assert not any(n.motion.powered for n in bench.machine.nodes)


def test_a_restore_whose_pdos_are_refused_says_so_and_is_asked_for_again(tmp_path, monkeypatch):
    """Which node holds what instead is said, and no session goes on until all is as it was."""
    monkeypatch.setattr(JournalKeeper, "forget", lambda *_: None)
    entry, fault = (0x1A00, 1), HostKilled()
    with Bench(tmp_path, Moment.STILL, lambda _: (fault,)) as bench:
        of_another_master(bench)
        assert command("measure", bench.profile, "--yes", "--out", bench.out)[0] == 4
        bench.machine.lift(fault)
        guards = bench.machine.node(TABLE).dictionary.guards
        own = guards.get(entry)
        guards[entry] = lambda _: 0x08000022
        now = bench.machine.node(TABLE).dictionary.read(*entry)
        for _ in range(2):  # nothing is forgotten by asking
            code, said = command("restore", bench.out)
            assert code == 7, said
            assert "table (node 11)" in said
            assert f"0x1A00:01 holds {now}, was " in said
            assert "arm (node 12) holds the old values" in said
            assert load_journal(bench.out / "write-journal.yaml").is_open
        code, said = command("measure", bench.profile, "--yes", "--out", tmp_path / "next")
        assert code == 3, said
        assert f"fieldtool restore {bench.out}" in said
        if own is None:
            del guards[entry]
        else:
            guards[entry] = own
        code, said = command("restore", bench.out)
        assert code == 0, said
        assert bench._all_changed() == {}


def test_a_check_that_lost_its_bus_leaves_what_restore_needs(tmp_path, monkeypatch):
    """Its folder is removed otherwise; the next session names it."""
    monkeypatch.chdir(tmp_path)
    with Bench(tmp_path, Moment.STILL, lambda _: (BusOff(),)) as bench:
        code, said = command("check", bench.profile, "--move")
        assert code == 4, said
        assert bench._all_changed().keys() == {TABLE, ARM}
        (folder,) = (tmp_path / "sessions").iterdir()
        assert f"fieldtool restore sessions/{folder.name}" in said
        bench.machine.lift(BusOff())
        code, said = command("measure", bench.profile, "--yes", "--out", tmp_path / "next")
        assert code == 3
        assert f"fieldtool restore {folder}" in said
        code, said = command("restore", folder)
        assert code == 0, said
        assert bench._all_changed() == {}


def test_a_session_that_ended_leaves_pdos_to_who_uses_the_bus(tmp_path):
    """A later `restore` of its parameters does not undo what another master has set up since."""
    with Bench(tmp_path, Moment.SWEEP, lambda _: ()) as bench:
        code, said = command("measure", bench.profile, "--yes", "--out", bench.out)
        assert code == 0, said
        assert bench._all_changed() == {}
        backup = load_backup(bench.out / "parameters-before.yaml")
        assert {h.info.address.index for h in backup.drives[0].set_up} >= {0x1400, 0x1A00, 0x6060}
        of_another_master(bench)
        code, said = command("restore", bench.out)
        assert code == 0, said
        assert bench._all_changed() == {}


@pytest.mark.parametrize("how", ["another object", "another order"])
def test_a_file_can_not_make_the_tool_write_other_objects_as_set_up(tmp_path, how):
    with Bench(tmp_path, Moment.SWEEP, lambda _: ()) as bench:
        bench.prepare_write()
        assert command("write", bench.out, "--yes")[0] == 0
        path = bench.out / "parameters-before.yaml"
        backup = load_backup(path)
        one = backup.drives[0]
        set_up = one.set_up[::-1]
        if how == "another object":
            info = replace(one.set_up[0].info, address=ObjectAddress(0x6040))
            set_up = (replace(one.set_up[0], info=info),)
        changed = replace(one, set_up=set_up)
        save_backup(replace(backup, drives=(changed, *backup.drives[1:])), path)
        code, said = command("restore", bench.out)
        assert code == 2
        assert "table, object 0x6040:00" in said or "table: the objects of the PDO 0x1800" in said
        assert "Nothing was written." in said
