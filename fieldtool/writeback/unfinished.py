"""Find a write-back that was cut off, whatever folder the next session is in.

The journal is in the session folder.  While it is open, a small file for each drive lies in the
user's state folder; it is named after the drive's vendor, product and serial number and says where
the journal is.  Besides, the folders beside a new session's are looked through, for what another
computer or user has left there.
"""

import os
import re
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from itertools import islice
from pathlib import Path
from typing import Any

import yaml
from filelock import FileLock, Timeout

from drives.errors import ProfileError
from drives.parameters import DriveRecord, Journal, Phase, load_journal, save_journal
from drives.parameters.durable import remove_durably, write_durably
from drives.parameters.guard import Recorded
from drives.parameters.values import ParameterDrive
from drives.profile import read_yaml
from fieldtool.errors import OutputError, UnfinishedWriteError

FORMAT = "fieldtool-unfinished/1"
JOURNAL = "write-journal.yaml"
STATE_VARIABLE = "FIELDTOOL_STATE_DIR"
"""Environment variable with another place for the user's state folder."""
FOLDERS_LOOKED_THROUGH = 500
"""Newest neighbours of a session folder that are looked through."""
HEAD_BYTES = 1000
"""Of a journal; whether it is open stands there."""


class JournalKeeper:
    """Saves a journal, and leaves a note for each drive as long as it is open.

    A context manager: however the work ends, others may then take up what it left.

    Parameters
    ----------
    path
        The journal's file, in its session folder.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._noted = False
        self._lock = _lock_of(path)
        """Held as long as the journal is open: others see that this process is alive."""

    def __enter__(self) -> "JournalKeeper":
        return self

    def __exit__(self, *_: object) -> None:
        self._lock.release()

    def __call__(self, journal: Journal) -> None:
        """Bring the journal to the disk before this returns.

        Raises
        ------
        OSError
            If journal or notes can not be written.
        UnfinishedWriteError
            If another process is at work with this journal; nothing was written.
        """
        if journal.is_open and not self._lock.is_locked:
            try:
                self._lock.acquire()
            except Timeout:
                raise UnfinishedWriteError(_at_work(self.path.parent)) from None
        save_journal(journal, self.path)
        if journal.is_open and not self._noted:
            self._note(journal)
            self._noted = True
        elif not journal.is_open:
            self._remove_notes(journal.machine, journal.drives)

    def settle(self, journal: Journal) -> None:
        """Remove the notes of drives that are in order, where others of the journal are not."""
        with suppress(OSError):
            back = [r for r in journal.drives if r.phase is Phase.ROLLED_BACK]
            self._remove_notes(journal.machine, back)

    def ended_before(self) -> bytes | None:
        """Return the journal that is there, word by word; None if it is open, or there is none."""
        if not self.path.is_file() or _may_be_open(self.path):
            return None
        return self.path.read_bytes()

    def forget(self, journal: Journal, before: bytes | None) -> None:
        """Put the journal from before back, and remove the notes: nothing is left to be taken back.

        What can not be removed does no harm: there will be nothing to restore.
        """
        with suppress(OSError):
            if before is None:
                remove_durably(self.path)
            else:
                write_durably(self.path, before)
            self._remove_notes(journal.machine, journal.drives)

    def _note(self, journal: Journal) -> None:
        state_folder().mkdir(parents=True, exist_ok=True)
        for record in journal.drives:
            data = {
                "format": FORMAT,
                "session": str(self.path.parent.resolve()),
                "machine": journal.machine,
                "axis": record.axis,
                "begun": journal.begun,
            }
            write_durably(_note_of(journal.machine, record), yaml.safe_dump(data).encode())

    def _remove_notes(self, machine: str, records: Iterable[DriveRecord]) -> None:
        """Remove the notes of drives; one about another folder stays."""
        for record in records:
            note = _note_of(machine, record)
            with suppress(ProfileError):  # there is none, or it does not say whose it is
                if Path(_noted(note)["session"]) == self.path.parent.resolve():
                    remove_durably(note)


def not_kept(keeper: JournalKeeper, error: OSError, *, back: str = "") -> OutputError:
    """Return the refusal to write without a journal.

    ``back``: what to do about the session folder where it is to be restored; there is no other one.
    """
    where = Path(error.filename or keeper.path)
    advice = back or "Make the folder writable, make room, or choose another folder."
    if where.resolve().parent != keeper.path.resolve().parent:
        advice = (
            "Make that folder writable, make room, or name another one for the notes in "
            f"{STATE_VARIABLE}."
        )
    return OutputError(
        f"{where}: the journal of the write can not be kept ({error.strerror or error}). Without it "
        f"nothing is written to the drives. {advice}"
    )


def state_folder(what: str = "unfinished") -> Path:
    """Return a folder of the tool's own, one for each user of a computer.

    ``unfinished``: notes about unfinished writes; ``tools``: parameter sets of tool set-ups.
    """
    own = os.environ.get(STATE_VARIABLE)
    if own:
        return Path(own) if what == "unfinished" else Path(own) / what
    home = Path.home()
    if sys.platform == "win32":
        base = Path(os.environ.get("LOCALAPPDATA") or home / "AppData" / "Local")
    elif sys.platform == "darwin":
        base = home / "Library" / "Application Support"
    else:
        base = Path(os.environ.get("XDG_STATE_HOME") or home / ".local" / "state")
    return base / "fieldtool" / what


def refuse_unfinished(machine: str, drives: Sequence[ParameterDrive], session: Path) -> None:
    """Refuse to go on where a write into one of these drives was cut off.

    Drives that are simulated in this process have nothing of an earlier one in them: what was cut off
    there ended with them.

    Parameters
    ----------
    machine
        Its name.
    drives
        Identified.
    session
        Folder of the session that is to begin; it and its neighbours are looked through too.

    Raises
    ------
    UnfinishedWriteError
        With the command that takes it back.
    """
    recorded = [_Identified(drive) for drive in drives]
    if recorded and all(drive.begins_anew for drive in drives):
        _forget(machine, recorded)
        return
    for one in recorded:
        note = _note_of(machine, one)
        if note.exists():
            _refuse_noted(note, one)
    for journal_file in (session / JOURNAL, *_neighbours(session)):
        if journal_file.is_file() and _may_be_open(journal_file):
            own = journal_file.parent == session
            found = _open_journal(journal_file, own=own)
            axis = None if found is None else _same_drive(found, recorded, own=own)
            if found is not None and axis is not None:
                raise _refusal(journal_file.parent, axis, found)


def refuse_elsewhere(
    machine: str, recorded: Iterable[Recorded], folder: Path, cut_off: Journal | None
) -> None:
    """Refuse to restore a folder where what was cut off in its drives is in another one.

    That other journal knows what the drives have stored; a restore that does not would end with drives
    that hold old and new values mixed after a power cycle, and its notes would be gone.

    Parameters
    ----------
    machine
        Its name.
    recorded
        All drives of the backup, those that are left out too.
    folder
        That is to be restored.
    cut_off
        Its journal, if it is open.

    Raises
    ------
    UnfinishedWriteError
        With the command that takes it back, and what to do where that is not possible any more.
    """
    for one in recorded:
        note = _note_of(machine, one)
        if note.exists() and not _is_about(note, one, folder, cut_off):
            _refuse_noted(
                note,
                one,
                f" If that can not be done any more, delete {note} and use --store with this restore: "
                "then all drives store what it brings back.",
            )


def _is_about(note: Path, one: Recorded, folder: Path, cut_off: Journal | None) -> bool:
    """Whether a note is about this folder, which may have been moved since."""
    try:
        noted = _noted(note)
    except ProfileError:
        return cut_off is not None and _concerns(cut_off, one, same_place=True)
    there = Path(noted["session"])
    if there == folder.resolve():
        return True
    moved = cut_off is not None and noted.get("begun") == cut_off.begun
    return moved and not _may_be_open(there / JOURNAL)


def _refuse_noted(note: Path, one: Recorded, otherwise: str = "") -> None:
    """Refuse to go on where a note is about something that was cut off; remove it where that ended."""
    folder = _folder_of(note)
    journal = _journal(folder / JOURNAL, note)
    if not journal.is_open:
        remove_durably(note)
    elif _concerns(journal, one, same_place=True):
        raise _refusal(folder, one.axis, journal, otherwise)


def _forget(machine: str, recorded: Sequence["_Identified"]) -> None:
    """Remove the notes about drives that are gone."""
    with suppress(OSError):
        for one in recorded:
            remove_durably(_note_of(machine, one))


def _lock_of(journal_file: Path) -> FileLock:
    """Return the lock of whoever works with a journal; one that is taken is not waited for."""
    return FileLock(journal_file.with_suffix(".lock"), timeout=0)


def is_left_open(folder: Path) -> bool:
    """Return whether the journal of this session says that something is to be taken back."""
    return _may_be_open(folder / JOURNAL)


def is_at_work(folder: Path) -> bool:
    """Return whether a living process has the journal of this session open."""
    lock = _lock_of(folder / JOURNAL)
    if not Path(lock.lock_file).is_file():
        return False
    try:
        with lock:
            return False
    except (Timeout, OSError):
        return True


def _at_work(folder: Path) -> str:
    return (
        f"another fieldtool is at work on this machine, with the session {folder}. Wait until it has "
        "ended, or stop it there with Ctrl-C. Nothing was moved or written."
    )


def _refusal(
    folder: Path, axis: str, journal: Journal, otherwise: str = ""
) -> UnfinishedWriteError:
    if is_at_work(folder):
        return UnfinishedWriteError(f"{axis}: {_at_work(folder)}")
    what = (
        "a write of parameters was cut off, and the drives may hold old and new ones mixed"
        if journal.writes
        else "a measurement was cut off, and the drives may hold what it had set for its time"
    )
    return UnfinishedWriteError(
        f"{axis}: {what}. Take it back first: fieldtool restore {folder}.{otherwise} Nothing was moved "
        "or written."
    )


class _Identified:
    """A drive on the bus as a file would record it."""

    def __init__(self, drive: ParameterDrive) -> None:
        self.axis, self.node_id = drive.axis, drive.node_id
        self.vendor_id = drive.identity.vendor_id
        self.product_code = drive.identity.product_code
        self.serial_number = drive.identity.serial_number


def _note_of(machine: str, drive: Recorded) -> Path:
    """Return the note's file: by serial number, else by the place on the machine."""
    if drive.serial_number:
        which = f"serial-{drive.serial_number}"
    else:
        which = f"{re.sub(r'[^A-Za-z0-9_-]', '_', machine)[:40]}-node-{drive.node_id}"
    name = f"{drive.vendor_id:08x}-{drive.product_code:08x}-{which}.yaml"
    return state_folder() / name


