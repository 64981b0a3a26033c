"""What a restore looks like on a terminal: what each drive held, and what was done."""

from rich.console import Console

from drives.parameters import DriveOutcome, Memory
from fieldtool.cli.output import indented
from fieldtool.cli.sheet import Sheet
from fieldtool.writeback.restoring import Restored

MEMORY_WORDS = {
    Memory.UNTOUCHED: "as it was before",
    Memory.OLD: "old values, stored",
    Memory.NEW: "new values: a power cycle brings them",
    Memory.UNKNOWN: "not known",
}


def show_restored(console: Console, restored: Restored) -> None:
    """Show what each drive held, what was brought back, and where the old values are now."""
    table = Sheet("axis", "node", "found", "brought back", "working memory", "non-volatile memory")
    for outcome in restored.outcomes:
        table.add(
            outcome.axis,
            str(outcome.node_id),
            _found(outcome, restored.had_write),
            _count(len(outcome.written)),
            "old values",
            MEMORY_WORDS[outcome.memory],
        )
    console.print(table)
    for sentence in sentences(restored):
        console.print(indented(sentence))


def sentences(restored: Restored) -> list[str]:
    """Return what there is to say below the table."""
    count = len(restored.written)
    said = []
    if restored.left_out:
        said.append(
            f"Left as they are: {', '.join(restored.left_out)}. The other drives hold the old values."
        )
    elif restored.cut_off is not None:
        said.append(
            f"The {'write' if restored.had_write else 'measurement'} that began at "
            f"{restored.cut_off.begun} had been cut off. It was taken back: all drives hold the old "
            "values."
        )
    not_stored = [o.axis for o in restored.outcomes if o.memory is not Memory.OLD]
    if count == 0:
        said.append("Every drive held what the backup holds; all was read back.")
        if not_stored and restored.cut_off is None:
            return [*said, *restored.notes]
    else:
        differed = "1 parameter differed and was"
        if count > 1:
            differed = f"{count} parameters differed and were"
        said.append(f"{differed} restored; all were read back.")
    if not not_stored:
        said.append("They are stored too: they survive a power cycle.")
    elif len(not_stored) == len(restored.outcomes):
        said.append(
            "They are in the drives' working memory only: a power cycle brings back what was stored. "
            "Use --store to keep them."
        )
    else:
        said.append(
            f"{', '.join(not_stored)}: in working memory only, because nothing new was stored there; a "
            "power cycle brings back what was stored before the write. Use --store to keep them."
        )
    return [*said, *restored.notes]


def _found(outcome: DriveOutcome, had_write: bool) -> str:
    if had_write:
        return outcome.found.value
    return "as in the backup" if not outcome.written else "other values than the backup"


def _count(number: int) -> str:
    return {0: "nothing", 1: "1 parameter"}.get(number, f"{number} parameters")
