"""Random machines whose tooling was changed, old gains in the drives: ``bench_retune.py N --seed S``.

Each goes the whole way over the virtual CAN, as ``fieldtool run --write`` does: measure, identify,
design, try the old parameters, write, try the new ones, keep or restore.  The end masses are 0.5 to 3
times what the prior model says, the last springs 0.4 to 1 times.  The old gains are those of the rule of
thumb (``fieldtool.design.rule``) for the old tooling.

What is wanted: stable in all; measured peak of sensitivity at most 2.1; settling shorter than before in
at least 90 % of the axes, never more than 5 % longer where the tool kept the parameters; prediction
against measurement within 10 % (peak) and 15 % (settling, to 3 cycles).  The true model's own figures
for what was written stand beside.  Left out: criticism, report and pictures, which take their time and
change nothing here.

With ``--hidden`` each machine has one effect beyond its prior model as well, drawn from the seed
(:func:`hide`), and criticism is on: the design rests on the model that it extends.  The machines are the
same otherwise.  The table then says what was hidden, what criticism named, and of what was not kept
whether the drives hold their old parameters.

Rows are appended to a file (``--out``), so that pieces add up: the same seed goes on where it ended.
"""

import argparse
import json
import os
import re
import shutil
import tempfile
import time
import traceback
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import yaml

from drives.errors import DrivesError
from drives.profile import MachineProfile, load_machine
from drives.sim.entries import ENTRIES
from drives.sim.lockstep_bus import register, unregister
from drives.sim.machine import simulated_machine
from drives.sim.running import RunningMachine
from fieldtool import workflow
from fieldtool.cli.main import exit_code
from fieldtool.design.machine import machine_of
from fieldtool.design.predict import predict
from fieldtool.design.rule import rule
from fieldtool.errors import FieldtoolError, PlanRefusedError
from fieldtool.records.closed_loop import AxisLoop, ClosedLoop
from fieldtool.records.model import MachineModel
from fieldtool.workflow import Options
from fieldtool.workflow.models import prior_model, truth_model
from fieldtool.workflow.verifying import Verification

CHANNEL = "bench-retune"
SECONDS = 15.0
"""Of excitation for the identification; where the tool says that it needs more, it gets what it says."""
MORE = re.compile(r"allow more time \(--time (\d+)\)")
BOUND, SLOWER, PEAK_OFF, TIME_OFF, CYCLES = 2.1, 1.05, 0.10, 0.15, 3.0


def random_machine(rng: np.random.Generator) -> dict[str, Any]:
    """Return a machine profile as plain values: 1 to 3 axes of 1 to 3 masses, modes from 3 to 25 Hz."""
    count = int(rng.integers(1, 4))
    scale = float(np.exp(rng.uniform(np.log(0.02), np.log(5.0))))
    axes, simulated, ends = [], [], []
    for k in range(count):
        n = int(rng.integers(1, 4))
        masses = scale * np.exp(rng.uniform(-0.5, 0.5, n))
        lowest = np.exp(rng.uniform(np.log(4.0), np.log(12.0)))
        springs = masses.mean() * (2 * np.pi * lowest) ** 2 * np.exp(rng.uniform(-0.3, 0.3, n - 1))
        dampers = springs * rng.uniform(1e-4, 8e-4, n - 1)
        heavier, softer = float(rng.uniform(0.5, 3.0)), float(rng.uniform(0.4, 1.0))
        true_masses, true_springs = masses.copy(), springs.copy()
        true_masses[-1] *= heavier if n > 1 else max(heavier, 0.7)
        if n > 1:
            true_springs[-1] *= softer
        friction = float(masses.sum() * rng.uniform(0.05, 0.5))
        torque = float(true_masses.sum() * rng.uniform(40.0, 120.0))
        rated = torque / 1.5
        axes.append(
            {
                "name": f"axis{k + 1}",
                "kind": "rotary",
                "node_id": k + 1,
                "drive": "reference",
                "limits": {
                    "travel": ["-120 deg", "120 deg"],
                    "velocity": "6 rad/s",
                    "acceleration": "200 rad/s2",
                    "torque": f"{torque!r} N m",
                    "following_error": "40 deg",
                },
                "prior": {
                    "masses": masses.tolist(),
                    "springs": springs.tolist(),
                    "dampers": dampers.tolist(),
                    "viscous_friction": friction,
                },
            }
        )
        simulated.append(
            {
                "masses": true_masses.tolist(),
                "springs": true_springs.tolist(),
                "dampers": dampers.tolist(),
                "viscous_friction": friction * float(rng.uniform(0.5, 2.0)),
                "rated_torque": rated,
                "peak_torque": 3 * torque,
                "torque_noise": 1e-3 * rated,
            }
        )
        ends.append((masses[-1], true_masses[-1]))
    couplings, true_couplings = [], []
    for a in range(count):
        for b in range(a + 1, count):
            share = float(rng.uniform(0.1, 0.5) / max(count - 1, 1) * rng.choice([-1.0, 1.0]))
            names = [f"axis{a + 1}", f"axis{b + 1}"]
            for into, which in ((couplings, 0), (true_couplings, 1)):
                size = share * float(np.sqrt(ends[a][which] * ends[b][which]))
                into.append({"axes": list(names), "value": size})
    return {
        "format": "fieldtool-machine/1",
        "name": "random",
        "bus": {"interface": "fieldsim", "channel": CHANNEL, "bitrate": 1_000_000},
        "axes": axes,
        "couplings": couplings,
        "simulation": {
            "seed": int(rng.integers(1, 2**31)),
            "axes": simulated,
            "couplings": true_couplings,
        },
    }


