"""Makers' faces end to end: what is found on each, against the reference drive and the truth.

Each line is one whole session (measure, identify, design; write and store where the profile allows it)
on the packaged turntable with an arm, its two drives being of the kinds named.  A star is the packaged
profile with the facts filled in that it says are unknown.
"""

import os
import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from drives.sim.servo_kernel import Parameter
from fieldtool import workflow
from fieldtool.workflow import Options
from tests.faces import machine_of, simulated
from tests.session.test_faces_session import numbers

PAIRS = (
    ("reference", "reference"),
    ("epos4*", "epos4-dual-loop"),
    ("epos4", "epos4-dual-loop"),
    ("novanta*", "epos4-dual-loop"),
    ("elmo-gold", "cia402*"),
    ("copley*", "nanotec*"),
)
WRITTEN = PAIRS[:4]
GAINS = ("position_p", "velocity_p", "velocity_i")


def main() -> None:
    """Print the table."""
    os.environ["FIELDTOOL_STATE_DIR"] = tempfile.mkdtemp()  # notes of other sessions are not ours
    print(
        f"{'table':18}{'arm':18}{'worst to reference':>20}{'worst to truth':>16}{'gains':>12}{'s':>6}"
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
            worst_gain = 0.0
            for k, axis in enumerate(result.tuning.axes if written else ()):
                for name in GAINS:
                    held = running.axes.get(k, Parameter[name.upper()])
                    worst_gain = max(worst_gain, abs(held / axis.parameters[name] - 1))
        found, truth = numbers(result.model), numbers(result.truth or result.model)
        reference = reference or found
        to_reference = max(abs(found[key] / reference[key] - 1) for key in reference)
        to_truth = max(abs(found[key] / truth[key] - 1) for key in truth)
        gains = f"{worst_gain:.1e}" if written else "not written"
        seconds = time.perf_counter() - begin
        print(
            f"{drives[0]:18}{drives[1]:18}{to_reference:20.1e}{to_truth:16.1e}{gains:>12}{seconds:6.0f}",
            flush=True,
        )


if __name__ == "__main__":
    main()
