"""Planted disasters in the write of new parameters: ``bench_verify.py N --seed S``.

Random machines (those of ``bench_retune``); the new parameters are the design for the true machine, so
that nothing but the disaster is wrong.  Right after they were written and read back, one of these
happens behind the tool's back, or one is planted in the files before:

    sign       a motor pushes against what its drive asks for
    gain       velocity_p and velocity_i of a drive become 10 times as large in its firmware
    hard       the same 100 times: the loop swings
    tuning     the tuning has velocity_p and velocity_i 10 times too large
    model      the session's model has all masses, springs, dampers and couplings times 2, or by 2
    none       nothing: these should be kept

What is wanted of all but the last: caught before motion, or stopped and restored; every drive off, every
object as before.  For those that swing: the time from where a torque first swings by a tenth of its
limit (a fifth while an axis is moved), peak to peak and to and fro, until no drive has power, as heard
on the bus: 50 ms at most.
"""

import argparse
import contextlib
import io
import os
import struct
import sys
import tempfile
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import yaml

from drives.profile import MachineProfile
from drives.sim.entries import ENTRIES
from drives.sim.faults import Fault, MotorReversed
from drives.sim.firmware import Parameter
from drives.sim.lockstep_bus import register, unregister
from drives.sim.machine import simulated_machine
from drives.sim.running import RunningMachine
from fieldtool.cli.main import main as tool
from fieldtool.design.decide import design
from fieldtool.design.rule import rule
from fieldtool.design.tuning_file import tuning_as_dict
from fieldtool.experiment.verification.trial import _Excited, _Steps
from fieldtool.records.model import MachineModel
from fieldtool.records.model_file import write_model
from fieldtool.records.session_folder import SessionFolder
from fieldtool.workflow.design_inputs import drive_sides, moves_of
from fieldtool.workflow.models import truth_model
from fieldtool.workflow.verifying import Verification

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from tests.benchmarks.bench_retune import CHANNEL, random_machine, with_old_gains
from tests.session.conftest import PROCESS_VALUES
from tests.tunings import scale_model

DISASTERS = ("sign", "gain", "hard", "tuning", "model", "none")
CAUGHT = (3, 4, 6)
SWINGS, MOVES, WINDOW = 0.1, 0.2, 0.03
SOONEST = 0.05


@dataclass(frozen=True)
class Gains(Fault):
    """Gains of a drive become so many times larger."""

    factor: float = 1.0

    def set(self, machine: RunningMachine, *, present: bool) -> None:
        """Multiply or divide."""
        k = machine.node(self.node_id).axis
        for name in (Parameter.VELOCITY_P, Parameter.VELOCITY_I):
            factor = self.factor if present else 1 / self.factor
            machine.axes.set(k, name, machine.axes.get(k, name) * factor)


@dataclass
class Heard:
    """What drives said on the bus: time, power, torque in per mille."""

    rows: dict[int, list[tuple[float, bool, int, float]]] = field(default_factory=dict)
    level: float = SWINGS
    """Share of the torque limit that counts as a swing now."""

    def __call__(self, time: int, cob_id: int, data: bytes) -> None:
        if 0x180 < cob_id < 0x200 and len(data) == 8:
            word, _, torque = struct.unpack("<Hih", data)
            row = (1e-9 * time, word & 0x6F == 0x27, torque, self.level)
            self.rows.setdefault(cob_id - 0x180, []).append(row)

    def stopped_after(self, limits: dict[int, float]) -> float | None:
        """Seconds from where a torque first swings until no drive has power; None: none did."""
        last_on = max(t for rows in self.rows.values() for t, on, *_ in rows if on)
        first = [self._swings(rows, limits[node]) for node, rows in self.rows.items()]
        began = min((t for t in first if t is not None), default=None)
        return None if began is None else max(0.0, last_on - began)

    @staticmethod
    def _swings(rows: list[tuple[float, bool, int, float]], limit: float) -> float | None:
        time = np.array([t for t, *_ in rows])
        torque = np.array([q for _, _, q, _ in rows], dtype=float)
        level = np.array([share for *_, share in rows]) * limit
        width = max(3, int(np.searchsorted(time, time[0] + WINDOW)))
        for k in range(width, time.size):
            part = torque[k - width : k + 1]
            if np.ptp(part) > level[k]:
                off = part - (part.max() + part.min()) / 2
                sides = np.sign(off[np.abs(off) > level[k] / 4])
                if np.count_nonzero(np.diff(sides)) >= 2:
                    return float(time[k])
        return None


def objects(running: RunningMachine) -> dict[tuple[int, int, int], Any]:
    """Every object of every node that a motion does not change by what it is."""
    return {
        (node.node_id, *key): _on_the_wire(node.dictionary.read(*key))
        for node in running.nodes
        for key, entry in ENTRIES.items()
        if entry.access != "wo" and key not in PROCESS_VALUES
    }


def _on_the_wire(value: Any) -> Any:
    return float(np.float32(value)) if isinstance(value, float) else value


