"""What has become of new parameters in the drives, by a session's log."""

from collections.abc import Mapping

from fieldtool.report.material import Event, Material
from fieldtool.report.words import listed
from fieldtool.writeback.earlier import FIRST_BACKUP


def state(material: Material) -> str:
    """Say whether new parameters were written, stored, or taken back, and what a power cycle brings."""
    written = [event for event in material.events_of("write") if event.get("written")]
    if not material.events:
        return "Designed; whether they were written is not known: there is no log."
    if not written:
        return "Designed; nothing was written into the drives."
    last = [e for e in material.events if e in written or e.get("event") == "restored"][-1]
    if last.get("event") == "restored":
        return (
            f"Written into the drives and read back; afterwards {_restored(last)}.{_brings(last)}"
        )
    if written[-1].get("stored"):
        return "Written into the drives, read back, and stored in their non-volatile memory."
    return (
        "Written into the drives' working memory and read back; not stored: a power cycle brings "
        "back what was stored."
    )


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
