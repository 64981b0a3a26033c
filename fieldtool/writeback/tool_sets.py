"""Parameter sets of several tool set-ups of one machine, by name.

Each is a folder with two files: ``parameters.yaml``, what the drives' controller parameters are with
this tool, in the form of a backup (whole, with the drives' identities and a checksum), and
``tool.yaml``, where it comes from and whether it was tried on the machine.  They lie in the user's state
folder, ``tools/MACHINE/NAME``; ``FIELDTOOL_STATE_DIR`` names another place for it.
"""

import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from drives.canopen_drive import CanopenDrive
from drives.errors import ProfileError
from drives.objects import ObjectAddress
from drives.parameters import (
    Backup,
    Change,
    DriveBackup,
    HeldObject,
    back_up,
    changes_back_to,
    check_objects,
    check_same_drives,
    load_backup,
    load_journal,
    save_backup,
)
from drives.parameters.durable import sync_folder
from drives.parameters.journal import State
from fieldtool.errors import NoSuchToolError, OutputError
from fieldtool.records.session_folder import SessionFolder
from fieldtool.writeback.tool_file import (
    ToolFile,
    file_checksum,
    read_tool_file,
    trial_of,
    write_tool_file,
)
from fieldtool.writeback.unfinished import state_folder

NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,49}")


@dataclass(frozen=True)
class ToolSet:
    """The parameters of one tool set-up."""

    name: str
    machine: str
    kept: str
    """UTC, ISO 8601."""
    source: str
    """Session folder, or ``drives``."""
    verified: bool
    """Whether these parameters stood their trial on the machine."""
    figures: Mapping[str, Mapping[str, float | None]]
    """What the trial measured, by axis: settling_time, overshoot, sensitivity_peak; empty without it."""
    parameters: Backup
    path: Path

    def as_dict(self) -> dict[str, Any]:
        """Plain values without the parameters."""
        return {
            "name": self.name,
            "machine": self.machine,
            "kept": self.kept,
            "source": self.source,
            "verified": self.verified,
            "figures": {axis: dict(values) for axis, values in self.figures.items()},
        }


@dataclass(frozen=True)
class ToolSets:
    """What is kept of a machine."""

    whole: tuple[ToolSet, ...]
    bad: Mapping[str, str]
    """Names of those that can not be used, and why."""

    def as_dict(self) -> dict[str, Any]:
        """Plain values, as ``--json`` prints them."""
        return {
            "tools": [tool.as_dict() for tool in self.whole],
            "bad": [{"name": name, "problem": problem} for name, problem in self.bad.items()],
        }


def tools_folder(machine: str) -> Path:
    """Return where the tool sets of a machine lie."""
    return state_folder("tools") / re.sub(r"[^A-Za-z0-9_.-]", "_", machine)


def tool_sets(machine: str) -> ToolSets:
    """Return all tool sets of a machine, by name; one that can not be read does not hide the others."""
    folder = tools_folder(machine)
    names = sorted(one.parent.name for one in folder.glob("*/tool.yaml"))
    whole, bad = list[ToolSet](), dict[str, str]()
    for name in names:
        try:
            whole.append(tool_set(machine, name))
        except ProfileError as error:
            bad[name] = str(error)
    return ToolSets(tuple(whole), bad)


def tool_set(machine: str, name: str, profile: Path | str = "MACHINE") -> ToolSet:
    """Return one tool set; ``profile`` is the machine's file, for what there is to be typed.

    Raises
    ------
    NoSuchToolError
        If there is none of that name.
    ProfileError
        If it is not whole.
    """
    _check_name(name)
    folder = tools_folder(machine) / name
    path = folder / "tool.yaml"
    if not path.is_file():
        others = [one.name for one in tools_folder(machine).glob("*") if one.is_dir()]
        known = f"there are {', '.join(sorted(others))}" if others else "there is none yet"
        raise NoSuchToolError(
            f"machine {machine} has no tool set {name!r}; {known}. `fieldtool tools keep {profile} "
            f"{name} --from SESSION` keeps what a session has written."
        )
    data = read_tool_file(path, name, machine)
    parameters = load_backup(folder / "parameters.yaml")
    return ToolSet(
        name, machine, data.kept, data.source, data.verified, data.figures, parameters, folder
    )


