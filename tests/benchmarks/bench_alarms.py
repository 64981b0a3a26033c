"""Do the watches for encoders and motors stay quiet on sound machines, and when do they see a fault?

Random machines of two kinds.  Two coupled axes: dry friction up to a fifth of the torque limit (Coulomb,
Stribeck), backlash, encoders of 2000 to 8 million counts a turn, soft and stiff springs, slow and fast
loops, noisy torques, prior masses wrong by up to a factor of two, slow and fast buses; on half of the
axes one thing more: weights, magnets that cog, parts that hang on springs, what shakes the machine,
delays, encoder errors.  And every third one of ``bench_retune``: one to three coupled axes of one to
three masses.  Each is measured by the fast plan on the lock-step bus, as a user would.  Of every second
machine the watches do not get 4 % of the samples, as on a bus that loses cycles; of every second pair
of machines a third of the SYNCs comes late, by 3 % of a cycle in the mean.

A false alarm is exit code 4, but for a torque above its limit, which is true where it is said.
``dead``, ``pushed`` and ``energy`` are the worst shares of the watches' bounds that sound axes came
to: 1 is an alarm.  Loops are stiff enough to move their axis against its friction, as a drive that was
set up once is.

Each machine that is sound is then measured again, with a motor that is reversed at a drawn moment of
the measurement: what stops it, after how many cycles, and after how far.

Target: no false alarm; every reversed motor stopped.

Run: python tests/benchmarks/bench_alarms.py [--seed S] [--machines N] [--reversals N]
"""

import argparse
import os
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from typing import Any
from unittest.mock import patch

import bench_retune
import numpy as np
import yaml

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from drives.canopen_drive.channel import Channel
from drives.canopen_drive.energy import Balance
from drives.canopen_drive.motion import CanopenMotion
from drives.canopen_drive.pace import LATE_SHARE
from drives.canopen_drive.sync import HostSync
from drives.canopen_drive.unseen import STOOD, Unseen
from drives.profile import load_machine
from drives.sim.faults import MotorReversed
from drives.sim.lockstep_bus import register, unregister
from drives.sim.machine import simulated_machine
from drives.sim.running import RunningMachine
from drives.sim.state_machine import State
from tests.faults.bench import command
from tests.late_syncs import giving_late
from tests.session.conftest import two_axes

TORQUE = 6.0
"""N m, the limit of both axes."""
WIDEST = 0.015
"""rad by which friction may hold an axis beside its target."""
SAG = 0.003
"""rad by which a weight may pull an axis down before its loop holds it."""
LOST = 0.04
"""Share of the samples that the watch does not get, of every second machine."""
LATE, LATE_BY = 0.3, 0.03
"""Share of the SYNCs that come late, of every second pair of machines; by so much of a cycle, in the
mean, but not so late that the cycle counts as a late one."""
worst = {"dead": 0.0, "pushed": 0.0, "energy": 0.0}


def _one_thing_more(rng: np.random.Generator) -> dict[str, Any]:
    """Return an effect that a sound axis may have."""
    share, phase = float(rng.uniform(0.2, 1.0)), float(rng.uniform(0, 6.28))
    kinds: list[dict[str, Any]] = [
        {"effect": "gravity", "torque": 0.01 * TORQUE * share, "angle": phase},
        {
            "effect": "cogging",
            "torque": 0.05 * TORQUE * share,
            "periods": int(rng.integers(4, 60)),
            "phase": phase,
        },
        {
            "effect": "periodic_disturbance",
            "torque": 0.02 * TORQUE * share,
            "frequency": float(rng.uniform(1.0, 50.0)),
        },
        {
            "effect": "extra_mode",
            "inertia": 0.01 * share,
            "frequency": float(np.exp(rng.uniform(np.log(2.0), np.log(40.0)))),
        },
        {"effect": "measurement_delay", "time": 0.002 * share},
        {"effect": "torque_lag", "time": 0.001 * share},
        {
            "effect": "encoder_error",
            "amplitude": 5e-4 * share,
            "periods": int(rng.integers(1, 100)),
            "phase": phase,
        },
    ]
    return kinds[rng.integers(len(kinds))]


