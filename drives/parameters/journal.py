"""What a write-back has come to, and what comes next: values and rules alone, no drive, no disk.

A journal says for every drive who it is, which parameters change from what to what, how far the
write has come, and what its non-volatile memory is known to hold.  It is saved *before* each step
that it names (:meth:`Journal.began`) and after it (:meth:`Journal.ended`), so whoever reads it
after a power cut knows what may have happened.  :func:`next_step` is the whole strategy::

    new:  write all, check all, (prove,) store all, check all, finish
    old:  bring all back in working memory, store back what was or may be stored, finish

A write that fails turns back (:meth:`Journal.turned_back`); one that was cut off is always taken
back, never forward: the old values are in the backup, whole and proven.
"""

from collections.abc import Collection
from dataclasses import dataclass, replace
from enum import StrEnum

from drives.objects import ObjectInfo
from drives.parameters.values import Raw


class Goal(StrEnum):
    """Which values all drives are to hold in the end."""

    NEW = "new"
    OLD = "old"


class State(StrEnum):
    """Whether a write-back has ended, and with which values in all drives."""

    OPEN = "open"
    NEW = "new"
    OLD = "old"


class Storing(StrEnum):
    """What is stored in non-volatile memory on the way to the goal."""

    NONE = "none"
    NEEDED = "needed"
    """Where it holds, or may hold, something else than the goal."""
    ALL = "all"


class Phase(StrEnum):
    """How far one drive has come."""

    PLANNED = "planned"
    WRITING = "writing"
    WRITTEN = "written"
    VERIFIED = "verified"
    STORING = "storing"
    STORED = "stored"
    GOING_BACK = "going back"
    BACK = "back"
    STORING_BACK = "storing back"
    ROLLED_BACK = "rolled back"


class Memory(StrEnum):
    """What a drive's non-volatile memory is known to hold of the parameters."""

    UNTOUCHED = "untouched"
    """What it held before the write, whatever that was: no drive tells."""
    OLD = "old"
    NEW = "new"
    UNKNOWN = "unknown"
    """Storing began, and nobody knows how it ended."""


class Action(StrEnum):
    """What is done with one drive, or in the end with all."""

    WRITE = "write"
    CHECK = "check"
    BRING_BACK = "bring back"
    STORE = "store"
    FINISH = "finish"


@dataclass(frozen=True)
class Step:
    """One thing to do."""

    action: Action
    axis: str = ""
    """Empty where it is for all drives."""


@dataclass(frozen=True)
class JournalEntry:
    """One parameter, old and new in the drive's own type."""

    info: ObjectInfo
    before: Raw
    after: Raw


@dataclass(frozen=True)
class DriveRecord:
    """One drive of a write-back."""

    axis: str
    node_id: int
    vendor_id: int
    product_code: int
    revision_number: int
    serial_number: int
    """0 where the drive has none."""
    entries: tuple[JournalEntry, ...]
    """In the order of writing; empty where this drive's parameters stay."""
    phase: Phase = Phase.PLANNED
    memory: Memory = Memory.UNTOUCHED
    memory_before: Memory = Memory.UNTOUCHED
    """What it was before storing began: it stays so if the drive refuses to store."""
    earlier: Memory = Memory.UNTOUCHED
    """What earlier writes had left there, seen from the first backup; counts while this one has left
    ``memory`` untouched."""


_BEGUN = {
    Action.WRITE: Phase.WRITING,
    Action.BRING_BACK: Phase.GOING_BACK,
}
_ENDED = {
    Action.WRITE: Phase.WRITTEN,
    Action.CHECK: Phase.VERIFIED,
    Action.BRING_BACK: Phase.BACK,
}
_RESTORED = (Phase.BACK, Phase.STORING_BACK, Phase.ROLLED_BACK)
"""Phases in which the old values were read back from working memory."""