def keep_session(
    machine: str, name: str, session: Path, controller: Mapping[str, Collection[ObjectAddress]]
) -> ToolSet:
    """Keep what a session wrote into the drives as a tool set.

    Parameters
    ----------
    machine, name
        Of the machine and of the tool set; one of that name is replaced.
    session
        Folder whose write has ended with the new parameters in the drives.
    controller
        Objects that hold controller parameters, by axis.

    Raises
    ------
    ProfileError
        If nothing was written there, or the files are not whole.
    OutputError
        If the tool set can not be written.
    """
    folder = SessionFolder(session)
    if not folder.journal.is_file():
        raise ProfileError(
            folder.journal, "nothing was written from this session: `fieldtool write` first"
        )
    journal = load_journal(folder.journal)
    if journal.state is not State.NEW:
        raise ProfileError(
            folder.journal,
            "the write of this session did not end with its parameters in the drives; they were "
            "restored, or the write was cut off",
        )
    if journal.machine != machine:
        raise ProfileError(folder.journal, f"is of machine {journal.machine}, not of {machine}")
    before = load_backup(session / journal.backup)
    entries = {record.axis: record.entries for record in journal.drives}
    parts = []
    for part in before.drives:
        written = {entry.info: entry.after for entry in entries.get(part.axis, ())}
        known = {held.info.address: held for held in part.held}
        now = known | {i.address: HeldObject(i, value) for i, value in written.items()}
        own = controller.get(part.axis, ())
        parts.append(replace(part, held=tuple(now[a] for a in own if a in now), set_up=()))
    verified, figures = trial_of(folder.verification, journal.drives)
    return _keep(machine, name, str(session), verified, figures, parts)


def keep_drives(
    machine: str,
    name: str,
    drives: Sequence[CanopenDrive],
    controller: Mapping[str, Collection[ObjectAddress]],
) -> ToolSet:
    """Keep what the drives hold now as a tool set: it was not tried by this tool."""
    parts = []
    for part in back_up(machine, drives).drives:
        own = set(controller.get(part.axis, ()))
        held = tuple(h for h in part.held if h.info.address in own)
        parts.append(replace(part, held=held, set_up=()))
    return _keep(machine, name, "drives", False, {}, parts)


def changes_to(
    drives: Sequence[CanopenDrive], tool: ToolSet, *, same_drives: bool = False
) -> tuple[Change, ...]:
    """Return what switching to a tool set would change, in the order of writing.

    Raises
    ------
    WrongDeviceError
        If it was kept from other drives.
    ProfileError
        If it names objects that are no parameters of a drive.
    """
    check_same_drives(drives, tool.parameters.drives, "tool set", trusted=same_drives)
    by_axis = {drive.axis: drive for drive in drives}
    changes: list[Change] = []
    for part in tool.parameters.drives:
        drive = by_axis[part.axis]
        check_objects(drive, (h.info for h in part.held), tool.path / "parameters.yaml", "tool set")
        changes += changes_back_to(drive, {h.info.address: h.value for h in part.held})
    return tuple(changes)


def _keep(
    machine: str,
    name: str,
    source: str,
    verified: bool,
    figures: Mapping[str, Mapping[str, float | None]],
    parts: Sequence[DriveBackup],
) -> ToolSet:
    _check_name(name)
    folder = tools_folder(machine) / name
    kept = datetime.now(UTC).isoformat(timespec="seconds")
    parameters = Backup(machine, kept, tuple(parts))
    tool = ToolSet(name, machine, kept, source, verified, figures, parameters, folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        # Both are on the disk before either takes its place: a full disk leaves the old set.  Cut off
        # between the two, the checksum of the parameters tells that they do not belong together.
        new = {name: folder / f"{name}.new" for name in ("parameters.yaml", "tool.yaml")}
        try:
            save_backup(parameters, new["parameters.yaml"])
            beside = file_checksum(new["parameters.yaml"])
            write_tool_file(new["tool.yaml"], ToolFile(**tool.as_dict(), parameters=beside))
            for name_now, path in new.items():
                path.replace(folder / name_now)
            sync_folder(folder)
        finally:
            for path in new.values():
                path.unlink(missing_ok=True)
    except OSError as error:
        raise OutputError(
            f"{folder}: the tool set can not be kept ({error.strerror or error}). Make room, or name "
            "another place in FIELDTOOL_STATE_DIR."
        ) from error
    return tool


def _check_name(name: str) -> None:
    if not NAME.fullmatch(name):
        raise ProfileError(
            Path(name),
            "a tool set's name is made of letters, digits, '_', '-' and '.', 50 at most",
        )
