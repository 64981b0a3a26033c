"""Where a criticism leaves a tie, the experiment that decides is planned, run and judged."""

import json
import re
from copy import deepcopy

import pytest
import yaml

from drives.profile import load_machine
from fieldtool import workflow
from fieldtool.errors import PlanRefusedError
from fieldtool.records.recording import load
from tests.session.conftest import one_axis

HIDDEN = {"measurement_delay": (0.0005, 0.05), "torque_lag": (0.0006, 0.05)}
"""Effect: time in s, and noise of the torque in N m that hides which of the two it is."""
TRIES = 3


def machine_with(folder, name, effect, seed, **limits):
    time, noise = HIDDEN[effect]
    machine = deepcopy(one_axis())
    machine["name"] = name
    machine["axes"][0]["limits"] |= limits
    machine["simulation"]["seed"] = seed
    machine["simulation"]["axes"][0] |= {
        "effects": [{"effect": effect, "time": time}],
        "torque_noise": noise,
    }
    path = folder / f"{name}.yaml"
    machine["bus"]["channel"] = str(path)
    path.write_text(yaml.safe_dump(machine), encoding="utf-8")
    return path


def tied(path, folder):
    """Measure, identify and criticise a machine whose noise leaves a tie; return the criticism."""
    workflow.measure(load_machine(path), folder)
    workflow.identify(folder)
    return workflow.criticise(folder).criticism


def test_a_delay_and_a_lag_are_told_apart_by_higher_frequencies(make_bench, tmp_path, fresh_rng):
    effect = list(HIDDEN)[fresh_rng.integers(2)]
    other = next(name for name in HIDDEN if name != effect)
    print("hidden", effect)
    for attempt in range(TRIES):  # at this noise now and then a tie does not come about
        earlier = tmp_path / f"first-{attempt}"
        path = machine_with(tmp_path, "first", effect, int(fresh_rng.integers(1000)))
        criticism = tied(path, earlier)
        named = [{c.effect, *(t.effect for t in c.ties)} for c in criticism.causes]
        if set(HIDDEN) in named:
            break
    assert named == [set(HIDDEN)]
    bench = make_bench()  # only for its command line

    if effect == "torque_lag":  # of a delay what is known may be all but enough
        # Limits that leave no room: one sentence, and nothing moves.
        narrow = machine_with(
            tmp_path, "narrow", effect, 1, travel=["-1 deg", "1 deg"], torque="0.2 N m"
        )
        refused = bench.command(
            "measure", narrow, "--to-distinguish", earlier, "--yes", "--out", tmp_path / "no"
        )
        assert refused.code == 3
        assert "would tell them apart" in refused.err
        assert "Nothing was moved" in refused.err
        assert not (tmp_path / "no" / "recording.h5").exists()

    outcome = bench.command(
        "measure", path, "--to-distinguish", earlier, "--yes", "--json",
        "--out", tmp_path / "second",
    )  # fmt: skip
    assert outcome.code == 0, outcome.err
    said = json.loads(outcome.out)
    assert said["answer"].startswith(f"Told apart: it is {effect} of table, and not {other} (evi")
    (named,) = said["criticism"]["causes"]
    assert named["effect"] == effect
    assert named["ties"] == []
    number = "delay" if effect == "measurement_delay" else "time"
    assert named["parameters"][number]["value"] == pytest.approx(HIDDEN[effect][0], rel=0.05)
    evidence = float(re.search(r"evidence ([\d.e+]+) to expect", outcome.err)[1])
    assert evidence >= 30
    assert "every limit is kept" in outcome.err
    names = [e.name for e in load(tmp_path / "second" / "recording.h5").experiments]
    assert "earlier pilot 1" in names
    assert "high 1" in names
    assert (tmp_path / "second" / "report.html").is_file()


def test_a_criticism_without_a_tie_leaves_nothing_to_measure(make_bench, tmp_path):
    path = machine_with(tmp_path, "quiet", "measurement_delay", 5)
    data = yaml.safe_load(path.read_text())
    data["simulation"]["axes"][0] |= {"effects": [], "torque_noise": 0.004}
    path.write_text(yaml.safe_dump(data))
    assert tied(path, tmp_path / "first").verdict == "adequate"
    with pytest.raises(PlanRefusedError, match="leaves no tie"):
        workflow.distinguish(load_machine(path), tmp_path / "first", tmp_path / "second")
    bench = make_bench()
    empty = tmp_path / "empty"
    empty.mkdir()
    refused = bench.command("measure", path, "--to-distinguish", empty, "--out", tmp_path / "x")
    assert refused.code == 2
    assert "no session folder" in refused.err
