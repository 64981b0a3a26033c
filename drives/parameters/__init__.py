"""Controller parameters: back up, compare, write in order, read back, restore, store.

Nothing here writes to a drive that is enabled.  Before the first write everything that could be
written is in a backup, and the journal of the write is on the disk; whatever fails during a write,
all drives get their old values back, now or by whoever reads the journal next.
"""

from drives.parameters.backup import Backup, DriveBackup, back_up, load_backup, save_backup
from drives.parameters.bring_back import Found
from drives.parameters.changes import (
    Change,
    Written,
    changes_back_to,
    planned_changes,
    read_loop,
    read_parameters,
)
from drives.parameters.guard import check_disabled, check_objects, check_same_drives
from drives.parameters.journal import (
    Action,
    DriveRecord,
    Journal,
    JournalEntry,
    Memory,
    Phase,
    Step,
    Storing,
)
from drives.parameters.journal_file import load_journal, save_journal
from drives.parameters.outcome import MEMORY_WORDS, DriveOutcome
from drives.parameters.set_up import check_set_up
from drives.parameters.store import can_store, check_can_store
from drives.parameters.transaction import Transaction
from drives.parameters.values import HeldObject, Raw, same

__all__ = [
    "MEMORY_WORDS",
    "Action",
    "Backup",
    "Change",
    "DriveBackup",
    "DriveOutcome",
    "DriveRecord",
    "Found",
    "HeldObject",
    "Journal",
    "JournalEntry",
    "Memory",
    "Phase",
    "Raw",
    "Step",
    "Storing",
    "Transaction",
    "Written",
    "back_up",
    "can_store",
    "changes_back_to",
    "check_can_store",
    "check_disabled",
    "check_objects",
    "check_same_drives",
    "check_set_up",
    "load_backup",
    "load_journal",
    "planned_changes",
    "read_loop",
    "read_parameters",
    "same",
    "save_backup",
    "save_journal",
]
