"""How well the host keeps its cycle: ``python tests/benchmarks/bench_loop.py``.

On the lock-step bus time is virtual and no cycle is ever late, so what is measured is the host's own
processor time in each cycle, blocks of targets included: how much it is, and in how many cycles it
takes more than half of the cycle.  On a SocketCAN bus (``vcan0`` here, or in a guest where this kernel
has none) master and simulated drives are two processes in real time: late cycles, worst lateness,
spoiled rows, what a third listener's kernel time stamps say of the SYNC, the host's processor share,
and the bus load by the bit rate.  A guest has one slow processor for both; its figures say what is
seen and survived, not what a laptop can do, and its processor shares are counted in whole clock ticks.
"""

import argparse
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from drives.bus import CyclicLoad, frame_bits
from drives.bus.kernel_link import kernel_links
from drives.canopen_drive import connect
from drives.errors import DrivesError
from drives.profile import MachineProfile, load_machine

MACHINE = Path(__file__).parents[1] / "socketcan" / "machine.yaml"
GUEST = Path(__file__).parents[3] / "shared" / "vcan" / "run-in-vcan.sh"
SECONDS = 15.0
RUNS = (
    (0.020, "host"),
    (0.010, "host"),
    (0.010, "kernel"),
    (0.005, "host"),
    (0.005, "kernel"),
    (0.002, "host"),
    (0.002, "kernel"),
)
BLOCK = 0.1
BUSY = 0.5
"""Share of a cycle of which the host may be busy, without a look at the bus."""


def waves(start: np.ndarray, cycle: float, seconds: float) -> Callable[[Any], np.ndarray | None]:
    """Return a source of gentle sines."""
    n = round(BLOCK / cycle)
    done = 0

    def source(_before: object) -> np.ndarray | None:
        nonlocal done
        if done * cycle >= seconds:
            return None
        t = cycle * (done + np.arange(n))
        done += n
        targets: np.ndarray = start + (0.1 * np.sin(2 * t))[:, None] * np.ones(start.size)
        return targets

    return source


def load_of(machine: MachineProfile, cycle: float) -> str:
    """Return the cyclic load in the worst case, in words."""
    load = CyclicLoad(len(machine.axes), cycle, machine.bus.bitrate)
    return f"{load.bits} bits a cycle, {100 * load.share:.1f} % of {machine.bus.bitrate} bit/s"


def measured_load(machine: MachineProfile, cycle: float, cycles: int, frames: list[int]) -> str:
    """Return the load of the frames that were heard, by their lengths."""
    bits = sum(frame_bits(length) for length in frames)
    return f"{100 * bits / (machine.bus.bitrate * cycle * cycles):.1f} %"


def lockstep(name: str, cycle: float) -> None:
    """Measure the host's own processor time in each cycle on the lock-step bus."""
    machine, clock = load_machine(name), time.thread_time
    own: list[float] = []
    with connect(machine) as group:
        bus = group.line.can_bus
        inside, last = 0.0, clock()

        def clocked(call: Callable[..., Any], sync: bool) -> Callable[..., Any]:
            def run(*arguments: Any) -> Any:
                nonlocal inside, last
                began = clock()
                try:
                    return call(*arguments)
                finally:
                    now = clock()
                    inside += now - began
                    if sync and arguments[0].arbitration_id == 0x080:
                        own.append(now - last - inside)
                        inside, last = 0.0, now

            return run

        bus.send, bus.recv = clocked(bus.send, True), clocked(bus.recv, False)  # type: ignore[method-assign]
        with group.motion(cycle) as motion:
            own.clear()
            motion.stream(waves(motion.position, cycle, 30.0))
        kept = group.punctuality
    times = 1e3 * np.array(own[10:])
    busy = int(np.sum(times > 1e3 * BUSY * cycle))
    median, most = np.percentile(times, [50, 99.9])
    print(
        f"lock-step  {machine.name:14} {1e3 * cycle:5g} ms  {kept.late} of {kept.cycles} cycles late "
        f"(virtual time); host's own processor time a cycle: median {median:.3f} ms "
        f"({100 * median / (1e3 * cycle):.1f} % of a processor), 99.9 % {most:.3f} ms, longest "
        f"{times.max():.2f} ms, {busy} above {100 * BUSY:g} % of the cycle; load at most "
        f"{load_of(machine, cycle)}"
    )


