"""An axis whose weak loop lets it sag as its drive is enabled, and how far it may."""

import numpy as np
import pytest

from drives.errors import OscillationError, SafetyStopError
from drives.sim.faults import MotorReversed
from fieldtool.experiment.directions import check_directions
from fieldtool.experiment.verification.trial import run_trial, still_allowed
from fieldtool.records.recording import load
from tests.session.test_trial import axes_of, trial, try_it

ARM = 12
CYCLE = 0.002
SAG = "40 mrad"
STIFFNESS = 8.0 * 0.6
"""N m/rad of the arm's position and velocity loop: its integral part takes over later."""


@pytest.fixture
def weighs(make_bench, profile_of_two, fresh_rng):
    """A machine whose arm has a weight that pulls it down by so much, and a limit for that."""

    def make(far, sag):
        arm, truth = profile_of_two["axes"][1], profile_of_two["simulation"]["axes"][1]
        arm["may_float"] = False
        if sag:
            arm["limits"]["sag"] = sag
        truth["gains"] |= {
            "position_p": 8.0,
            "velocity_p": 0.6,
            "velocity_i": float(fresh_rng.uniform(1.5, 5.0)),
        }
        angle = float(np.pi / 2 * fresh_rng.choice([-1.0, 1.0]) + fresh_rng.uniform(-0.3, 0.3))
        truth["effects"] = [
            {
                "effect": "gravity",
                "torque": float(far * STIFFNESS / abs(np.sin(angle))),
                "angle": angle,
            }
        ]
        profile_of_two["simulation"]["seed"] = int(fresh_rng.integers(2**31))
        return make_bench(profile_of_two)

    return make


def check(bench, kept):
    with bench.connected() as group:
        axes = axes_of(group)
        check_directions(group, axes, CYCLE, kept.append)


def farthest(experiment):
    """How far the arm went from where it was at first."""
    arm = experiment.position[:, 1]
    return np.abs(arm - arm[0]).max()


def allowed(bench):
    with bench.connected() as group:
        return still_allowed(axes_of(group))[1]


def test_an_axis_that_sags_is_stopped_and_the_limit_for_that_is_named(weighs):
    bench, kept = weighs(0.025, None), []
    with pytest.raises(SafetyStopError, match=r"sags when its brake opens.*`sag`") as stop:
        check(bench, kept)
    assert (stop.value.axis, stop.value.runaway) == ("arm", True)
    assert "Secure it against falling" in str(stop.value)
    assert bench.powered() == {}


def test_with_that_limit_it_is_checked_and_measured(weighs):
    bench, kept = weighs(0.025, SAG), []
    check(bench, kept)
    assert [(e.name, e.complete) for e in kept] == [
        ("direction check of table", True),
        ("direction check of arm", True),
    ]
    outcome = bench.measure(plan="fast")
    assert outcome.code == 0, outcome.err
    assert bench.powered() == {}
    assert bench.changed() == {}


def test_one_that_sags_farther_than_its_limit_is_stopped_too(weighs):
    bench = weighs(0.025, "5 mrad")
    outcome = bench.measure(plan="fast")
    assert outcome.code == 4
    assert "`sag` in the machine profile is 0.005 rad" in " ".join(outcome.err.split())
    cut = load(bench.out / "recording.h5").experiments[-1]
    assert (cut.name, cut.complete) == ("standing still", False)
    assert farthest(cut) < 1.3 * (0.005 + allowed(bench))
    assert bench.powered() == {}


@pytest.mark.parametrize("far", [0.0, 0.025])
def test_a_reversed_motor_is_found_before_it_has_gone_farther(weighs, far):
    """Without a weight it runs away from a pulse or a nudge: there nothing is allowed but what was."""
    bench, kept = weighs(far, SAG), []
    bench.inject(MotorReversed(ARM))
    with pytest.raises(SafetyStopError, match="arm: ") as stop:
        check(bench, kept)
    assert stop.value.axis == "arm"
    assert farthest(kept[-1]) < 1.3 * ((0.04 if far else 0.0) + allowed(bench))
    assert bench.powered() == {}


@pytest.mark.parametrize("sag", [None, SAG])
@pytest.mark.parametrize("trusts_loops", [True, False])
def test_in_a_trial_it_may_sag_as_its_limit_says(weighs, trusts_loops, sag):
    bench, kept = weighs(0.045, sag), []
    if sag:
        tried = try_it(bench, kept, trusts_loops=trusts_loops)
        assert tried.sags[1] > allowed(bench)
        assert [e.name for e in kept] == ["after: move of table", "after: move of arm"]
        return
    with pytest.raises(OscillationError, match=r"sags under its load.*have no `sag`"):
        try_it(bench, kept, trusts_loops=trusts_loops)
    assert bench.powered() == {}


def test_a_reversed_motor_is_found_in_a_trial_too(weighs):
    bench, kept = weighs(0.025, SAG), []
    bench.inject(MotorReversed(ARM))
    with pytest.raises(OscillationError, match="arm: ") as stop:
        try_it(bench, kept)
    assert stop.value.axis == "arm"
    assert farthest(kept[-1]) < 1.3 * (0.04 + allowed(bench))
    assert bench.powered() == {}


def test_new_loops_may_sag_little_farther_than_the_old_ones_did(weighs):
    bench = weighs(0.045, SAG)
    with bench.connected() as group:
        axes = axes_of(group)
        with pytest.raises(OscillationError, match="sags under its load"):
            run_trial(
                group,
                trial(),
                axes,
                lambda _: None,
                "after",
                trusts_loops=False,
                sags=still_allowed(axes),
            )
