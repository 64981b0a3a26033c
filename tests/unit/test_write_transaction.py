"""Any write-back, cut off anywhere by anything, ends with all drives old or all new.

A world of drives with working and non-volatile memory, and of a host that may die, counts every
operation; what happens at which operation is drawn.  The journal's rules, the transaction and the
restore are the tool's own.
"""

import struct
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import SimpleNamespace

import pytest
from hypothesis import event, given, settings
from hypothesis import strategies as st

from drives.api import DriveIdentity
from drives.cia402 import PowerState
from drives.errors import SdoAbortError, SdoTimeoutError, WriteBackError, WriteBackMixedError
from drives.objects import ObjectAddress, ObjectInfo
from drives.parameters import (
    Backup,
    DriveBackup,
    DriveRecord,
    HeldObject,
    Journal,
    JournalEntry,
    Memory,
    Storing,
    Transaction,
    load_journal,
    save_journal,
)
from drives.parameters.journal import Action, State
from drives.profile import load_drive
from fieldtool.writeback.restoring import Source, journal_back

PROFILE = load_drive("reference")
WRITTEN = ("filter1_type", "filter1_zero_damping", "position_p")
INFOS = {
    n: ObjectInfo(PROFILE.parameters[n].object, PROFILE.parameters[n].type, n) for n in WRITTEN
}
OTHER = ObjectInfo(ObjectAddress(0x6065), "UNSIGNED32", "following error window")
FACTORY = {**{info.address: 0 for info in INFOS.values()}, OTHER.address: 1}
REFUSED, BROKEN = 0x08000022, 0x06060000


class HostDiedError(BaseException):
    """The host is gone: nothing that it wanted to do happens any more."""


@dataclass(frozen=True)
class Event:
    """What happens at an operation."""

    kind: str
    drive: int = 0
    bank: str = "old"


@dataclass
class World:
    """Drives and a host."""

    events: dict[int, Event] = field(default_factory=dict)
    operations: int = 0
    dead: bool = False
    saved: Journal | None = None
    powers: int = 0
    drives: list["FakeDrive"] = field(default_factory=list)

    def operation(self) -> Event | None:
        """Count an operation of the host's; return what happens at it to the drive it is for."""
        if self.dead:
            raise HostDiedError
        self.operations += 1
        event_now = self.events.pop(self.operations, None)
        if event_now is not None and event_now.kind == "dies before":
            self.dead = True
            raise HostDiedError
        if event_now is not None and event_now.kind == "power":
            self.powers += 1
            self.drives[event_now.drive % len(self.drives)].lose_power()
            return None
        return event_now

    def save(self, journal: Journal) -> None:
        happens = self.operation()
        if happens is not None and happens.kind == "disk full":
            raise OSError(28, "No space left on device")
        self.saved = journal
        if happens is not None and happens.kind == "dies after":
            self.dead = True
            raise HostDiedError


class FakeDrive:
    """Working memory, non-volatile memory, and what SDO does with them."""

    def __init__(self, world, axis, node_id, values):
        self.world, self.axis, self.node_id = world, axis, node_id
        self.ram, self.nvm = dict(values), dict(values)
        self.profile, self.axis_profile = PROFILE, SimpleNamespace(password=None)
        self.identity = DriveIdentity(0x20192, 1, 2, 3, 100 + node_id, "", "")

    def lose_power(self):
        self.ram = dict(self.nvm)
        self.boots += self.heard

    def power_state(self):
        return PowerState.SWITCH_ON_DISABLED

    left_changed, boots = False, 0
    heard = True
    """Whether its boot-up message is."""

    def answers(self):
        return True

    def wakes(self, patience):
        return True

    def wait(self, seconds):
        pass

    def read(self, info, timeout=None):
        happens = self.world.operation()
        self._fail(info, happens, "read")
        value = self.ram[info.address]
        self._die(happens)
        return value

    def write(self, info, value, timeout=None):
        happens = self.world.operation()
        stores = info.address == PROFILE.store.object
        if happens is not None and happens.kind == "power while storing":
            if stores:
                banks = {"old": self.nvm, "new": dict(self.ram), "corrupted": dict(FACTORY)}
                self.nvm = dict(banks[happens.bank])
            self.world.powers += 1
            self.lose_power()
            raise SdoTimeoutError(self.axis, info.address.index, 0, "did not answer")
        if happens is not None and happens.kind == "broken memory" and stores:
            self.nvm = dict({"old": self.nvm, "new": self.ram}.get(happens.bank, FACTORY))
            raise SdoAbortError(self.axis, info.address.index, 0, BROKEN, "write")
        if happens is None or happens.kind != "answer lost":
            self._fail(info, happens, "write")
        if stores:
            self.nvm = dict(self.ram)
        else:
            altered = happens is not None and happens.kind == "altered"
            self.ram[info.address] = 7 if altered else info.decode(info.encode(value))
        self._die(happens)
        if happens is not None and happens.kind == "answer lost":
            raise SdoTimeoutError(self.axis, info.address.index, 0, "did not answer")

    def _fail(self, info, happens, verb):
        if happens is None:
            return
        if happens.kind == "refused":
            raise SdoAbortError(self.axis, info.address.index, 0, REFUSED, verb)
        if happens.kind in ("silent", "answer lost"):
            raise SdoTimeoutError(self.axis, info.address.index, 0, "did not answer")

    def _die(self, happens):
        if happens is not None and happens.kind == "dies after":
            self.world.dead = True
            raise HostDiedError


