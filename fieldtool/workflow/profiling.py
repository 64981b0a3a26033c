"""Drive and machine profiles as files: a first one from an EDS, a check, and what is still open."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from drives.errors import ProfileError
from drives.profile import DriveProfile, load_drive, load_machine, read_yaml
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

    def as_dict(self) -> dict[str, Any]:
        """Plain values."""
        return {
            "file": str(self.path),
            "kind": self.kind,
            "name": self.name,
            "unknown": list(self.unknown),
            "obstacles": list(self.obstacles),
        }


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
    """Read a drive or machine profile, and a drive profile's EDS file with it.

    Raises
    ------
    ProfileError
        For the first thing that is wrong: with file, line, key and value.
    """
    data, _ = read_yaml(path)
    kind = str(data.get("format", ""))
    if kind.startswith("fieldtool-machine/"):
        machine = load_machine(path)
        for axis in machine.axes:
            profile = load_drive(axis.drive, machine.path)
            if axis.eds is not None:
                profile = profile.with_eds(machine.path.parent / axis.eds)
            _with_eds(profile)
        return CheckedProfile(path, "machine", machine.name)
    if kind.startswith("fieldtool-drive/"):
        profile = load_drive(path)
        _with_eds(profile)
        return CheckedProfile(path, "drive", profile.name, profile.unknown, obstacles(profile))
    raise ProfileError(
        path, f"format must be fieldtool-drive/1 or fieldtool-machine/1, got {kind!r}", 1
    )


def _with_eds(profile: DriveProfile) -> None:
    """Compare a profile with its EDS file, where it has one."""
    if profile.eds_path is not None:
        profile.with_types_of(read_eds(profile.eds_path))
