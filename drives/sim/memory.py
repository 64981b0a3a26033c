"""Non-volatile memory of the simulated drive: what survives a power cycle."""

from typing import Literal

from drives.sim.dictionary import DriveDictionary, Key, Value

SAVE = int.from_bytes(b"save", "little")
LOAD = int.from_bytes(b"load", "little")

_COMMUNICATION = range(0x1000, 0x2000)

Bank = Literal["old", "new", "corrupted"]
"""What memory holds when the supply failed while it was written: drives with two banks hold what was
there before or, if only the end was missing, what was to be stored; others hold neither, find a wrong
checksum when they are switched on, and begin with factory values."""


class NonVolatileMemory:
    """Stored parameters by key; empty on a new drive."""

    def __init__(self) -> None:
        self._stored: dict[Key, Value] = {}
        self.node_id: int | None = None
        """What LSS stored."""
        self.corrupted = False
        """Whether its checksum is wrong: factory values are valid."""

    @property
    def stored(self) -> dict[Key, Value]:
        """A copy of what is stored; empty if nothing is."""
        return dict(self._stored)

    def save(self, dictionary: DriveDictionary) -> None:
        """Store every parameter as it stands in the drive's working memory."""
        self._stored, self.corrupted = dictionary.parameters(), False

    def erase(self) -> None:
        """Forget what was stored: from the next reset on, factory values are valid."""
        self._stored, self.corrupted = {}, False

    def cut_off(self, bank: Bank, dictionary: DriveDictionary) -> None:
        """Hold what is left when the supply fails while it is written."""
        if bank == "new":
            self.save(dictionary)
        elif bank == "corrupted":
            self._stored, self.corrupted = {}, True

    def recall(self, dictionary: DriveDictionary, *, all_of_it: bool) -> None:
        """Fill working memory as after power-up; without ``all_of_it`` the communication part."""
        volatile = [key for key, entry in dictionary.entries.items() if entry.access == "rw"]
        if not all_of_it:
            volatile = [key for key in volatile if key[0] in _COMMUNICATION]
        dictionary.load(self._stored, volatile)
