"""Planted disasters in the write of new parameters: ``bench_verify.py N --seed S``.

Random machines (those of ``bench_retune``); the new parameters are the design for the true machine, so
that nothing but the disaster is wrong.  Right after they were written and read back, one of these
happens behind the tool's back, or one is planted in the files before:

    sign       a motor pushes against what its drive asks for
    gain       velocity_p and velocity_i of a drive become 10 times as large in its firmware
    hard       the same 100 times: the loop swings
    position   position_p becomes 10 times as large
    weak       velocity_p and velocity_i become a tenth
    lazy       position_p becomes a tenth
    tuning     the tuning has velocity_p and velocity_i 10 times too large
    model      the session's model has all masses, springs, dampers and couplings times 2, or by 2
    design     the same, and the tuning is the design for that wrong model
    none       nothing: these should be kept
    rough      nothing, but axes have dry friction, coarse encoders, noise of 3 % in the torque, motors
               that lag, delays of the position, cogging, weights: whether they are kept is for the
               judge, but none may be stopped by a watch

What is wanted of all but the last: caught before motion, or stopped and restored; every drive off, every
object as before.

For the first six the time is told from where the disaster first shows until no drive has power, 50 ms
at most.  Where it first shows is found by a twin: the same machine with the same noise, to which the
same is done without the disaster.  It shows in the first of SHOWS samples within OF cycles in which any
drive's told torque is off the twin's by more than SIGMAS standard deviations of its noise and QUANTA
steps of 1/1000 of the rated torque: one sample alone (a step of the encoder that was answered too hard,
and silence after it) is no more than an outlier.  Noise is that of the measured torque, and what the
encoder's steps make of it with the controller that was written.  Nobody without a twin sees it sooner
in a torque.  In parentheses the same from the first samples whose position is off the twin's by COUNTS
counts or whose torque is off: a loop of 2 Hz with the wrong sign needs longer than 50 ms to double such
a way, while its torque is still far below the step in which it is told.  Off is a drive whose statusword
says so in the PDO of a SYNC.  "Before motion" are those that were stopped while all axes were told to
stand; "unseen" those that were stopped in motion before they showed in a torque.

Rows are appended to a file (``--out``), so that pieces add up: the same seed goes on where it ended.
"""

import argparse
import contextlib
import copy
import io
import json
import os
import struct
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import yaml

from drives.profile import MachineProfile, load_machine
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
from fieldtool.experiment.verification.trial import run_trial
from fieldtool.records.model import MachineModel
from fieldtool.records.model_file import read_model, write_model
from fieldtool.records.session_folder import SessionFolder
from fieldtool.workflow.design_inputs import drive_sides, moves_of
from fieldtool.workflow.models import truth_model
from fieldtool.workflow.trial_loops import drive_loop
from fieldtool.workflow.verifying import Verification

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from tests.benchmarks.bench_retune import CHANNEL, random_machine, with_old_gains
from tests.session.conftest import PROCESS_VALUES
from tests.tunings import scale_model

FAULTS = ("sign", "gain", "hard", "position", "weak", "lazy")
DISASTERS = (*FAULTS, "tuning", "model", "design", "none", "rough")
CAUGHT = (3, 4, 6)
COUNTS, SIGMAS, QUANTA = 3.0, 4.0, 2.0
SHOWS, OF = 3, 8
SOONEST = 0.05
CYCLE = 0.001


@dataclass(frozen=True)
class Gains(Fault):
    """Gains of a drive become so many times larger."""

    factor: float = 1.0
    names: tuple[Parameter, ...] = (Parameter.VELOCITY_P, Parameter.VELOCITY_I)

    def set(self, machine: RunningMachine, *, present: bool) -> None:
        """Multiply or divide."""
        k = machine.node(self.node_id).axis
        for name in self.names:
            factor = self.factor if present else 1 / self.factor
            machine.axes.set(k, name, machine.axes.get(k, name) * factor)


