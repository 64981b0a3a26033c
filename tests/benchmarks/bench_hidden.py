"""What criticism finds of what was hidden: right names, wrong names, numbers, smallest sizes.

Machines are drawn at random and recorded from the plant (:mod:`tests.hidden.plant_recordings`); effects
are hidden at a wanted multiple of the noise floor (:mod:`tests.hidden.hiding`) and sought by criticism
alone, from the machine as it was accepted before.

- ``one``: one effect.  The right name and axis have to stand first.  A tie is counted apart: another
  name first, with the right one as a rival that explains as much and the experiment that would tell.
- ``none``: nothing.  ``two``: two effects, each of its own axis or the same.
- ``removed``: one effect that the library of this run lacks; a confident wrong name is one without
  the word that some is left, as good as the right one would have been.
- ``size``: one effect, sizes from the noise floor up.
- ``time``: two axes, six recordings of 20 s at 1 kHz, the whole library.

Every case is one line of JSON in FILE, with its seed: a run goes on where FILE ends, until it holds as
many cases as are asked for, and a table of all of them is printed at the end.  Without arguments, a few
of each into a file that is thrown away.

``keep=DIRECTORY`` keeps what was drawn and recorded, so that other code can be tried on the same cases.

Run: python tests/benchmarks/bench_hidden.py [KIND=CASES ...] [file=FILE] [seed=SEED] [keep=DIRECTORY]
"""

import json
import os
import pickle
import sys
import tempfile
import time
from collections import Counter, defaultdict
from dataclasses import replace
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")  # small matrices: threads only wait for each other
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from fieldtool.criticise.criticise import criticise
from fieldtool.criticise.effects import candidates
from fieldtool.criticise.search import instants
from fieldtool.criticise.search.fit import EXACTLY, fit
from fieldtool.criticise.search.screen import screened, tangent
from fieldtool.criticise.where.sentences import relative_error
from fieldtool.errors import NotEnoughDataError
from tests.hidden.hiding import MAKERS, draw
from tests.hidden.plant_recordings import random_machine, record
from tests.hidden.scoring import cause_of, is_of, numbers, tie_with

FEW = {"one": 19, "none": 4, "two": 4, "removed": 4, "size": 0, "time": 1}
SIZES = (4.0, 2.0, 8.0, 1.0)
"""Times the noise floor, in the order in which all effects are tried at each."""
EFFECTS = tuple(MAKERS)
SMALL = tuple(e for e in EFFECTS if e != "measurement_delay")
"""Effects that can be as small as is wanted: the plant's shortest delay is far above the noise."""
TOLD = 3
"""Of so many cases with one effect, one is fitted with the structure told as well."""


def told(criticised, hidden):
    """Error on unseen data of a fit that is told effect and axis, per axis: the best start wins.

    It is fitted to its end: one that stops on its way is a matter of luck on unseen data.
    """
    found = criticised.found
    start = found.before.hypothesis
    context = found.prepared.context(start)
    pool = [
        e for e in candidates(context)
        if e.name == hidden.effect and (e.axis == hidden.axis or e.other == hidden.axis)
    ]  # fmt: skip
    simulator = found.prepared.simulator
    at = tangent(simulator, start)
    best = None
    for one in screened(simulator, at, pool, lambda _: None)[:3]:
        grown = start.with_effect(one.effect)
        grown = replace(grown, values=(*grown.values[:-1], one.start))
        fitted = fit(simulator, fit(simulator, grown, steps=20).hypothesis, 40, enough=EXACTLY)
        fitted = instants.timed(simulator, fitted)
        if best is None or fitted.cost < best.cost:
            best = fitted
    if best is None:
        return None
    parts = simulator.parts(best.hypothesis, "unseen")
    return [relative_error(parts, k) for k in range(len(context.axes))]


