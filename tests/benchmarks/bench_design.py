"""How good the design is: ``bench_design.py [limit|peers|random|friction|time]``.

limit    against a global search (differential evolution, long, on the true machine itself, with the
         same structure and the same bounds): time until motor and last mass have arrived, bandwidth.
peers    relay tuning (Ziegler-Nichols) and symmetric optimum on the total inertia, both told the true
         machine and given its inertia to feed forward; the tool's rule of thumb; a shaper alone on the
         old gains (as Klipper chooses it); beside the old gains and the design: settling, peak of
         sensitivity, vibration after the move.
random   machines whose tooling was changed, drives tuned for the old one, a model with errors: what
         the design does on the true machine.
friction what feed-forward of friction brings to drives that have it (the EPOS4's two loops): predicted
         following error and arrival over those of a design without it.
time     seconds for three axes.

All is judged on the true machine by frequency responses and eigenvalues; seeds vary and are printed.
"""

import argparse
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
from design_machines import RESOLUTION, TIMING, Case, case
from design_rivals import Global, klipper_choice, moved, peaks, relay, symmetric_optimum

from drives.profile import load_machine
from drives.profile.loading import load_drive
from fieldtool.design.decide import design, swing
from fieldtool.design.machine import machine_of
from fieldtool.design.no_worse import arrival
from fieldtool.design.predict import predict
from fieldtool.design.rule import DesignError, rule
from fieldtool.design.servo import Servo
from fieldtool.records.model import Estimate
from fieldtool.workflow.models import truth_model

NOISE = 0.01


def servos_of(one: Case, tuning) -> tuple[Servo, ...]:  # type: ignore[no-untyped-def]
    return tuple(s.servo(a.parameters) for s, a in zip(one.sides, tuning.axes, strict=True))


def arrivals(one: Case, servos: tuple[Servo, ...], shapers=None) -> list[float]:  # type: ignore[no-untyped-def]
    figures = moved(machine_of(one.true), servos, one.moves, shapers)
    return [max(m.positioning_time, q.positioning_time) for m, q in figures]


def limit(rng: np.random.Generator, machines: int, generations: int) -> None:
    print("\nAgainst the limit (peak of sensitivity at most 2 for both)")
    print(f"{'machine':>12} {'axis':>6} {'arrives: design':>16} {'global':>8} {'bandwidth: design':>18} "
          f"{'global':>8} {'peak':>6} {'global':>7} {'seconds':>9} {'global':>8}")  # fmt: skip
    ratios, widths = [], []
    for k in range(machines):
        lengths = [(2,), (3,), (2, 1), (1,), (2, 2)][k % 5]
        one = case(rng, lengths, 0.0)
        modes = machine_of(one.true).modes
        top = 3 * float(modes.max()) if modes.size else 2 * np.pi * 30
        began = time.perf_counter()
        try:
            tuning = design(
                one.found, one.sides, one.moves, response="stiff", top=top / (2 * np.pi)
            )
        except DesignError as error:
            print(f"{lengths!s:>12} refused: {error}")
            continue
        ours, seconds = servos_of(one, tuning), time.perf_counter() - began
        began = time.perf_counter()
        limits = [side.torque_limit for side in one.sides]
        rival = Global(
            one.true, one.moves, TIMING, 2.0, top, [NOISE * t for t in limits], limits, RESOLUTION
        )
        theirs = rival.search(generations, 8, int(rng.integers(2**31)))
        search = time.perf_counter() - began
        a, b = arrivals(one, ours), arrivals(one, theirs)
        p, q = (predict(one.true, s, one.moves) for s in (ours, theirs))
        for i in range(len(lengths)):
            w, v = p.axes[i].margins, q.axes[i].margins
            ratios.append(a[i] / b[i])
            widths.append(w.bandwidth / v.bandwidth)
            print(f"{lengths!s:>12} {i + 1:>6} {a[i]:>15.3f}s {b[i]:>7.3f}s {w.bandwidth:>15.2f} Hz "
                  f"{v.bandwidth:>5.2f} Hz {w.sensitivity_peak:>6.2f} {v.sensitivity_peak:>7.2f} "
                  f"{seconds:>8.1f}s {search:>7.1f}s", flush=True)  # fmt: skip
    either = [r <= 1.1 or w >= 0.9 for r, w in zip(ratios, widths, strict=True)]
    print(
        f"arrival over that of the global search: median {np.median(ratios):.3f}, worst "
        f"{max(ratios):.3f}; bandwidth: median {np.median(widths):.2f}, worst {min(widths):.2f}; "
        f"within 10 % in one of them: {sum(either)} of {len(either)}"
    )