def random_machine(rng: np.random.Generator) -> tuple[dict[str, Any], str]:
    """Return a machine profile, and what is special of it in words."""
    profile = two_axes()
    profile["bus"]["bitrate"] = int(rng.choice([500_000, 1_000_000]))
    said = [f"{profile['bus']['bitrate'] // 1000} kbit/s"]
    prior = float(np.exp(rng.uniform(-np.log(2), np.log(2))))
    soft = float(np.exp(rng.uniform(np.log(0.3), np.log(3))))
    for axis, truth in zip(profile["axes"], profile["simulation"]["axes"], strict=True):
        counts = round(np.exp(rng.uniform(np.log(2000), np.log(2**23))))
        truth["encoder_counts_per_rev"] = counts
        truth["springs"] = [soft * k for k in truth["springs"]]
        axis["prior"]["springs"] = list(truth["springs"])
        axis["prior"]["masses"] = [prior * m for m in axis["prior"]["masses"]]
        truth["torque_noise"] = float(rng.choice([0.0, 0.004, 0.02]))
        slow = float(rng.uniform(0.4, 1.4))
        truth["gains"] |= {
            "position_p": 15 * slow,
            "velocity_p": 1.2 * min(slow, 1.0),
            "velocity_i": 8 * slow * slow,
        }
        effects = []
        torque = float(rng.choice([0.0, 0.02, 0.1, 0.2])) * TORQUE * float(rng.uniform(0.8, 1.0))
        gains = truth["gains"]
        short = torque / (gains["position_p"] * gains["velocity_p"]) / WIDEST
        if short > 1:
            gains["position_p"] *= short**0.5
            gains["velocity_p"] *= short**0.5
            gains["velocity_i"] *= short
        if torque and rng.random() < 0.5:
            effects.append({"effect": "coulomb_friction", "location": "motor", "torque": torque})
        elif torque:
            effects.append(
                {
                    "effect": "stribeck_friction",
                    "location": "motor",
                    "torque": 0.7 * torque,
                    "breakaway": torque,
                    "velocity": 0.1,
                }
            )
        if truth["springs"] and rng.random() < 0.4:
            effects.append({"effect": "backlash", "joint": 1, "play": 0.002})
        backlash = any(one["effect"] == "backlash" for one in effects)
        more = _one_thing_more(rng) if rng.random() < 0.5 else None
        if more and more["effect"] == "cogging":
            # friction holds it where it begins: else it leaves before its drive is enabled
            more["torque"] = min(more["torque"], torque)
            more = more if torque else None
        if more:
            if more["effect"] == "gravity":  # what its loops hold when its brake opens
                more["torque"] = min(
                    more["torque"], SAG * gains["position_p"] * gains["velocity_p"]
                )
            effects.append(more)
            axis["may_float"] = axis["may_float"] and more["effect"] != "gravity"
        truth["effects"] = effects
        said.append(
            f"{axis['name']}: {counts} counts, friction {100 * torque / TORQUE:.0f} %, loops x{slow:.1f}"
            f"{', backlash' if backlash else ''}{', ' + str(more) if more else ''}"
        )
    said.append(f"springs x{soft:.1f}, prior masses x{prior:.1f}")
    return profile, "; ".join(said)


def drawn_machine(rng: np.random.Generator, number: int) -> tuple[dict[str, Any], str]:
    """Return a machine profile of the kind that this number has, and what is special of it."""
    if number % 3 < 2:
        return random_machine(rng)
    profile = bench_retune.random_machine(rng)
    with tempfile.TemporaryDirectory() as name:
        bench_retune.with_old_gains(profile, Path(name))
    masses = [len(axis["masses"]) for axis in profile["simulation"]["axes"]]
    return profile, f"new tooling, axes of {masses} masses"


