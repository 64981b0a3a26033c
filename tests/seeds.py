"""Seeds that change with the code, and the same again for the same code.

A run has one number, shown in its first lines; every test derives its own seed from it. Without
``FIELDTOOL_SEED`` the number comes from the contents of the program and its tests: every change
draws new cases, and one state of the code gives one answer, wherever it is tried.
``FIELDTOOL_SEED=NUMBER pytest ...`` draws the cases of that number, ``FIELDTOOL_SEED=new`` others.
"""

import os
import zlib
from pathlib import Path

import numpy as np

VARIABLE = "FIELDTOOL_SEED"
ROOT = Path(__file__).parents[1]
ROOMS = ("fieldtool", "drives", "profiles", "tests")


def seed_of_run() -> int:
    """Return the run's number; processes begun later inherit it."""
    given = os.environ.get(VARIABLE, "")
    if not given:
        os.environ[VARIABLE] = str(seed_of_contents())
    elif given == "new":
        os.environ[VARIABLE] = str(int(np.random.SeedSequence().generate_state(1)[0]))
    return int(os.environ[VARIABLE])


def seed_of_contents() -> int:
    """Return a number of 32 bits made of the names and lines of all Python files of the project."""
    check = 0
    for path in sorted(path for room in ROOMS for path in (ROOT / room).rglob("*.py")):
        if "node_modules" not in path.parts:  # installed there for one test
            lines = [path.relative_to(ROOT).as_posix().encode(), *path.read_bytes().splitlines()]
            check = zlib.crc32(b"\n".join(lines), check)
    return check


def fresh_seed() -> int:
    """Return the running test's own seed, and print it; outside of a test, that of the run's modules."""
    test = os.environ.get("PYTEST_CURRENT_TEST", "").rpartition(" ")[0]
    parts = [seed_of_run(), zlib.crc32(test.encode())]
    seed = int(np.random.SeedSequence(parts).generate_state(1)[0])
    print("seed", seed)
    return seed
