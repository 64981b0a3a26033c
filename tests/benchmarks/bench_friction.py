"""How well are masses and springs found of motors with dry friction, and how true are the errors told?

The packaged turntable and arm, with Coulomb friction at both motors of a share of the torque limit,
loops stiff enough to move against it, measured by the fast plan and identified through the command line
with the prior model as it stands.  Printed: the largest error of motors' masses, of all other masses,
springs and couplings, of the friction, and errors over the standard errors that were told.

Run: python tests/benchmarks/bench_friction.py [--seed S] [--machines N] [--time SECONDS] [SHARE ...]
"""

import argparse
import os
import sys
import tempfile
import time
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import yaml

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from drives.profile import load_machine
from drives.sim.lockstep_bus import register, unregister
from drives.sim.machine import simulated_machine
from fieldtool.records.model import MachineModel
from fieldtool.records.model_file import read_model
from tests.faults.bench import command

MACHINE = Path(__file__).resolve().parents[2] / "profiles" / "machines" / "turntable-arm.yaml"
TORQUE = 6.0
"""N m, the limit of both axes."""
STIFFER = 4.0
"""Stiffness of the loops over the packaged machine's."""
SHARES = (0.02, 0.05, 0.1, 0.15)


def rubbing(share: float, seed: int) -> dict[str, Any]:
    """Return the machine profile with friction of a share of the torque limit."""
    profile: dict[str, Any] = yaml.safe_load(MACHINE.read_text(encoding="utf-8"))
    profile["simulation"]["seed"] = seed
    profile["bus"]["channel"] = f"friction-{share}-{seed}"
    for truth in profile["simulation"]["axes"]:
        truth["effects"] = [
            {"effect": "coulomb_friction", "location": "motor", "torque": share * TORQUE}
        ]
        for gain, power in (("position_p", 0.5), ("velocity_p", 0.5), ("velocity_i", 1.0)):
            truth["gains"][gain] *= STIFFER**power
    return profile


def measured(profile: dict[str, Any], seconds: float) -> tuple[MachineModel | None, str]:
    """Measure and identify; return the model, or None and what was said."""
    channel = profile["bus"]["channel"]
    with (
        tempfile.TemporaryDirectory() as name,
        patch.dict(os.environ, {"FIELDTOOL_STATE_DIR": str(Path(name) / "notes")}),
    ):
        path, out = Path(name) / "machine.yaml", Path(name) / "session"
        path.write_text(yaml.safe_dump(profile, sort_keys=False), encoding="utf-8")
        register(channel, simulated_machine(load_machine(path)))
        try:
            for words in (
                ("measure", path, "--yes", "--time", seconds, "--out", out),
                ("identify", out),
            ):
                code, text = command(*words)
                if code:
                    return None, f"{words[0]} ended with {code}: {text[:200]}"
        finally:
            unregister(channel)
        return read_model(out / "model.yaml"), ""


def errors(model: MachineModel, truth: dict[str, Any], friction: float) -> dict[str, list[Any]]:
    """Relative errors, and those over the standard errors told, of three kinds of numbers."""
    pairs: dict[str, list[tuple[float, float, float]]] = {
        "motors": [],
        "others": [],
        "friction": [],
    }
    for axis, true in zip(model.axes, truth["axes"], strict=True):
        estimates = (*axis.masses, *axis.springs)
        for k, (one, value) in enumerate(
            zip(estimates, (*true["masses"], *true.get("springs", ())), strict=True)
        ):
            pairs["others" if k else "motors"].append((one.value, one.std, value))
    for one, true in zip(model.couplings, truth["couplings"], strict=True):
        pairs["others"].append((one.value, one.std, true["value"]))
    for effect in model.effects:
        if effect["effect"] == "coulomb_friction":
            found = effect["parameters"]["torque"]
            pairs["friction"].append((found["value"], found["std"], friction))
    return {
        kind: [(value / true - 1, (value - true) / std) for value, std, true in listed]
        for kind, listed in pairs.items()
    }


def main() -> int:
    """Print a row for each share; return 1 where something was not identified."""
    options = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    options.add_argument("--seed", type=int)
    options.add_argument("--machines", type=int, default=3)
    options.add_argument("--time", type=float, default=30.0)
    options.add_argument("shares", nargs="*", type=float, default=list(SHARES))
    given = options.parse_args()
    seed = given.seed
    if seed is None:
        seed = int(np.random.SeedSequence().generate_state(1)[0])
    print(f"seed {seed}, {given.machines} machines a row, {given.time:g} s of excitation")
    print("friction of  not     motors' masses      others              friction")
    print("the limit    found   error %   / std     error %   / std     error %   / std")
    failed, began = 0, time.process_time()
    for share in given.shares:
        rows: dict[str, list[Any]] = {"motors": [], "others": [], "friction": []}
        lost = []
        for k in range(given.machines):
            profile = rubbing(share, seed % 2**31 + k)
            model, said = measured(profile, given.time)
            if model is None:
                lost.append(said)
                continue
            for kind, found in errors(model, profile["simulation"], share * TORQUE).items():
                rows[kind] += found
        cells = [
            f"{100 * max(abs(e) for e, _ in found):7.3f} {max(abs(z) for _, z in found):7.1f}    "
            if found
            else f"{'-':>7} {'-':>7}    "
            for found in rows.values()
        ]
        print(f"{100 * share:7.1f} %   {len(lost):3d}    {' '.join(cells)}", flush=True)
        for said in lost:
            print(f"      {said}", flush=True)
        failed += len(lost)
    print(f"{time.process_time() - began:.0f} s of CPU")
    return int(failed > 0)


if __name__ == "__main__":
    sys.exit(main())
