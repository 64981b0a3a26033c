"""The fast plan as a user meets it: planned, measured, stopped, and what it makes of dry friction."""

import json
import signal
from dataclasses import dataclass, replace
from importlib.resources import files

import numpy as np
import pytest
import yaml

from drives.profile import load_machine
from drives.sim.faults import DriveFault, Fault
from fieldtool.workflow import fast_measuring
from fieldtool.workflow.models import prior_model
from fieldtool.workflow.preparation import setting_of, without_feed_forward

TABLE, ARM = 11, 12
INTO = (900, 3000)
"""SYNCs from the start of pilot and main experiments into their excitation: the axes are brought to
their centres, and wait until they are at rest, first."""


@dataclass(frozen=True)
class Pressed(Fault):
    """The user presses Ctrl-C at this moment."""

    def set(self, machine, *, present):
        signal.raise_signal(signal.SIGINT)


def turntable(friction=0.0, travel=None):
    """The packaged turntable, with dry friction at both motors, N m, and another travel, degrees."""
    text = files("profiles").joinpath("machines/turntable-arm.yaml").read_text(encoding="utf-8")
    machine = yaml.safe_load(text)
    for axis, simulated in zip(machine["axes"], machine["simulation"]["axes"], strict=True):
        if friction:
            simulated["effects"] = [
                {"effect": "coulomb_friction", "location": "motor", "torque": friction}
            ]
        if travel is not None:
            axis["limits"]["travel"] = [f"-{travel} deg", f"{travel} deg"]
    return machine


def inject_in(bench, monkeypatch, part, fault):
    """Let a fault come in the midst of the pilot (part 0) or of the main experiments (1)."""
    run_multisine, parts = fast_measuring.run_multisine, []

    def noting(*arguments):
        if len(parts) == part:
            bench.inject(fault, bench.machine.sync_count + INTO[part])
        parts.append(part)
        return run_multisine(*arguments)

    monkeypatch.setattr(fast_measuring, "run_multisine", noting)


def fast(bench, command, *options):
    return bench.command(command, bench.profile, "--out", bench.out, *options)


def enabling_words(frames):
    """Controlwords with all four enabling bits, from RPDOs and SDO downloads of 0x6040."""
    words = []
    for frame in frames:
        if frame.cob_id & 0x780 == 0x200 and len(frame.data) >= 2:
            words.append(int.from_bytes(frame.data[:2], "little"))
        if frame.cob_id & 0x780 == 0x600 and frame.data[1:3] == b"\x40\x60":
            words.append(int.from_bytes(frame.data[4:6], "little"))
    return [word for word in words if word & 0x0F == 0x0F]


# --- plans ---------------------------------------------------------------------------------------


def test_plan_only_moves_nothing(make_bench):
    bench = make_bench(turntable())
    bench.listen()
    outcome = fast(bench, "measure", "--plan-only")
    frames = bench.heard()
    assert outcome.code == 0, outcome.err
    for words in ("pilot", "main", "To expect (95 %)", "moves at most"):
        assert words in outcome.out
    assert frames, "the drives' gains were read"
    assert enabling_words(frames) == []
    assert [f for f in frames if f.cob_id & 0x780 == 0x600 and f.data[0] >> 5 == 1] == [], (
        "a download"
    )
    assert bench.machine.sync_count == 0
    assert bench.changed() == {}
    assert not bench.out.exists()


def test_a_plan_alone_is_made_as_if_feed_forward_were_off(make_bench):
    """The run that follows switches it off; a plan alone does not touch it, and says the same."""
    bench = make_bench(turntable())
    with bench.connected() as group:
        machine = load_machine(bench.profile)
        model = prior_model(machine)
        held = setting_of(machine, group, model).loops
        planned = [without_feed_forward(*pair) for pair in zip(group.drives, held, strict=True)]
        with group.without_feed_forward():
            met = setting_of(machine, group, model).loops
    assert any(loop.velocity_ff for loop in held)
    assert planned == list(met)


def test_too_little_time_is_extended_and_said(make_bench):
    bench = make_bench(turntable())
    outcome = fast(bench, "measure", "--plan-only", "--time", 3, "--json")
    assert outcome.code == 0, outcome.err
    seconds = json.loads(outcome.out)["excitation_s"]
    assert seconds > 3
    said = " ".join(outcome.err.split())
    assert "3 s are too short for this machine: run-in and two periods" in said
    assert f"take {seconds:.0f} s in all" in said
    enough = fast(bench, "measure", "--plan-only", "--time", 12)
    assert enough.code == 0
    assert "too short" not in enough.out


