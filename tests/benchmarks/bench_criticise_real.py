"""What criticism says of real data: ``bench_criticise_real.py [emps] [two-mass-bench]``.

The EMPS ball-screw axis, split in time: two thirds are fitted, the rest is unseen; in pieces by turns,
and with the last third in one piece.  Wanted: delay and asymmetric friction named, a relative force
error of at most 2.4 % on the unseen part (the authors' model: 4.1 %), a mass within 1 % of 95.1 kg.

The two-mass bench, open loop, torque in A: what is left is said, and nothing invented.

The data are looked for in ``$FIELDTOOL_DATA``, else in ``shared/data`` beside the project.
"""

import os
import sys
import time
from pathlib import Path

from fieldtool.criticise.criticise import criticise
from fieldtool.criticise.criticism import Criticism
from fieldtool.identify.recorded import identify_recording
from fieldtool.records.csv_folder import read_folder

BESIDE = Path(__file__).resolve().parents[3] / "shared" / "data"
CASES = (("emps", False), ("emps", True), ("two-mass-bench", False))
"""Folder, and whether the last third is kept in one piece."""


def show(criticism: Criticism) -> None:
    """Print verdict, causes with their numbers, and errors on what no fit has seen."""
    held = criticism.held_out
    unseen = f"{', '.join(held.experiments)} (split by {held.split})"
    print(f"  verdict {criticism.verdict}; unseen: {unseen}")
    for cause in criticism.causes:
        numbers = ", ".join(
            f"{name} {n.value:.4g} +- {n.std:.2g} {n.unit}" for name, n in cause.parameters.items()
        )
        ties = f"; as good: {', '.join(t.effect for t in cause.ties)}" if cause.ties else ""
        print(f"  {cause.axis}: {cause.effect}, chance {cause.chance:.1e}: {numbers}{ties}")
    for axis, after in held.error_after.items():
        noise = held.noise_floor[axis]
        floor = "not known" if noise is None else f"{100 * noise:.2f} %"
        print(
            f"  {axis}: relative error of the torque on unseen data "
            f"{100 * held.error_before[axis].torque:.2f} % -> {100 * after.torque:.2f} % "
            f"(noise {floor})"
        )
    for model in criticism.model.axes:
        for k, mass in enumerate(model.masses, start=1):
            print(f"  {model.name}: mass {k} {mass.value:.5g} +- {mass.std:.2g}")
    for sentence in criticism.unexplained:
        print(f"  left: {sentence}")


def main() -> None:
    """Print all that is asked for."""
    folder = Path(os.environ.get("FIELDTOOL_DATA", BESIDE))
    for name, contiguous in CASES:
        if sys.argv[1:] and name not in sys.argv[1:]:
            continue
        if not (folder / name).is_dir():
            print(f"{name}: skipped, no measurements here; set FIELDTOOL_DATA")
            continue
        began = time.perf_counter()
        recording = read_folder(folder / name)
        model = identify_recording(recording, {}).model
        criticism = criticise(recording, model, contiguous=contiguous).criticism
        piece = ", the last third in one piece" if contiguous else ""
        print(f"{name}{piece}: {time.perf_counter() - began:.0f} s")
        show(criticism)


if __name__ == "__main__":
    main()
