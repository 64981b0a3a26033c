"""Random frames on the bus while the whole tool works, and wrong SDO answers of every kind.

The host hears them; the drives do not, so that whatever a drive holds at the end was written by the
tool.  Four kinds: bystanders (identifiers that are nobody's here), likenesses (29-bit, remote and error
frames, which CANopen does not use, with the look-alikes' identifiers), look-alikes (the nodes' own
identifiers with any content and length, and what only a master may send), and answers (SDO answers
right before and after the true one, made from the request).
"""

import struct
import tempfile
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from random import Random
from typing import Any

import can

from drives.sim.entries import ENTRIES
from fieldtool.errors import FieldtoolError
from fieldtool.records.recording import load
from tests.faults.bench import ARM, GAINS, TABLE, Bench, Moment, command

HARMLESS = ("bystanders", "likenesses")
CODES = (0, 3, 4, 5, 6, 7)
OURS = {base + node for node in (TABLE, ARM) for base in (0x80, 0x180, 0x580, 0x600, 0x700)}
COMMANDS = {0x000, 0x080, 0x77F} | {
    base + node for node in (TABLE, ARM) for base in (0x200, 0x300, 0x400, 0x500)
}
"""Identifiers of frames that stop the axes at once when somebody else sends them."""
PARAMETERS = tuple(
    key
    for key, entry in ENTRIES.items()
    if entry.is_parameter and key[0] not in range(0x1000, 0x2000)
)
SET_BY_TOOL = {
    (0x6007, 0): (1, 2, 3),
    (0x605A, 0): (2, 6),
    (0x6060, 0): (8, 10),
    (0x60C2, 1): (2,),
    (0x60C2, 2): (-3,),
    (0x2010, 4): (0,),
    (0x2010, 5): (0,),
}
"""Parameters that the tool sets for a while, and to what; what is not put back has to be said."""


@dataclass(frozen=True)
class Noise:
    """How the bus is disturbed."""

    kind: str
    rate: float
    """Frames a SYNC (likenesses, and while parameters are written: a frame of the host's), or wrong
    answers a request."""
    seed: int
    quiet: int = 0
    """Requests that are answered rightly first."""
    at_most: float = float("inf")
    """Frames in all."""


@dataclass(frozen=True)
class Outcome:
    """What came of it."""

    code: int
    said: str
    frames: int
    problems: tuple[str, ...]