def planted(seed: int, number: int, disaster: str) -> dict[str, Any]:
    """Write once with one disaster; return what came of it."""
    rng = np.random.default_rng([seed, number])
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        os.environ["FIELDTOOL_STATE_DIR"] = str(folder / "notes")
        machine, _ = with_old_gains(random_machine(rng), folder)
        truth = truth_model(machine)
        if truth is None:
            raise AssertionError("a simulated machine has a truth")
        machine = _with_stable_gains(machine, truth, folder)
        session = _session(machine, truth, folder, disaster, rng)
        running = register(CHANNEL, simulated_machine(machine))
        heard = Heard()
        running.listen(heard)
        before = objects(running)
        node = int(rng.choice([n.node_id for n in running.nodes]))
        faults: dict[str, Fault] = {
            "sign": MotorReversed(node),
            "gain": Gains(node, 10.0),
            "hard": Gains(node, 100.0),
        }
        fault = faults.get(disaster)
        prove, move, excite = Verification.prove, _Steps.move, _Excited.motion

        def moving(steps: _Steps, one: Any) -> None:
            heard.level = MOVES
            move(steps, one)

        def exciting(mover: _Excited, *arguments: Any, **options: Any) -> Any:
            heard.level = np.inf
            return excite(mover, *arguments, **options)

        def spoiled(one: Verification) -> None:
            heard.rows.clear()
            heard.level = SWINGS
            if fault is not None:
                running.inject(fault)
            try:
                prove(one)
            finally:
                if fault is not None:
                    running.lift(fault)

        try:
            said = io.StringIO()
            code: Any = 0
            with (
                patch.object(Verification, "prove", spoiled),
                patch.object(_Steps, "move", moving),
                patch.object(_Excited, "motion", exciting),
                contextlib.redirect_stderr(said),
                contextlib.redirect_stdout(io.StringIO()),
            ):
                try:
                    tool(["write", str(session), "--yes", "--store"])
                except SystemExit as ended:
                    code = ended.code or 0
            limits = {
                axis.node_id: 1000 * axis.limits.torque / one.rated_torque
                for axis, one in zip(machine.axes, machine.simulation.axes, strict=True)
            }
            return {
                "disaster": disaster,
                "code": code,
                "said": " ".join(said.getvalue().split()),
                "powered": [n.node_id for n in running.nodes if n.motion.powered],
                "changed": sum(before[k] != v for k, v in objects(running).items()),
                "stored": any(n.memory.stored for n in running.nodes),
                "after": heard.stopped_after(limits) if fault and heard.rows else None,
            }
        finally:
            unregister(CHANNEL)


def _with_stable_gains(machine: MachineProfile, truth: MachineModel, folder: Path) -> Any:
    """Give the drives the rule's gains for the true machine: what is old here is good."""
    data = yaml.safe_load(machine.path.read_text())
    for axis, loop in zip(data["simulation"]["axes"], rule(truth), strict=True):
        axis["gains"] |= {
            "position_p": 0.7 * loop.position_p,
            "velocity_p": 0.7 * loop.velocity_p,
            "velocity_i": 0.4 * loop.velocity_i,
        }
    machine.path.write_text(yaml.safe_dump(data))
    from drives.profile import load_machine

    return load_machine(machine.path)


def _session(
    machine: Any, truth: MachineModel, folder: Path, disaster: str, rng: np.random.Generator
) -> Path:
    """Return a session folder with the true model and the design for it, or spoiled ones."""
    session = folder / "session"
    session.mkdir()
    (session / "machine.yaml").write_text(machine.path.read_text())
    sides = drive_sides(SessionFolder(session), machine, 0.001)
    tuning = design(truth, sides, moves_of(machine, truth))
    data = tuning_as_dict(tuning)
    if disaster == "tuning":
        wrong = rng.choice(data["axes"])
        for name in ("velocity_p", "velocity_i"):
            wrong["parameters"][name] *= 10.0
    (session / "tuning.yaml").write_text(yaml.safe_dump(data))
    write_model(truth, session / "model.yaml")
    if disaster == "model":
        scale_model(session / "model.yaml", float(rng.choice([0.5, 2.0])))
    return session


def main() -> None:
    """Plant each disaster in so many machines, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("count", type=int, nargs="?", default=3)
    parser.add_argument("--seed", type=int, help="default: a new one")
    parser.add_argument("--only", nargs="*", default=DISASTERS, choices=DISASTERS)
    arguments = parser.parse_args()
    seed = arguments.seed
    if seed is None:
        seed = int(np.random.SeedSequence().generate_state(1)[0])
    print(f"seed {seed}, {arguments.count} machines")
    print(
        f"{'disaster':>10} {'caught':>8} {'codes':>16} {'not as before':>14} {'on':>3}  stopped after"
    )
    for disaster in arguments.only:
        rows = [planted(seed, number, disaster) for number in range(arguments.count)]
        caught = sum(row["code"] in CAUGHT for row in rows)
        spoiled = sum(bool(row["changed"] or row["stored"]) for row in rows)
        times = [row["after"] for row in rows if row["after"] is not None]
        shown = (
            f"{len(times)} swung; longest {1000 * max(times):.0f} ms, "
            f"{sum(t <= SOONEST for t in times)} within 50 ms"
            if times
            else ""
        )
        codes = dict(Counter(row["code"] for row in rows))
        print(
            f"{disaster:>10} {caught:>5}/{len(rows):<2} {codes!s:>16} {spoiled:>14} "
            f"{sum(bool(row['powered']) for row in rows):>3}  {shown}",
            flush=True,
        )
        for row in rows:
            expected = row["code"] == 0 if disaster == "none" else row["code"] in CAUGHT
            if not expected:
                print(f"             {row['code']}: {row['said'][:300]}")


if __name__ == "__main__":
    main()