def test_three_seconds_for_the_papers_machine_are_extended(small_bench):
    outcome = small_bench.command("measure", "paper-3x3", "--plan-only", "--time", 3)
    assert outcome.code == 0, outcome.err
    assert "3 s are too short for this machine" in outcome.out


@pytest.mark.parametrize(
    "options",
    [
        ("--plan", "classic", "--time", 20),
        ("--plan", "classic", "--plan-only"),
        ("--time", "inf"),
        ("--time", "nan"),
        ("--time", 0),
        ("--time", 1e6),
        ("--plan", "fats"),
    ],
)
@pytest.mark.parametrize("command", ["measure", "run"])
def test_wrong_options_are_refused(small_bench, command, options):
    outcome = fast(small_bench, command, *options)
    assert outcome.code == 2
    assert "Invalid value" in outcome.err
    assert small_bench.machine.sync_count == 0


# --- stops ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("part", [0, 1])
def test_ctrl_c_disables_the_drives_and_keeps_the_data(make_bench, monkeypatch, part):
    bench = make_bench(turntable())
    inject_in(bench, monkeypatch, part, Pressed(TABLE))
    outcome = fast(bench, "run", "--write", "--yes")
    assert outcome.code == 130, outcome.err
    assert "Stopping all axes" in outcome.err
    assert "stopped by the user" in outcome.err
    stopped_safely(bench, ["pilot 1", "fast 1"][part])


@pytest.mark.parametrize("part", [0, 1])
def test_a_drive_fault_in_the_middle_is_named_and_the_data_are_kept(make_bench, monkeypatch, part):
    bench = make_bench(turntable())
    inject_in(bench, monkeypatch, part, DriveFault(ARM, 0x2310))
    bench.listen()
    outcome = fast(bench, "measure")
    assert enabling_words(bench.heard()), "what --plan-only must not send"
    assert outcome.code == 4, outcome.err
    assert "arm" in outcome.err
    assert "0x2310" in outcome.err
    stopped_safely(bench, ["pilot 1", "fast 1"][part])


def stopped_safely(bench, cut):
    """Drives off and as they were, feed-forward put back; complete experiments, then the cut one."""
    assert bench.powered() == {}
    assert bench.changed() == {}
    experiments = bench.recording().experiments
    assert [e.name for e in experiments if not e.complete] == [cut]
    assert experiments[-1].name == cut
    assert experiments[-1].samples > 100
    assert experiments[-1].note
    assert not (bench.out / "write-journal.yaml").exists()


def test_feed_forward_is_off_while_it_measures_and_put_back(make_bench, monkeypatch):
    bench = make_bench(turntable())
    node = bench.machine.nodes[0]
    before, during = bench.objects(), []

    @dataclass(frozen=True)
    class Looked(Fault):
        def set(self, machine, *, present):
            during.append(bench.changed()[TABLE])

    inject_in(bench, monkeypatch, 1, Looked(TABLE))
    outcome = fast(bench, "measure")
    assert outcome.code == 0, outcome.err
    assert any(was and not now for was, now in during[0].values()), "velocity_ff was 1"
    assert bench.objects() == before
    assert bench.changed() == {}
    assert node.memory.stored == {}
    assert bench.powered() == {}


# --- a pilot that nothing explains ---------------------------------------------------------------


def test_a_plan_on_a_model_that_does_not_explain_the_pilot_is_weaker(make_bench, monkeypatch):
    """An arm three times as heavy as the profile says: by its model the plan would pass the limit."""
    machine = turntable()
    machine["simulation"]["axes"][1]["masses"] = [0.12]
    bench = make_bench(machine)
    read_pilot = fast_measuring.read_pilot

    def unexplained(recording, prior):
        return replace(read_pilot(recording, prior), model=prior, friction=None)

    monkeypatch.setattr(fast_measuring, "read_pilot", unexplained)
    outcome = fast(bench, "measure")
    assert outcome.code == 0, outcome.err
    said = " ".join(outcome.out.split())
    more = float(said.split("In the pilot the torques went up to ")[1].split()[0])
    assert more > 1.3
    experiments = bench.recording().experiments
    taken = {
        part: max(np.abs(e.torque[:, 1]).max() for e in experiments if e.name.startswith(part))
        for part in ("pilot", "fast")
    }
    assert taken["pilot"] < taken["fast"] < 0.9 * 6.0


