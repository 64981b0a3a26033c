"""Kill -9 at random moments of write-back and storing, then ``fieldtool restore``: what is left.

The drives live in this process, served over a socket, some machines at a time, since most of the time
is waiting for drives that store and for the bus to be quiet; ``fieldtool write`` and ``fieldtool
restore`` are processes of their own, and the first is ended by SIGKILL: before its first write, after a
frame while it writes or reads back, or while drives store.  In half of the trials the supply of one or
all drives fails at that moment (a drive that is storing then holds old, new, or corrupted memory); in
some the restore is killed as well, and repeated.  In the end working memory and non-volatile memory of
all drives are compared with what they held before.

Target: never a mixed machine, never a lost backup.

Run: python tests/benchmarks/bench_kill.py [--seed S] [--moments N] [--axes A]
"""

import argparse
import queue
import sys
import tempfile
import time
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from tests.apart import MachineApart
from tests.kills import Trial, random_moment, tried

WHEN = (
    "before the backup",
    "before the journal",
    "writing",
    "checking",
    "storing",
    "ended",
)
STORE_TIME = 0.2
"""s, of the simulated drives."""


def main() -> int:
    """Try all moments; return 1 if one of them left what must not be."""
    options = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    options.add_argument("--seed", type=int)
    options.add_argument("--moments", type=int, default=200)
    options.add_argument("--axes", type=int, default=3)
    options.add_argument("--machines", type=int, default=4, help="tried on at the same time")
    given = options.parse_args()
    seed = given.seed
    if seed is None:
        seed = int(np.random.SeedSequence().generate_state(1)[0])
    rng = np.random.default_rng(seed)
    print(f"seed {seed}, {given.moments} moments, {given.axes} axes", flush=True)
    moments = [random_moment(rng, given.axes, STORE_TIME) for _ in range(given.moments)]
    began, trials = time.perf_counter(), []
    with ExitStack() as stack:
        machines: queue.SimpleQueue[MachineApart] = queue.SimpleQueue()
        for _ in range(given.machines):
            folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
            machines.put(stack.enter_context(MachineApart(folder, given.axes, quick=True)))

        def one(k: int) -> Trial:
            machine = machines.get()
            try:
                return tried(machine, moments[k], f"moment-{k}")
            finally:
                machines.put(machine)

        workers = stack.enter_context(ThreadPoolExecutor(given.machines))
        for k, trial in enumerate(workers.map(one, range(given.moments))):
            trials.append(trial)
            if trial.fault:
                print(f"moment {k}, {moments[k]}: {trial.fault}", flush=True)
            if (k + 1) % 20 == 0:
                passed = time.perf_counter() - began
                left = passed / (k + 1) * (given.moments - k - 1)
                print(f"  {k + 1} tried, {passed:.0f} s, {left:.0f} s left", flush=True)
    _show(trials)
    return int(any(trial.fault for trial in trials))


def _show(trials: list[Trial]) -> None:
    head = f"{'killed while':22}{'moments':>8}{'supply lost':>12}{'restore killed':>15}"
    print(f"\n{head}{'all old':>9}{'all new':>9}{'mixed':>7}{'backup lost':>12}{'wrong':>7}")
    for when in (*WHEN, "all"):
        chosen = [t for t in trials if when in ("all", t.when)]
        held = Counter("mixed" if "mixed" in (t.working, t.stored) else t.working for t in chosen)
        print(
            f"{when:22}{len(chosen):8}{sum(t.supply != 'stays' for t in chosen):12}"
            f"{sum(t.killed_again for t in chosen):15}{held['old']:9}{held['new']:9}{held['mixed']:7}"
            f"{sum(not t.backup_whole for t in chosen):12}{sum(bool(t.fault) for t in chosen):7}"
        )


if __name__ == "__main__":
    sys.exit(main())