@dataclass
class Heard:
    """What drives said on the bus since the new parameters were written: a row a SYNC, by node."""

    most: float = np.inf
    """Rows after which the user stops."""
    rows: dict[int, list[tuple[float, bool, int, int]]] = field(default_factory=dict)
    """Time, s; whether it is enabled; position, counts; torque, 1/1000."""
    told: dict[int, int] = field(default_factory=dict)
    """Target that each drive was told first once it was enabled, counts."""
    moved: bool = False
    """Whether a drive that is enabled was told anything but to stand where it stands."""

    def __call__(self, nanoseconds: int, cob_id: int, data: bytes) -> None:
        if 0x180 < cob_id < 0x200 and len(data) == 8:
            word, position, torque = struct.unpack("<Hih", data)
            row = (1e-9 * nanoseconds, word & 0x6F == 0x27, position, torque)
            rows = self.rows.setdefault(cob_id - 0x180, [])
            rows.append(row)
            if len(rows) == self.most:
                raise KeyboardInterrupt

    def command(self, cob_id: int, data: bytes) -> None:
        """Hear what a drive is told."""
        if 0x200 < cob_id < 0x280 and len(data) == 8:
            word, target, offset = struct.unpack("<Hih", data)
            rows = self.rows.get(cob_id - 0x200)
            if rows and rows[-1][1] and word & 0xF == 0xF:
                stood = self.told.setdefault(cob_id, target)
                self.moved |= abs(target - stood) > COUNTS or offset != 0

    def stopped_after(self, twin: "Heard", noise: dict[int, float]) -> list[float | None]:
        """Return seconds from where it first shows until no drive has power: in torque; in any signal.

        None: it never shows.
        """
        began, off = np.full(2, np.inf), -np.inf
        for node, rows in self.rows.items():
            own, other = np.array(rows), np.array(twin.rows[node][: len(rows)])
            own = own[: len(other)]
            far = np.abs(own[:, 2:] - other[:, 2:]) > (COUNTS, SIGMAS * noise[node] + QUANTA)
            for k, shown in enumerate((far[:, 1], far.any(axis=1))):
                shows = np.flatnonzero(shown)
                for first, last in zip(shows, shows[SHOWS - 1 :], strict=False):
                    if last - first < OF:
                        began[k] = min(began[k], float(own[first, 0]))
                        break
            on = [t for t, enabled, *_ in rows if enabled]
            off = max(off, on[-1] + CYCLE if on else off)
        return [None if t == np.inf else max(0.0, off - t) for t in began.tolist()]


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


def planted(seed: int, number: int, disaster: str, cycles: int | None = None) -> dict[str, Any]:
    """Write once with one disaster; return what came of it; the trial ends after so many cycles."""
    rng = np.random.default_rng([seed, number, 2])
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        os.environ["FIELDTOOL_STATE_DIR"] = str(folder / "notes")
        text, good = prepared(seed, number, rough=disaster == "rough")
        (folder / "machine.yaml").write_text(text)
        machine = load_machine(folder / "machine.yaml")
        session = _session(machine, folder, disaster, good, rng)
        running = register(CHANNEL, simulated_machine(machine))
        heard = Heard()
        running.listen(heard)
        receive = running.receive

        def received(cob_id: int, data: bytes | bytearray) -> bool:
            heard.command(cob_id, bytes(data))
            return receive(cob_id, data)

        before = objects(running)
        node = int(rng.choice([n.node_id for n in running.nodes]))
        faults: dict[str, Fault] = {
            "sign": MotorReversed(node),
            "gain": Gains(node, 10.0),
            "hard": Gains(node, 100.0),
            "position": Gains(node, 10.0, (Parameter.POSITION_P,)),
            "weak": Gains(node, 0.1),
            "lazy": Gains(node, 0.1, (Parameter.POSITION_P,)),
        }
        fault = faults.get(disaster)
        prove, noise = Verification.prove, [0.0] * len(machine.axes)

        def tried(group: Any, trial: Any, axes: Any, keep: Any, name: str, **more: Any) -> Any:
            if disaster in (*FAULTS, "twin") and name == "before":  # saves time
                trial = replace(trial, excitation=None)
            return run_trial(group, trial, axes, keep, name, **more)

        def spoiled(one: Verification) -> None:
            pairs = zip(one._group.drives, one._planned.new, strict=True)
            noise[:] = [drive_loop(*pair).noise for pair in pairs]
            heard.rows.clear()
            heard.told.clear()
            heard.moved = False
            heard.most = cycles or np.inf
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
                patch.object(running, "receive", received),
                patch("fieldtool.workflow.verifying.run_trial", tried),
                contextlib.redirect_stderr(said),
                contextlib.redirect_stdout(io.StringIO()),
            ):
                try:
                    tool(["write", str(session), "--yes", "--store"])
                except SystemExit as ended:
                    code = ended.code or 0
            return {
                "disaster": disaster,
                "code": code,
                "said": " ".join(said.getvalue().split()),
                "powered": [n.node_id for n in running.nodes if n.motion.powered],
                "changed": sum(before[k] != v for k, v in objects(running).items()),
                "stored": any(n.memory.stored for n in running.nodes),
                "heard": heard,
                "noise": {
                    n.node_id: 1000 * np.hypot(one.torque_noise, loop) / one.rated_torque
                    for n, one, loop in zip(
                        running.nodes, machine.simulation.axes, noise, strict=True
                    )
                },
            }
        finally:
            unregister(CHANNEL)


