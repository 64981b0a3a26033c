"""Carry a write-back out on the drives, step by step as the journal's rules say, or take it back."""

from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress

from drives.canopen_drive.interrupts import uninterrupted
from drives.errors import (
    STOPPED_AT_REST,
    DrivesError,
    SdoAbortError,
    SdoError,
    StoppedError,
    UserStopError,
    WriteBackError,
    WriteBackMixedError,
)
from drives.objects import ObjectAddress
from drives.parameters.access import take_over, unlock
from drives.parameters.backup import Backup
from drives.parameters.bring_back import BroughtBack, Found, SilentDriveError, bring_back
from drives.parameters.journal import (
    Action,
    DriveRecord,
    Goal,
    Journal,
    JournalEntry,
    Memory,
    Phase,
    Step,
    Storing,
    next_step,
)
from drives.parameters.outcome import DriveOutcome, sentence, what_is_held
from drives.parameters.store import StoreRefusedError, store
from drives.parameters.values import ParameterDrive, same

Save = Callable[[Journal], None]
"""Brings a journal to the disk before it returns."""
Tell = Callable[[Step], None]
"""Is told which step begins."""
Prove = Callable[[], None]
"""Tries the new values in all drives' working memory, before anything is stored; raises if they fail."""
ROUNDS = 3
"""Times that everything is brought back at most, where drives lose their supply meanwhile."""


class MismatchError(DrivesError):
    """A drive holds something else than what was written."""


class NotTakenError(DrivesError):
    """A drive did not take a value."""