def fed(one: Case, servos: tuple[Servo, ...]) -> tuple[Servo, ...]:
    """Return controllers with velocity and inertia fed forward, as the design's are."""
    return tuple(
        replace(s, loop=replace(s.loop, velocity_ff=1.0, inertia_ff=axis.total_mass))
        for s, axis in zip(servos, one.true.axes, strict=True)
    )


def peers(rng: np.random.Generator, machines: int) -> None:
    names = (
        "old gains",
        "old gains + shaper",
        "relay, Ziegler-Nichols",
        "symmetric optimum",
        "rule of thumb",
        "design, soft",
        "design, normal",
        "design, stiff",
    )
    found: dict[str, list[tuple[float, float, float]]] = {name: [] for name in names}
    unstable = dict.fromkeys(names, 0)
    for _ in range(machines):
        lengths = tuple(int(n) for n in rng.integers(1, 4, int(rng.integers(1, 4))))
        if max(lengths) == 1:
            lengths = (2, *lengths[1:])
        one = case(rng, lengths, 0.01)
        machine = machine_of(one.true)
        designed = {
            name: servos_of(one, design(one.found, one.sides, one.moves, response=name))
            for name in ("soft", "normal", "stiff")
        }
        ruled = tuple(Servo(loop, 500.0, TIMING) for loop in rule(one.found))
        shapers = []
        for k in range(len(lengths)):
            there = swing(machine, one.old, k)
            shapers.append(None if there is None else klipper_choice(there[0])[1:])
        for name, servos, shaped in (
            ("old gains", one.old, None),
            ("old gains + shaper", one.old, shapers),
            ("relay, Ziegler-Nichols", fed(one, relay(one.true, TIMING)), None),
            ("symmetric optimum", fed(one, symmetric_optimum(one.true, TIMING, 500.0)), None),
            ("rule of thumb", ruled, None),
            *((f"design, {name}", servos, None) for name, servos in designed.items()),
        ):
            height = peaks(machine, servos)
            if not np.isfinite(height).all():
                unstable[name] += 1
                continue
            for k, (motor, load) in enumerate(moved(machine, servos, one.moves, shaped)):
                settled = max(motor.settling_time, load.settling_time)
                found[name].append((settled, height[k], load.residual_peak / one.moves[k].distance))
    print(
        f"\nPeers on {machines} machines with new tooling (median and 90 % of all axes, true machine)"
    )
    print(f"{'':>24} {'unstable':>9} {'settling after the move':>24} {'peak of sensitivity':>20} "
          f"{'vibration, per mille':>21}")  # fmt: skip
    for name in names:
        table = np.array(found[name]) if found[name] else np.full((1, 3), np.nan)
        mid, far = np.median(table, axis=0), np.percentile(table, 90, axis=0)
        print(
            f"{name:>24} {unstable[name]:>9} {mid[0]:>14.3f} {far[0]:>7.3f} s {mid[1]:>13.2f} "
            f"{far[1]:>6.2f} {1e3 * mid[2]:>14.2f} {1e3 * far[2]:>6.2f}"
        )


