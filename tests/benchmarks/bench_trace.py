"""What a trace costs a cycle: ``python tests/benchmarks/bench_trace.py``.

The three axes of paper-3x3 hold their positions at a SYNC every millisecond of virtual time; runs
without a trace and with each format take turns, so that they see the same state of the computer.
The cost of a cycle is the median of the differences to the run without a trace in the same round.
"""

import argparse
import statistics
import tempfile
import time
from pathlib import Path

import numpy as np

from drives.api import Capture
from drives.canopen_drive import connect
from drives.profile import load_machine
from drives.trace import FORMATS

CYCLE_TIME = 0.001


def seconds(cycles: int, trace: Path | None) -> float:
    """Return the wall time of so many cycles."""
    with (
        connect(load_machine("paper-3x3"), trace=trace) as group,
        group.motion(CYCLE_TIME) as motion,
    ):
        block = np.tile(motion.position, (cycles, 1))
        blocks = iter([block])

        def source(_before: Capture | None) -> np.ndarray | None:
            return next(blocks, None)

        began = time.perf_counter()
        motion.stream(source)
        return time.perf_counter() - began


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cycles", type=int, default=2000)
    parser.add_argument("--rounds", type=int, default=7)
    given = parser.parse_args()
    cost: dict[str, list[float]] = {suffix: [] for suffix in FORMATS}
    sizes: dict[str, float] = {}
    plain: list[float] = []
    seconds(given.cycles, None)  # compiles
    with tempfile.TemporaryDirectory() as folder:
        for number in range(given.rounds):
            off = seconds(given.cycles, None)
            plain.append(off / given.cycles)
            for suffix in FORMATS:
                path = Path(folder) / f"{number}{suffix}"
                cost[suffix].append((seconds(given.cycles, path) - off) / given.cycles)
                sizes[suffix] = path.stat().st_size / given.cycles
    frames = 1 + 2 * 3
    print(f"{given.rounds} rounds of {given.cycles} cycles, {frames} frames a cycle")
    print(f"without a trace {1e6 * statistics.median(plain):7.1f} us a cycle, everything simulated")
    print("format   us a cycle   us a frame   share of a 1 ms cycle   bytes a cycle")
    for suffix, values in cost.items():
        us = 1e6 * statistics.median(values)
        print(f"{suffix:6} {us:12.1f} {us / frames:12.2f} {us / 10:20.1f} % {sizes[suffix]:14.0f}")


if __name__ == "__main__":
    main()