def judged(kind, case, without=frozenset(), with_told=False):
    """Criticise one case; return its line."""
    begin = time.process_time()
    try:
        criticised = criticise(
            case.recording, case.machine.model, case.machine.model, without=without
        )
    except NotEnoughDataError as error:
        return refused(kind, case, str(error))
    seconds = time.process_time() - begin
    c = criticised.criticism
    first = c.causes[0] if c.causes else None
    line = {
        "kind": kind,
        "seed": case.seed,
        "axes": len(case.machine.hardware),
        "hidden": hidden_in(case),
        "named": [
            {"effect": x.effect, "axis": x.axis, "location": x.location, "gain": x.gain,
             "chance": x.chance, "ties": [[t.effect, t.axis] for t in x.ties],
             "numbers": {k: [n.value, n.std] for k, n in x.parameters.items()}}
            for x in c.causes
        ],
        "verdict": c.verdict,
        "unexplained": list(c.unexplained),
        "rejected": [[r.effect, r.axis, r.why] for r in c.rejected if "no trace" not in r.why],
        "before": [e.torque for e in c.held_out.error_before.values()],
        "after": [e.torque for e in c.held_out.error_after.values()],
        "noise": list(c.held_out.noise_floor.values()),
        "seconds": round(seconds, 2),
    }  # fmt: skip
    if len(case.hidden) == 1:
        hidden = case.hidden[0]
        line["first"] = bool(first and is_of(hidden, first.effect, first.axis))
        line["tie"] = bool(not line["first"] and first and tie_with(hidden, first))
        if with_told:
            line["told"] = told(criticised, hidden)
    line["numbers"] = {
        h.effect: {k: [n.truth, n.value, n.std, n.right] for k, n in numbers(case, h, x).items()}
        for h in case.hidden
        for x in [cause_of(h, c)]
        if x is not None
    }
    return line


def hidden_in(case):
    """What was hidden in a case, as its line says it."""
    return [
        {"effect": h.effect, "axis": h.axis + 1, "size": round(h.visibility, 2),
         "part": repr(h.part)} for h in case.hidden
    ]  # fmt: skip


def refused(kind, case, why):
    """Line of a case of which criticism says nothing but why: nothing is found, nothing is wrong."""
    return {
        "kind": kind, "seed": case.seed, "axes": len(case.machine.hardware),
        "hidden": hidden_in(case), "named": [], "verdict": "refused", "why": why, "numbers": {},
        "first": False, "tie": False, "seconds": 0.0,
    }  # fmt: skip


def kept(keep):
    """Draw cases, or take them from a directory where they were drawn before."""

    def drawn(seed, effects, wanted=None):
        if keep is None:
            return draw(seed, effects, wanted)
        name = "-".join(["case", str(seed), *(e or "any" for e in effects), str(wanted or "any")])
        path = keep / f"{name}.pkl"
        if not path.is_file():
            path.write_bytes(pickle.dumps(draw(seed, effects, wanted)))
        return pickle.loads(path.read_bytes())

    return drawn


