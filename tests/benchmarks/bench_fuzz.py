"""Random frames and wrong SDO answers on the bus: ``python -m tests.benchmarks fuzz``.

A million frames that are nobody's during whole measurements, and as many that are not CANopen's (29-bit,
remote, error) with the nodes' identifiers; then look-alikes of the nodes' own frames and wrong SDO
answers, in measurements and writes.  What must not be: an unhandled exception, a hang, a
drive under power at the end, a value in a drive that the tool should not have written.

Run by itself: python tests/benchmarks/bench_fuzz.py [--frames N] [--cases N]
"""

import argparse
import sys
import time
from pathlib import Path
from random import Random

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from tests.faults.bench import Moment
from tests.faults.fuzz_bus import HARMLESS, Noise, Outcome, disturbed, tally

FRAMES, RATE, CASES = 1_000_000, 80.0, 150
RATES = {"look-alikes": (0.002, 0.01, 0.1, 1.0), "answers": (0.002, 0.01, 0.05, 0.3, 1.0)}


def main() -> int:
    options = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    options.add_argument("--frames", type=int, default=FRAMES)
    options.add_argument("--cases", type=int, default=CASES)
    asked = options.parse_args()
    seed = int(np.random.SeedSequence().generate_state(1)[0])
    print("seed", seed)
    random, wrong = Random(seed), 0
    for kind in HARMLESS:
        began, sent, outcomes = time.process_time(), 0, list[Outcome]()
        while sent < asked.frames:
            noise = Noise(kind, RATE, random.getrandbits(32), at_most=asked.frames - sent)
            outcomes.append(disturbed(noise))
            sent += outcomes[-1].frames
            wrong += _told(noise, outcomes[-1]) or outcomes[-1].code != 0
        print(
            f"{kind}: {sent} frames, {tally(outcomes)}, {time.process_time() - began:.0f} s of CPU"
        )
    for kind, rates in RATES.items():
        began, outcomes = time.process_time(), []
        for _ in range(asked.cases):
            quiet = random.choice((0, 60, 100, 200, 300, 400))
            noise = Noise(kind, random.choice(rates), random.getrandbits(32), quiet)
            outcomes.append(disturbed(noise, random.choice((Moment.SWEEP, Moment.WRITE))))
            wrong += _told(noise, outcomes[-1])
        frames = sum(one.frames for one in outcomes)
        seconds = time.process_time() - began
        print(
            f"{kind}: {asked.cases} commands, {frames} frames, {tally(outcomes)}, {seconds:.0f} s of CPU"
        )
    print(f"{wrong} not as they have to be")
    return min(wrong, 1)


def _told(noise: Noise, outcome: Outcome) -> bool:
    for problem in outcome.problems:
        print(f"  {noise}: {problem}: {outcome.said[:200]}")
    return bool(outcome.problems)


if __name__ == "__main__":
    sys.exit(main())
