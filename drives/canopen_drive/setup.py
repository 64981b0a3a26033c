"""Objects that are changed while the tool runs, and put back afterwards."""

from collections.abc import Callable
from functools import partial
from math import remainder
from typing import TypeVar

from drives import objects
from drives.canopen_drive.drive import CanopenDrive
from drives.canopen_drive.torque_offset import TORQUE_OFFSET
from drives.cia402 import Mode
from drives.errors import (
    DrivesError,
    NotSupportedError,
    SdoAbortError,
    SdoError,
)
from drives.objects import ObjectAddress, ObjectInfo, type_bits
from drives.profile import UNKNOWN

Held = TypeVar("Held", bound=int | float | str | None)

PDO_OFF = 1 << 31
NO_MODE = 0
"""Of 0x6060; some drives show it and refuse it."""
COAST = 0
QUICK_STOP_RAMP = {"disable": 2, "hold": 6}
"""Values of 0x605A: slow down on the quick stop ramp, then switch on disabled, or stay."""
SYNCHRONOUS = 1
HOST_NODE_ID = 127
HOST_HEARTBEAT = 0.05
"""Seconds between the host's heartbeats while the machine moves."""
HOST_LOST_AFTER = 0.2
"""Seconds without the host's heartbeat after which a drive stops by itself."""
DRIVE_HEARTBEAT = 0.1
"""Seconds between a drive's heartbeats while the machine moves."""

OUTPUTS = (objects.CONTROLWORD, objects.TARGET_POSITION, objects.TARGET_TORQUE)
OUTPUTS_WITH_OFFSET = (objects.CONTROLWORD, objects.TARGET_POSITION, TORQUE_OFFSET)
INPUTS = (objects.STATUSWORD, objects.POSITION_ACTUAL, objects.TORQUE_ACTUAL)
PDOS = ((0x1400, 0x1600), (0x1800, 0x1A00))
"""Communication and mapping objects of the first PDO each way: it is mapped anew, the next three are
switched off."""


def read_twice(
    axis: str, info: ObjectInfo, read: Callable[[], Held], ending: str = "It was not changed."
) -> Held:
    """Return what an object holds, read two times: what a wrong answer said would be written back.

    Parameters
    ----------
    axis, info
        Which object.
    read
        Reads it; None where it holds nothing that could be written again.
    ending
        What else to do where the two differ, and what was not done.

    Raises
    ------
    NotSupportedError
        If the two differ.
    """
    first, again = read(), read()
    if first != again:
        one, other = ("nothing that can be kept" if v is None else v for v in (first, again))
        raise NotSupportedError(
            f"{axis}, object {info.address} ({info.name}): read as {one}, then as {other}, and what it "
            "holds is to be brought back if need be. Check the bus, and that nobody else writes to the "
            f"drive, and try again. {ending}"
        )
    return first


class TemporaryObjects:
    """Writes that remember what was there, for one drive.

    :meth:`put_back` belongs into a ``finally``.
    """

    def __init__(self, drive: CanopenDrive) -> None:
        self._drive = drive
        self._before: list[tuple[ObjectInfo, float, bool]] = []

    def change(self, info: ObjectInfo, value: float) -> None:
        """Write a value, remembering the one before.

        Raises
        ------
        NotSupportedError
            If the object changes by itself, or the drive holds another value than it was given.
        SdoError
            If it can not be read or written.
        """
        before = self.before(info)
        if before == value:
            return
        self.note(info, before)
        self._drive.write(info, value)
        found = self._drive.read_number(info)
        if found != value:
            raise NotSupportedError(
                f"{self._drive.axis}, object {info.address} ({info.name}): wrote {value}, the drive "
                f"holds {found}. It can not be used safely."
            )

    def before(self, info: ObjectInfo) -> float:
        """Read what is to be written back later.

        Raises
        ------
        NotSupportedError
            If it changes by itself.
        SdoError
            If it can not be read.
        """
        return read_twice(self._drive.axis, info, partial(self._drive.read_number, info))

    def note(self, info: ObjectInfo, before: float, matters: bool = True) -> None:
        """Remember a value to be written when all is put back.

        What does not matter, such as a mapping entry that is not in use, may be refused then.
        """
        self._before.append((info, before, matters))

    def put_back(self) -> list[str]:
        """Write all old values, newest first, and read them back; return what failed, in words.

        A drive that does not answer any more, or not rightly, is not asked for each of them.  One for
        which somebody else answers as well is written to all the same: the values are of before.
        """
        wanted = {
            info.address: (info, before)
            for info, before, matters in reversed(self._before)
            if matters
        }
        with self._drive.told_all_the_same():
            failures = self._written()
            if not failures:
                failures = [text for pair in wanted.values() if (text := self._held(*pair))]
        if failures:
            self._drive.left_changed = True
        return failures

    def _written(self) -> list[str]:
        failures = []
        while self._before:
            info, before, matters = self._before.pop()
            try:
                self._write_surely(info, before)
            except SdoAbortError as error:
                if matters:
                    failures.append(str(error))
            except DrivesError as error:
                failures.append(str(error))
                if self._before and not self._drive.answers():
                    left = dict.fromkeys(str(info.address) for info, *_ in self._before)
                    failures.append(
                        f"{self._drive.axis}: node {self._drive.node_id} gives no right answer any "
                        f"more; not put back: {', '.join(left)}. Switch the drive off and on."
                    )
                    self._before.clear()
        return failures

    def _write_surely(self, info: ObjectInfo, value: float) -> None:
        """Write; where the answer is missing or wrong, see what the drive holds, and try once more."""
        try:
            self._drive.write(info, value)
        except SdoAbortError:
            raise
        except SdoError:
            if self._drive.read_number(info) != value:
                self._drive.write(info, value)

    def _held(self, info: ObjectInfo, value: float) -> str:
        """Return a sentence if a drive does not hold what was put back, though it was told once more."""
        try:
            if self._drive.read_number(info) == value:
                return ""
            self._drive.write(info, value)
            found = self._drive.read_number(info)
        except DrivesError as error:
            return str(error)
        if found == value:
            return ""
        return (
            f"{self._drive.axis}, object {info.address} ({info.name}): wrote {value} as it was before, "
            f"the drive holds {found}."
        )