def case_of(kind, number, seed, effect=None, draw=draw):
    """One case of a kind; the effect goes round, or is that which is asked for."""
    name = effect or EFFECTS[number % len(EFFECTS)]
    if kind == "one":
        return judged(kind, draw(seed, (name,)), with_told=number % TOLD == 0)
    if kind == "none":
        return judged(kind, draw(seed, ()))
    if kind == "two":
        return judged(kind, draw(seed, (None, None)))
    if kind == "removed":
        return judged(kind, draw(seed, (name,)), frozenset({name}))
    if kind == "size":
        name = effect or SMALL[number % len(SMALL)]
        size = SIZES[(number if effect else number // len(SMALL)) % len(SIZES)]
        return judged(kind, draw(seed, (name,), size))
    return timed(seed)


def timed(seed):
    """Two axes, six recordings of 20 s at 1 kHz: friction and a delay hidden, all of the library."""
    from drives.sim.effects import AsymmetricFriction, MeasurementDelay

    machine = random_machine(np.random.default_rng(seed), axes=2)
    some = 0.05 * machine.peak[0]
    hidden = machine.with_effects(
        {0: [AsymmetricFriction(some, 0.7 * some)], 1: [MeasurementDelay(2e-3)]}
    )
    recording = record(hidden, seed, with_moves=True)
    wall, begin, told_at = time.perf_counter(), time.process_time(), []
    criticised = criticise(
        recording, machine.model, machine.model, advance=lambda _, share: told_at.append(share)
    )
    return {
        "kind": "time",
        "seed": seed,
        "axes": 2,
        "recordings": [len(e.time) * recording.sample_period for e in recording.experiments],
        "seconds": round(time.process_time() - begin, 2),
        "wall": round(time.perf_counter() - wall, 2),
        "reports": len(told_at),
        "named": [[c.effect, c.axis] for c in criticised.criticism.causes],
    }


def share(part, whole):
    """As text: percent and counts."""
    return f"{100 * part / whole:5.1f} % ({part} of {whole})" if whole else "-"


def table_one(lines):
    """Confusion matrix as lists, numbers, held-out error against a fit that was told."""
    print(f"\none hidden effect, {len(lines)} cases")
    print(f"  right effect and axis first     {share(sum(x['first'] for x in lines), len(lines))}")
    ties = sum(x["first"] or x["tie"] for x in lines)
    print(f"  first, or in a tie that says so {share(ties, len(lines))}")
    alone = sum(x["first"] and len(x["named"]) == 1 for x in lines)
    print(f"  and nothing wrong beside        {share(alone, len(lines))}")
    flat = [n for x in lines for each in x["numbers"].values() for n in each.values()]
    print(f"  numbers within 10 % or 95 %     {share(sum(n[3] for n in flat), len(flat))}")
    whole = [all(n[3] for n in each.values()) for x in lines for each in x["numbers"].values()]
    print(f"  all numbers of a cause          {share(sum(whole), len(whole))}")
    ratios = [
        np.sqrt(sum(a * a for a in x["after"]) / sum(t * t for t in x["told"]))
        for x in lines
        if x.get("told") and x["first"]
    ]
    if ratios:
        print(
            f"  error after / fit told          median {np.median(ratios):.3f}, "
            f"95 % {np.quantile(ratios, 0.95):.3f}, largest {max(ratios):.3f}; "
            f"at most 1.1 in {share(sum(r <= 1.1 for r in ratios), len(ratios))}"
        )
    rows = defaultdict(list)
    for x in lines:
        rows[x["hidden"][0]["effect"]].append(x)
    print(f"\n  {'hidden':22} cases first  tie numbers  named first instead")
    for effect in EFFECTS:
        mine = rows.get(effect, [])
        if not mine:
            continue
        wrong = Counter(
            x["named"][0]["effect"] + ("" if x["named"][0]["effect"] != effect else " (axis)")
            if x["named"] else "nothing" for x in mine if not x["first"]
        )  # fmt: skip
        good = [all(n[3] for n in e.values()) for x in mine for e in x["numbers"].values()]
        print(
            f"  {effect:22} {len(mine):5} {sum(x['first'] for x in mine):5} "
            f"{sum(x['tie'] for x in mine):4} {sum(good):4}/{len(good):<3} "
            f" {', '.join(f'{k} {v}' for k, v in wrong.most_common())}"
        )


def table_rest(kind, lines):
    """One line for each of the other kinds."""
    print(f"\n{kind}, {len(lines)} cases")
    if kind == "none":
        print(
            f"  no cause named                  {share(sum(not x['named'] for x in lines), len(lines))}"
        )
    elif kind == "two":
        both, tied, clean = 0, 0, 0
        for x in lines:
            keys = {(h["effect"]) for h in x["hidden"]}
            found = {n["effect"] for n in x["named"]}
            both += keys <= found
            tied += keys <= found | {t[0] for n in x["named"] for t in n["ties"]}
            clean += found <= keys
        print(f"  both named                      {share(both, len(lines))}")
        print(f"  named, or in a tie              {share(tied, len(lines))}")
        print(f"  none wrong beside               {share(clean, len(lines))}")
    elif kind == "removed":
        unexplained = sum(x["verdict"] in ("unexplained", "partly explained") for x in lines)
        wrong = sum(x["verdict"] in ("explained",) for x in lines)
        none = sum(x["verdict"] == "unexplained" for x in lines)
        print(f"  unexplained                     {share(none, len(lines))}")
        print(f"  or partly, with a relative      {share(unexplained, len(lines))}")
        print(
            f"  no name at all                  {share(sum(not x['named'] for x in lines), len(lines))}"
        )
        print(f"  a confident wrong name          {share(wrong, len(lines))}")
        print(
            "   ",
            Counter(
                (x["hidden"][0]["effect"], *(n["effect"] for n in x["named"]))
                for x in lines
                if x["named"]
            ).most_common(12),
        )


def table_size(lines):
    """Detection against size, for each effect."""
    print(f"\ndetection (right name and axis first, or in a tie) against size, {len(lines)} cases")
    print(f"  {'times the noise floor':22} " + " ".join(f"{s:>7}" for s in sorted(SIZES)))
    for effect in EFFECTS:
        cells = []
        for size in sorted(SIZES):
            mine = [
                x for x in lines
                if x["hidden"][0]["effect"] == effect
                and abs(np.log(x["hidden"][0]["size"] / size)) < 0.3
            ]  # fmt: skip
            good = sum(x["first"] or x["tie"] for x in mine)
            cells.append(f"{good}/{len(mine)}" if mine else "-")
        print(f"  {effect:22} " + " ".join(f"{c:>7}" for c in cells))


def main():
    """Run what is asked for, then print what the file holds."""
    words = dict(word.split("=", 1) for word in sys.argv[1:])
    file = Path(words.pop("file", "") or Path(tempfile.mkdtemp()) / "hidden.jsonl")
    seed = int(words.pop("seed", 0)) or int(np.random.SeedSequence().entropy % 2**31)
    effect = words.pop("effect", None)
    keep = Path(words.pop("keep")) if "keep" in words else None
    if keep is not None:
        keep.mkdir(parents=True, exist_ok=True)
    todo = {k: int(v) for k, v in words.items()} or FEW
    print(f"seed {seed}, {file}")
    have = [json.loads(row) for row in file.read_text().splitlines()] if file.is_file() else []
    begun = time.perf_counter()
    for kind, count in todo.items():
        already = sum(x["kind"] == kind for x in have)
        for number in range(already, count):
            line = case_of(kind, number, seed + 7919 * number, effect, kept(keep))
            have.append(line)
            with file.open("a") as out:
                out.write(json.dumps(line, default=float) + "\n")
            hidden = ", ".join(f"{h['effect']} {h['size']}" for h in line.get("hidden", []))
            named = [n if isinstance(n, list) else [n["effect"], n["axis"]] for n in line["named"]]
            missed = kind in ("one", "size") and not line["first"]
            mark = "" if not missed else "  tie" if line["tie"] else "  WRONG"
            print(
                f"{time.perf_counter() - begun:6.0f} s  {kind} {line['seed']}: {hidden or '-'} -> "
                f"{named} {line.get('verdict', '')} {line['seconds']} s{mark}",
                flush=True,
            )
    for kind in ("one", "none", "two", "removed"):
        lines = [x for x in have if x["kind"] == kind]
        if lines and kind == "one":
            table_one(lines)
        elif lines:
            table_rest(kind, lines)
    if sized := [x for x in have if x["kind"] == "size"]:
        table_size(sized)
    seconds = [x["seconds"] for x in have if x["kind"] != "time"]
    if seconds:
        print(
            f"\nCPU time of a criticism: median {np.median(seconds):.1f} s, most {max(seconds):.1f} s"
        )
    for x in have:
        if x["kind"] == "time":
            print(
                f"two axes, {x['recordings']} s: {x['seconds']} s CPU, {x['wall']} s wall, "
                f"{x['reports']} reports of progress, named {x['named']}"
            )


if __name__ == "__main__":
    main()
