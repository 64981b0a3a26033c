"""Makers' faces end to end: what is found on each, against the reference drive and the truth.

Each line is one whole session (measure, identify, design; write and store where the profile allows it)
on the packaged turntable with an arm, its two drives being of the kinds named, as ``tests.faces`` has
them: a star is the packaged profile with the facts filled in that measuring needs, a plus with those
that writing needs too, ``own`` a drive in no list.  ``gains``: of the firmware after a power cycle,
against those that were designed.  ``path``: how far the machine then moves otherwise than with reference
drives that were given the designed gains.
"""

import os
import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import numpy as np

from fieldtool import workflow
from fieldtool.workflow import Options
from tests.faces import machine_of, simulated
from tests.session.test_faces_session import (
    GAINS,
    by_reference_drives,
    moved,
    numbers,
    settings,
)

PAIRS = (
    ("reference", "reference"),
    ("epos4*", "epos4-dual-loop"),
    ("epos4", "epos4-dual-loop"),
    ("novanta*", "epos4-dual-loop"),
    ("copley+", "nanotec+"),
    ("own", "epos4-dual-loop"),
    ("elmo-gold", "cia402*"),
    ("copley*", "nanotec*"),
)
WRITTEN = PAIRS[:6]


def main() -> None:
    """Print the table."""
    os.environ["FIELDTOOL_STATE_DIR"] = tempfile.mkdtemp()  # notes of other sessions are not ours
    print(
        f"{'table':18}{'arm':18}{'worst to reference':>20}{'worst to truth':>16}{'gains':>12}"
        f"{'path, rad':>12}{'s':>6}"
    )
    reference: dict[str, float] = {}
    for drives in PAIRS:
        begin = time.perf_counter()
        folder = Path(tempfile.mkdtemp())
        machine = machine_of(drives, folder)
        written = drives in WRITTEN
        options = Options(write=written, store=written)
        with simulated(machine) as running:
            result = workflow.run(machine, folder / "one", options, confirm=lambda _: True)
            for node in running.nodes:
                node.power_cycle()
            held = [settings(running, k) for k in range(2)]
            path = moved(machine) if written else None
        gains, apart = "not written", ""
        if path is not None:
            worst = max(
                abs(firmware[name] / axis.parameters[name] - 1)
                for axis, firmware in zip(result.tuning.axes, held, strict=True)
                for name in GAINS
                if axis.parameters.get(name)
            )
            other = by_reference_drives(drives, result.tuning, folder)
            gains, apart = f"{worst:.1e}", f"{np.abs(path - other).max():.1e}"
        found, truth = numbers(result.model), numbers(result.truth or result.model)
        reference = reference or found
        to_reference = max(abs(found[key] / reference[key] - 1) for key in reference)
        to_truth = max(abs(found[key] / truth[key] - 1) for key in truth)
        seconds = time.perf_counter() - begin
        print(
            f"{drives[0]:18}{drives[1]:18}{to_reference:20.1e}{to_truth:16.1e}{gains:>12}"
            f"{apart:>12}{seconds:6.0f}",
            flush=True,
        )


if __name__ == "__main__":
    main()