def mode(drive: CanopenDrive, wanted: Mode, changes: TemporaryObjects) -> None:
    """Set the mode of operation, remembering the one before.

    Raises
    ------
    NotSupportedError
        If the drive does not confirm.
    """
    before = changes.before(objects.MODE)
    changes.note(objects.MODE, before, matters=before != NO_MODE)
    drive.set_mode(wanted)


def cycle(drive: CanopenDrive, cycle_time: float, changes: TemporaryObjects) -> None:
    """Tell the drive the time between targets (0x60C2, and 0x1006 where it is in use).

    Raises
    ------
    NotSupportedError
        If the cycle time is no whole number of the profile's unit.
    """
    exponent = drive.profile.interpolation_index
    value = cycle_time / 10.0**exponent
    if abs(value - round(value)) > 1e-6 or not 1 <= round(value) <= 255:
        raise NotSupportedError(
            f"{drive.axis}: a cycle of {cycle_time * 1000:g} ms is not 1 to 255 times "
            f"{10.0**exponent:g} s, as 0x60C2 needs it."
        )
    _check_sync(drive, cycle_time)
    changes.change(objects.INTERPOLATION_INDEX, exponent)
    changes.change(objects.INTERPOLATION_VALUE, round(value))
    period = drive.read_optional(objects.SYNC_PERIOD)
    if period:
        changes.change(objects.SYNC_PERIOD, round(cycle_time * 1e6))


def _check_sync(drive: CanopenDrive, cycle_time: float) -> None:
    """Refuse a cycle that the drive's profile says the drive can not follow."""
    rules, name = drive.profile.sync, drive.profile.name
    shortest, longest, multiple = (
        None if value == UNKNOWN else float(value)
        for value in (rules.shortest, rules.longest, rules.multiple)
    )
    said = f"{drive.axis}: a cycle of {cycle_time * 1000:g} ms is"
    if shortest is not None and cycle_time < shortest * (1 - 1e-9):
        raise NotSupportedError(
            f"{said} shorter than {shortest * 1000:g} ms, the shortest that drive profile {name} allows."
        )
    if longest is not None and cycle_time > longest * (1 + 1e-9):
        raise NotSupportedError(
            f"{said} longer than {longest * 1000:g} ms, the longest that drive profile {name} allows."
        )
    if multiple is not None and abs(remainder(cycle_time, multiple)) > 1e-6 * multiple:
        raise NotSupportedError(
            f"{said} no multiple of {multiple * 1000:g} ms, as drive profile {name} wants it."
        )


def clear_torque_offset(drive: CanopenDrive, changes: TemporaryObjects, *, streamed: bool) -> None:
    """Let the drive add no torque of its own accord: 0x60B2 is 0 before it is enabled.

    What somebody left there would push an axis that holds its position, and one that floats.  Where
    the offset is streamed it is put back in any case, because what was sent last may have stayed.

    Raises
    ------
    NotSupportedError
        If the drive keeps another value.
    SdoError
        If the object can not be read or written.
    """
    info = drive.info(TORQUE_OFFSET.address)
    before = None if info is None else drive.read_optional(info)
    if info is None or before is None:
        return
    if streamed and before == 0:
        changes.note(info, 0)
    changes.change(info, 0)


