"""Multisine data that do not allow the answer: exit code 5, what is wrong and what to do, data kept."""

import json
import re
from dataclasses import dataclass, replace
from importlib.resources import files
from itertools import count

import numpy as np
import pytest
import yaml

from drives.profile import load_machine
from drives.sim.faults import Fault, MotorReversed
from drives.sim.firmware import Parameter
from drives.sim.lockstep_bus import register, unregister
from drives.sim.machine import simulated_machine
from fieldtool import workflow
from fieldtool.experiment import axes
from fieldtool.records.csv_folder import write_folder
from fieldtool.records.recording import load, save
from fieldtool.workflow import fast_measuring, planning

TABLE, ARM = 11, 12
KNOWN = ("--masses", "table=2", "--masses", "arm=1")
_channels = count()


def turntable(**gains):
    """The packaged turntable; other gains of the table's loop."""
    text = files("profiles").joinpath("machines/turntable-arm.yaml").read_text(encoding="utf-8")
    machine = yaml.safe_load(text)
    machine["simulation"]["axes"][0]["gains"] |= gains
    return machine


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    """A fast measurement of the turntable: pilot and two experiments of 1.56 s periods."""
    folder = tmp_path_factory.mktemp("good")
    machine = turntable()
    machine["bus"]["channel"] = channel = f"bad-input-{next(_channels)}"
    profile = folder / "machine.yaml"
    profile.write_text(yaml.safe_dump(machine), encoding="utf-8")
    register(channel, simulated_machine(load_machine(profile)))
    try:
        workflow.measure(profile, folder / "session")
    finally:
        unregister(channel)
    return load(folder / "session" / "recording.h5")


def main_experiments(recording):
    return [one for one in recording.experiments if one.name.startswith("fast")]


def cut(one, rows):
    """The first rows of an experiment."""
    part = slice(0, rows)
    kept = {
        name: None if (values := getattr(one, name)) is None else values[part]
        for name in ("time", "position", "torque", "position_reference", "torque_reference")
    }
    return replace(one, **kept, velocity=None, statusword=None, extra={})


def column(values, axis, new):
    changed = values.copy()
    changed[:, axis] = new
    return changed


def unreferenced(one):
    """As another program may have recorded it: positions and torques only."""
    return replace(one, position_reference=None, torque_reference=None, extra={})


def other(one, **columns):
    """Another torque, position or reference of the arm."""
    return replace(
        one,
        **{name: column(getattr(one, name), 1, new) for name, new in columns.items()},
    )


def periods(one, share):
    return cut(one, round(share * one.period / (one.time[1] - one.time[0])))


def never_repeating(one, rng):
    """Motion that does not come back, of about the same size."""
    walk = np.cumsum(rng.normal(size=one.position.shape), axis=0)
    return replace(
        one,
        period=None,
        position_reference=1e-3 * walk,
        position=1e-3 * walk,
        torque=walk,
        extra={},
    )


def saturated(one):
    limit = 0.6 * np.abs(one.torque[:, 1]).max()
    return other(one, torque=np.clip(one.torque[:, 1], -limit, limit))


def one_way(one):
    """An arm that is braked in one direction much more than in the other."""
    speed = np.abs(np.gradient(one.position[:, 1]))
    return other(one, torque=one.torque[:, 1] + 8.0 * speed / speed.max())


def still(one, rng):
    """An arm without excitation, whose sensors show noise."""
    return other(
        one,
        position_reference=0.0,
        position=6e-6 * rng.integers(-1, 2, one.samples),
        torque=0.004 * rng.normal(size=one.samples),
    )


def twice(experiments, rng):
    """The first experiment, measured again with fresh noise."""
    first = experiments[0]
    noise = rng.normal(size=first.torque.shape)
    return [first, replace(first, name="again", torque=first.torque + 0.004 * noise)]


