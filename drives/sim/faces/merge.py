"""A maker's objects over the reference drive's: what both have, what is only shown, what only works.

The firmware needs its standard objects whether the maker's drive shows them or not: those that it
does not show are hidden from SDO and PDO.  Communication objects keep the reference drive's values,
since a DCF file holds those of the node that it was taken from.
"""

from collections.abc import Mapping
from dataclasses import replace
from importlib.resources import files
from pathlib import Path

from drives.sim.dictionary import Key
from drives.sim.entries import ENTRIES, OBJECTS, Entry, ObjectEntry
from drives.sim.faces.eds_entries import EdsFile

MODES = 0x3A5
"""0x6502 of a drive whose file does not tell: profile position and velocity, homing, the three
cyclic modes."""
_FIRMWARE_MODES = {0, 1, 8, 9, 10}
_DEVICE_TYPE, _MODES, _MODE = (0x1000, 0), (0x6502, 0), (0x6060, 0)
_COMMANDS = {0x1010, 0x1011, 0x6040, 0x6060, 0x6071, 0x607A, 0x60B0, 0x60B1, 0x60B2, 0x60FF}


def shipped(name: str) -> Path:
    """Return an EDS file that ships with the drive profiles."""
    return Path(str(files("profiles").joinpath("drives", name)))


def dressed(path: Path) -> tuple[tuple[ObjectEntry, ...], frozenset[Key]]:
    """Return a maker's objects completed for the firmware, and which of them are hidden.

    Raises
    ------
    EdsFileError
        If the file can not be read.
    """
    return merged(EdsFile(path))


def merged(file: EdsFile) -> tuple[tuple[ObjectEntry, ...], frozenset[Key]]:
    """Do the same for a file that was read."""
    identity = {
        (0x1018, 1): file.device("VendorNumber"),
        (0x1018, 2): file.device("ProductNumber"),
        (0x1018, 3): file.device("RevisionNumber"),
    }
    shown = {
        index: replace(
            described, entries=tuple(_with_values(e, identity) for e in described.entries)
        )
        for index, described in file.objects.items()
    }
    return completed(shown)


def completed(
    shown: Mapping[int, ObjectEntry],
) -> tuple[tuple[ObjectEntry, ...], frozenset[Key]]:
    """Add what the firmware works with to the objects that a drive shows; return what is hidden."""
    visible = {entry.key for described in shown.values() for entry in described.entries}
    merged = dict(shown)
    for reference in OBJECTS:
        own = merged.get(reference.index)
        if own is None:
            merged[reference.index] = reference
            continue
        extra = tuple(e for e in reference.entries if e.key not in visible)
        if extra:
            entries = tuple(sorted((*own.entries, *extra), key=lambda e: e.subindex))
            merged[reference.index] = replace(own, entries=entries, is_variable=False)
    hidden = frozenset(ENTRIES) - visible
    return tuple(merged[index] for index in sorted(merged)), hidden


def _with_values(entry: Entry, identity: Mapping[Key, int]) -> Entry:
    reference = ENTRIES.get(entry.key)
    stored = entry.index not in _COMMANDS
    if entry.key in identity and not entry.default:
        return replace(entry, default=identity[entry.key])
    if entry.key == _DEVICE_TYPE:
        return replace(entry, default=int(ENTRIES[_DEVICE_TYPE].default))
    if entry.key == _MODES:
        return replace(entry, default=entry.default or MODES)
    if entry.key == _MODE:
        return replace(entry, default=1, stored=False, low=None, high=None)
    if reference is not None and 0x1000 <= entry.index < 0x2000 and entry.index != 0x1018:
        return replace(
            entry,
            default=reference.default,
            plus_node_id=reference.plus_node_id,
            low=reference.low,
            high=reference.high,
            stored=reference.stored,
        )
    if reference is not None:
        entry = replace(entry, choices=reference.choices)
    return replace(entry, stored=stored)


def with_modes(
    objects: tuple[ObjectEntry, ...], supported: int | None = None
) -> tuple[ObjectEntry, ...]:
    """Let 0x6060 take only modes that 0x6502 offers and the firmware has."""
    entries = {e.key: e for o in objects for e in o.entries}
    offered = int(entries[_MODES].default) if supported is None else supported
    choices = tuple(m for m in sorted(_FIRMWARE_MODES) if m == 0 or offered >> (m - 1) & 1)

    def limited(entry: Entry) -> Entry:
        if entry.key == _MODES:
            return replace(entry, default=offered)
        return replace(entry, choices=choices) if entry.key == _MODE else entry

    return tuple(replace(o, entries=tuple(limited(e) for e in o.entries)) for o in objects)