def hide(data: dict[str, Any], rng: np.random.Generator) -> dict[str, Any]:
    """Give one axis of a machine an effect that no prior model has; return it as in ``model.yaml``."""
    count = len(data["simulation"]["axes"])
    elastic = [k for k in range(count) if data["simulation"]["axes"][k]["springs"]]
    name = str(rng.choice(list(PARTS if elastic else ON_ONE_MASS)))
    k = int(rng.choice(range(count) if name in ON_ONE_MASS else elastic))
    truth = data["simulation"]["axes"][k]
    location, numbers = PARTS[name](truth, rng)
    place = {"joint": int(location.split()[1])} if "spring" in location else {}
    if name in ("coulomb_friction", "extra_mode"):
        place = {"location": location}
    truth["effects"] = [{"effect": name, **place, **numbers}]
    axis = data["axes"][k]["name"]
    return {"effect": name, "axis": axis, "location": location, "parameters": numbers}


def _between(rng: np.random.Generator, low: float, high: float) -> float:
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def _spring(truth: Mapping[str, Any], rng: np.random.Generator) -> str:
    return f"spring {rng.integers(1, len(truth['masses']))}"


PARTS: Mapping[str, Any] = {
    "coulomb_friction": lambda t, r: (
        "motor",
        {"torque": t["rated_torque"] * _between(r, 0.01, 0.08)},
    ),
    "extra_mode": lambda t, r: (
        "load",
        {
            "mass": t["masses"][-1] * _between(r, 0.1, 0.5),
            "frequency": _between(r, 6.0, 40.0),
            "damping_ratio": _between(r, 0.005, 0.03),
        },
    ),
    "structural_damping": lambda t, r: (_spring(t, r), {"loss_factor": _between(r, 0.02, 0.15)}),
    "backlash": lambda t, r: (_spring(t, r), {"gap": _between(r, 3e-4, 3e-3)}),
    "cogging": lambda t, r: (
        "motor",
        {
            "amplitude": t["rated_torque"] * _between(r, 0.003, 0.03),
            "periods": float(r.choice([8, 12, 16, 18, 24])),
            "phase": 0.0,
        },
    ),
}
"""Place and numbers of what may be hidden, from the truth of its axis: dry friction of 1 to 8 % of the
rated torque, a mass of 0.1 to 0.5 of the last one on a spring of its own (6 to 40 Hz with the other end
held), play of 1 to 10 arc minutes, magnets of 0.3 to 3 % of the rated torque, in one of whose detents it
rests."""
ON_ONE_MASS = ("coulomb_friction", "extra_mode", "cogging")