CASES = {
    "too short": (
        lambda e, _: [periods(one, 1.5) for one in e],
        ("fast 1", "1.50 periods of", "at least 2", "measure longer"),
    ),
    "less than a period": (
        lambda e, _: [periods(one, 0.6) for one in e],
        ("fast 1", "0.60 periods of", "at least 2", "measure longer"),
    ),
    "too short to find a period": (
        lambda e, _: [replace(periods(one, 1.3), period=None) for one in e],
        ("fast 1", "no period given", "repeat at no shift up to", "at least two whole"),
    ),
    "never repeats": (
        lambda e, rng: [never_repeating(one, rng) for one in e],
        ("fast 1", "no period given", "references repeat at no shift", "give the period"),
    ),
    "wrong period": (
        lambda e, _: [replace(one, period=1.4) for one in e],
        ("fast 1", "do not repeat after 1400 samples", "correct the period"),
    ),
    "period between samples": (
        lambda e, _: [replace(one, period=1.5603) for one in e],
        ("fast 1", "1.5603 s", "whole number of samples", "correct"),
    ),
    "saturated torque": (
        lambda e, _: [saturated(one) for one in e],
        ("fast 1", "torque of arm is saturated", "N m", "% of the samples", "lower the amplitude"),
    ),
    "axis at rest": (
        lambda e, rng: [still(one, rng) for one in e],
        ("axis arm was not excited", "within the noise", "measure again with all axes driven"),
    ),
    "axis without a reference that moves": (
        lambda e, _: [other(one, position_reference=0.0) for one in e],
        ("axis arm was not excited", "only answers the other axes", "measure again"),
    ),
    "dead torque": (
        lambda e, _: [other(one, torque=0.0) for one in e],
        ("axis arm", "torque is 0 N m in every sample", "check the column"),
    ),
    "dead encoder": (
        lambda e, _: [unreferenced(other(one, position=1.0)) for one in e],
        ("axis arm", "position is 1 rad in every sample", "blocked", "measure again"),
    ),
    "fewer experiments than axes": (
        lambda e, _: e[:1],
        ("2 axes (table, arm) needs 2", "there are 1 (fast 1)", "measure 1 more"),
    ),
    "the same experiment twice": (
        twice,
        ("fast 1 and again are alike", "condition number", "orthogonal phases"),
    ),
    "another amplitude only": (
        lambda e, _: [
            e[0],
            replace(
                e[0],
                name="half",
                position=0.5 * e[0].position,
                torque=0.5 * e[0].torque,
                position_reference=0.5 * e[0].position_reference,
            ),
        ],
        ("fast 1 and half are alike", "condition number", "orthogonal phases"),
    ),
    "strongly non-linear": (
        lambda e, _: [one_way(one) for one in e],
        ("axis arm is strongly non-linear", "even distortion", "dB", "larger amplitude"),
    ),
    "nothing complete": (
        lambda e, _: [replace(one, complete=False) for one in e],
        ("no complete experiment", "fieldtool measure"),
    ),
}


@pytest.mark.parametrize("case", CASES)
def test_bad_data_are_named_with_what_to_do(small_bench, good, tmp_path, fresh_rng, case):
    spoil, sentences = CASES[case]
    path = tmp_path / "recording.h5"
    experiments = tuple(spoil(main_experiments(good), fresh_rng))
    save(replace(good, experiments=experiments), path)
    before = path.read_bytes()
    outcome = small_bench.command("identify", path)
    named_with_exit_code_5(outcome, sentences)
    assert path.read_bytes() == before
    assert load(path).names == ("table", "arm")


def named_with_exit_code_5(outcome, sentences):
    assert outcome.code == 5, outcome.err + outcome.out
    lines = outcome.err.strip().splitlines()
    assert all(line.startswith("fieldtool: ") for line in lines), outcome.err
    for sentence in sentences:
        assert sentence in lines[0]


