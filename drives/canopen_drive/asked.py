"""What drives say of themselves while they move: mode and power state, asked for beside the PDOs.

No PDO carries the mode of operation, and a statusword that is stuck in its PDO looks like a sound one.
So one drive after the other is asked by SDO for 0x6061 and, in turn, 0x6041.  Nobody waits: a request
goes out when all PDOs of a cycle are in, and its answer comes with the frames of later cycles.

One wrong answer may be somebody else's.  It is believed when the drive is asked again and gives the
same, with no other answer beside it either time.  No answer proves nothing: other watches see a node
that is lost, and all drives are asked once more at the end of a motion.

Two frames in ``LEAST_CYCLES`` cycles are 27 bits a cycle at most: less than the tenth of the bus that
cyclic frames leave free (``drives.bus.load``).
"""

from collections.abc import Sequence
from math import ceil

from drives import objects
from drives.canopen_drive.channel import Channel
from drives.canopen_drive.sdo import SDO_TIMEOUT, expedited
from drives.cia402 import ENABLED_MASK, Mode, PowerState

PERIOD, LEAST_CYCLES = 0.05, 10
"""Seconds, and cycles at least, from one request to the next."""


class Asked:
    """Asks the drives of a motion, one after the other."""

    def __init__(self, channels: Sequence[Channel], cycle_time: float) -> None:
        self._drives = [_Questions(channel) for channel in channels]
        self.every = max(LEAST_CYCLES, ceil(PERIOD / cycle_time - 1e-9))
        """Cycles from one request to the next."""
        self._patience = ceil(SDO_TIMEOUT / (self.every * cycle_time))
        """Requests after which an answer that did not come is given up."""
        self._cycles = self._requests = 0

    def wrong(self) -> tuple[Channel, str] | None:
        """Go on by a cycle; return a drive that is surely not as its PDOs say, and how that shows.

        To be called once a cycle, when its PDOs are in and show all axes enabled.
        """
        self._cycles += 1
        if self._cycles < self.every or any(one.channel.missing for one in self._drives):
            return None
        self._cycles = 0
        self._requests += 1
        for one in self._drives:
            said = one.judge()
            if said:
                return one.channel, said
        latest = self._requests - self._patience
        ready = [one for one in self._drives if not one.waits or one.asked <= latest]
        if ready:
            min(ready, key=lambda one: (one.suspect is None, one.asked)).ask(self._requests)
        return None


class _Questions:
    """What one drive is asked in turn."""

    def __init__(self, channel: Channel) -> None:
        self.channel = channel
        self.waits = False
        """Whether its answer did not come yet."""
        self.asked = 0
        """Number of its latest request."""
        self.suspect: int | None = None
        """What it said when it was asked last, if that was wrong and it was right before."""
        drive = channel.drive
        known = (objects.MODE_DISPLAY, objects.STATUSWORD)
        self._object, self._next = (drive.info(info.address) or info for info in known)

    def ask(self, number: int) -> None:
        """Send a request; one that was not answered is given up, with what it was to confirm."""
        if self.waits:
            self._go_on()
        self.waits, self.asked = True, number
        address = self._object.address
        self.channel.drive.node.sdo.ask(address.index, address.subindex)

    def _go_on(self) -> None:
        self._object, self._next, self.suspect = self._next, self._object, None

    def judge(self) -> str:
        """Take the answers that came; return what is wrong, in a sentence, once it is sure."""
        answers = self.channel.drive.node.sdo.forget_old()
        shown = {self._matters(v): v for v in map(self._value, answers) if v is not None}
        if not self.waits or not shown:
            return ""
        self.waits = False
        wrong, value = shown.popitem()
        if shown or wrong == self._wanted() or self.suspect not in (None, wrong):
            self._go_on()
            return ""
        if self.suspect is None:
            self.suspect = wrong
            return ""
        return mode_words(self.channel, value) if self._is_mode else self._state_words(value)

    @property
    def _is_mode(self) -> bool:
        return self._object.address == objects.MODE_DISPLAY.address

    def _value(self, answer: bytes) -> int | None:
        """Return the value in an answer; None if it does not answer the request."""
        address = self._object.address
        data = expedited(answer, address.index, address.subindex)
        try:
            value = None if data is None else self._object.decode(data)
        except ValueError:
            return None
        return value if isinstance(value, int) else None

    def _matters(self, value: int) -> int:
        """Return what must be as it is wanted: of a statusword, the power state alone."""
        return value if self._is_mode else value & ENABLED_MASK

    def _wanted(self) -> int:
        if self._is_mode:
            return wanted_mode(self.channel).value
        return self.channel.statusword & ENABLED_MASK

    def _state_words(self, shown: int) -> str:
        drive, told = self.channel.drive, self.channel.statusword
        return (
            f"{drive.axis}: the PDOs of node {drive.node_id} show statusword 0x{told:04X} "
            f"({_state(told)}), the drive itself (object 0x6041:00) shows 0x{shown:04X} "
            f"({_state(shown)}): what it does is not seen; all axes were stopped. What was measured in "
            "this motion is kept, but do not rely on it. Switch the drive off and on."
        )


def wanted_mode(channel: Channel) -> Mode:
    """Return the mode of operation that an axis was set to."""
    return Mode.CYCLIC_TORQUE if channel.free else Mode.CYCLIC_POSITION


def mode_words(channel: Channel, shown: int) -> str:
    """Return that a drive is in another mode than it was set to, in a sentence."""
    wanted, names = wanted_mode(channel), {mode.value: mode.words for mode in Mode}
    return (
        f"{channel.drive.axis}: the drive left mode {wanted.words} ({wanted.value}) by itself: object "
        f"0x6061:00 shows {shown} ({names.get(shown, 'a mode of its maker')}), so it did not follow "
        "its targets; all axes were stopped. What was measured in this motion is kept, but do not rely "
        "on it. Look for what else sets the mode: an input, a program in the drive, another master."
    )


def _state(statusword: int) -> str:
    try:
        return PowerState.of(statusword).words
    except ValueError:
        return "no CiA 402 state"