def with_old_gains(data: dict[str, Any], folder: Path) -> tuple[MachineProfile, bool]:
    """Put the rule's gains for the old tooling into the drives; return whether they are stable now."""
    path = folder / "machine.yaml"
    path.write_text(yaml.safe_dump(data))
    bare = load_machine(path)
    loops: list[AxisLoop] = rule(prior_model(bare))
    for axis, loop in zip(data["simulation"]["axes"], loops, strict=True):
        axis["gains"] = {
            "position_p": loop.position_p,
            "velocity_p": loop.velocity_p,
            "velocity_i": loop.velocity_i,
            "velocity_ff": 1.0,
            "velocity_filter": 200.0,
        }
    path.write_text(yaml.safe_dump(data))
    machine = load_machine(path)
    truth = truth_model(machine)
    if truth is None:
        raise AssertionError("a simulated machine has a truth")
    return machine, ClosedLoop(truth, tuple(loops)).stable


def tried(
    seed: int, number: int, keep: Path | None = None, *, hidden: bool = False
) -> dict[str, Any]:
    """Take one machine the whole way; return what came of it, plain values.

    ``keep`` is where its session folder stays, for looking at it; ``hidden``: one effect is hidden in
    the machine, and criticism is on.
    """
    data = random_machine(np.random.default_rng([seed, number]))
    effect = hide(data, np.random.default_rng([seed, number, 1])) if hidden else None
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        if keep is not None:
            folder = keep / f"{seed}-{number}"
            folder.mkdir(parents=True, exist_ok=True)
        os.environ["FIELDTOOL_STATE_DIR"] = str(folder / "notes")
        machine, stable_before = with_old_gains(data, folder)
        row: dict[str, Any] = {
            "seed": seed,
            "number": number,
            "axes": [len(a.prior.masses) for a in machine.axes],
            "old_stable": stable_before,
        }
        running = register(CHANNEL, simulated_machine(machine))
        before = _held(running)
        plans: list[Any] = []
        planned = Verification.plan

        def noted(one: Verification, changes: Any) -> Any:
            plans.append(planned(one, changes))
            return plans[-1]

        begun = time.perf_counter()
        try:
            with ExitStack() as stack:
                uncriticised = ("fieldtool.workflow.stages.criticised", _uncriticised)
                for target, new in (
                    *(() if hidden else (uncriticised,)),
                    ("fieldtool.workflow.criticising.draw_criticism", lambda *_: None),
                    ("fieldtool.workflow.stages._reported", lambda *_: None),
                    ("fieldtool.workflow.stages.report", lambda *_: None),
                    ("fieldtool.workflow.stages.draw_responses", lambda *_: None),
                    ("fieldtool.workflow.verifying.draw_verification", lambda *_: None),
                ):
                    stack.enter_context(patch(target, new))
                stack.enter_context(patch.object(Verification, "plan", noted))
                result = _run(machine, folder / "session")
            row["outcome"] = "kept"
            row["time"] = result.machine_time
        except (DrivesError, FieldtoolError) as error:
            row["outcome"] = type(error).__name__
            row["said"] = " ".join(
                [str(error), *(getattr(error, "__notes__", ()) if hidden else ())]
            )
            row["code"] = exit_code(error)
        except Exception as error:  # a defect, of one machine of many
            row["outcome"] = type(error).__name__
            row["said"] = traceback.format_exc()
            row["code"] = exit_code(error)
        finally:
            row["powered"] = [n.node_id for n in running.nodes if n.motion.powered]
            unregister(CHANNEL)
        row["seconds"] = time.perf_counter() - begun
        found = folder / "session" / "verification.yaml"
        if found.is_file():
            row["verification"] = yaml.safe_load(found.read_text())
        truth = truth_model(machine)
        if effect is not None and truth is not None:
            row |= {"hidden": effect, "as_before": before == _held(running)}
            row["criticism"] = _criticism(folder / "session" / "criticism.yaml")
            truth = replace(truth, effects=(effect,))
        if plans:
            row["true"] = _true_figures(truth, plans[-1])
    return row


def _held(running: RunningMachine) -> list[Any]:
    """Every parameter of the maker's that a drive holds, as it is on the bus."""
    own = [
        entry.key
        for entry in ENTRIES.values()
        if entry.is_parameter and 0x2000 <= entry.index < 0x6000
    ]
    values = [node.dictionary.read(*key) for node in running.nodes for key in own]
    return [np.float32(one) if isinstance(one, float) else one for one in values]


