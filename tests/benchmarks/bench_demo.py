"""How well and how fast the classic plan works: ``python tests/benchmarks/bench_demo.py``.

The packaged simulated machine as ``fieldtool demo`` runs it, each time with another seed of its
noise: error of every parameter, wall and machine time, and how long the screen stood still.
Targets of the project: masses and springs within 2 %, couplings within 5 % with the right signs,
under 3 minutes on 2 cores.
"""

import argparse
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from drives.profile import MachineProfile, load_machine
from drives.sim.lockstep_bus import register, unregister
from drives.sim.machine import simulated_machine
from fieldtool import workflow
from fieldtool.experiment.forecast import AxisForecast
from fieldtool.experiment.multisine.runner import MultisineProgress
from fieldtool.experiment.stepped.plan import SweepPlan
from fieldtool.experiment.stepped.runner import Progress
from fieldtool.records.model import MachineModel
from fieldtool.workflow import Options, Quiet, SessionResult
from fieldtool.workflow.planning import PlannedFast

LIMITS = {"mass": 2.0, "spring": 2.0, "coupling": 5.0}
"""Per cent."""
CHANNEL = "bench-demo"


@dataclass
class Watch(Quiet):
    """A screen that notes when it is told something."""

    told: list[tuple[float, str]] = field(default_factory=list)
    bar: list[float] = field(default_factory=list)

    def __post_init__(self) -> None:
        self._tell("start")

    def _tell(self, what: str) -> None:
        self.told.append((time.perf_counter(), what))

    def stage(self, title: str) -> None:
        self._tell(title)

    def say(self, sentence: str) -> None:
        self._tell(sentence)

    def plan(self, plan: SweepPlan, expected: Sequence[AxisForecast], duration: float) -> None:
        self._tell("plan")

    def fast_plan(self, planned: PlannedFast) -> None:
        self._tell("plan")

    def progress(self, progress: Progress | MultisineProgress) -> None:
        self._tell(progress.name)
        self.bar.append(self.told[-1][0])

    def longest_silence(self) -> tuple[float, str]:
        """Return the longest time in which nothing was told, and what was told before it."""
        self._tell("end")
        times = np.array([moment for moment, _ in self.told])
        worst = int(np.argmax(np.diff(times)))
        return float(np.diff(times)[worst]), self.told[worst][1]

    def longest_stand(self) -> float:
        """Return the longest time between two moves of the bar, planning in between included."""
        return float(np.diff(self.bar).max())


def rows(
    found: MachineModel, truth: MachineModel
) -> Iterator[tuple[str, str, float, float, float]]:
    """Kind, name, true value, error in per cent, error in its own standard errors."""
    for axis, true in zip(found.axes, truth.axes, strict=True):
        for kind, plural in (("mass", "masses"), ("spring", "springs"), ("damper", "dampers")):
            pairs = zip(getattr(axis, plural), getattr(true, plural), strict=False)
            for k, (value, wanted) in enumerate(pairs, start=1):
                off = value.value - wanted.value
                yield (
                    kind, f"{axis.name} {kind} {k}", wanted.value,
                    100 * off / wanted.value, off / value.std,
                )  # fmt: skip
    true_values = {tuple(sorted(c.axes)): c.value for c in truth.couplings}
    for coupling in found.couplings:
        wanted_value = true_values[tuple(sorted(coupling.axes))]
        off = coupling.value - wanted_value
        name = f"{' - '.join(coupling.axes)} coupling"
        yield "coupling", name, wanted_value, 100 * off / wanted_value, off / coupling.std


CLASSIC = Options(plan="classic", write=True)


@contextmanager
def on_the_bus(name: str, seed: int) -> Iterator[MachineProfile]:
    """The machine of this name with this seed of its noise, on a bus of its own."""
    machine = load_machine(name)
    if machine.simulation is None:
        raise SystemExit(f"machine {name} has no simulation")
    machine = machine.model_copy(
        update={
            "simulation": machine.simulation.model_copy(update={"seed": seed}),
            "bus": machine.bus.model_copy(update={"channel": CHANNEL}),
        }
    )
    register(CHANNEL, simulated_machine(machine))
    try:
        yield machine
    finally:
        unregister(CHANNEL)


def run(
    name: str, seed: int, folder: Path, options: Options = CLASSIC
) -> tuple[SessionResult, Watch]:
    """One session on the machine of this name with this seed of its noise."""
    watch = Watch()
    with on_the_bus(name, seed) as machine:
        result = workflow.run(machine, folder, options, screen=watch, confirm=lambda _: True)
    return result, watch


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--machine", default="paper-3x3")
    parser.add_argument("--seeds", type=int, nargs="*", help="default: 3 new ones")
    arguments = parser.parse_args()
    seeds = arguments.seeds or [int(s) for s in np.random.SeedSequence().generate_state(3)]
    errors: dict[str, list[tuple[float, float]]] = {}
    kinds: dict[str, tuple[str, float]] = {}
    print(f"{arguments.machine}, classic plan")
    print(
        f"{'seed':>12} {'wall s':>8} {'machine s':>10} {'silence s':>10} {'bar stood s':>12}  "
        "silent after"
    )
    for seed in seeds:
        with tempfile.TemporaryDirectory() as folder:
            result, watch = run(arguments.machine, seed, Path(folder) / "session")
        silence, after = watch.longest_silence()
        print(
            f"{seed:12d} {result.wall_time:8.1f} {result.machine_time:10.0f} {silence:10.2f} "
            f"{watch.longest_stand():12.2f}  {after[:60]}",
            flush=True,
        )
        if result.truth is None:
            raise SystemExit("the truth of this machine is not known")
        for kind, name, true, error, sigmas in rows(result.model, result.truth):
            errors.setdefault(name, []).append((error, sigmas))
            kinds[name] = kind, true
    print()
    print(f"{'parameter':<26}{'truth':>8}  {'error of each seed, % (standard errors)':<48} worst %")
    for name, found in errors.items():
        cells = " ".join(f"{error:+8.3f} ({sigmas:+5.1f})" for error, sigmas in found)
        worst = max(abs(error) for error, _ in found)
        limit = LIMITS.get(kinds[name][0])
        verdict = "" if limit is None else f" of {limit:g}{'' if worst <= limit else ' MISSED'}"
        print(f"{name:<26}{kinds[name][1]:8g}  {cells:<48} {worst:7.3f}{verdict}")


if __name__ == "__main__":
    main()