class NoisyBench(Bench):
    """A bench whose host hears more than the nodes say."""

    def __init__(self, folder: Path, noise: Noise, moment: Moment = Moment.SWEEP) -> None:
        super().__init__(folder, moment, lambda _: ())
        self.watch.fault_time = 0.0
        self.noise, self._random, self.sent = noise, Random(noise.seed), 0
        self._left, self._asked = 0.0, 0
        self._other: can.BusABC | None = None

    def __exit__(self, *what: object) -> None:
        if self._other is not None:
            self._other.shutdown()
        super().__exit__(*what)

    def _seen(self, cob_id: int, data: bytes | bytearray) -> bool:
        noise, request = self.noise, bytes(data)
        if noise.kind != "answers":
            if cob_id == 0x80 or noise.kind == "likenesses" or self.moment is Moment.WRITE:
                self._left += noise.rate
                while self._left >= 1:
                    self._left -= 1
                    self._say(*self._any())
            return super()._seen(cob_id, data)
        asked = cob_id in (0x600 + TABLE, 0x600 + ARM)
        self._asked += asked
        asked = asked and self._asked > noise.quiet and self._random.random() < noise.rate
        before = asked and self._random.random() < 0.5
        if before:
            self._say(cob_id - 0x80, self._answer(request))
        result = super()._seen(cob_id, data)
        if asked and not before:
            self._say(cob_id - 0x80, self._answer(request))
        return result

    def _say(self, cob_id: int, data: bytes) -> None:
        if self.sent < self.noise.at_most:
            self.sent += 1
            if self.noise.kind == "likenesses":
                self._say_likeness(cob_id, data)
            else:
                self.machine.announce(cob_id, data)

    def _say_likeness(self, cob_id: int, data: bytes) -> None:
        how = self._random.choice(("is_extended_id", "is_remote_frame", "is_error_frame"))
        frame: dict[str, Any] = {"is_extended_id": False, how: True, "dlc": len(data)}
        if how != "is_remote_frame":
            frame["data"] = data
        if self._other is None:
            self._other = can.Bus(interface="fieldsim", channel=self.channel)
        self._other.send(can.Message(arbitration_id=cob_id, **frame))
        while self._other.recv(0) is not None:
            pass  # what others said meanwhile

    def _any(self) -> tuple[int, bytes]:
        random = self._random
        data = random.randbytes(random.choice((0, 1, 2, 4, 6, 7, 8, 8, 8)))
        if self.noise.kind != "bystanders":
            return random.choice((*OURS, *COMMANDS)), data
        while (cob_id := random.randrange(0x800)) in OURS | COMMANDS:
            pass
        return cob_id, data

    def _answer(self, request: bytes) -> bytes:
        """Return an answer to a request that is wrong in some way, or looks right and is not."""
        random = self._random
        answer = bytearray(8)
        specifier = {0: 1, 1: 3, 2: 2, 3: 0}.get(request[0] >> 5, 4)
        answer[0] = specifier << 5 | (0x03 if specifier == 2 else request[0] & 0x10)
        answer[1:4] = request[1:4]
        answer[4:] = random.randbytes(4)
        for _ in range(random.choice((0, 1, 1, 2))):
            answer[random.randrange(8)] ^= 1 << random.randrange(8)
        if random.random() < 0.1:
            answer = bytearray(struct.pack("<B3sL", 0x80, request[1:4], random.getrandbits(32)))
        return bytes(answer[: random.choice((8, 8, 8, 8, 0, 1, 3, 4, 7))])

    def outcome(self) -> Outcome:
        """Run the command that the moment belongs to, and judge what came of it."""
        if self.moment is Moment.WRITE:
            self.prepare_write()
            code, said = command("write", self.out, "--yes", "--store")
        else:
            code, said = command("measure", self.profile, "--yes", "--out", self.out)
        self.machine.advance_to(self.machine.time + 2_000_000_000)
        return Outcome(code, said, self.sent, tuple(self._problems(code, said)))

    def _problems(self, code: int, said: str) -> list[str]:
        found = []
        if code not in CODES:
            found.append(f"exit code {code}")
        if "Traceback" in said or "defect of fieldtool" in said:
            found.append("an unhandled exception")
        for node in self.machine.nodes:
            if node.motion.powered:
                found.append(f"node {node.node_id} is under power")
            found += [f"node {node.node_id}: {wrong}" for wrong in self._wrong(node, code, said)]
        if (self.out / "recording.h5").exists():
            try:
                load(self.out / "recording.h5")
            except FieldtoolError as error:
                found.append(f"recording: {error}")
        return found

    def _wrong(self, node: Any, code: int, said: str) -> list[str]:
        """Return what was written that should not have been."""
        found, held = [], self._objects(node)
        for key in PARAMETERS:
            was, now = self.before[node.node_id].get(key), held.get(key)
            if was == now:
                continue
            place = f"0x{key[0]:04X}:{key[1]:02X}"
            if self.moment is Moment.WRITE:
                right = now == GAINS["reference"].get(key) and code in (0, 7)
            else:
                right = now in SET_BY_TOOL.get(key, ()) and place in said
            if not right:
                found.append(f"{place} was {was}, is {now} (exit code {code})")
        return found


def disturbed(noise: Noise, moment: Moment = Moment.SWEEP) -> Outcome:
    """Run a command on a disturbed bus."""
    with (
        tempfile.TemporaryDirectory(prefix="fuzz-") as folder,
        NoisyBench(Path(folder), noise, moment) as bench,
    ):
        return bench.outcome()


def tally(outcomes: list[Outcome]) -> str:
    """Return how often each exit code came."""
    codes = Counter(outcome.code for outcome in outcomes)
    return ", ".join(f"{code}: {times}" for code, times in sorted(codes.items()))