def single(value):
    return struct.unpack("<f", struct.pack("<f", value))[0]


def values_of(number):
    """Old or new values of the drive with this number."""
    return {
        INFOS["filter1_type"].address: number % 2,
        INFOS["filter1_zero_damping"].address: single(0.1 * (1 + number)),
        INFOS["position_p"].address: 1000 + number,
        OTHER.address: 4242,
    }


def made(count, storing, events):
    """Make a world, its planned journal and its backup."""
    world = World(events)
    records, parts = [], []
    for k in range(count):
        old, new = values_of(10 * k), values_of(10 * k + 5)
        drive = FakeDrive(world, f"axis{k}", 1 + k, old)
        world.drives.append(drive)
        entries = tuple(
            JournalEntry(info, old[info.address], new[info.address]) for info in INFOS.values()
        )
        records.append(DriveRecord(drive.axis, drive.node_id, 1, 2, 3, 101 + k, entries))
        held = tuple(HeldObject(i, old[i.address]) for i in (*INFOS.values(), OTHER))
        parts.append(DriveBackup(drive.axis, drive.node_id, 1, 2, 101 + k, 3, held))
    journal = Journal("machine", "2026-01-01T00:00:00+00:00", "b.yaml", storing, tuple(records))
    return world, journal, Backup("machine", "2026-01-01T00:00:00+00:00", tuple(parts))


def all_hold(world, offset, *, nvm=True):
    return all(
        drive.ram == values_of(10 * k + offset)
        and (not nvm or drive.nvm == values_of(10 * k + offset))
        for k, drive in enumerate(world.drives)
    )


def restored(world, backup, store=False):
    """Restore as the command does, from the journal that was saved last."""
    source = Source(Path("b.yaml"), backup, world.saved)
    Transaction(world.drives, journal_back("machine", source, store), backup, world.save).restore()


KINDS = (
    "dies before",
    "dies after",
    "power",
    "power while storing",
    "broken memory",
    "refused",
    "silent",
    "answer lost",
    "altered",
    "disk full",
)
EVENTS = st.builds(
    Event,
    st.sampled_from(KINDS),
    st.integers(0, 2),
    st.sampled_from(["old", "new", "corrupted"]),
)


@settings(max_examples=400, deadline=None)
@given(
    count=st.integers(1, 3),
    storing=st.sampled_from([Storing.NONE, Storing.ALL]),
    events=st.dictionaries(st.integers(1, 90), EVENTS, max_size=6),
    again=st.lists(st.dictionaries(st.integers(1, 60), EVENTS, max_size=3), max_size=2),
)
def test_all_old_or_all_new_whatever_happens_and_when(count, storing, events, again):
    world, journal, backup = made(count, storing, dict(events))
    how = "wrote"
    try:
        Transaction(world.drives, journal, backup, world.save).write()
    except WriteBackMixedError:
        how = "mixed, and said so"
    except (WriteBackError, OSError):
        how = "taken back"
    except HostDiedError:
        how = "died"
    event(how)
    if world.powers == 0:
        if how == "wrote":
            assert all_hold(world, 5, nvm=storing is Storing.ALL)
            assert world.saved is not None
            assert not world.saved.is_open
            return
        if how == "taken back":
            assert all_hold(world, 0)
    elif how == "wrote" and not (world.saved and world.saved.is_open):
        return  # a drive that lost its supply after the last look
    if world.saved is None:
        assert all_hold(world, 0), "nothing may be written before the journal is on the disk"
        return
    if how == "died" and world.saved.state is State.NEW:
        assert world.powers or all_hold(world, 5, nvm=storing is Storing.ALL)
        return
    if how == "mixed, and said so":
        assert world.saved.is_open or all_hold(world, 0)
    for more in again:  # restores that are disturbed as well
        world.dead, world.operations, world.events = False, 0, dict(more)
        try:
            restored(world, backup)
        except (WriteBackMixedError, HostDiedError, OSError):
            continue
    world.dead, world.events = False, {}
    restored(world, backup)
    assert world.saved is not None
    assert not world.saved.is_open
    assert [d.ram for d in world.drives] == [values_of(10 * k) for k in range(count)]
    assert [d.nvm for d in world.drives] == [values_of(10 * k) for k in range(count)]


