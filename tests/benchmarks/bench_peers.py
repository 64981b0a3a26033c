"""Other people's methods on the same measured responses: ``python tests/benchmarks/bench_peers.py``.

One response matrix a machine, the same for all: vector fitting (scikit-rf), LSCF and RFP with LSFD
(sdypy-EMA), AAA (scipy), peak picking with half-power widths, and plain least squares from a start
that is wrong by 30 %, against our fit of modes, order reductions and maximum likelihood.

All are told how many masses each axis has.  Peers that fit poles get the accelerance -w**2 G, whose
rigid body is a constant, with the axes made alike in size; their poles and residues go through our
block order reduction to masses and springs, as they have nothing of that kind themselves.  sdypy-EMA
wants an operator's clicks at stable poles: they come from the truth, which no other method sees.

Settings, chosen for the least errors on other seeds: vector fitting with as many pairs of poles as
modes and a constant (two pairs more on the real bench); LSCF of order 20 (30 where there are few
lines); RFP of order 20, the package's largest; AAA of the sum of the drive points with one pair more;
least squares with our parameters and derivatives.

The real bench is looked for in ``$FIELDTOOL_DATA/two-mass-bench``, else in
``shared/data/two-mass-bench`` beside the project.
"""

import argparse
import os
import sys
import time
from collections.abc import Sequence
from pathlib import Path

os.environ["OMP_NUM_THREADS"] = "1"  # times are those of one thread
os.environ["OPENBLAS_NUM_THREADS"] = "1"
os.environ["MKL_NUM_THREADS"] = "1"

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from peers_data import Case, bench_case, paper_case, random_cases
from peers_found import Found, Method
from peers_methods import OPERATOR, aaa, ema, missing, peak_picking, vector_fitting
from peers_ours import (
    block_reduction,
    one_axis_reduction,
    plain_least_squares,
    refined,
    refined_from,
    workflow,
    wrong_start,
)
from peers_score import CRITERIA, NEAR, Row, counted, pair, short

from fieldtool.records.model import MachineModel

NOISES = (1e-3, 1e-2)
"""Of torques of size 1, random machines."""
PAPER = "ours: modes, one axis (paper)"
BLOCKS = "ours: modes, blocks"
WRONG = "ours: likelihood, wrong start"
OURS = "ours: modes, blocks, likelihood"
WHOLE = "ours: whole recording"
CLEARLY = 1.25
"""Times the error of another step of ours from which it is said."""


def methods(case: Case, start: MachineModel) -> dict[str, tuple[Method, str]]:
    """All methods by name, each with the package that it needs."""
    more = 2 if len(case.masses) == 1 else 0  # the real machine has more than its two masses
    order = 20 if case.hertz.size > 50 else 30
    return {
        "vector fitting (scikit-rf)": (vector_fitting(more), "skrf"),
        "LSCF + LSFD (sdypy-EMA)": (ema("lscf", order), "sdypy.EMA"),
        "RFP + LSFD (sdypy-EMA)": (ema("rfp", 20), "sdypy.EMA"),
        "AAA + least squares (scipy)": (aaa(), "scipy.interpolate.AAA"),
        "peak picking, half power": (peak_picking, "scipy"),
        "least squares of G": (plain_least_squares(start, "response"), "scipy"),
        "least squares of -w2 G": (plain_least_squares(start, "acceleration"), "scipy"),
        "least squares, own noise": (plain_least_squares(start, "diagonal"), "scipy"),
        WRONG: (refined_from(start), "scipy"),
        PAPER: (one_axis_reduction, "scipy"),
        BLOCKS: (block_reduction, "scipy"),
        OURS: (refined, "scipy"),
        WHOLE: (workflow, "scipy"),
    }


def timed(method: Method, case: Case) -> tuple[Found, tuple[float, float]]:
    """Run a method; a peer that breaks down has found nothing, and says why.

    With wall and processor time, s.
    """
    began, worked = time.perf_counter(), time.process_time()
    try:
        found = method(case)
    except Exception as error:
        found = Found(np.zeros(0, complex), None, f"{type(error).__name__}: {str(error)[:80]}")
    return found, (time.perf_counter() - began, time.process_time() - worked)


def study(cases: Sequence[Case], seed: int) -> dict[str, Row]:
    """Every method on every case."""
    rows: dict[str, Row] = {}
    for k, case in enumerate(cases):
        if case.truth is None:
            raise ValueError(f"{case.name}: the truth is not known")
        for name, (method, package) in methods(case, wrong_start(case.truth, seed + k)).items():
            if name == WHOLE and case.recording is None:
                continue
            row = rows.setdefault(name, Row())
            if missing(package):
                row.remarks.append(f"{package} is not installed: pip install fieldtool[benchmarks]")
                continue
            row.add(case, *timed(method, case))
    return rows