def forked(work: Callable[[], object], output: Path) -> int:
    """Do something in a copy of this process; return its id."""
    pid = os.fork()
    if pid:
        return pid
    signal.signal(signal.SIGINT, signal.default_int_handler)
    with output.open("w", buffering=1) as file:
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)
        sys.stdout = sys.stderr = file
        try:
            work()
        except BaseException as error:
            print(error)
    os._exit(0)


def socketcan() -> None:
    """Measure on vcan0, with the simulated drives in a process of their own."""
    from fieldtool.cli.main import main

    here = ["simulate", str(MACHINE), "--interface", "socketcan", "--channel", "vcan0"]
    said = Path(tempfile.mkdtemp()) / "simulator"
    simulator = forked(lambda: main(here), said)
    while not said.exists() or "Serving" not in said.read_text():
        time.sleep(0.1)
    try:
        for cycle, sync in RUNS:
            one_run(cycle, sync)
    finally:
        os.kill(simulator, signal.SIGINT)
        os.waitpid(simulator, 0)
    print("simulator: " + " ".join(said.read_text().split("\n", 1)[1].split()))


def one_run(cycle: float, sync: str) -> None:
    """Stream for some seconds, and print a line."""
    from drives.bus.kernel_bus import KernelBus

    machine = load_machine(MACHINE)
    bus = machine.bus.model_copy(update={"sync": sync, "shortest_cycle": 0.001})
    machine = machine.model_copy(update={"bus": bus})
    head = f"vcan0      {machine.name:14} {1e3 * cycle:5g} ms  SYNC by {sync:6} "
    listener = KernelBus("vcan0")
    listener.socket.setsockopt(1, 33, 32_000_000)
    spoiled = rows = 0
    first = float("inf")
    try:
        with connect(machine) as group:
            try:
                with group.motion(cycle) as motion:
                    first = time.time()
                    begun, cpu = time.perf_counter(), time.process_time()
                    capture = motion.stream(waves(motion.position, cycle, SECONDS))
                    wall, cpu = time.perf_counter() - begun, time.process_time() - cpu
                    rows, spoiled = capture.rows, len(capture.missing)
            except DrivesError as error:
                print(f"{head}stopped: {error}")
            kept = group.punctuality
    finally:
        stamps, lengths = [], []
        while (message := listener.recv(0)) is not None and len(stamps) < (rows or 1):
            if message.timestamp < first:
                continue
            lengths.append(len(message.data))
            if message.arbitration_id == 0x080:
                stamps.append(message.timestamp)
        listener.shutdown()
    if not rows:
        return
    steps = 1e3 * np.diff(stamps)
    mean = 1e3 * (stamps[-1] - stamps[0]) / (len(stamps) - 1)
    print(
        f"{head}{kept.late} of {kept.cycles} cycles late, worst {1e3 * kept.worst:.2f} ms; "
        f"{spoiled} of {rows} rows spoiled, {kept.overruns} frames lost; SYNC every {mean:.4f} ms, "
        f"1 to 99 % {np.percentile(steps, 1):.2f} to {np.percentile(steps, 99):.2f} ms; "
        f"{cpu / wall:.0%} of a processor; load at most {load_of(machine, cycle)}, "
        f"of the frames heard {measured_load(machine, cycle, len(stamps), lengths)}"
        f"{'; ' + kept.real_time if kept.real_time else ''}"
    )


def main() -> None:
    """Print a line a run."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--here", action="store_true", help="only vcan0, in this kernel")
    here = parser.parse_args().here
    if not here:
        print(f"load of the computer {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores")
        lockstep("turntable-arm", 0.001)
        lockstep("paper-3x3", 0.001)
    if here or kernel_links("vcan0"):
        socketcan()
    elif GUEST.exists() and shutil.which("linux.uml") and os.geteuid() == 0:
        urgent = ["chrt", "-r", "1"] if shutil.which("chrt") else []
        command = [*urgent, str(GUEST), "-t", "400", sys.executable, __file__, "--here"]
        subprocess.run(command, check=True)
    else:
        print("no vcan0 here, and no guest that has one")


if __name__ == "__main__":
    main()