def judged(seed: int, number: int, disasters: Sequence[str]) -> Iterator[dict[str, Any]]:
    """Plant disasters in one machine; tell by a twin without them when they showed, and how long."""
    timed = []
    for disaster in disasters:
        begun = time.process_time()
        row = planted(seed, number, disaster)
        heard, noise = row.pop("heard"), row.pop("noise")
        row |= {"seed": seed, "number": number, "after": [None, None], "moved": heard.moved}
        row["seconds"] = time.process_time() - begun
        if disaster in FAULTS and heard.rows:
            timed.append((row, heard, noise))
        else:
            yield row
    if timed:
        cycles = max(len(rows) for _, heard, _ in timed for rows in heard.rows.values())
        twin = planted(seed, number, "twin", cycles + 1)["heard"]
        for row, heard, noise in timed:
            row["after"] = heard.stopped_after(twin, noise)
            yield row


def roughen(data: dict[str, Any], rng: np.random.Generator) -> None:
    """Give each axis of a machine some of what real ones have."""
    for axis, truth in zip(data["axes"], data["simulation"]["axes"], strict=True):
        limit = float(axis["limits"]["torque"].split()[0])
        own = {
            "coulomb_friction": {"torque": limit * float(rng.uniform(0.005, 0.04))},
            "torque_lag": {"time": float(rng.uniform(0.2e-3, 1e-3))},
            "measurement_delay": {"time": int(rng.integers(1, 9)) / 8000},
            "cogging": {"torque": limit * float(rng.uniform(0.002, 0.01)), "periods": 24},
            "gravity": {"torque": limit * float(rng.uniform(0.002, 0.01)), "angle": 0.7},
        }
        truth["effects"] = [
            {"effect": name, **values} for name, values in own.items() if rng.random() < 0.4
        ]
        truth["torque_noise"] = truth["rated_torque"] * float(rng.choice([1e-3, 0.01, 0.03]))
        truth["encoder_counts_per_rev"] = int(2 ** rng.integers(16, 23))


@lru_cache(maxsize=2)
def prepared(seed: int, number: int, *, rough: bool) -> tuple[str, dict[str, Any]]:
    """Return a machine's profile, and the design for it as it truly is, as plain values.

    Its drives hold the rule's gains for the true machine: what is old is good.
    """
    data = random_machine(np.random.default_rng([seed, number]))
    if rough:
        roughen(data, np.random.default_rng([seed, number, 1]))
    with tempfile.TemporaryDirectory() as name:
        session = Path(name)
        machine, _ = with_old_gains(data, session)
        for axis, loop in zip(data["simulation"]["axes"], rule(_truth(machine)), strict=True):
            axis["gains"] |= {
                "position_p": 0.7 * loop.position_p,
                "velocity_p": 0.7 * loop.velocity_p,
                "velocity_i": 0.4 * loop.velocity_i,
            }
        for axis, truth in zip(data["axes"], machine.simulation.axes, strict=True):
            axis["encoder_counts_per_rev"] = truth.encoder_counts_per_rev
        text = yaml.safe_dump(data)
        machine.path.write_text(text)
        machine = load_machine(machine.path)
        write_model(_truth(machine), session / "model.yaml")
        return text, _designed(session, machine)


def _truth(machine: MachineProfile) -> MachineModel:
    truth = truth_model(machine)
    if truth is None:
        raise AssertionError("a simulated machine has a truth")
    return truth


def _designed(session: Path, machine: MachineProfile) -> dict[str, Any]:
    """Return the design for the model in a session folder."""
    sides = drive_sides(SessionFolder(session), machine, CYCLE)
    believed = read_model(session / "model.yaml")
    return tuning_as_dict(design(believed, sides, moves_of(machine, believed)))