def show(title: str, rows: dict[str, Row]) -> None:
    """Print the table of one data set, and what was missed, invented or said."""
    print(f"\n{title}")
    heads = "".join(f"{what:>17}" for what in CRITERIA)
    print(
        f"{'error in %, rms / worst':<31}{heads}{'missed':>8}{'invented':>9}{'machines':>9}{'wall s':>8}"
        f"{'CPU s':>7}"
    )
    for name, row in rows.items():
        if not row.cases:
            print(f"{name:<31}  {row.remarks[0] if row.remarks else 'not run'}")
            continue
        cells = "".join(f"{pair(row, what):>17}" for what in CRITERIA)
        print(
            f"{name:<31}{cells}{len(row.missed):8d}{len(row.invented):9d}"
            f"{f'{row.machines}/{row.cases}':>9}{row.wall:8.3f}{row.processor:7.3f}"
        )
    for name, row in rows.items():
        for what, values in (
            ("missed Hz ", row.missed),
            ("invented Hz ", row.invented),
            ("", row.remarks),
        ):
            if values and row.cases:
                print(f"  {name}: {what}{counted(values)}")


def verdict(title: str, rows: dict[str, Row]) -> list[str]:
    """Say where our way from responses to the refined machine is not the best, and why."""
    ours, lines = rows[OURS], []
    peers = {name: row for name, row in rows.items() if not name.startswith("ours") and row.cases}
    inside = float(np.sqrt(np.mean(np.square(ours.sigmas)))) if ours.sigmas else float("nan")
    for what in CRITERIA:
        rivals = {n: r.rms(what) for n, r in peers.items() if r.whole and what in r.errors}
        if not rivals:
            continue
        best = min(rivals, key=lambda n: rivals[n])
        if rivals[best] >= ours.rms(what):
            continue
        lines.append(
            f"{title}, {what}: {best} {short(rivals[best])} % against {short(ours.rms(what))} % "
            f"({ours.rms(what) / rivals[best]:.2f} times); ours is off by {inside:.2f} of its own "
            f"standard errors, {_judged(inside)}"
        )
    faster = [n for n, r in peers.items() if r.processor < ours.processor]
    if faster:
        times = ", ".join(
            f"{n} {rows[n].processor:.3f}" + ("" if rows[n].whole else " (not all was found)")
            for n in faster
        )
        lines.append(
            f"{title}, time: ours {ours.processor:.3f} s of CPU; less take {times}: they weight nothing "
            "with the covariance of the noise, fit neither friction nor delay (but for least squares), "
            "and give no standard errors"
        )
    lines += _wrong_starts(title, rows) + _own_steps(title, rows)
    return lines or [f"{title}: ours is the best in everything"]


def _wrong_starts(title: str, rows: dict[str, Row]) -> list[str]:
    """Where plain least squares finds more than our likelihood fit, both from the wrong start."""
    ours = rows[WRONG]
    better = [n for n, r in rows.items() if n.startswith("least") and _lost(r) < _lost(ours)]
    if not better:
        return []
    shown = ", ".join(f"{n} {_lost(rows[n])}" for n in better)
    return [
        f"{title}, modes missed from the wrong start: {WRONG} {_lost(ours)}, {shown}; our likelihood "
        "fit takes long first steps and is made to begin at what the order reduction found, which "
        "needs no start"
    ]


def _lost(row: Row) -> int:
    return len(row.missed)


def _own_steps(title: str, rows: dict[str, Row]) -> list[str]:
    """Where an earlier step of ours is clearly better than a later one."""
    lines = []
    steps = [(name, rows[name]) for name in (PAPER, BLOCKS, OURS) if rows[name].whole]
    for k, (later, row) in enumerate(steps):
        for earlier, other in steps[:k]:
            worse = [w for w in CRITERIA if row.rms(w) > CLEARLY * other.rms(w)]
            lines += [
                f"{title}, {what}: {later} {short(row.rms(what))} %, {earlier} "
                f"{short(other.rms(what))} %"
                for what in worse
            ]
    return lines


def _judged(inside: float) -> str:
    if inside <= 1.25:
        return "as the noise allows: the difference is chance"
    return "more than the noise allows: this is no chance"


