"""What comes out of a real bench's recordings: ``python tests/benchmarks/bench_real_bench.py [folder]``.

Two servo motors joined by a flexible coupling, driven open loop by a current multisine.  Import and
identification as ``fieldtool import`` and ``fieldtool identify`` do them; then the load side, which
the fit never saw, predicted from the motor side.  Targets of the project: inertia ratio 1.00 +-
0.02, hidden load-side response within 0.25 dB and 2 degrees in the median from 11 to 200 Hz.

The data are looked for in the folder given, else in ``$FIELDTOOL_DATA/two-mass-bench``, else in
``shared/data/two-mass-bench`` beside the project.
"""

import os
import sys
import tempfile
import time
from pathlib import Path

from fieldtool import workflow
from fieldtool.records.model import Estimate
from fieldtool.records.model_file import write_model

BAND = (11.0, 200.0)


def data_folder() -> Path | None:
    """Return the folder with the bench's data, None where it is absent."""
    beside = Path(__file__).resolve().parents[3] / "shared" / "data"
    if len(sys.argv) > 1:
        return Path(sys.argv[1])
    folder = Path(os.environ.get("FIELDTOOL_DATA", beside)) / "two-mass-bench"
    return folder if folder.is_dir() else None


def row(what: str, value: Estimate, unit: str = "", scale: float = 1.0) -> None:
    """Print a value with its standard error."""
    print(f"{what:<34}{scale * value.value:12.5g} +- {scale * value.std:<10.2g}{unit}")


def main() -> None:
    """Print the tables."""
    folder = data_folder()
    if folder is None:
        print("skipped: no measurements of the two-mass bench here; set FIELDTOOL_DATA")
        return
    with tempfile.TemporaryDirectory() as place:
        recording, model = Path(place) / "bench.h5", Path(place) / "model.yaml"
        began = time.perf_counter()
        workflow.import_folder(folder, recording)
        imported = time.perf_counter()
        found = workflow.identify(recording)
        identified = time.perf_counter()
        write_model(found.model, model)
        comparisons = workflow.compare(recording, model, BAND)
        compared = time.perf_counter()
    print(
        f"import {imported - began:.2f} s, identify {identified - imported:.2f} s, "
        f"compare {compared - identified:.2f} s"
    )
    chain = found.chain
    if chain is None:
        raise SystemExit("the recording was not identified as a chain")
    features = chain.features
    row("inertia ratio load / motor", features.inertia_ratio, "  (wanted: 1.00 +- 0.02)")
    for value in features.antiresonances:
        row("antiresonance", value, "Hz")
    for value in features.resonances:
        row("resonance", value, "Hz")
    for value in features.damping_ratios:
        row("damping ratio of the resonance", value)
    row("delay from torque to position", chain.delay, "ms", 1e3)
    axis = found.model.axes[0]
    for name, values in (("mass", axis.masses), ("spring", axis.springs), ("damper", axis.dampers)):
        for k, value in enumerate(values, start=1):
            row(f"{name} {k} (torque in A)", value)
    row("viscous friction at the motor", axis.viscous_friction)
    print(f"{'response not explained by the model':<34}{100 * chain.model_error:12.2g} %")
    for note in found.notes:
        print(f"  {note}")
    print()
    print(f"load side, never seen by the fit, {BAND[0]:g} to {BAND[1]:g} Hz: median error")
    print("(wanted: at most 0.25 dB and 2 degrees)")
    print(f"{'experiment':<12}{'lines':>6}  {'ratio':<32}{'dB':>8}{'degrees':>10}")
    for comparison in comparisons:
        for ratio in (comparison.per_position, comparison.per_torque):
            print(
                f"{comparison.experiment:<12}{comparison.frequencies.size:6d}  {ratio.what:<32}"
                f"{ratio.median_db:8.3f}{ratio.median_degrees:10.3f}"
            )


if __name__ == "__main__":
    main()