def test_a_pilot_whose_modes_are_too_fast_for_the_cycle_is_not_followed(make_bench, monkeypatch):
    """Friction that holds an axis looks like a spring a hundred times as stiff."""
    bench = make_bench(turntable())
    read_pilot = fast_measuring.read_pilot

    def stiff(recording, prior):
        found = read_pilot(recording, prior)
        table, *others = found.model.axes
        springs = tuple(replace(k, value=300 * k.value) for k in table.springs)
        model = replace(found.model, axes=(replace(table, springs=springs), *others))
        return replace(found, model=model)

    monkeypatch.setattr(fast_measuring, "read_pilot", stiff)
    outcome = fast(bench, "measure")
    assert outcome.code == 0, outcome.err
    said = " ".join(outcome.out.split())
    assert "too fast for the cycle" in said
    assert "Simulated with the pilot's model" not in said
    assert "Resonances found" not in said


# --- dry friction --------------------------------------------------------------------------------


@pytest.mark.parametrize(("travel", "friction", "biased"), [(120, 0.16, True), (40, 0.06, False)])
def test_moderate_dry_friction_leaves_masses_and_springs(make_bench, travel, friction, biased):
    """5 % of the peak torque: a constant velocity keeps it out, where the travel is long enough."""
    bench = make_bench(turntable(friction, travel))
    measured = fast(bench, "measure")
    assert measured.code == 0, measured.err
    outcome = bench.command("identify", bench.out, "--masses", "table=2", "--masses", "arm=1")
    assert outcome.code == 0, outcome.err
    said = " ".join((measured.out + outcome.out).split())
    assert ("a constant velocity is added, so that the axes do not reverse" in said) == biased
    assert ("the travel is too short for a constant velocity" in said) != biased
    for name in ("table", "arm"):
        assert f"{name}: dry friction of " in said
    model = yaml.safe_load((bench.out / "model.yaml").read_text(encoding="utf-8"))
    found = {
        effect["axis"]: effect["parameters"]["torque"]["value"]
        for effect in model["effects"]
        if effect["effect"] == "coulomb_friction"
    }
    assert found == pytest.approx({"table": friction, "arm": friction}, rel=0.05)
    for axis, truth in zip(model["axes"], bench.data["simulation"]["axes"], strict=True):
        for kind in ("masses", "springs"):
            values = [one["value"] for one in axis[kind]]
            assert values == pytest.approx(truth.get(kind, []), rel=2e-3)


def test_friction_of_most_of_the_torque_is_told_from_masses_and_springs(make_bench, fresh_rng):
    """It holds the motors at every turn; the prior model is that of the machine before new tooling."""
    friction = float(fresh_rng.uniform(0.6, 0.9))
    machine = turntable(friction)
    for simulated in machine["simulation"]["axes"]:
        for gain, factor in (("position_p", 2.0), ("velocity_p", 2.0), ("velocity_i", 4.0)):
            simulated["gains"][gain] *= factor
    bench = make_bench(machine)
    outcome = fast(bench, "measure", "--time", 20)
    assert outcome.code == 0, outcome.err
    outcome = bench.command("identify", bench.out)
    assert outcome.code == 0, outcome.err
    model = yaml.safe_load((bench.out / "model.yaml").read_text(encoding="utf-8"))
    for axis, truth in zip(model["axes"], machine["simulation"]["axes"], strict=True):
        for kind in ("masses", "springs"):
            for one, true in zip(axis[kind], truth.get(kind, []), strict=True):
                assert one["value"] == pytest.approx(true, abs=5 * one["std"] + 0.002 * true)
                assert one["value"] == pytest.approx(true, rel=0.06)
    rubs = {
        e["axis"]: e["parameters"]["torque"]["value"]
        for e in model["effects"]
        if e["effect"] == "coulomb_friction"
    }
    assert rubs == pytest.approx({"table": friction, "arm": friction}, rel=0.05)
