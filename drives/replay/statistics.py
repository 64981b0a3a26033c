"""What a trace amounts to: pace of the SYNC, missing PDOs, load of the bus, errors."""

from collections import Counter
from dataclasses import dataclass, field

import numpy as np

from drives.bus import frame_bits
from drives.replay.decoding import Decoded

LOAD_WINDOW = 0.1
"""Seconds over which the load of the bus is taken."""
PAUSE = 3.5
"""Times the median cycle from which the time between two SYNCs is a pause, not a cycle."""


@dataclass(frozen=True)
class Pace:
    """Times from SYNC to SYNC, s."""

    syncs: int
    median: float
    deviation: float
    """Standard deviation from the median."""
    shortest: float
    longest: float
    late: int
    """Cycles longer than one and a quarter of the median."""
    pauses: int
    """Longer times without a SYNC, which are in none of the numbers before."""


@dataclass(frozen=True)
class PdoCount:
    """PDOs of one node, from its first to its last."""

    node: int
    received: int
    missing: int
    """SYNCs without one in between."""
    doubled: int
    """SYNCs with more than one."""


@dataclass(frozen=True)
class Statistics:
    """What a trace amounts to."""

    frames: int
    seconds: float
    """From the first frame to the last."""
    kinds: dict[str, int]
    """Number of frames of each kind."""
    pace: Pace | None
    """None with less than three SYNCs."""
    pdos: tuple[PdoCount, ...]
    mean_load: float
    peak_load: float
    """Share of the bit rate, with worst-case stuffing; the peak is over ``LOAD_WINDOW``."""
    aborts: tuple[str, ...]
    """SDO aborts, each text once with its number."""
    unanswered: int
    """SDO requests for an object without an answer before the next one to the same node."""
    emergencies: tuple[str, ...]
    """With time and node."""
    boots: tuple[str, ...]
    """Boot-up messages, with time and node."""


@dataclass
class _Inputs:
    first: int = -1
    last: int = -1
    per_sync: Counter[int] = field(default_factory=Counter)


class Counting:
    """Counts decoded frames as they come.

    Parameters
    ----------
    bitrate
        Of the bus, bit/s.
    """

    def __init__(self, bitrate: int) -> None:
        self._bitrate = bitrate
        self._frames = 0
        self._begin: float | None = None
        self._end = 0.0
        self._kinds: Counter[str] = Counter()
        self._syncs: list[float] = []
        self._inputs: dict[int, _Inputs] = {}
        self._bits: Counter[int] = Counter()
        self._aborts: Counter[str] = Counter()
        self._waiting: dict[int, bool] = {}
        self._unanswered = 0
        self._emergencies: list[str] = []
        self._boots: list[str] = []

    def add(self, frame: Decoded) -> None:
        """Count one frame."""
        self._frames += 1
        if self._begin is None:
            self._begin = self._end = frame.time
        self._begin, self._end = min(self._begin, frame.time), max(self._end, frame.time)
        self._kinds[frame.kind] += 1
        self._bits[int(frame.time // LOAD_WINDOW)] += frame_bits(len(frame.data))
        match frame.kind:
            case "SYNC":
                self._syncs.append(frame.time)
            case "PDO" if not frame.sent:
                self._input(frame.node)
            case "SDO":
                self._sdo(frame)
            case "EMCY":
                self._emergencies.append(f"{frame.time:.3f} s node {frame.node}: {frame.text}")
            case "heartbeat" if frame.data == b"\0":
                self._boots.append(f"{frame.time:.3f} s node {frame.node}")

    def _input(self, node: int) -> None:
        inputs, sync = self._inputs.setdefault(node, _Inputs()), len(self._syncs)
        if inputs.first < 0:
            inputs.first = sync
        inputs.last = sync
        inputs.per_sync[sync] += 1

    def _sdo(self, frame: Decoded) -> None:
        if frame.text.startswith("abort"):
            self._aborts[f"node {frame.node}: {frame.text}"] += 1
        if frame.sent and frame.text.startswith(("read ", "write ")):
            self._unanswered += self._waiting.get(frame.node, False)
            self._waiting[frame.node] = True
        elif not frame.sent:
            self._waiting[frame.node] = False

    def result(self) -> Statistics:
        """Return what was counted so far."""
        begin = self._end if self._begin is None else self._begin
        seconds = self._end - begin
        bits = sum(self._bits.values())
        peak = max(self._bits.values(), default=0) / (self._bitrate * LOAD_WINDOW)
        return Statistics(
            self._frames,
            seconds,
            dict(self._kinds.most_common()),
            _pace(self._syncs),
            tuple(_count(node, inputs) for node, inputs in sorted(self._inputs.items())),
            bits / (self._bitrate * max(seconds, LOAD_WINDOW)),
            peak,
            tuple(f"{text} ({n})" for text, n in self._aborts.most_common()),
            self._unanswered + sum(self._waiting.values()),
            tuple(self._emergencies),
            tuple(self._boots),
        )


def _pace(syncs: list[float]) -> Pace | None:
    gaps = np.diff(syncs)
    if gaps.size < 2:
        return None
    middle = float(np.median(gaps))
    cycles = gaps[gaps < PAUSE * middle]
    return Pace(
        len(syncs),
        middle,
        float(np.sqrt(np.mean((cycles - middle) ** 2))),
        float(cycles.min()),
        float(cycles.max()),
        int(np.count_nonzero(cycles > 1.25 * middle)),
        int(gaps.size - cycles.size),
    )


def _count(node: int, inputs: _Inputs) -> PdoCount:
    span = inputs.last - inputs.first + 1
    return PdoCount(
        node,
        sum(inputs.per_sync.values()),
        span - len(inputs.per_sync),
        sum(n > 1 for n in inputs.per_sync.values()),
    )