def _session(
    machine: MachineProfile,
    folder: Path,
    disaster: str,
    good: dict[str, Any],
    rng: np.random.Generator,
) -> Path:
    """Return a session folder with the true model and the design for it, or spoiled ones."""
    session = folder / "session"
    session.mkdir()
    (session / "machine.yaml").write_text(machine.path.read_text())
    model, factor = session / "model.yaml", float(rng.choice([0.5, 2.0]))
    write_model(_truth(machine), model)
    data = copy.deepcopy(good)
    if disaster in ("model", "design"):
        scale_model(model, factor)
    if disaster == "design":
        data = _designed(session, machine)
    if disaster == "tuning":
        wrong = rng.choice(data["axes"])
        for name in ("velocity_p", "velocity_i"):
            wrong["parameters"][name] *= 10.0
    (session / "tuning.yaml").write_text(yaml.safe_dump(data))
    return session


def main() -> None:
    """Plant each disaster in so many machines, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("count", type=int, nargs="?", default=3)
    parser.add_argument("--seed", type=int, help="default: a new one")
    parser.add_argument("--only", nargs="*", default=DISASTERS, choices=DISASTERS)
    parser.add_argument("--out", type=Path, help="JSON lines, appended; default: none kept")
    parser.add_argument("--seconds", type=float, default=1e9, help="begin no machine after these")
    arguments = parser.parse_args()
    seed = arguments.seed
    if seed is None:
        seed = int(np.random.SeedSequence().generate_state(1)[0])
    rows: list[dict[str, Any]] = []
    if arguments.out and arguments.out.is_file():
        rows = [json.loads(line) for line in arguments.out.read_text().splitlines()]
        rows = [row for row in rows if row["seed"] == seed]
    done = {(row["number"], row["disaster"]) for row in rows}
    begun = time.perf_counter()
    for number in range(arguments.count):
        wanted = [one for one in arguments.only if (number, one) not in done]
        if time.perf_counter() - begun > arguments.seconds:
            continue
        for row in judged(seed, number, wanted):
            rows.append(row)
            if arguments.out:
                with arguments.out.open("a") as file:
                    file.write(json.dumps(row) + "\n")
    table(seed, rows)


def table(seed: int, rows: list[dict[str, Any]]) -> None:
    """Print what came of all disasters so far."""
    print(f"seed {seed}")
    print(
        f"{'disaster':>10} {'caught':>8} {'codes':>16} {'not as before':>14} {'on':>3}  stopped after"
    )
    for disaster in DISASTERS:
        own = [row for row in rows if row["disaster"] == disaster]
        if not own:
            continue
        caught = sum(row["code"] in CAUGHT for row in own)
        spoiled = sum(bool(row["changed"] or row["stored"]) for row in own)
        codes = dict(Counter(row["code"] for row in own))
        print(
            f"{disaster:>10} {caught:>5}/{len(own):<2} {codes!s:>16} {spoiled:>14} "
            f"{sum(bool(row['powered']) for row in own):>3}  {_times(own)}"
        )
        for row in own:
            expected = row["code"] in CAUGHT
            if disaster in ("none", "rough"):
                stopped = "its power was cut" in row["said"]
                expected = not stopped if disaster == "rough" else row["code"] == 0
            late = row["moved"] and (row["after"][0] or 0.0) > SOONEST
            if not expected or late:
                after = f", {1000 * row['after'][0]:.0f} ms" if late else ""
                print(f"             {row['number']}: {row['code']}{after}: {row['said'][:260]}")


def _times(rows: list[dict[str, Any]]) -> str:
    """How soon they were stopped, in words; empty for what is not timed."""
    if rows[0]["disaster"] not in FAULTS:
        return ""
    moved = [row for row in rows if row["moved"]]
    shown, counted = ([t for row in moved if (t := row["after"][k]) is not None] for k in (0, 1))
    text = f"{len(rows) - len(moved)} before motion, {len(moved) - len(shown)} unseen"
    for before, times, behind in (("; ", shown, ""), (" (", counted, ")")):
        if times:
            text += (
                f"{before}of {len(times)} median {1000 * np.median(times):.0f}, longest "
                f"{1000 * max(times):.0f} ms, {sum(t <= SOONEST for t in times)} within 50 ms{behind}"
            )
    return text


if __name__ == "__main__":
    main()