def main() -> int:
    """Measure them; return 1 if a watch stopped one that is sound, or none stopped a reversed motor."""
    options = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    options.add_argument("--seed", type=int)
    options.add_argument("--machines", type=int, default=24)
    options.add_argument("--reversals", type=int, default=1, help="of each machine")
    given = options.parse_args()
    seed = given.seed
    if seed is None:
        seed = int(np.random.SeedSequence().generate_state(1)[0])
    print(f"seed {seed}, {given.machines} machines", flush=True)
    bench = Bench(np.random.default_rng([seed, given.machines]))
    began, false, most, codes = time.process_time(), 0, [0.0, 0.0, 0.0], []
    stops: list[Stop] = []
    for k in range(given.machines):
        profile, said = drawn_machine(np.random.default_rng([seed, k]), k)
        worst.update(dead=0.0, pushed=0.0, energy=-1.0)
        bench.loses = LOST * (k % 2)
        bench.late = k // 2 % 2 == 1
        said += ", cycles lost" * (k % 2) + ", SYNC late" * bench.late
        code, text = bench.measured(profile)
        alarm = code == 4 and "is above the limit" not in text
        false += alarm
        codes.append(code)
        most = [max(a, b) for a, b in zip(most, worst.values(), strict=True)]
        shares = ", ".join(f"{name} {share:.2f}" for name, share in worst.items())
        print(f"{k:3} code {code}  {shares}  {said}{'  FALSE ALARM' if alarm else ''}", flush=True)
        if code:
            print(f"      {text[:300]}", flush=True)
            continue
        samples, rng = bench.samples, np.random.default_rng([seed, k, 1])
        for _ in range(given.reversals):
            node = int(rng.choice([axis["node_id"] for axis in profile["axes"]]))
            stop = bench.reversed(profile, node, int(rng.integers(1, samples)))
            stops.append(stop)
            print(f"      {stop}", flush=True)
    print(
        f"{given.machines} sound machines, {false} false alarms, {codes.count(0)} measured to the end; "
        f"worst share of the bounds: dead {most[0]:.2f}, pushed {most[1]:.2f}, energy {most[2]:.2f}"
    )
    for name in ("its energy", "another watch or limit", "NOTHING"):
        of_these = [stop for stop in stops if stop.stopped_by == name]
        if of_these:
            cycles = sorted(stop.cycles for stop in of_these)
            ways = sorted(stop.way for stop in of_these)
            print(
                f"{len(of_these)} of {len(stops)} reversed motors stopped by {name}, after "
                f"{np.median(cycles):.0f} cycles (at most {cycles[-1]:.0f}), {np.median(ways):.2g} rad "
                f"(at most {ways[-1]:.2g})"
            )
    print(f"{time.process_time() - began:.0f} s of CPU")
    return int(false > 0 or 1 in codes or any(stop.stopped_by == "NOTHING" for stop in stops))


@dataclass(frozen=True)
class Stop:
    """What stopped a motor that was reversed."""

    stopped_by: str
    cycles: float
    """While its drive was enabled after it."""
    way: float
    """rad from where it was, at most, in these."""
    said: str

    def __str__(self) -> str:
        return (
            f"reversed: stopped by {self.stopped_by} after {self.cycles:.0f} cycles and {self.way:.3f} "
            f"rad: {self.said[:110]}"
        )


