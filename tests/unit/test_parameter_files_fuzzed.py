"""Backups and journals that somebody changed, checksum included: refused in words, or harmless."""

from contextlib import suppress

import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from drives.canopen_drive.setup import cob_id_of, kind_of
from drives.errors import ProfileError
from drives.objects import ObjectAddress, ObjectInfo
from drives.parameters import (
    Backup,
    DriveBackup,
    DriveRecord,
    HeldObject,
    Journal,
    JournalEntry,
    Storing,
    load_backup,
    load_journal,
    save_backup,
    save_journal,
)
from drives.parameters.backup import checksum
from tests.fuzzed import STRANGE, changed, places

INFO = ObjectInfo(ObjectAddress(0x2010, 1), "REAL32", "gain")
TEXT = ObjectInfo(ObjectAddress(0x2011), "VISIBLE_STRING", "label")


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """A journal and a backup, as plain values."""
    folder = tmp_path_factory.mktemp("files")
    entries = (JournalEntry(INFO, 0.5, 1.5), JournalEntry(TEXT, "a", "b"))
    record = DriveRecord("x", 5, 1, 2, 3, 4, entries)
    journal = Journal("m", "2026-01-01", "b.yaml", Storing.ALL, (record,))
    held = (HeldObject(INFO, 0.5), HeldObject(TEXT, "a"))
    set_up = (HeldObject(cob_id_of(0x1400), 0x205), HeldObject(kind_of(0x1400), 255))
    backup = Backup("m", "2026-01-01", (DriveBackup("x", 5, 1, 2, 4, 3, held, set_up),))
    save_journal(journal, folder / "write-journal.yaml")
    save_backup(backup, folder / "b.yaml")
    return folder, [
        yaml.safe_load((folder / name).read_text()) for name in ("write-journal.yaml", "b.yaml")
    ]


@settings(max_examples=400, deadline=None)
@given(st.data())
def test_a_changed_file_is_refused_in_words_or_is_whole(files, data):
    folder, originals = files
    which = data.draw(st.integers(0, 1))
    original = originals[which]
    where = data.draw(st.sampled_from([w for w in places(original) if w]))
    how = data.draw(st.sampled_from(["replace", "remove", "double"]))
    plain = changed(original, where, data.draw(STRANGE), how)
    try:
        body = {k: v for k, v in plain.items() if k not in ("format", "checksum")}
        plain["checksum"] = checksum(plain.get("drives") if which else body)
        text = yaml.safe_dump(plain, sort_keys=False)
    except (yaml.YAMLError, TypeError, ValueError):
        return  # no YAML can say it
    path = folder / "changed.yaml"
    path.write_text(text, encoding="utf-8")
    try:
        if which:
            loaded = load_backup(path)
            values = [(h.info, h.value) for d in loaded.drives for h in (*d.held, *d.set_up)]
            assert all(isinstance(d.node_id, int) for d in loaded.drives)
        else:
            journal = load_journal(path)
            assert "/" not in journal.backup
            entries = [e for d in journal.drives for e in d.entries]
            values = [(e.info, v) for e in entries for v in (e.before, e.after)]
    except ProfileError:
        return
    for info, value in values:
        info.encode(value)
        assert isinstance(value, str) == (info.type == "VISIBLE_STRING")


@settings(max_examples=150, deadline=None)
@given(st.binary(max_size=300), st.integers(0, 10_000), st.integers(0, 1))
def test_noise_in_a_file_is_refused_in_words(files, noise, at, which):
    folder, _ = files
    whole = (folder / ("b.yaml" if which else "write-journal.yaml")).read_bytes()
    at %= len(whole)
    path = folder / "noise.yaml"
    path.write_bytes(whole[:at] + noise + whole[at + len(noise) :])
    with suppress(ProfileError):  # and nothing else
        load_backup(path) if which else load_journal(path)
