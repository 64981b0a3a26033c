"""Seeds that are new in every run, and the same again when a failure is to be seen again.

A run draws one number and shows it in its first lines; every test derives its own seed from it.
``FIELDTOOL_SEED=NUMBER pytest ...`` draws them all again.
"""

import os
import zlib

import numpy as np

VARIABLE = "FIELDTOOL_SEED"


def seed_of_run() -> int:
    """Return the run's number; the first call draws it, and processes begun later inherit it."""
    if VARIABLE not in os.environ:
        os.environ[VARIABLE] = str(int(np.random.SeedSequence().generate_state(1)[0]))
    return int(os.environ[VARIABLE])


def fresh_seed() -> int:
    """Return the running test's own seed, and print it; outside of a test, that of the run's modules."""
    test = os.environ.get("PYTEST_CURRENT_TEST", "").rpartition(" ")[0]
    parts = [seed_of_run(), zlib.crc32(test.encode())]
    seed = int(np.random.SeedSequence(parts).generate_state(1)[0])
    print("seed", seed)
    return seed