@settings(max_examples=60, deadline=None)
@given(
    count=st.integers(1, 3),
    storing=st.sampled_from(list(Storing)),
    upto=st.integers(0, 60),
    text=st.text(st.characters(codec="utf-8", exclude_categories=["Cs", "Cc"]), max_size=10),
)
def test_a_journal_comes_back_from_its_file_as_it_was(tmp_path_factory, count, storing, upto, text):
    world, journal, backup = made(count, storing, {upto: Event("dies after")})
    journal = replace(journal, machine=text)
    with suppress(HostDiedError):
        Transaction(world.drives, journal, backup, world.save).write()
    if world.saved is not None:
        path = tmp_path_factory.mktemp("journal") / "write-journal.yaml"
        save_journal(world.saved, path)
        assert load_journal(path) == world.saved
        assert list(path.parent.iterdir()) == [path]


def test_nothing_is_written_before_the_journal_is_saved():
    world, journal, backup = made(2, Storing.ALL, {1: Event("disk full")})
    with pytest.raises(OSError, match="No space"):
        Transaction(world.drives, journal, backup, world.save).write()
    assert all_hold(world, 0)


def test_a_memory_is_trusted_only_after_the_answer():
    """A host that dies while a drive stores leaves a journal that says so."""
    world, journal, backup = made(1, Storing.ALL, {})
    Transaction(world.drives, journal, backup, world.save).write()
    for at in range(1, world.operations + 1):
        world, journal, backup = made(1, Storing.ALL, {at: Event("dies before")})
        with suppress(HostDiedError):
            Transaction(world.drives, journal, backup, world.save).write()
        if world.drives[0].nvm != values_of(0):
            assert world.saved is not None
            assert world.saved.drives[0].memory in (Memory.UNKNOWN, Memory.NEW)


def test_who_hears_of_storing_can_not_stop_what_is_brought_back():
    """A screen whose output is full or closed."""
    for at in range(1, 40):
        world, journal, backup = made(2, Storing.ALL, {at: Event("refused")})
        told = []

        def deaf(step, told=told):
            told.append(step)
            if told[-1].action is Action.STORE and len(told) > 3:
                raise OSError("No space left on device")

        with suppress(WriteBackError, OSError):
            Transaction(world.drives, journal, backup, world.save, deaf).write()
        assert all_hold(world, 0) or all_hold(world, 5)


class Stumbling(FakeDrive):
    """Refuses its last new value; when it is brought back, the first drive loses its supply once."""

    refused = lost = False

    def write(self, info, value, timeout=None):
        if info == INFOS["position_p"] and not self.refused:
            self.refused = True
            self._fail(info, Event("refused"), "write")
        if self.refused and not self.lost:
            self.lost = True
            self.world.drives[0].lose_power()
        super().write(info, value, timeout)


def test_a_drive_that_loses_what_was_brought_back_gets_it_again():
    """Its old values were in working memory only, so its supply takes them away."""
    world, journal, backup = made(2, Storing.NONE, {})
    world.drives[0].nvm = dict(FACTORY)
    world.drives[1].__class__ = Stumbling
    with pytest.raises(WriteBackError):
        Transaction(world.drives, journal, backup, world.save).write()
    assert world.drives[1].lost
    assert all_hold(world, 0, nvm=False)


