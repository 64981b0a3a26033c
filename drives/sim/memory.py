"""Non-volatile memory of the simulated drive: what survives a power cycle."""

from drives.sim.dictionary import DriveDictionary, Key, Value
from drives.sim.entries import ENTRIES

SAVE = int.from_bytes(b"save", "little")
LOAD = int.from_bytes(b"load", "little")

_COMMUNICATION = range(0x1000, 0x2000)
VOLATILE_KEYS = tuple(key for key, entry in ENTRIES.items() if entry.access == "rw")
"""Everything that a power cycle sets back, to its stored value or to the factory's."""
COMMUNICATION_KEYS = tuple(key for key in VOLATILE_KEYS if key[0] in _COMMUNICATION)
"""The part of it that a reset of the communication sets back."""


class NonVolatileMemory:
    """Stored parameters by key; empty on a new drive."""

    def __init__(self) -> None:
        self._stored: dict[Key, Value] = {}
        self.node_id: int | None = None
        """What LSS stored."""

    @property
    def stored(self) -> dict[Key, Value]:
        """A copy of what is stored; empty if nothing is."""
        return dict(self._stored)

    def save(self, dictionary: DriveDictionary) -> None:
        """Store every parameter as it stands in the drive's working memory."""
        self._stored = dictionary.parameters()

    def erase(self) -> None:
        """Forget what was stored: from the next reset on, factory values are valid."""
        self._stored = {}

    def recall(self, dictionary: DriveDictionary, *, all_of_it: bool) -> None:
        """Fill working memory as after power-up; without ``all_of_it`` the communication part."""
        dictionary.load(self._stored, VOLATILE_KEYS if all_of_it else COMMUNICATION_KEYS)