def show_bench(folder: Path | None, seed: int) -> list[str]:
    """Print the table of the real bench, where no truth is known; say who is nearer to ratio 1."""
    if folder is None:
        print("\nreal two-mass bench: skipped, no measurements here; set FIELDTOOL_DATA")
        return []
    case = bench_case(folder)
    ours, seconds = timed(workflow, case)
    if ours.model is None:
        raise SystemExit(f"the real bench was not identified: {ours.why}")
    OPERATOR[case.name] = ours.poles
    print(f"\n{case.name}, {case.hertz.size} lines of the motor side; no truth is known")
    print(
        "(a reference analysis: antiresonance 54.0 Hz, resonance 76.1 Hz, inertia ratio 0.987 +- "
        "0.007; two equal motors: 1.00)"
    )
    print(
        f"{'':<31}{'antiresonance':>14}{'resonance':>11}{'damping':>9}{'(fr/fa)2-1':>11}"
        f"{'ratio':>8}{'wall s':>8}{'CPU s':>7}"
    )
    ratios: dict[str, float] = {}
    for name, (method, package) in methods(case, wrong_start(ours.model, seed)).items():
        if missing(package):
            print(f"{name:<31}  {package} is not installed: pip install fieldtool[benchmarks]")
            continue
        found, spent = (ours, seconds) if name == WHOLE else timed(method, case)
        _bench_row(name, found, spent)
        ratios[name] = inertia_ratio(found)
    off = {name: abs(ratio - 1.0) for name, ratio in ratios.items() if np.isfinite(ratio)}
    nearer = [f"{name} {ratios[name]:.3f}" for name in off if off[name] < off[WHOLE]]
    return [
        f"{case.name}: inertia ratio by ours {ratios[WHOLE]:.3f}; nearer to that of two equal motors: "
        f"{', '.join(nearer) or 'none'}"
    ]


def inertia_ratio(found: Found) -> float:
    """Last mass over first mass of a single axis, nan without a machine."""
    if found.model is None:
        return float("nan")
    masses = found.model.axes[0].masses
    return masses[-1].value / masses[0].value


def _bench_row(name: str, found: Found, seconds: tuple[float, float]) -> None:
    if not found.poles.size:
        print(f"{name:<31}  no mode; {found.why}")
        return
    pole = found.poles[np.argmin(np.abs(np.abs(found.poles) / (2 * np.pi) - 76.0))]
    resonance = abs(pole) / (2 * np.pi)
    ratio = "-" if found.model is None else f"{inertia_ratio(found):.3f}"
    dip = found.antiresonance
    if np.isnan(dip) and found.model is not None:
        axis = found.model.axes[0]
        dip = float(np.sqrt(axis.springs[0].value / axis.masses[1].value) / (2 * np.pi))
    print(
        f"{name:<31}{dip:14.2f}{resonance:11.2f}{-pole.real / abs(pole):9.4f}"
        f"{(resonance / dip) ** 2 - 1:11.3f}{ratio:>8}"
        f"{seconds[0]:8.3f}{seconds[1]:7.3f}  {found.why}"
    )


def bench_folder() -> Path | None:
    """Return the folder with the real bench's data, None where it is absent."""
    beside = Path(__file__).resolve().parents[3] / "shared" / "data"
    folder = Path(os.environ.get("FIELDTOOL_DATA", beside)) / "two-mass-bench"
    return folder if folder.is_dir() else None


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seed", type=int, help="default: a new one")
    parser.add_argument("--draws", type=int, default=3, help="noises per random machine")
    parser.add_argument("--no-paper", action="store_true", help="leave the simulated session out")
    arguments = parser.parse_args()
    seed = arguments.seed
    if seed is None:
        seed = int(np.random.SeedSequence().generate_state(1)[0])
    print(f"seed {seed}; one thread; a mode counts as found within {100 * NEAR:g} %")
    sets = random_cases(seed, NOISES, arguments.draws)
    study(sets[0][:1], seed)  # what is loaded or compiled at the first use is not counted
    titled = {} if arguments.no_paper else {"(a) paper's machine": [paper_case(seed)]}
    for letter, noise, cases in zip("bc", NOISES, sets, strict=True):
        titled[f"({letter}) random machines, noise {noise:g}"] = cases
    lines = []
    for title, cases in titled.items():
        rows = study(cases, seed)
        names = ", ".join(dict.fromkeys(case.name for case in cases))
        show(f"{title}: {names}; {cases[0].hertz.size} lines", rows)
        lines += verdict(title, rows)
    lines += show_bench(bench_folder(), seed)
    print("\nwhere ours is not the best (of methods that found all modes and machines)")
    print("\n".join(lines))


if __name__ == "__main__":
    main()
