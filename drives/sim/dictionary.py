"""The simulated drive's object dictionary: durand's, with CiA 301's checks completed.

What durand's dictionary lacks and this one has: a variable has no sub-index but 0; data that are
too long or too short are told apart; NaN is refused; values that no range describes, and writes
that the drive's state forbids, are refused with the abort code that says so; nothing that goes
wrong in a callback is swallowed.
"""

import struct
from collections.abc import Callable, Iterable, Mapping, Sequence
from math import isnan
from typing import Any

from durand.datatypes import is_numeric, struct_dict
from durand.object_dictionary import ObjectDictionary, Record, Variable

from drives.sim.abort_codes import Abort, refuse
from drives.sim.entries import OBJECTS, Entry, ObjectEntry

Key = tuple[int, int]
"""Index and sub-index."""
Value = int | float | bytes
Guard = Callable[[Any], int | None]
"""Gets the value that is to be written; returns an abort code, or None if it may be."""


class DriveVariable(Variable):  # type: ignore[misc]  # durand is not typed
    """One entry as durand's SDO server sees it."""

    def __init__(self, entry: Entry, value: Value) -> None:
        super().__init__(entry.type, entry.access, value=value, name=entry.name)
        self.entry = entry
        if entry.low is not None:
            self.minimum = entry.low
        if entry.high is not None:
            self.maximum = entry.high

    def unpack(self, data: bytes) -> Value:
        """Return the value of downloaded bytes.

        Raises
        ------
        SDODomainAbort
            If there are too many or too few, or they are no number.
        """
        if not is_numeric(self.datatype):
            return bytes(data)
        layout: struct.Struct = struct_dict[self.datatype]
        if len(data) > layout.size:
            raise refuse(Abort.TOO_LONG, *self.entry.key)
        if len(data) < layout.size:
            raise refuse(Abort.TOO_SHORT, *self.entry.key)
        value: int | float = layout.unpack(data)[0]
        if isinstance(value, float) and isnan(value):
            raise refuse(Abort.INVALID_VALUE, *self.entry.key)
        return value


class DriveDictionary(ObjectDictionary):  # type: ignore[misc]  # durand is not typed
    """Values of one drive's entries, with their checks and their effects.

    Parameters
    ----------
    node_id
        Defaults such as COB-IDs depend on it.
    overrides
        Values that differ from the tables' defaults on this very drive, by key: the factory
        settings, which 0x1011 goes back to.
    objects
        Its objects.
    hidden
        Entries that the drive works with and that nobody outside sees.

    Raises
    ------
    KeyError
        If an override names an entry that does not exist.
    """

    def __init__(
        self,
        node_id: int,
        overrides: Mapping[Key, Value],
        objects: Sequence[ObjectEntry] = OBJECTS,
        hidden: frozenset[Key] = frozenset(),
    ) -> None:
        super().__init__()
        self.entries = {e.key: e for described in objects for e in described.entries}
        self.hidden = hidden
        self._hidden_objects = {
            described.index
            for described in objects
            if all(entry.key in hidden for entry in described.entries)
        }
        unknown = [f"0x{i:04X}:{s:02X}" for i, s in overrides if (i, s) not in self.entries]
        if unknown:
            raise KeyError(f"the simulated drive has no object {', '.join(unknown)}")
        self.guards: dict[Key, Guard] = {}
        self.effects: dict[Key, Callable[[Any], None]] = {}
        self.alterations: dict[Key, Callable[[Value], Value]] = {}
        """What a faulty drive makes of a written value (fault injection)."""
        self._overrides = dict(overrides)
        self.node_id = node_id
        for described in objects:
            if described.is_variable:
                self[described.index] = self._variable(described.entries[0])
                continue
            record = _FullRecord(described.name)
            for entry in described.entries:
                record[entry.subindex] = self._variable(entry)
            self[described.index] = record
        for key in hidden:
            self._data[key] = self.factory_value(self.entries[key])

    def set_node_id(self, node_id: int) -> None:
        """Make the defaults that depend on the node id anew."""
        self.node_id = node_id
        for entry in self.entries.values():
            if entry.plus_node_id:
                self._find(*entry.key).value = self.factory_value(entry)

    def _variable(self, entry: Entry) -> DriveVariable:
        return DriveVariable(entry, self.factory_value(entry))

    def factory_value(self, entry: Entry) -> Value:
        """Return what a brand-new drive of this kind has here."""
        override = self._overrides.get(entry.key)
        return entry.default_for(self.node_id) if override is None else override

    def lookup(self, index: int, subindex: int | None = None) -> Any:
        """Return the object or, with a sub-index, its variable, as others see it.

        Raises
        ------
        KeyError
            If none is there, or it is hidden.
        """
        if index in self._hidden_objects or (index, subindex or 0) in self.hidden:
            raise KeyError(f"0x{index:04X}:{subindex or 0:02X} is not shown")
        return self._find(index, subindex)

    def shows(self, key: Key) -> Entry | None:
        """Return an entry that others see, None if there is none."""
        return None if key in self.hidden else self.entries.get(key)

    def _find(self, index: int, subindex: int | None = None) -> Any:
        if subindex and index in self._variables:
            raise KeyError(f"0x{index:04X} is a variable: it has no sub-index {subindex}")
        return super().lookup(index, subindex)

    def write(self, index: int, subindex: int, value: Value, downloaded: bool = False) -> None:
        """Write a value, check it, and let it act.

        The SDO server (``downloaded``) has checked access and limits; others get that check here.

        Raises
        ------
        SDODomainAbort
            If the value or the drive's state forbids it.
        KeyError
            If there is no such entry.
        """
        key = (index, subindex)
        entry = self.entries[key]
        if not downloaded:
            self._check_range(entry, value)
        if entry.choices and value not in entry.choices:
            raise refuse(Abort.INVALID_VALUE, index, subindex)
        guard = self.guards.get(key)
        if guard is not None:
            code = guard(value)
            if code is not None:
                raise refuse(code, index, subindex)
        if key in self.alterations:
            value = self.alterations[key](value)
        self._data[key] = value
        effect = self.effects.get(key)
        if effect is not None:
            effect(value)

    def _check_range(self, entry: Entry, value: Value) -> None:
        if isinstance(value, bytes):
            return
        variable = self._find(entry.index, entry.subindex)
        if variable.minimum is not None and value < variable.minimum:
            raise refuse(Abort.TOO_LOW, *entry.key)
        if variable.maximum is not None and value > variable.maximum:
            raise refuse(Abort.TOO_HIGH, *entry.key)

    def force(self, index: int, subindex: int, value: Value) -> None:
        """Set a value from inside the drive: no checks, no effects."""
        self._data[index, subindex] = value

    def parameters(self) -> dict[Key, Value]:
        """Return the values of all entries that can be stored."""
        return {key: self.read(*key) for key, entry in self.entries.items() if entry.is_parameter}

    def load(self, values: Mapping[Key, Value], keys: Iterable[Key]) -> None:
        """Set entries to stored values, or to factory ones where nothing is stored; no effects."""
        for key in keys:
            entry = self.entries[key]
            self._data[key] = values.get(key, self.factory_value(entry))


class _FullRecord(Record):  # type: ignore[misc]  # durand is not typed
    """A record whose sub-index 0 is an entry like the others (it can be written in mappings)."""

    def __getitem__(self, subindex: int) -> Variable:
        return self._variables[subindex]

    def __iter__(self) -> Any:
        return iter(sorted(self._variables.items()))

    def __len__(self) -> int:
        return len(self._variables)

    def __contains__(self, subindex: int) -> bool:
        return subindex in self._variables
