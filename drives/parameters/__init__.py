"""Controller parameters: back up, compare, write in order, read back, restore, store.

Nothing here writes to a drive that is enabled.  Before the first write everything that could be
written is in a backup, and whatever fails during a write, all drives get their old values back.
"""

from drives.parameters.backup import Backup, DriveBackup, back_up, load_backup, save_backup
from drives.parameters.changes import Change, Written, planned_changes, read_loop, read_parameters
from drives.parameters.restore import check_same_drives, restore
from drives.parameters.store import store
from drives.parameters.values import HeldObject, Raw
from drives.parameters.write import check_disabled, write

__all__ = [
    "Backup",
    "Change",
    "DriveBackup",
    "HeldObject",
    "Raw",
    "Written",
    "back_up",
    "check_disabled",
    "check_same_drives",
    "load_backup",
    "planned_changes",
    "read_loop",
    "read_parameters",
    "restore",
    "save_backup",
    "store",
    "write",
]