def _criticism(path: Path) -> dict[str, Any] | None:
    """Verdict and causes of a session's criticism; None where it was not made."""
    if not path.is_file():
        return None
    found = yaml.safe_load(path.read_text())
    causes = [
        {k: c[k] for k in ("effect", "axis", "location", "parameters")} for c in found["causes"]
    ]
    return {"verdict": found["verdict"], "causes": causes}


def _run(machine: MachineProfile, folder: Path) -> workflow.SessionResult:
    """Run a session; once more with the time that the tool asks for, as a person would."""
    seconds = SECONDS
    while True:
        try:
            return workflow.run(
                machine,
                folder,
                Options(write=True, excitation_time=seconds),
                confirm=lambda _: True,
            )
        except PlanRefusedError as error:
            asked = MORE.search(str(error))
            if asked is None or float(asked[1]) <= seconds:
                raise
            seconds = float(asked[1])
            shutil.rmtree(folder)


def _uncriticised(_session: Any, model: MachineModel, *_: Any) -> tuple[MachineModel, None]:
    return model, None


def _true_figures(truth: MachineModel | None, plan: Any) -> list[dict[str, Any]]:
    """What the new parameters do on the true model, for the same moves."""
    if truth is None:
        return []
    prediction = predict(machine_of(truth), plan.new, plan.moves)
    return [
        {
            "stable": prediction.stable,
            "sensitivity_peak": axis.margins.sensitivity_peak,
            "settling_time": axis.move.settling_time if axis.move else None,
        }
        for axis in prediction.axes
    ]


def _judged(rows: list[dict[str, Any]]) -> None:
    """Print the table of all rows so far."""
    outcomes: dict[str, int] = {}
    for row in rows:
        outcomes[row["outcome"]] = outcomes.get(row["outcome"], 0) + 1
    print(f"{len(rows)} machines: {outcomes}")
    for row in rows:
        if "hidden" in row:
            print(f"  {row['number']}: {_named(row)}")
        if row["outcome"] != "kept":
            stable = "" if row["old_stable"] else " (old gains are not stable with the new tooling)"
            said = row.get("said", "")
            if "hidden" in row:
                held = (
                    "old parameters held" if row["as_before"] else "PARAMETERS ARE NOT THE OLD ONES"
                )
                said = f"exit code {row['code']}, {held}: {said}"
            else:
                said = said[:230]
            print(f"  {row['number']}{stable}: {row['outcome']}: {said}")
    kept = [row for row in rows if row["outcome"] == "kept"]
    axes = [
        (one, true, row["verification"]["cycle"])
        for row in kept
        if row.get("verification")
        for one, true in zip(row["verification"]["axes"], row["true"], strict=True)
    ]
    if not axes:
        return
    powered = sum(bool(row["powered"]) for row in rows)
    unstable = sum(not true["stable"] for _, true, _ in axes)
    print(
        f"drives left enabled: {powered}; kept axes {len(axes)}, unstable by the truth {unstable}"
    )
    peaks = _pairs(axes, "after", "sensitivity_peak")
    print(f"measured peak of sensitivity: median {np.median(peaks):.3g}, largest {max(peaks):.3g}")
    true_peaks = [true["sensitivity_peak"] for _, true, _ in axes]
    print(
        f"true peak of sensitivity: median {np.median(true_peaks):.3g}, largest {max(true_peaks):.3g}"
    )
    slack = [CYCLES * cycle for *_, cycle in axes]
    before = _pairs(axes, "before", "settling_time")
    after = _pairs(axes, "after", "settling_time")
    predicted = _pairs(axes, "predicted", "settling_time")
    shorter = sum(a < b or (a == 0 and b == 0) for a, b in zip(after, before, strict=True))
    longer = sum(a > SLOWER * b + s for a, b, s in zip(after, before, slack, strict=True))
    print(
        f"settling shorter than before: {shorter} of {len(axes)} ({100 * shorter / len(axes):.0f} %), "
        f"more than 5 % (and 3 cycles) longer: {longer}; median {np.median(before):.3g} s -> "
        f"{np.median(after):.3g} s"
    )
    foreseen = _pairs(axes, "predicted", "sensitivity_peak")
    off = [abs(p / q - 1) for p, q in zip(peaks, foreseen, strict=True)]
    print(
        f"peak against prediction: within 10 % {sum(o <= PEAK_OFF for o in off)} of {len(off)}, "
        f"median {100 * np.median(off):.2g} %, worst {100 * max(off):.2g} %"
    )
    apart = [
        max(0.0, abs(a - p) - s) / max(p, 1e-9) if abs(a - p) > s else 0.0
        for a, p, s in zip(after, predicted, slack, strict=True)
    ]
    print(
        f"settling against prediction: within 15 % (or 3 cycles) {sum(o <= TIME_OFF for o in apart)} of "
        f"{len(apart)}, worst {100 * max(apart):.2g} %"
    )
    latest = _pairs(axes, "predicted", "settling_latest")
    said = [max(p, b if np.isfinite(b) else 0.0) for p, b in zip(predicted, latest, strict=True)]
    inside = [
        p - max(TIME_OFF * p, s) <= a <= b + max(TIME_OFF * b, s)
        for a, p, b, s in zip(after, predicted, said, slack, strict=True)
    ]
    later = sum(b > p for p, b in zip(predicted, said, strict=True))
    print(
        f"  up to the later time that is told where a swing touches the band's edge ({later} axes): "
        f"{sum(inside)} of {len(inside)}"
    )
    print(f"seconds a machine: median {np.median([row['seconds'] for row in rows]):.0f}")