class Transaction:
    """One write-back over all drives of a machine.

    Parameters
    ----------
    drives
        All of them, identified and disabled.  Without some of the journal's, it can not end: nothing
        but bringing the others back makes sense then.
    journal
        How far it has come.
    backup
        Everything that the drives held before it.
    save
        Is given the journal before and after each step; an OSError ends the write.
    tell
        Is told which step begins.
    prove
        Called once all drives hold the new values and have been read back, before one of them stores:
        what it raises takes the write back.  The journal is open meanwhile.
    stop_requested
        Asked before each drive stores and before the write ends: a stop takes the write back.
    wanted
        What new values are in physical units, in words, by axis and object; for messages.
    boots
        How often each drive had booted, by axis, before the backup was taken: one that has booted since
        has lost what was not stored, and the write is taken back.  Without, what they have now.
    """

    def __init__(
        self,
        drives: Iterable[ParameterDrive],
        journal: Journal,
        backup: Backup,
        save: Save,
        tell: Tell = lambda _: None,
        prove: Prove | None = None,
        stop_requested: Callable[[], bool] = lambda: False,
        wanted: Mapping[tuple[str, ObjectAddress], str] | None = None,
        boots: Mapping[str, int] | None = None,
    ) -> None:
        self._wanted = wanted or {}
        self._tell, self._prove, self._stop_requested = tell, prove, stop_requested
        self._drives = {drive.axis: drive for drive in drives}
        self._boots = dict(boots or {axis: drive.boots for axis, drive in self._drives.items()})
        self._backups = {part.axis: part for part in backup.drives}
        self._save = save
        self.journal = journal
        self._begun = False
        here = [record for record in journal.drives if record.axis in self._drives]
        self.outcomes = {record.axis: DriveOutcome(record.axis, record.node_id) for record in here}
        self._left_out = {record.axis for record in journal.drives} - self._drives.keys()
        self.unsaved: OSError | None = None
        """Why the journal could not be saved on the way back."""

    # --- forward ---------------------------------------------------------------------------------

    def write(self) -> None:
        """Write, check and, if the journal says so, store; all or nothing.

        Raises
        ------
        OSError
            If the journal could not be saved before the first write; nothing was written.
        WriteBackError
            If a drive refused or holds another value, or the new ones were not proven: all drives hold
            their old values.
        WriteBackMixedError
            If the old values could not be brought back either; says which drive holds what.
        UserStopError
            If the user stopped: all drives hold their old values, unless the write had just ended.
        """
        try:
            self._save(self.journal)
            self._begun = True
            while (step := next_step(self.journal)) is not None:
                if step.action in (Action.STORE, Action.FINISH):
                    self._prove_once()
                    self._heed_stop()
                self._step_forward(step)
            self._heed_stop()
        except BaseException as error:
            if self.journal.is_open:
                self._take_back(error)
            error.add_note(f"{_ENDED_WORDS[self.journal.state.value]}")
            raise

    def _prove_once(self) -> None:
        """Have the new values tried, and see that they are still there afterwards."""
        prove, self._prove = self._prove, None
        if prove is not None:
            prove()
            for drive in self._drives.values():
                if drive.left_changed:
                    raise MismatchError(
                        f"{drive.axis}: what the trial had set for its time could not be put back"
                    )
                self._check(drive)

    def _heed_stop(self) -> None:
        """End the write if the user asked for it: a trial that has just ended no longer asks."""
        if self._stop_requested():
            raise UserStopError(STOPPED_AT_REST)

    def _refuse_restarted(self) -> None:
        """End the write if a drive has lost its supply: also where it holds all that was written."""
        for axis, drive in self._drives.items():
            stored = self._record(axis).phase is Phase.STORED
            if drive.boots != self._boots[axis] and not stored:
                raise MismatchError(
                    f"{axis}: node {drive.node_id} has restarted since its parameters were backed up, "
                    "and lost what was not stored in it. Check its supply"
                )

    def _step_forward(self, step: Step) -> None:
        self._refuse_restarted()
        self._tell(step)
        drive = self._drives.get(step.axis)
        if step.action in (Action.STORE, Action.FINISH):
            with uninterrupted():  # a stop waits for the answer, which says what the memory holds
                self._begin(step)
                if drive is None:
                    if self.journal.storing is not Storing.NONE:  # it took its time
                        for each in self._drives.values():
                            self._check(each)
                else:
                    self._store(drive)
                self._end(step)
            return
        self._begin(step)
        if drive is not None:
            entries = self.journal.drive(step.axis).entries
            if step.action is Action.WRITE:
                changed = [e for e in entries if not same(e.info, e.before, e.after)]
                unlock(drive)
                for entry in changed:
                    self._write(drive, entry)
                take_over(drive, {entry.info.address for entry in changed})
            else:
                self._check(drive)
        self._end(step)

    def _write(self, drive: ParameterDrive, entry: JournalEntry) -> None:
        """Write one new value; where that fails, say which parameter, which value, and what to do."""
        try:
            drive.write(entry.info, entry.after)
        except SdoError as error:
            why = error.what
            if isinstance(error, SdoAbortError):
                physical = self._wanted.get((drive.axis, entry.info.address))
                value = f"{entry.after} ({physical})" if physical else f"{entry.after}"
                todo = _TODO.get(error.code, _LOOK_UP).format(name=entry.info.name)
                why = f"the drive holds {entry.before} and refused to take {value}: {error.why}. {todo}"
            raise NotTakenError(
                f"{drive.axis}, {entry.info.name}, object {entry.info.address}: {why}"
            ) from error

    def _check(self, drive: ParameterDrive) -> None:
        """Read a drive's parameters back, and see that they are those of the goal."""
        forward = self.journal.goal is Goal.NEW
        wanted = {
            entry.info: entry.after if forward else entry.before
            for entry in self._record(drive.axis).entries
        }
        if not forward:  # and of all that came back, what does not change by itself
            known = {parameter.object for parameter in drive.profile.parameters.values()}
            written = self.outcomes[drive.axis].written
            wanted |= {h.info: h.value for h in written if h.info.address in known}
        for info, value in wanted.items():
            found = drive.read(info)
            if not same(info, found, value):
                physical = self._wanted.get((drive.axis, info.address)) if forward else None
                raise MismatchError(
                    f"{drive.axis}, {info.name}, object {info.address}: wrote {value}, the drive "
                    f"holds {found}{f' (in its own units; {physical} was wanted)' if physical else ''}."
                )

    def _store(self, drive: ParameterDrive) -> None:
        try:
            store(drive)
        except StoreRefusedError:
            self.journal = self.journal.refused_to_store(drive.axis)
            raise
        self._check(drive)  # one that has restarted shows what it has stored

    def _begin(self, step: Step) -> None:
        self._go(self.journal.began(step))

    def _end(self, step: Step) -> None:
        self._go(self.journal.ended(step))

    def _go(self, journal: Journal) -> None:
        if journal != self.journal:
            self._save(journal)
            self.journal = journal

    def _record(self, axis: str) -> DriveRecord:
        return self.journal.drive(axis)

    # --- back ------------------------------------------------------------------------------------

    def _take_back(self, cause: BaseException) -> None:
        """Go back after a failure; raise what says how that ended, unless it was a stop."""
        with uninterrupted():
            # Where one lost its supply, so may have one to which nothing was written yet.
            self._back_again(self.journal.turned_back(distrust=self._begun), set_up=False)
        reason = str(cause).rstrip(".") or type(cause).__name__
        try:
            self._refuse_or_say(reason, cause)
        except DrivesError as error:
            for note in getattr(
                cause, "__notes__", ()
            ):  # such as a drive that may still be enabled
                error.add_note(note)
            self._note_whole(error)
            raise
        self._note_whole(cause)

    def _note_whole(self, error: BaseException) -> None:
        """Say which drives have come to rest since, and hold nothing any more that a trial had set."""
        for axis, outcome in self.outcomes.items():
            if self._drives[axis].left_changed and outcome.is_back:
                error.add_note(
                    f"{axis}: since then the drive has shown that it is off, and all that the trial had "
                    "left changed in it, its fail-safe objects too, was brought back."
                )

    def _refuse_or_say(self, reason: str, cause: BaseException) -> None:
        self._refuse_mixed(f"writing failed: {reason}. Not everything could be restored", cause)
        failed = self._begun if isinstance(cause, OSError) else not isinstance(cause, StoppedError)
        if failed and isinstance(cause, DrivesError | OSError):
            unsaved = (
                f" The journal does not say so ({self.unsaved}): run `fieldtool restore` once."
                if self.unsaved
                else ""
            )
            raise WriteBackError(
                f"{reason}. Nothing was changed: all parameters were restored and read back."
                f"{self._stored_back()}{unsaved}"
            ) from cause

    def restore(self) -> None:
        """Bring the whole backup back into all drives, and store it as the journal says.

        Raises
        ------
        WriteBackMixedError
            If a value could not be restored or stored; every other one was.
        UserStopError
            If the user stopped meanwhile: everything was restored all the same.
        """
        done = False
        try:
            with uninterrupted():
                self._save(self.journal)
                self._back_again(self.journal, set_up=True)
                self._refuse_mixed("not everything could be restored", None)
                done = True
        except BaseException as error:
            if done:  # a stop that was held back
                but = f" but {', '.join(sorted(self._left_out))}" if self._left_out else ""
                error.add_note(f"The restore had ended: all drives{but} hold the old values.")
            raise

    def _back_again(self, journal: Journal, *, set_up: bool) -> None:
        """Bring back until all drives hold their old values at the same time."""
        self._go_quietly(journal)
        for _ in range(ROUNDS):
            self._back(set_up=set_up)
            if all(outcome.trouble != _LOST for outcome in self.outcomes.values()):
                return
            self._go_quietly(self.journal.turned_back(distrust=True))

    def _back(self, *, set_up: bool) -> None:
        given_up = set(self._left_out)
        for outcome in self.outcomes.values():
            outcome.trouble = ""
        while (step := next_step(self.journal, given_up)) is not None:
            with suppress(Exception):  # nobody to hear it is no reason to leave drives as they are
                self._tell(step)
            self._go_quietly(self.journal.began(step))
            try:
                if step.action is Action.FINISH:
                    self._check_back(given_up)
                    if given_up:
                        continue
                elif step.action is Action.BRING_BACK:
                    self._bring_back(step.axis, set_up=set_up)
                else:
                    self._store(self._drives[step.axis])
            except DrivesError as error:
                lost = step.action is Action.STORE and isinstance(error, MismatchError)
                self.outcomes[step.axis].trouble = _LOST if lost else str(error)
                given_up.add(step.axis)
                continue
            self._go_quietly(self.journal.ended(step))
        if self._left_out and given_up == self._left_out:
            self._check_back(given_up)  # what the finish would have done
        for axis, outcome in self.outcomes.items():
            outcome.memory = self._record(axis).memory

    def _bring_back(self, axis: str, *, set_up: bool) -> None:
        outcome, drive = self.outcomes[axis], self._drives[axis]
        set_up = set_up or drive.left_changed
        try:
            done: BroughtBack = bring_back(
                drive, self._record(axis), self._backups[axis], set_up=set_up
            )
        except SilentDriveError:
            outcome.found = Found.SILENT
            raise
        if not outcome.written:
            outcome.found = done.found
        again = {held.info.address for held in done.written}
        kept = tuple(held for held in outcome.written if held.info.address not in again)
        outcome.written = (*kept, *done.written)
        outcome.failed = dict(done.failed)
        # What this tool had changed keeps the journal open, and is not stored as it is now.
        changed = {entry.info.address for entry in self._record(axis).entries}
        changed |= {held.info.address for held in self._backups[axis].set_up}
        if changed & done.failed.keys():
            raise MismatchError(f"{axis}: what the tool had changed could not be brought back")

    def _check_back(self, given_up: set[str]) -> None:
        """See that drives that were brought back first have not lost their supply since."""
        for axis, drive in self._drives.items():
            if axis in self.outcomes and axis not in given_up:
                try:
                    self._check(drive)
                except DrivesError:
                    self.outcomes[axis].trouble = _LOST
                    given_up.add(axis)

    def _go_quietly(self, journal: Journal) -> None:
        """Save the journal if that is possible: on the way back nothing may stand in it."""
        try:
            self._go(journal)
        except OSError as error:
            self.unsaved, self.journal = error, journal

    def _refuse_mixed(self, what: str, cause: BaseException | None) -> None:
        """Raise, if not everything is as it was."""
        if all(outcome.is_back for outcome in self.outcomes.values()):
            return
        parts = self.journal, self.outcomes, self._backups
        raise WriteBackMixedError(sentence(what, *parts), what_is_held(*parts)) from cause

    def _stored_back(self) -> str:
        back = [o.axis for o in self.outcomes.values() if o.memory is Memory.OLD]
        if not back:
            return ""
        return f" {', '.join(back)} stored the old values again, so they survive a power cycle."


_LOOK_UP = "Compare this object with the drive's manual, and correct {name} in the drive profile."
_RANGE = (
    "Look up its range in the drive's manual, give it as `minimum` and `maximum` of {name} in the drive "
    "profile, and design anew."
)
_STATE = (
    "The drive takes {name} in another state: see in its manual in which, and whether it is locked or "
    "somebody else has the control."
)
_TODO = {
    **dict.fromkeys((0x06090030, 0x06090031, 0x06090032, 0x06090036), _RANGE),
    **dict.fromkeys((0x08000020, 0x08000021, 0x08000022), _STATE),
}
"""What to do, by the code with which a drive refused a value."""
_LOST = "lost the values that were brought back: did it lose its supply?"
_ENDED_WORDS = {
    "new": "The write had ended: all drives hold the new values.",
    "old": "All drives hold the old values.",
    "open": "The drives may hold old and new values mixed: use `fieldtool restore`.",
}