@dataclass(frozen=True)
class Journal:
    """A write-back over all drives of a machine."""

    machine: str
    begun: str
    """UTC, ISO 8601."""
    backup: str
    """Name of the backup file beside the journal; it holds the old values."""
    storing: Storing
    drives: tuple[DriveRecord, ...]
    goal: Goal = Goal.NEW
    state: State = State.OPEN

    def drive(self, axis: str) -> DriveRecord:
        """Return the record of an axis; raise KeyError if there is none."""
        for record in self.drives:
            if record.axis == axis:
                return record
        raise KeyError(axis)

    @property
    def is_open(self) -> bool:
        """Whether drives may hold old and new values mixed."""
        return self.state is State.OPEN

    @property
    def writes(self) -> bool:
        """Whether it is about new values; without, drives only held others for a time."""
        return any(record.entries for record in self.drives)

    def began(self, step: Step) -> "Journal":
        """Return the journal to be saved before a step is done."""
        if step.action is Action.STORE:
            record = self.drive(step.axis)
            phase = Phase.STORING if self.goal is Goal.NEW else Phase.STORING_BACK
            before = record.memory_before if _storing(record) else record.memory
            return self._with(step.axis, phase=phase, memory=Memory.UNKNOWN, memory_before=before)
        if step.action in _BEGUN:
            return self._with(step.axis, phase=_BEGUN[step.action])
        return self

    def ended(self, step: Step) -> "Journal":
        """Return the journal to be saved when a step has been done and proven."""
        if step.action is Action.FINISH:
            return replace(self, state=State(self.goal.value))
        if step.action is Action.STORE:
            memory = Memory(self.goal.value)
            phase = Phase.STORED if self.goal is Goal.NEW else Phase.ROLLED_BACK
            return self._with(step.axis, phase=phase, memory=memory, memory_before=memory)
        done = self._with(step.axis, phase=_ENDED[step.action])
        if step.action is Action.BRING_BACK and not _must_store(done, done.drive(step.axis)):
            return done._with(step.axis, phase=Phase.ROLLED_BACK)
        return done

    def refused_to_store(self, axis: str) -> "Journal":
        """Return the journal when a drive said that it has not stored: its memory is what it was."""
        record = self.drive(axis)
        phase = Phase.VERIFIED if self.goal is Goal.NEW else Phase.BACK
        return self._with(axis, phase=phase, memory=record.memory_before)

    def turned_back(self, *, distrust: bool) -> "Journal":
        """Return the journal of the way back to the old values.

        Parameters
        ----------
        distrust
            Bring back drives too to which nothing was written yet, or which were back already: time
            has passed since, in which they may have lost their supply.
        """
        drives = tuple(
            record
            if not distrust and record.phase in (Phase.PLANNED, *_RESTORED)
            else replace(record, phase=Phase.GOING_BACK)
            for record in self.drives
        )
        storing = self.storing if self.goal is Goal.OLD else Storing.NEEDED
        back = replace(self, goal=Goal.OLD, state=State.OPEN, storing=storing, drives=drives)
        for record in drives:
            if record.phase is Phase.PLANNED:
                back = back._with(record.axis, phase=Phase.ROLLED_BACK)
        return back

    def _with(
        self,
        axis: str,
        *,
        phase: Phase,
        memory: Memory | None = None,
        memory_before: Memory | None = None,
    ) -> "Journal":
        def changed(record: DriveRecord) -> DriveRecord:
            return replace(
                record,
                phase=phase,
                memory=record.memory if memory is None else memory,
                memory_before=record.memory_before if memory_before is None else memory_before,
            )

        drives = tuple(changed(r) if r.axis == axis else r for r in self.drives)
        return replace(self, drives=drives)


def _storing(record: DriveRecord) -> bool:
    return record.phase in (Phase.STORING, Phase.STORING_BACK)


def _must_store(journal: Journal, record: DriveRecord) -> bool:
    """Whether a drive that is back in working memory has to store that."""
    if journal.storing is Storing.ALL:
        return True
    return journal.storing is Storing.NEEDED and record.memory in (Memory.NEW, Memory.UNKNOWN)


def next_step(journal: Journal, given_up: Collection[str] = ()) -> Step | None:
    """Return what comes next; None when all is done, or all that can be done.

    Parameters
    ----------
    journal
        How far it has come.  One that was cut off is turned back first.
    given_up
        Axes that failed on the way back: they are left alone, and there is no finish.
    """
    if not journal.is_open:
        return None
    records = [record for record in journal.drives if record.axis not in given_up]
    for phase, action in _ORDER[journal.goal]:
        for record in records:
            if record.phase is phase and (
                action is not Action.STORE or _has_to_store(journal, record)
            ):
                return Step(action, record.axis)
    return None if given_up else Step(Action.FINISH)


def _has_to_store(journal: Journal, record: DriveRecord) -> bool:
    if journal.goal is Goal.NEW:
        return journal.storing is Storing.ALL and bool(record.entries)
    return _must_store(journal, record)


_ORDER = {
    Goal.NEW: (
        (Phase.PLANNED, Action.WRITE),
        (Phase.WRITTEN, Action.CHECK),
        (Phase.VERIFIED, Action.STORE),
    ),
    Goal.OLD: (
        (Phase.GOING_BACK, Action.BRING_BACK),
        (Phase.BACK, Action.STORE),
    ),
}
"""What is done with drives of which phase; a row is done with all drives before the next begins."""