class Bench:
    """Simulated machines behind the command line, and how near the watches come to their bounds.

    ``loses`` is the share of the samples that watches do not get, ``late`` whether SYNCs come late.
    """

    def __init__(self, rng: np.random.Generator) -> None:
        self.loses, self.late = 0.0, False
        self.samples = 0
        """That channels took in the last measurement."""
        self._rng, self._lost = rng, dict[int, float]()
        self._seen: Callable[[], None] = lambda: None
        self._watch_unseen()
        self._watch_energy()
        HostSync.give = giving_late(self._lateness)  # type: ignore[method-assign]

    def _loses(self, watch: object, cycles: float) -> float | None:
        """Return the cycles since a watch's last sample; None where it does not get this one."""
        cycles += self._lost.pop(id(watch), 0.0)
        if self._rng.random() < self.loses:
            self._lost[id(watch)] = cycles
            return None
        return cycles

    def _lateness(self, cycle: float) -> float:
        """Return by how many seconds the next SYNC is late."""
        if not self.late or self._rng.random() >= LATE:
            return 0.0
        return min(self._rng.exponential(LATE_BY), LATE_SHARE / 2) * cycle

    def _watch_unseen(self) -> None:
        take = Unseen.take

        def noted(
            watch: Unseen, position: int, torque: int, cycles: float = 1.0, disturbed: float = 0.0
        ) -> None:
            since = self._loses(watch, cycles)
            if since is None:
                return
            take(watch, position, torque, since, disturbed)
            if watch._coasting and watch._stood >= STOOD:
                worst["dead"] = max(worst["dead"], abs(watch.way) / watch.dead)
            elif not watch._coasting and watch.knows:
                worst["pushed"] = max(worst["pushed"], abs(watch.way) / watch.at_rest)

        Unseen.take = noted  # type: ignore[method-assign]

    def _watch_energy(self) -> None:
        take, take_all, check = Balance.take, Channel.take, CanopenMotion._check_energy

        def noted(
            watch: Balance, position: int, torque: int, target: int, cycles: float, **more: bool
        ) -> None:
            since = self._loses(watch, cycles)
            if since is not None:
                take(watch, position, torque, target, since, **more)

        def counted(channel: Channel, data: bytes) -> None:
            self.samples += 1
            self._seen()
            take_all(channel, data)

        def checked(motion: CanopenMotion) -> None:
            balances = [channel.balance for channel in motion._channels]
            missing = -sum(one.brought + one.stored for one in balances)
            spare = min(balances, key=lambda one: one.lately).spare
            worst["energy"] = max(worst["energy"], missing / spare)
            check(motion)

        Balance.take = noted  # type: ignore[method-assign]
        Channel.take = counted  # type: ignore[method-assign]
        CanopenMotion._check_energy = checked  # type: ignore[method-assign]

    def measured(self, profile: dict[str, Any], node: int = 0, at: int = 0) -> tuple[int, str]:
        """Measure a machine; reverse a motor at a sample of this number, if a node is given."""
        seconds = "20"
        while True:
            self.samples = 0
            self.after = self.way = 0.0
            code, text = self._command(profile, seconds, node, at)
            asked = bench_retune.MORE.search(text)
            if code != 3 or asked is None or asked[1] == seconds:
                return code, text
            seconds = asked[1]

    def _command(
        self, profile: dict[str, Any], seconds: str, node: int, at: int
    ) -> tuple[int, str]:
        channel = f"alarms-{next(_numbers)}"
        with (
            tempfile.TemporaryDirectory() as name,
            patch.dict(os.environ, {"FIELDTOOL_STATE_DIR": str(Path(name) / "notes")}),
        ):
            path = Path(name) / "machine.yaml"
            profile["bus"]["channel"] = channel
            path.write_text(yaml.safe_dump(profile, sort_keys=False), encoding="utf-8")
            machine = register(channel, simulated_machine(load_machine(path)))
            if node:
                self._seen = self._reverse(machine, node, at)
            try:
                return command(
                    "measure", path, "--yes", "--time", seconds, "--out", Path(name) / "session"
                )
            finally:
                self._seen = lambda: None
                unregister(channel)

    def _reverse(self, machine: RunningMachine, node: int, at: int) -> Callable[[], None]:
        """Return what reverses a motor at a sample, and follows it as long as its drive is enabled."""
        begun: list[tuple[float, float]] = []

        def seen() -> None:
            drive = machine.node(node)
            place = float(machine.axes.state[machine.axes.plant.motors[drive.axis]])
            if self.samples == at:
                begun.append((machine.now, place))
                machine.inject(MotorReversed(node))
            if begun and drive.motion.state is State.OPERATION_ENABLED:
                self.after = (machine.now - begun[0][0]) * 1e9 / machine.period
                self.way = max(self.way, abs(place - begun[0][1]))

        return seen

    def reversed(self, profile: dict[str, Any], node: int, at: int) -> Stop:
        """Measure a machine of which a motor is reversed on the way."""
        code, text = self.measured(profile, node, at)
        by = (
            "its energy" if "more energy than they were given" in text else "another watch or limit"
        )
        return Stop(by if code == 4 else "NOTHING", self.after, self.way, text)


_numbers = count()


if __name__ == "__main__":
    sys.exit(main())