def _noted(note: Path) -> Mapping[str, Any]:
    """Return what a note says; raise ProfileError if it is none."""
    data: Mapping[str, Any]
    data, _ = read_yaml(note, 100_000)
    if data.get("format") != FORMAT or not isinstance(data.get("session"), str):
        raise ProfileError(note, f"format must be {FORMAT}")
    return data


def _folder_of(note: Path) -> Path:
    try:
        return Path(_noted(note)["session"])
    except ProfileError as error:
        raise UnfinishedWriteError(
            f"{error}. It says where the journal of a write is that was cut off. Use `fieldtool "
            "restore` with that session's folder, or delete the file if you know that the drives are "
            "in order. Nothing was moved or written."
        ) from error


def _journal(journal_file: Path, note: Path) -> Journal:
    try:
        return load_journal(journal_file)
    except ProfileError as error:
        raise UnfinishedWriteError(
            f"something that had changed these drives was cut off, and its journal is not to be had: "
            f"{error}. If the folder was moved, use `fieldtool restore` with where it is now. If it is "
            f"gone, delete {note}; unless the drives were brought in order elsewhere, bring a backup "
            "back then, and store it in all drives: fieldtool restore BACKUP --store. Nothing was moved "
            "or written."
        ) from error


def _neighbours(session: Path) -> Iterator[Path]:
    """Yield the journals of the newest folders beside this one."""
    try:
        with os.scandir(session.resolve().parent) as entries:
            folders = [(e.stat().st_mtime, e.path) for e in entries if e.is_dir()]
    except OSError:
        return
    folders.sort(reverse=True)
    for _, folder in islice(folders, FOLDERS_LOOKED_THROUGH):
        if Path(folder) != session.resolve():
            yield Path(folder) / JOURNAL


def _may_be_open(journal_file: Path) -> bool:
    try:
        with journal_file.open("rb") as file:
            return b"state: open" in file.read(HEAD_BYTES)
    except OSError:
        return False


def _open_journal(journal_file: Path, *, own: bool) -> Journal | None:
    try:
        journal = load_journal(journal_file)
    except ProfileError:
        if own:
            raise
        return None
    return journal if journal.is_open else None


def _same_drive(journal: Journal, drives: Iterable[_Identified], *, own: bool) -> str | None:
    """Return the axis of one of these drives that a journal holds and that is not in order."""
    return next((d.axis for d in drives if _concerns(journal, d, same_place=own)), None)


def _concerns(journal: Journal, drive: Recorded, *, same_place: bool) -> bool:
    """Whether an open journal holds this drive, and it was not brought back.

    Drives without a serial number are told by their node id, where the place is known to be the same.
    """
    for record in journal.drives:
        known = (record.vendor_id, record.product_code, record.serial_number)
        if (
            known == (drive.vendor_id, drive.product_code, drive.serial_number)
            and (drive.serial_number or (same_place and record.node_id == drive.node_id))
            and record.phase is not Phase.ROLLED_BACK
        ):
            return True
    return False
