"""What has become of new parameters in the drives, by a session's log and write journal."""

from collections.abc import Mapping

from drives.parameters import Journal
from drives.parameters.journal import State
from fieldtool.report.material import Event, Material
from fieldtool.report.words import listed
from fieldtool.writeback.earlier import FIRST_BACKUP


def state(material: Material) -> str:
    """Say whether new parameters were written, stored, or taken back, and what a power cycle brings."""
    if not material.events:
        return "Designed; whether they were written is not known: there is no log."
    journal = material.journal if material.journal and material.journal.writes else None
    done = [event for event in material.events if _changes(event)]
    last = done[-1] if done else {}
    if _unknown(journal, last):
        return (
            "A write into the drives has not ended, or was not taken back in all of them: what they "
            "hold is not known. `fieldtool restore` with the session's folder brings the old ones back."
        )
    written = [event for event in done if event.get("event") == "write"]
    if not (journal or written or "verified" in {event.get("event") for event in done}):
        return "Designed; nothing was written into the drives."
    kept = [event for event in done if event.get("event") != "verified"]
    later = " What was written later was taken back." if last.get("event") == "verified" else ""
    if last.get("event") == "restored" or (written and kept[-1].get("event") == "restored"):
        begun = "and read back" if written else "in whole or in part"
        back = kept[-1]
        return (
            f"Written into the drives {begun}; afterwards {_restored(back)}.{_brings(back)}{later}"
        )
    if not written:
        if journal and journal.state is State.NEW:
            return "Written into the drives and read back; the log does not say whether they are stored."
        return "Written into the drives and taken back: the drives hold what they held before."
    if written[-1].get("stored"):
        return (
            f"Written into the drives, read back, and stored in their non-volatile memory.{later}"
        )
    return (
        "Written into the drives' working memory and read back; not stored: a power cycle brings "
        f"back what was stored.{later}"
    )


def _unknown(journal: Journal | None, last: Event) -> bool:
    """Whether a write was cut off, or drives could not be taken back; a later restore is no such end."""
    if last.get("event") == "restored":
        restored = str(last.get("time"))
        return journal is not None and journal.is_open and journal.begun[:19] > restored[:19]
    return last.get("verdict") == "mixed" or (journal is not None and journal.is_open)


def _changes(event: Event) -> bool:
    """Whether an event tells of new or old parameters in the drives."""
    kind = event.get("event")
    if kind == "verified":  # one that was stood is followed by its write
        return event.get("verdict") in ("restored", "mixed")
    return kind == "restored" or (kind == "write" and bool(event.get("written")))


def trial_sentence(material: Material) -> str:
    """Say what came of the trial, and what was brought back since; empty where there was none."""
    if material.trial is None:
        return ""
    events = material.events
    trials = [k for k, event in enumerate(events) if event.get("event") == "verified"]
    since = events[trials[-1] :] if trials else ()
    back = [event for event in since if event.get("event") == "restored"]
    if not back or since[0].get("verdict") == "restored":
        return material.trial.sentence
    return f"{material.trial.sentence} Since then {_restored(back[-1])}."


def _restored(event: Event) -> str:
    without, backup = event.get("without"), event.get("backup", FIRST_BACKUP)
    but = ", ".join(map(str, without)) if isinstance(without, list) else ""
    old = "the old ones were" if backup == FIRST_BACKUP else f"what {backup} holds was"
    return f"{old} brought back (`fieldtool restore`){f', but for {but}' if but else ''}"


def _brings(event: Event) -> str:
    """Say what a power cycle brings after a restore; empty where the log does not tell."""
    if "stored" not in event:
        return ""
    if event["stored"]:
        return " Their non-volatile memory holds it too."
    memory = event.get("memory")
    held = memory if isinstance(memory, Mapping) else {}
    only, new, unknown = (
        listed([axis for axis, what in held.items() if what in kinds])
        for kinds in (("untouched", "new", "unknown"), ("new",), ("unknown",))
    )
    where = f"In {only} it is" if only else "It is"
    words = f" {where} in working memory only: a power cycle brings back what was stored."
    if new:
        words += f" The non-volatile memory of {new} holds new parameters."
    if unknown:
        words += f" What the non-volatile memory of {unknown} holds is not known."
    return f"{words} `fieldtool restore --store` stores what was brought back."