@pytest.mark.parametrize("number", [0, 1, 2])
def test_a_drive_that_lost_all_gets_the_whole_backup_back(number):
    """Its memory was corrupted while it stored: values that nobody wrote are gone too."""
    count = 3
    world, journal, backup = made(count, Storing.ALL, {})
    Transaction(world.drives, journal, backup, world.save).write()
    stores = [w for w in range(1, world.operations) if _stores_at(count, w) == number]
    assert len(stores) == 1
    cut = {stores[0]: Event("power while storing", bank="corrupted")}
    world, journal, backup = made(count, Storing.ALL, cut)
    with pytest.raises(WriteBackError):
        Transaction(world.drives, journal, backup, world.save).write()
    assert all_hold(world, 0)


def _stores_at(count, operation):
    """Return which drive stores at an operation of an undisturbed write; None if none does."""
    world, journal, backup = made(count, Storing.ALL, {operation: Event("dies before")})
    with suppress(HostDiedError):
        Transaction(world.drives, journal, backup, world.save).write()
    before = [drive.nvm for drive in world.drives]
    world, journal, backup = made(count, Storing.ALL, {operation: Event("dies after")})
    with suppress(HostDiedError):
        Transaction(world.drives, journal, backup, world.save).write()
    changed = [k for k, drive in enumerate(world.drives) if drive.nvm != before[k]]
    return changed[0] if changed else None


class LosesBeforeStoring(FakeDrive):
    """Loses its supply right before it stores for the time with this number, from 1."""

    number, stores = 1, 0

    def write(self, info, value, timeout=None):
        if info.address == PROFILE.store.object:
            self.stores += 1
            if self.stores == self.number:
                self.lose_power()
        super().write(info, value, timeout)


@pytest.mark.parametrize("number", [1, 2])
def test_what_was_stored_counts_only_if_it_was_still_there(number):
    """A drive that rebooted in between has confirmed that it stored something else.

    1: on the way forward, so all go back; 2: on the way back, after the second drive refused.
    """
    world, journal, backup = made(2, Storing.ALL, {})
    world.drives[0].__class__ = LosesBeforeStoring
    world.drives[0].number = number
    if number == 2:
        world.drives[1].__class__ = type(
            "Refusing", (FakeDrive,), {"write": _refuse_to_store(FakeDrive.write)}
        )
    with pytest.raises(WriteBackError):
        Transaction(world.drives, journal, backup, world.save).write()
    assert world.drives[0].stores >= number
    assert all_hold(world, 0)


@pytest.mark.parametrize("heard", [True, False])
@pytest.mark.parametrize("number", [0, 1])
def test_a_drive_that_reboots_gets_back_what_was_not_stored_too(number, heard):
    """Its stored gains are the old ones, or it is written after its boot: nothing else shows it.

    The first drive refuses one value more, so that all are taken back; the second may not be written
    yet then.
    """
    taken_back = 0
    for at in range(2, 20):
        refused = {at: Event("power", drive=number), at + 1: Event("refused")}
        for events in ({at: Event("power", drive=number)}, refused):
            world, journal, backup = made(2, Storing.NONE, dict(events))
            for drive in world.drives:
                drive.nvm[OTHER.address] = 1
                drive.heard = heard
            try:
                Transaction(world.drives, journal, backup, world.save).write()
            except WriteBackError:
                taken_back += 1
                assert [d.ram for d in world.drives] == [values_of(0), values_of(10)], events
    assert taken_back > 10


def test_a_drive_that_reboots_and_then_takes_all_new_values_is_noticed():
    """It has lost what was not stored; the write is not said to have ended well."""
    world, journal, backup = made(2, Storing.NONE, {1: Event("power", drive=1)})
    world.drives[1].nvm[OTHER.address] = 1
    with pytest.raises(WriteBackError, match=r"axis1: node 2 has restarted .* Nothing was changed"):
        Transaction(world.drives, journal, backup, world.save).write()
    assert all_hold(world, 0, nvm=False)


@pytest.mark.parametrize("storing", [Storing.NONE, Storing.ALL])
def test_a_drive_that_booted_before_its_backup_is_written(storing):
    world, journal, backup = made(2, storing, {})
    for drive in world.drives:
        drive.boots = 3
    Transaction(world.drives, journal, backup, world.save).write()
    assert all_hold(world, 5, nvm=storing is Storing.ALL)


def _refuse_to_store(write):
    def refusing(drive, info, value, timeout=None):
        if info.address == PROFILE.store.object:
            raise SdoAbortError(drive.axis, info.address.index, 0, REFUSED, "write")
        write(drive, info, value, timeout)

    return refusing