def random(rng: np.random.Generator, machines: int) -> None:
    print(f"\n{machines} machines with new tooling, old gains in the drives, model with 1 % errors")
    heights, shorter, longer, axes, failed, seconds = [], 0, [], 0, 0, []
    for _ in range(machines):
        lengths = tuple(int(n) for n in rng.integers(1, 4, int(rng.integers(1, 5))))
        one = case(rng, lengths, 0.01)
        machine = machine_of(one.true)
        began = time.perf_counter()
        try:
            tuning = design(one.found, one.sides, one.moves, response="stiff")
        except DesignError as error:
            failed += 1
            print(f"  {lengths}: refused: {error}")
            continue
        seconds.append(time.perf_counter() - began)
        servos = servos_of(one, tuning)
        heights.append(float(peaks(machine, servos).max()))
        was = (
            arrivals(one, one.old)
            if np.isfinite(peaks(machine, one.old)).all()
            else [np.inf] * len(lengths)
        )
        now = arrivals(one, servos)
        for a, b in zip(was, now, strict=True):
            axes += 1
            shorter += b < a or b <= one.moves[0].duration
            longer.append(b / a if np.isfinite(a) else 0.0)
    print(
        f"  stable {np.isfinite(heights).sum()} of {len(heights)}, refused {failed}; peak of "
        f"sensitivity: median {np.median(heights):.2f}, largest {max(heights):.3f} (2.1 allowed)"
    )
    print(
        f"  arrives earlier: {shorter} of {axes} axes ({100 * shorter / axes:.0f} %); time over before: "
        f"median {np.median(longer):.3f}, worst {max(longer):.3f}; design: median "
        f"{np.median(seconds):.1f} s, longest {max(seconds):.1f} s"
    )


def friction(rng: np.random.Generator, machines: int) -> None:
    print(f"\n{machines} machines, viscous friction 0.5 to 10 times the inertia a second")
    dual = load_drive("epos4-dual-loop").tunable
    for share in (0.0, 1.0):
        rows = []
        for _ in range(machines):
            lengths = tuple(int(n) for n in rng.integers(1, 3, int(rng.integers(1, 3))))
            one = case(rng, lengths, 0.01)
            rubbed = tuple(
                replace(a, viscous_friction=Estimate(float(rng.uniform(0.5, 10)) * a.total_mass))
                for a in one.found.axes
            )
            model, now = replace(one.found, axes=rubbed), {"velocity_ff": share}
            found = []
            for tunable in (dual - {"viscous_ff"}, dual):
                sides = [replace(s, tunable=tunable, present=now) for s in one.sides]
                prediction = design(model, sides, one.moves).prediction
                assert prediction is not None
                found.append(prediction.axes)
            for before, after in zip(*found, strict=True):
                assert before.move is not None
                assert after.move is not None
                error = after.move.following_error / before.move.following_error
                rows.append((error, arrival(after) / arrival(before)))
        error, later = np.median(rows, axis=0)
        print(
            f"  {share:.0%} of the velocity fed forward, {len(rows)} axes: following error "
            f"{error:.2f} times (median; {min(rows)[0]:.2f} to {max(rows)[0]:.2f}), arrival {later:.3f}",
            flush=True,
        )


def seconds(rng: np.random.Generator, machines: int) -> None:
    print("\nTime of the design for three axes (uncertainty included)")
    paper = truth_model(load_machine("paper-3x3"))
    assert paper is not None

    def timed(what: str, work: Callable[[], object]) -> None:
        began, cpu = time.perf_counter(), time.process_time()
        work()
        print(f"  {what}: {time.perf_counter() - began:.1f} s of wall time, "
              f"{time.process_time() - cpu:.1f} s of one core", flush=True)  # fmt: skip

    for k in range(machines):
        one = case(rng, (3, 3, 3), 0.01)
        for name, compare in (("normal", False), ("normal", True), ("stiff", False)):
            timed(
                f"3 x 3 masses, machine {k + 1}, {name}{', all three' if compare else ''}",
                partial(design, one.found, one.sides, one.moves, response=name, compare=compare),
            )
    timed("paper-3x3, errors not known, normal", partial(design, paper))


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser()
    parser.add_argument("what", nargs="*", default=[])
    parser.add_argument("--machines", type=int, default=None)
    parser.add_argument("--generations", type=int, default=150)
    parser.add_argument("--seed", type=int, default=None)
    given = parser.parse_args()
    seed = int(np.random.SeedSequence().generate_state(1)[0]) if given.seed is None else given.seed
    print("seed", seed)
    parts = {
        "time": lambda rng: seconds(rng, given.machines or 3),
        "peers": lambda rng: peers(rng, given.machines or 10),
        "random": lambda rng: random(rng, given.machines or 20),
        "friction": lambda rng: friction(rng, given.machines or 6),
        "limit": lambda rng: limit(rng, given.machines or 4, given.generations),
    }
    for name, part in parts.items():
        if not given.what or name in given.what:
            part(np.random.default_rng(seed))


if __name__ == "__main__":
    main()
