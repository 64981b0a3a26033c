"""Drive and machine profiles as files: a first one from an EDS, a check, and what is still open."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from drives.errors import ProfileError
from drives.profile import (
    DriveProfile,
    MachineProfile,
    load_drive,
    load_machine,
    packaged,
    read_yaml,
)
from drives.profile.draft import draft, profile_name
from drives.profile.eds import read_eds
from drives.profile.match import obstacles
from fieldtool.errors import OutputError
from fieldtool.records.files import write_new


@dataclass(frozen=True)
class CheckedProfile:
    """What there is to say of a profile that can be read."""

    path: Path
    kind: str
    """drive or machine."""
    name: str
    unknown: tuple[str, ...] = ()
    """Keys of a drive profile that say ``unknown``, dotted."""
    obstacles: tuple[str, ...] = ()
    """What can not be done with such a drive, a phrase each."""
    drives: tuple[tuple["CheckedProfile", tuple[str, ...]], ...] = ()
    """Of a machine profile: its drive profiles, each once, with the axes that have it."""

    def as_dict(self) -> dict[str, Any]:
        """Plain values."""
        plain: dict[str, Any] = {
            "file": str(self.path),
            "kind": self.kind,
            "name": self.name,
            "unknown": list(self.unknown),
            "obstacles": list(self.obstacles),
        }
        if self.kind == "machine":
            plain["drives"] = [{**one.as_dict(), "axes": list(axes)} for one, axes in self.drives]
        return plain


def new_profile(eds: Path, out: Path | None = None) -> CheckedProfile:
    """Write a first drive profile for an EDS file; return what a person still has to fill in.

    Parameters
    ----------
    eds
        The drive's EDS or DCF file.
    out
        The new file; beside the EDS file, with its name, where None.

    Raises
    ------
    ProfileError
        If the EDS file can not be read.
    OutputError
        If the new file exists or can not be written.
    """
    dictionary = read_eds(eds)
    path = eds.with_suffix(".yaml") if out is None else out
    beside = eds.absolute().parent == path.absolute().parent
    name = profile_name(path)
    text = draft(dictionary, name, eds.name if beside else str(eds.absolute()))
    try:
        write_new(path, text)
    except FileExistsError:
        raise OutputError(
            f"{path}: is there already and is not overwritten. Give another name with -o."
        ) from None
    return check_profile(path)


def check_profile(path: Path) -> CheckedProfile:
    """Read a drive or machine profile, and the EDS files of its drives with it.

    Parameters
    ----------
    path
        A file, or the name of a packaged profile.

    Raises
    ------
    ProfileError
        For the first thing that is wrong: with file, line, key and value.
    """
    if str(path) in packaged("drives"):
        path = load_drive(path).path
    elif str(path) in packaged("machines"):
        path = load_machine(path).path
    data, _ = read_yaml(path)
    kind = str(data.get("format", ""))
    if kind.startswith("fieldtool-machine/"):
        machine = load_machine(path)
        return CheckedProfile(path, "machine", machine.name, drives=_drives_of(machine))
    if kind.startswith("fieldtool-drive/"):
        return _checked(load_drive(path))
    raise ProfileError(
        path, f"format must be fieldtool-drive/1 or fieldtool-machine/1, got {kind!r}", 1
    )


def _drives_of(machine: MachineProfile) -> tuple[tuple[CheckedProfile, tuple[str, ...]], ...]:
    """Check the drive profiles of a machine; one with two EDS files counts as two."""
    axes: dict[tuple[Path, Path | None], list[str]] = {}
    found: dict[tuple[Path, Path | None], CheckedProfile] = {}
    for axis in machine.axes:
        profile = load_drive(axis.drive, machine.path)
        if axis.eds is not None:
            profile = profile.with_eds(machine.path.parent / axis.eds)
        key = (profile.path, profile.eds_path)
        if key not in found:
            found[key] = _checked(profile)
        axes.setdefault(key, []).append(axis.name)
    return tuple((found[key], tuple(names)) for key, names in axes.items())


def _checked(profile: DriveProfile) -> CheckedProfile:
    """Compare a profile with its EDS file, where it has one."""
    if profile.eds_path is not None:
        profile.with_types_of(read_eds(profile.eds_path))
    return CheckedProfile(profile.path, "drive", profile.name, profile.unknown, obstacles(profile))