def test_distortion_is_said_beside_a_model_that_does_not_fit(small_bench, good, tmp_path):
    """Dry friction as large as the torque bends the responses until no chains explain them."""
    path = tmp_path / "recording.h5"
    rubbed = [
        replace(e, torque=e.torque + 3.0 * np.sign(np.gradient(e.position, axis=0)))
        for e in main_experiments(good)
    ]
    save(replace(good, experiments=tuple(rubbed)), path)
    outcome = small_bench.command("identify", path, "--masses", "table=1", "--masses", "arm=1")
    named_with_exit_code_5(outcome, ())
    assert "The data are strongly non-linear" in outcome.err
    for name in ("table", "arm"):
        assert re.search(rf"{name} \(-\d+ dB of its torque\)", outcome.err)
    assert "larger amplitude" in outcome.err


# --- recordings from elsewhere -------------------------------------------------------------------


@pytest.mark.parametrize("with_references", [True, False])
def test_a_period_that_nobody_wrote_down_is_found(small_bench, good, tmp_path, with_references):
    """Periods of two lengths; without references the torques tell them."""
    change = (lambda one: one) if with_references else unreferenced
    chosen = good.experiments if with_references else main_experiments(good)
    experiments = [replace(change(one), period=None) for one in chosen if one.kind == "multisine"]
    write_folder(replace(good, experiments=tuple(experiments)), tmp_path / "data")
    assert "    period:" not in (tmp_path / "data" / "recording.yaml").read_text(encoding="utf-8")
    path = tmp_path / "out.h5"
    assert small_bench.command("import", tmp_path / "data", "-o", path).code == 0
    outcome = small_bench.command("identify", path, "--json", *KNOWN)
    assert outcome.code == 0, outcome.err
    table, arm = json.loads(outcome.out)["model"]["axes"]
    assert [m["value"] for m in table["masses"]] == pytest.approx([0.02, 0.03], rel=2e-3)
    assert table["springs"][0]["value"] == pytest.approx(190, rel=2e-3)
    assert arm["masses"][0]["value"] == pytest.approx(0.04, rel=2e-3)


def test_the_next_plan_from_data_without_a_period(small_bench, good, tmp_path):
    path = tmp_path / "recording.h5"
    experiments = [replace(one, period=None) for one in main_experiments(good)]
    save(replace(good, experiments=tuple(experiments)), path)
    outcome = small_bench.command("identify", path, "--plan-only", "--time", 8, *KNOWN)
    assert outcome.code == 0, outcome.err
    assert "What the next measurement should be" in outcome.out
    assert "To expect (95 %)" in outcome.out


def test_a_folder_that_never_repeats_is_imported_but_not_identified(
    small_bench, good, tmp_path, fresh_rng
):
    experiments = tuple(never_repeating(one, fresh_rng) for one in main_experiments(good))
    write_folder(replace(good, experiments=experiments), tmp_path / "data")
    path = tmp_path / "out.h5"
    assert small_bench.command("import", tmp_path / "data", "-o", path).code == 0
    outcome = small_bench.command("identify", path)
    named_with_exit_code_5(outcome, ("no period given", "half of the record", "give the period"))
    assert load(path).experiment("fast 1").samples == experiments[0].samples


# --- loops that become unstable ------------------------------------------------------------------


@dataclass(frozen=True)
class GainsRise(Fault):
    """A loop's position gain and integral gain become so many times larger."""

    factor: float = 1.0

    def set(self, machine, *, present):
        k = machine.node(self.node_id).axis
        for parameter in (Parameter.POSITION_P, Parameter.VELOCITY_I):
            machine.axes.set(k, parameter, machine.axes.get(k, parameter) * self.factor)


def in_the_pilot(bench, monkeypatch, fault, after):
    """Let a fault come so many SYNCs after the pilot's axes begin to move to their centres."""
    run_multisine, parts = fast_measuring.run_multisine, []

    def noting(*arguments):
        if not parts:
            bench.inject(fault, bench.machine.sync_count + after)
        parts.append(arguments)
        return run_multisine(*arguments)

    monkeypatch.setattr(fast_measuring, "run_multisine", noting)


