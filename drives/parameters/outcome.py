"""What came of each drive, and how a person is told."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from drives.objects import ObjectAddress
from drives.parameters.backup import DriveBackup
from drives.parameters.bring_back import Found
from drives.parameters.journal import DriveRecord, Journal, Memory, Phase
from drives.parameters.values import HeldObject, same

MEMORY_WORDS = {
    Memory.UNTOUCHED: "its non-volatile memory is as it was before",
    Memory.OLD: "its non-volatile memory holds the old values too",
    Memory.NEW: "its non-volatile memory holds the new values: a power cycle brings them",
    Memory.UNKNOWN: "what its non-volatile memory holds is not known",
}
"""What a drive's non-volatile memory holds, for a person."""


@dataclass
class DriveOutcome:
    """What one drive was found to hold, and what was done."""

    axis: str
    node_id: int
    found: Found = Found.OLD
    written: tuple[HeldObject, ...] = ()
    """Values that differed and were brought back."""
    failed: dict[ObjectAddress, str] = field(default_factory=dict)
    """Objects that were not, and what the drive holds instead, in words."""
    trouble: str = ""
    """Why it could not be brought back or stored; empty where it could."""
    memory: Memory = Memory.UNTOUCHED

    @property
    def place(self) -> str:
        """Axis and node."""
        return f"{self.axis} (node {self.node_id})"

    @property
    def is_back(self) -> bool:
        """Whether everything is as it was."""
        return not self.trouble and not self.failed


def what_is_held(
    journal: Journal, outcomes: Mapping[str, DriveOutcome], backups: Mapping[str, DriveBackup]
) -> dict[str, str]:
    """Return what is not as it was, in words, by its place: drive, parameter, object."""
    holds: dict[str, str] = {}
    for axis, outcome in outcomes.items():
        record = journal.drive(axis)
        part = backups[axis]
        names = {held.info.address: held.info.name for held in (*part.held, *part.set_up)}
        names |= {entry.info.address: entry.info.name for entry in record.entries}
        for address, text in outcome.failed.items():
            holds[f"{outcome.place}, {names[address]}, {address}"] = text
        if outcome.trouble and not outcome.failed:
            holds[outcome.place] = _of_drive(record, outcome)
        elif not outcome.is_back and outcome.memory in (Memory.NEW, Memory.UNKNOWN):
            holds[f"{outcome.place}, non-volatile memory"] = _MEMORY_ALONE[outcome.memory]
    return holds


def sentence(
    what: str,
    journal: Journal,
    outcomes: Mapping[str, DriveOutcome],
    backups: Mapping[str, DriveBackup],
) -> str:
    """Say what failed, what every drive holds now, and what to do."""
    listed = "; ".join(
        f"{place} holds {text}" for place, text in what_is_held(journal, outcomes, backups).items()
    )
    rest = "".join(
        f" {outcome.place} holds the old values; {MEMORY_WORDS[outcome.memory]}."
        for outcome in outcomes.values()
        if outcome.is_back
    )
    return (
        f"{what}: {listed}.{rest} Do not run the machine; use `fieldtool restore` with the session "
        "folder once the drives answer again."
    )


def _of_drive(record: DriveRecord, outcome: DriveOutcome) -> str:
    if record.phase is Phase.GOING_BACK:
        changed = [e for e in record.entries if not same(e.info, e.before, e.after)]
        which = ", ".join(f"{e.info.name} {e.info.address}" for e in changed)
        working = f"not known values of {which}" if which else "not known values"
    else:
        working = "the old values in working memory"
    return f"{working}; {MEMORY_WORDS[record.memory]} ({outcome.trouble.rstrip('.')})"


_MEMORY_ALONE = {
    Memory.NEW: "the new values: a power cycle brings them",
    Memory.UNKNOWN: "nobody knows what: storing was not confirmed",
}