def _named(row: Mapping[str, Any]) -> str:
    """What was hidden, and what criticism said of the machine."""
    found = row["criticism"]
    if found is None:
        return f"{_effect(row['hidden'])}; not criticised"
    causes = ", ".join(_effect(cause) for cause in found["causes"])
    return f"{_effect(row['hidden'])}; {found['verdict']}: {causes or 'no cause'}"


def _effect(effect: Mapping[str, Any]) -> str:
    numbers = {
        name: one["value"] if isinstance(one, Mapping) else one
        for name, one in effect["parameters"].items()
    }
    words = " ".join(f"{name} {value:.3g}" for name, value in numbers.items())
    return f"{effect['effect']} of {effect['axis']} ({effect['location']}) {words}"


def _pairs(axes: list[Any], which: str, name: str) -> list[float]:
    """One figure of every axis; what is infinite or missing counts as such."""
    values = [(one[which] or {}).get(name) for one, _, _ in axes]
    return [float("inf") if value is None else float(value) for value in values]


def main() -> None:
    """Go on with the machines of a seed, and print the table of all so far."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("count", type=int, nargs="?", default=6)
    parser.add_argument("--seed", type=int, help="default: a new one")
    parser.add_argument("--out", type=Path, help="JSON lines, appended; default: none kept")
    parser.add_argument("--only", type=int, nargs="*", help="numbers of these machines alone")
    parser.add_argument("--keep", type=Path, help="keep session folders here")
    parser.add_argument(
        "--hidden", action="store_true", help="hide an effect in each machine, and criticise"
    )
    parser.add_argument("--seconds", type=float, default=1e9, help="begin no machine after these")
    arguments = parser.parse_args()
    seed = arguments.seed
    if seed is None:
        seed = int(np.random.SeedSequence().generate_state(1)[0])
    rows: list[dict[str, Any]] = []
    if arguments.out and arguments.out.is_file():
        rows = [json.loads(line) for line in arguments.out.read_text().splitlines()]
    rows = [row for row in rows if ("hidden" in row) == arguments.hidden]
    done = {row["number"] for row in rows if row["seed"] == seed}
    print(f"seed {seed}, {len(done)} machines done before", flush=True)
    begun = time.perf_counter()
    for number in arguments.only or range(arguments.count):
        if number in done or time.perf_counter() - begun > arguments.seconds:
            continue
        row = tried(seed, number, arguments.keep, hidden=arguments.hidden)
        rows.append(row)
        print(f"  {number}: axes {row['axes']} {row['outcome']} {row['seconds']:.0f} s", flush=True)
        if arguments.out:
            with arguments.out.open("a") as file:
                file.write(json.dumps(row) + "\n")
    _judged(rows)


if __name__ == "__main__":
    main()