def kept_and_safe(bench):
    assert bench.powered() == {}
    last = bench.recording().experiments[-1]
    assert not last.complete
    assert last.samples > 100
    assert np.ptp(last.torque[:, 0]) > 1.0
    return last


@pytest.mark.parametrize("factor", [5.0, 6.0])
def test_a_loop_that_becomes_unstable_in_the_pilot(make_bench, monkeypatch, factor):
    """It grows until a limit stops it, in the pilot or in the pause before the pilot is repeated."""
    monkeypatch.setattr(planning, "PILOT_SHARE", 0.03)  # else higher gains alone reach a limit
    bench = make_bench(turntable())
    in_the_pilot(bench, monkeypatch, GainsRise(TABLE, factor), 1500)
    outcome = bench.command("measure", bench.profile, "--out", bench.out, "--time", 20)
    named_with_exit_code_5(
        outcome, ("table: its loop becomes unstable", "experiment pilot", "Hz", "gains")
    )
    assert "what stopped the axes: table: torque" in outcome.err
    kept_and_safe(bench)


def unstable_with_the_true_end_mass(position_p=35, velocity_i=16):
    """A table whose loop is stable by the prior model; it grows by e in about 1 s with the true mass."""
    machine = turntable(position_p=position_p, velocity_i=velocity_i)
    machine["simulation"]["axes"][0]["masses"] = [0.02, 0.2]
    return machine


@pytest.mark.parametrize(
    ("gains", "wait", "how"),
    [
        ((35, 16), 0.5, "unstable: by what the pilot has shown"),  # too slow for 2 s and the wait
        ((35, 16), 20.0, "becomes unstable: after the last experiment"),
        ((60, 30), 20.0, "becomes unstable: in experiment pilot 1"),
    ],
)
def test_a_loop_that_is_unstable_with_the_true_end_mass_only(
    make_bench, monkeypatch, gains, wait, how
):
    """Directions are not checked here: the pilot is the first that moves."""
    monkeypatch.setattr(axes, "STILL_TIMEOUT", wait)
    monkeypatch.setattr(fast_measuring, "check_directions", lambda *_: None)
    bench = make_bench(unstable_with_the_true_end_mass(*gains))
    outcome = bench.command("measure", bench.profile, "--out", bench.out)
    named_with_exit_code_5(outcome, ("table: its loop ", how, "Hz", "Lower the drive's gains"))
    assert bench.powered() == {}
    assert bench.changed() == {}
    assert bench.recording().experiment("pilot 1").samples > 100


def test_the_check_of_directions_stops_an_unstable_loop_before_the_pilot(make_bench):
    """That is a safety stop: it can not tell why an axis moves that was told to stand still."""
    bench = make_bench(unstable_with_the_true_end_mass())
    outcome = bench.command("measure", bench.profile, "--out", bench.out)
    assert outcome.code == 4, outcome.err
    assert "table" in outcome.err
    assert bench.powered() == {}
    assert bench.changed() == {}
    last = bench.recording().experiments[-1]
    assert last.name.startswith("direction check of")
    assert not last.complete


def test_a_motor_that_runs_away_in_the_pilot_is_a_safety_stop(make_bench, monkeypatch):
    """A limit that is passed without an oscillation that grows stays what it is: exit code 4."""
    bench = make_bench(turntable())
    in_the_pilot(bench, monkeypatch, MotorReversed(TABLE), 1200)
    outcome = bench.command("measure", bench.profile, "--out", bench.out)
    assert outcome.code == 4, outcome.err
    assert "table" in outcome.err
    assert "unstable" not in outcome.err
    assert kept_and_safe(bench).name == "pilot 1"
