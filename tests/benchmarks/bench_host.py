"""How fast the whole CANopen path runs: ``python tests/benchmarks/bench_host.py``.

The three axes of paper-3x3 at a SYNC every millisecond, streamed through ``drives.canopen_drive``
as an experiment does it: targets out, limits watched in every cycle, positions and torques in.
Blocks of cycles run by turns plain, for the speed, and with clocks around the parts, for the
shares; so both come from one run and one state of the computer.  Target of the project: at least
8 simulated seconds a second on one core.
"""

import argparse
import os
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from drives.api import Capture
from drives.canopen_drive import connect
from drives.profile import load_machine
from drives.sim.lockstep_bus import LockstepBus
from drives.sim.machine import simulated_machine

CYCLE_TIME = 0.001
BLOCK = 1000
WANTED = 8.0
PLANT_CALLS = ("latch", "advance", "follow_position")
BUS_CALLS = ("send", "recv")


@dataclass
class Clocks:
    """Clocks around calls; they run only while they are switched on."""

    bus: LockstepBus
    seconds: dict[str, float] = field(default_factory=lambda: {"plant": 0.0, "bus": 0.0})
    frames: int = 0

    def switch(self, *, on: bool) -> None:
        for target, calls, name in (
            (self.bus.machine.axes, PLANT_CALLS, "plant"),
            (self.bus, BUS_CALLS, "bus"),
        ):
            for call in calls:
                if on:
                    setattr(target, call, self._clocked(getattr(target, call), name))
                else:
                    vars(target).pop(call, None)
        if on:
            self.bus.enqueue = self._counted(self.bus.enqueue)  # type: ignore[method-assign]
        else:
            vars(self.bus).pop("enqueue", None)

    def _clocked(self, call: Callable[..., Any], name: str) -> Callable[..., Any]:
        seconds, clock, send = self.seconds, time.perf_counter, call.__name__ == "send"

        def clocked(*arguments: Any) -> Any:
            began = clock()
            try:
                return call(*arguments)
            finally:
                seconds[name] += clock() - began
                self.frames += send

        return clocked

    def _counted(self, call: Callable[..., Any]) -> Callable[..., Any]:
        def counted(*arguments: Any) -> None:
            self.frames += 1
            call(*arguments)

        return counted


@dataclass
class Stream:
    """Targets of all axes, block by block; notes how long each block took."""

    start: np.ndarray
    clocks: Clocks
    blocks: int
    plain: list[tuple[float, float]] = field(default_factory=list)
    """Wall and processor seconds of each plain block."""
    clocked: float = 0.0
    _done: int = 0
    _began: tuple[float, float] = (0.0, 0.0)

    def __call__(self, before: Capture | None) -> np.ndarray | None:
        now = time.perf_counter(), time.process_time()
        taken = now[0] - self._began[0], now[1] - self._began[1]
        if self._done == 1:  # the first block warms up
            pass
        elif self._done and self._done % 2:
            self.clocked += taken[0]
        elif self._done:
            self.plain.append(taken)
        if self._done == self.blocks:
            self.clocks.switch(on=False)
            return None
        self.clocks.switch(on=self._done % 2 == 0 and self._done > 0)
        t = CYCLE_TIME * (self._done * BLOCK + np.arange(BLOCK))
        wave = 0.02 * np.sin(2 * np.pi * 2.0 * t)
        self._done += 1
        self._began = time.perf_counter(), time.process_time()
        targets: np.ndarray = self.start + wave[:, None] * np.ones(self.start.size)
        return targets


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--blocks", type=int, default=31, help="of 1000 cycles each, odd")
    blocks = parser.parse_args().blocks | 1
    profile = load_machine("paper-3x3")
    bus = LockstepBus(machine=simulated_machine(profile))
    clocks = Clocks(bus)
    try:
        with connect(profile, bus=bus) as group, group.motion(CYCLE_TIME) as motion:
            stream = Stream(motion.position, clocks, blocks)
            motion.stream(stream)
    finally:
        bus.shutdown()
    wall, cpu = (np.array(values) / BLOCK for values in zip(*stream.plain, strict=True))
    clocked = stream.clocked / BLOCK / (blocks // 2)
    cycles = BLOCK * (blocks // 2)
    plant, far = (clocks.seconds[name] / cycles for name in ("plant", "bus"))
    frames = clocks.frames / cycles
    cycle = float(np.median(wall))
    print(
        f"paper-3x3, 1 kHz SYNC, {wall.size} plain and {blocks // 2} clocked blocks of {BLOCK} cycles;"
    )
    print(f"load of the computer {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores")
    print(f"{'cycles/s':>34} {1 / cycle:10.0f}")
    print(f"{'frames/s':>34} {frames / cycle:10.0f}   ({frames:.2f} a cycle)")
    print(
        f"{'simulated seconds a second, median':>34} {CYCLE_TIME / cycle:10.1f}   (wanted: {WANTED:g})"
    )
    print(f"{'best block':>34} {CYCLE_TIME / float(wall.min()):10.1f}")
    print(f"{'a second of processor time':>34} {CYCLE_TIME / float(np.median(cpu)):10.1f}")
    for name, part in (("plant", plant), ("nodes and bus", far - plant), ("host", clocked - far)):
        print(f"{name:>34} {part * 1e6:10.1f} us {part / clocked:5.0%}")
    print(f"{'cycle with clocks around its parts':>34} {clocked * 1e6:10.1f} us")
    print(f"{'plain cycle':>34} {cycle * 1e6:10.1f} us")


if __name__ == "__main__":
    main()