def process_data(
    drive: CanopenDrive, changes: TemporaryObjects, *, torque_offset: bool = False
) -> None:
    """Map one PDO each way, 8 bytes, taken over at every SYNC; switch the drive's others off.

    With ``torque_offset`` the torque that goes out is 0x60B2 in place of the target torque 0x6071.

    Raises
    ------
    NotSupportedError
        If the drive's types do not fill the 8 bytes as the tool sends them.
    SdoError
        If the drive refuses the mapping.
    """
    outputs = OUTPUTS_WITH_OFFSET if torque_offset else OUTPUTS
    for wanted in (*outputs, *INPUTS):
        info = drive.info(wanted.address)
        if info is None:
            raise NotSupportedError(
                f"{drive.axis}: the drive has no {wanted.name} {wanted.address.short}, which the tool's "
                "PDOs carry, by its EDS file. It can not be measured."
            )
        if info is not None and type_bits(info.type) != type_bits(wanted.type):
            raise NotSupportedError(
                f"{drive.axis}, object {wanted.address} ({wanted.name}): the drive has "
                f"{info.type}, the tool's PDOs need {wanted.type}."
            )
    for (communication, mapping), cob_id, entries in zip(
        PDOS, (0x200, 0x180), (outputs, INPUTS), strict=True
    ):
        for other in range(3, 0, -1):
            _switch_off(drive, communication + other, changes)
        _map(drive, communication, mapping, cob_id + drive.node_id, entries, changes)


def _switch_off(drive: CanopenDrive, communication: int, changes: TemporaryObjects) -> None:
    info = cob_id_of(communication)
    before = drive.read_optional(info)
    if before is not None and not before & PDO_OFF:
        changes.change(info, before | PDO_OFF)


def _map(
    drive: CanopenDrive,
    communication: int,
    mapping: int,
    cob_id: int,
    entries: tuple[ObjectInfo, ...],
    changes: TemporaryObjects,
) -> None:
    identifier, kind, count = cob_id_of(communication), kind_of(communication), count_of(mapping)
    old_identifier, old_count = (int(changes.before(info)) for info in (identifier, count))
    old_entries = [changes.before(entry_of(mapping, k + 1)) for k in range(old_count)]
    # Put back in reverse: off, identifier, type, count 0, entries, count, on.  CiA 301, clause 7.5.2.36.
    off = (old_identifier | PDO_OFF) & 0xFFFFFFFF
    changes.note(identifier, old_identifier)
    changes.note(count, old_count)
    for k in range(old_count, len(entries)):
        unused = drive.read_optional(entry_of(mapping, k + 1))
        if unused is not None:
            changes.note(entry_of(mapping, k + 1), unused, matters=False)
    for k, old in enumerate(old_entries):
        changes.note(entry_of(mapping, k + 1), old)
    changes.note(count, 0)
    drive.write(identifier, off)
    changes.change(kind, SYNCHRONOUS)
    changes.note(identifier, off)
    changes.note(identifier, cob_id | PDO_OFF)  # an identifier may change only while the PDO is off
    drive.write(count, 0)
    for k, info in enumerate(entries):
        address = info.address
        value = address.index << 16 | address.subindex << 8 | type_bits(info.type)
        drive.write(entry_of(mapping, k + 1), value)
    drive.write(count, len(entries))
    found = [drive.read_int(entry_of(mapping, k + 1)) >> 8 for k in range(drive.read_int(count))]
    wanted = [info.address.index << 8 | info.address.subindex for info in entries]
    if found != wanted:
        raise SdoAbortError(drive.axis, mapping, 0, 0x06040041, "map")
    drive.write(identifier, cob_id)


def cob_id_of(communication: int) -> ObjectInfo:
    """Return the object with a PDO's identifier, and bit 31 that switches it off."""
    return ObjectInfo(ObjectAddress(communication, 1), "UNSIGNED32", "COB-ID of PDO")


def kind_of(communication: int) -> ObjectInfo:
    """Return the object that says when a PDO is sent, or taken over."""
    return ObjectInfo(ObjectAddress(communication, 2), "UNSIGNED8", "PDO transmission type")


def count_of(mapping: int) -> ObjectInfo:
    """Return the object that says how many objects a PDO carries."""
    return ObjectInfo(ObjectAddress(mapping, 0), "UNSIGNED8", "number of mapped objects")


def entry_of(mapping: int, k: int) -> ObjectInfo:
    """Return the object that says what a PDO carries in place k, from 1."""
    return ObjectInfo(ObjectAddress(mapping, k), "UNSIGNED32", f"mapped object {k}")
