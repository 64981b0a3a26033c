"""Is the controller the one that was written, and does its motor push the way it is asked to?

The drive and its machine are simulated here step by step, by a loop of their own, not by the tool's
matrices.
"""

from dataclasses import dataclass, replace
from math import copysign, exp
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st

from drives.api import Alarm, AxisLimits
from fieldtool.design.servo import Servo, Timing
from fieldtool.experiment.verification.controller import (
    FROM_POSITION,
    FROM_REFERENCE,
    DriveLoop,
    ExpectedTorque,
    locked_torque,
)
from fieldtool.experiment.verification.identity import BLIND, IdentityWatch
from fieldtool.experiment.verification.learned import Learned
from fieldtool.experiment.verification.watch import Guards, TrialWatch
from fieldtool.experiment.verification.work import WorkRecord, WorkWatch
from fieldtool.records.closed_loop import AxisLoop, Biquad
from fieldtool.workflow import trial_records
from fieldtool.workflow.design_inputs import timing_of
from fieldtool.workflow.trial_loops import drive_loop, first_answer

STEP, PERIOD, LAG = 1e-3, 0.125e-3, 0.16e-3
COUNT = 2 * np.pi / 2**20
INERTIA, LIMIT = 0.5, 40.0
LIMITS = AxisLimits((-3.0, 3.0), 3.0, 60.0, LIMIT, 0.5)
GOOD = AxisLoop(30.0, 60.0 * INERTIA, 60.0 * 15.0 * INERTIA, 1.0, 0.9 * INERTIA)


class Blind:
    """A watch for swings that sees none."""

    trusts_loops = strays = False

    def begin(self):
        """Nothing is kept."""

    def take(self, position, torque, smooth):
        """Say nothing."""


@dataclass
class Axis:
    """A motor with a load on a spring and its drive, stepped at the rate of the drive's loops."""

    loop: AxisLoop
    sign: float = 1.0
    friction: float = 0.0
    load: float = 0.4 * INERTIA
    spring: float = 0.4 * INERTIA * (2 * np.pi * 15.0) ** 2
    period: float = PERIOD
    lag: float = LAG

    def run(self, targets, noise=0.0, seed=0, count=COUNT, step=STEP):
        """Return positions and torques as they are told at each SYNC, (n,) each."""
        rng = np.random.default_rng(seed)
        motor, loop = INERTIA - self.load, self.loop
        q1 = q2 = v1 = v2 = seen = integral = torque = last = before = 0.0
        memory = [[0.0, 0.0] for _ in loop.filters]
        parts = max(
            1, round(self.period / PERIOD)
        )  # of a loop's period, in which the machine moves
        h = self.period / parts
        follow, damping = 1 - exp(-h / self.lag), 0.02 * self.load * 90
        told = []
        for target in targets.tolist():
            told.append((round(q1 / count) * count, torque + noise * rng.standard_normal()))
            speed, bend = (target - last) / step, (target - 2 * last + before) / step**2
            loops = round(step / self.period)
            for k in range(loops):
                position = round(q1 / count) * count
                velocity, seen = (position - seen) / self.period, position
                reference = last + (target - last) * k / loops
                error = loop.position_p * (reference - position) + speed - velocity
                fed = loop.viscous_ff * speed + loop.inertia_ff * bend
                wanted = loop.velocity_p * error + integral + fed
                integral += loop.velocity_i * self.period * error
                for one, state in zip(loop.filters, memory, strict=True):
                    wanted = filtered(one, state, wanted, self.period)
                for _ in range(parts):
                    torque += follow * (min(max(wanted, -LIMIT), LIMIT) - torque)
                    pull = self.spring * (q2 - q1)
                    push = self.sign * torque + pull
                    if abs(v1) < 1e-6 and abs(push) <= self.friction:
                        v1 = 0.0
                    else:
                        slid = v1 + h * (push - copysign(self.friction, v1 or push)) / motor
                        v1 = 0.0 if slid * v1 < 0 else slid
                    v2 += h * (-pull - damping * (v2 - v1)) / self.load
                    q1, q2 = q1 + h * v1, q2 + h * v2
            before, last = last, target
        position, torques = np.array(told).T
        return position, torques


def filtered(one, state, value, h):
    """A filter by small steps of its own differential equation (implicit Euler)."""
    (n2, n1, n0), (d1, d0) = one.numerator, one.denominator
    x, dx = state
    dx = (dx + h * (value - d0 * x)) / (1 + h * d1 + h * h * d0)
    x = x + h * dx
    state[:] = [x, dx]
    return n2 * (value - d1 * dx - d0 * x) + n1 * dx + n0 * x


def drive(loop, **changes):
    noise = Servo(loop, timing=Timing(LAG, PERIOD)).torque_noise(COUNT)
    one = DriveLoop(loop, period=PERIOD, lag=LAG + PERIOD / 2, unsure=0.1e-3, noise=noise)
    return replace(one, **changes)


def trial_path(loop, count=COUNT, hold=100, step=STEP, one=None):
    answer = first_answer([one or drive(loop)], count, LIMITS, 0.5, step)
    u = np.arange(round(0.2 / step)) * step / 0.2
    nudge = np.round(0.01 * u**3 * (10 - 15 * u + 6 * u * u) / count) * count
    return np.concatenate(
        [np.zeros(hold), answer, np.zeros(120), nudge, nudge[-1] - nudge, np.zeros(50)]
    ), hold


def watch(loop, learned=None, noise=0.0, encoder=None, step=STEP, **changes):
    if encoder is not None:
        changes["noise"] = encoder
    quanta = np.array([max(noise, 0.01)])
    if learned is None:
        learned = Learned(np.array([2 * noise]), np.array([0.3]), np.zeros(1))
    return IdentityWatch([drive(loop, **changes)], step, quanta, learned, ["N m"])


def first_alarm(one, position, torque, target):
    for n, (q, t, r) in enumerate(zip(position, torque, target, strict=True)):
        if one.take([q], [t], [r], [0.0], fresh=True):
            return n
    return None


@settings(max_examples=40, deadline=None)
@given(
    bandwidth=st.floats(15.0, 120.0),
    ratio=st.floats(2.0, 5.0),
    ahead=st.floats(0.0, 1.0),
    against=st.floats(0.0, 1.0),
    friction=st.floats(0.0, 4.0),
    noise=st.floats(0.0, 0.03),
    notch=st.booleans(),
    seed=st.integers(0, 2**31),
)
def test_a_controller_that_was_written_is_never_doubted(
    bandwidth, ratio, ahead, against, friction, noise, notch, seed
):
    filters = (Biquad.notch(120.0, 0.1, 0.7),) if notch else ()
    loop = AxisLoop(
        bandwidth / ratio,
        bandwidth * INERTIA,
        bandwidth**2 / 4 * INERTIA,
        1.0,
        ahead * INERTIA,
        filters,
        against * bandwidth * INERTIA,
    )
    target, _ = trial_path(loop)
    sigma = noise * LIMIT
    position, torque = Axis(loop, friction=friction).run(target, sigma, seed)
    assert first_alarm(watch(loop, noise=sigma), position, torque, target) is None


UNKNOWN_TIMES = Timing(1e-3, 0.5e-3)
"""What is reckoned with where a profile does not know them."""


def unknown(loop, count=COUNT):
    """What a watch is told of a drive whose loops' period and torque lag are not known."""
    servo = Servo(loop, timing=UNKNOWN_TIMES)
    return {
        "period": UNKNOWN_TIMES.period,
        "lag": UNKNOWN_TIMES.lag,
        "unsure": 1.05e-3,
        "unsure_velocity": 0.5 * UNKNOWN_TIMES.period,
        "encoder": servo.torque_noise(count),
        "count": servo.count_torque(count),
    }


def quick_path(way, count):
    """A move that feed-forward makes nearly by itself, out and back."""
    u = np.arange(round(0.2 / STEP)) * STEP / 0.2
    out = np.round(way * u**3 * (10 - 15 * u + 6 * u * u) / count) * count
    return np.concatenate([np.zeros(60), out, np.full(60, out[-1]), out[-1] - out, np.zeros(50)])


def sentences(one, position, torque, target):
    return [
        text
        for q, t, r in zip(position, torque, target, strict=True)
        for _, text in one.take([q], [t], [r], [0.0], fresh=True)
    ]


RIGID = {"load": 1e-3 * INERTIA, "spring": 1e-3 * INERTIA * (2 * np.pi * 15.0) ** 2}


@settings(max_examples=25, deadline=None)
@given(
    bandwidth=st.floats(40.0, 100.0),
    ratio=st.floats(1.8, 4.0),
    ahead=st.floats(0.95, 1.0),
    way=st.floats(0.1, 0.4),
    noise=st.floats(0.0, 0.05),
    seed=st.integers(0, 2**31),
)
def test_gains_that_were_written_are_never_doubted_where_times_are_not_known(
    bandwidth, ratio, ahead, way, noise, seed
):
    """Four times as quick as is reckoned with, so its velocity comes earlier; its position does not."""
    fine = COUNT / 16
    velocity_p = bandwidth * INERTIA
    loop = AxisLoop(bandwidth / ratio, velocity_p, bandwidth / 4 * velocity_p, 1.0, ahead * INERTIA)
    target = quick_path(way, fine)
    position, torque = Axis(loop, **RIGID).run(target, noise, seed, fine)
    said = sentences(watch(loop, noise=noise, **unknown(loop, fine)), position, torque, target)
    assert not [text for text in said if "times what was written" in text]


def test_without_what_is_not_known_of_its_velocity_good_gains_would_be_doubted():
    fine = COUNT / 16
    loop = AxisLoop(40.0, 71.0 * INERTIA, 71.0 * 46.0 * INERTIA, 1.0, 0.97 * INERTIA)
    target = quick_path(0.2, fine)
    position, torque = Axis(loop, **RIGID).run(target, 0.02, 3, fine)
    known = unknown(loop, fine) | {"unsure_velocity": 0.0}
    assert sentences(watch(loop, noise=0.02, **known), position, torque, target)
    one = watch(loop, noise=0.02, **unknown(loop, fine))
    assert not sentences(one, position, torque, target)


@pytest.mark.parametrize("factor", [0.1, 10.0])
@pytest.mark.parametrize("names", [("velocity_p", "velocity_i"), ("position_p",)])
def test_gains_ten_times_off_show_where_times_are_not_known(names, factor):
    fine = COUNT / 16
    held = replace(GOOD, **{name: factor * getattr(GOOD, name) for name in names})
    for target in (trial_path(GOOD, fine)[0], quick_path(0.2, fine)):
        position, torque = Axis(held).run(target, 0.02, 3, fine)
        one = watch(GOOD, noise=0.02, **unknown(GOOD, fine))
        assert sentences(one, position, torque, target)


def believed(loop, count, lag=0.0, period="unknown"):
    """What a watch is told of a drive by its profile."""
    profile = SimpleNamespace(
        loop_period=period, torque_lag=lag, interpolation="linear", structure="unknown", name="any"
    )
    told = SimpleNamespace(profile=profile, scaling=SimpleNamespace(position=count))
    return replace(drive_loop(told, Servo(loop, timing=timing_of(profile, STEP))), why_not="")


def watched(one, noise):
    learned = Learned(np.array([2 * noise]), np.array([0.3]), np.zeros(1))
    return IdentityWatch([one], STEP, np.array([max(noise, 0.01)]), learned, ["N m"])


TIMES = {
    "loops": st.sampled_from([1, 2, 4, 8, 16, 32]),
    "lag": st.floats(0.05e-3, 1e-3),
    "lag_is_known": st.booleans(),
}


@settings(max_examples=60, deadline=None)
@given(
    bandwidth=st.floats(15.0, 120.0),
    ratio=st.floats(2.0, 5.0),
    integral=st.floats(0.1, 0.3),
    ahead=st.floats(0.0, 1.0),
    against=st.floats(0.0, 1.0),
    friction=st.floats(0.0, 4.0),
    noise=st.just(0.0) | st.floats(0.0, 0.03),
    notch=st.booleans(),
    rigid=st.booleans(),
    quick=st.booleans(),
    finer=st.sampled_from([0.25, 1.0, 4.0, 16.0]),
    seed=st.integers(0, 2**31),
    **TIMES,
)
@example(99.5, 2.487, 0.25, 0.78, 0.86, 2.2, 0.0, False, False, True, 16.0, 1, 32, 0.08e-3, False)
@example(100, 3.0, 0.25, 0.5, 0.0, 0.0, 0.0, False, False, True, 1.0, 5, 16, 0.06e-3, False)
@example(68, 3.0, 0.25, 0.5, 0.0, 0.0, 0.0, False, False, False, 1.0, 29, 32, 0.15e-3, False)
@example(15.0, 2.0, 0.25, 0.0, 0.0, 0.0, 0.0, True, False, False, 16.0, 0, 1, 1e-3, False)
@example(22.84, 2.207, 0.1, 0.41, 1.0, 0.56, 0.0, True, False, False, 16.0, 53672467, 2, 1e-3, True)
@example(15.0, 4.23, 0.3, 0.386, 0.0, 4.0, 0.0, True, False, False, 16.0, 1599907105, 1, 5e-5, True)
def test_a_sound_drive_is_never_doubted_whatever_the_period_that_nobody_knows(
    bandwidth,
    ratio,
    integral,
    ahead,
    against,
    friction,
    noise,
    notch,
    rigid,
    quick,
    finer,
    seed,
    loops,
    lag,
    lag_is_known,
):
    filters = (Biquad.notch(120.0, 0.1, 0.7),) if notch else ()
    velocity_p, count, period = bandwidth * INERTIA, COUNT / finer, STEP / loops
    loop = AxisLoop(
        bandwidth / ratio,
        velocity_p,
        integral * bandwidth * velocity_p,
        1.0,
        ahead * INERTIA,
        filters,
        against * velocity_p,
    )
    known = believed(loop, count, lag + period / 2 if lag_is_known else 0.0)
    target = quick_path(0.2, count) if quick else trial_path(loop, count, one=known)[0]
    axis = Axis(loop, friction=friction, period=period, lag=lag, **(RIGID if rigid else {}))
    position, torque = axis.run(target, noise * LIMIT, seed, count)
    assume(np.abs(torque).max() < 0.95 * LIMIT)
    assert not sentences(watched(known, noise * LIMIT), position, torque, target)


GAINS = ("velocity_p", "velocity_i")


@pytest.mark.parametrize("loops", [1, 8, 32])
@pytest.mark.parametrize("finer", [1.0, 16.0])
@pytest.mark.parametrize(
    ("gains", "told", "moves"),
    [(-1.0, 1.0, False), (1.0, -1.0, False), (1.0, 10.0, False), (10.0, 1.0, True)],
)
def test_wrong_signs_and_scales_show_where_the_period_is_not_known(
    gains, told, moves, finer, loops
):
    """All but gains that feed-forward hides at once in the first answer; those in the move after it."""
    count = COUNT / finer
    known = believed(GOOD, count)
    target, _ = trial_path(GOOD, count, one=known)
    if moves:
        target = np.concatenate([target, quick_path(0.2, count)])
    held = replace(GOOD, **{name: gains * getattr(GOOD, name) for name in GAINS})
    position, torque = Axis(held, period=STEP / loops).run(target, 0.02, 3, count)
    assert sentences(watched(known, 0.02), position, told * torque, target)


@pytest.mark.parametrize("count", [COUNT, COUNT / 16])
def test_only_where_the_period_is_not_known_more_is_taken(count):
    known, unsure = (believed(GOOD, count, LAG, period) for period in (PERIOD, "unknown"))
    servo = Servo(GOOD, timing=Timing(LAG, PERIOD, STEP))
    assert known.noise == pytest.approx(servo.torque_noise(count))
    assert known.count == pytest.approx(servo.count_torque(count))
    assert known.unsure_velocity == 0
    assert unsure.noise > known.noise
    assert unsure.count > known.count
    assert unsure.period > known.period, "what is expected is reckoned with the cautious one"


WRONG = {
    "gains ten times too high": {"velocity_p": 10.0, "velocity_i": 10.0},
    "gains of the wrong sign": {"velocity_p": -1.0, "velocity_i": -1.0},
    "feed-forward three times too high": {"inertia_ff": 3.0},
    "feed-forward of friction twenty times too high": {"viscous_ff": 20.0},
}


@pytest.mark.parametrize("what", WRONG)
def test_another_controller_shows_in_its_first_answer_within_some_counts(what):
    loop = replace(GOOD, viscous_ff=0.2 * GOOD.velocity_p)
    changed = {name: factor * getattr(loop, name) for name, factor in WRONG[what].items()}
    target, hold = trial_path(loop)
    position, torque = Axis(replace(loop, **changed)).run(target, 0.02, 3)
    found = first_alarm(watch(loop, noise=0.02), position, torque, target)
    assert found is not None
    assert found <= hold + 50
    assert np.abs(position[:found]).max() < 500 * COUNT


@pytest.mark.parametrize("factor", [6.0, 10.0])
def test_feed_forward_of_friction_that_is_too_high_shows_before_it_leads_far(factor):
    loop = replace(GOOD, viscous_ff=0.2 * GOOD.velocity_p)
    held = replace(loop, viscous_ff=factor * loop.viscous_ff)
    target, _ = trial_path(loop)
    position, torque = Axis(held).run(target, 0.02, 3)
    found = first_alarm(watch(loop, noise=0.02), position, torque, target)
    assert found is not None
    right, _ = Axis(loop).run(target, 0.02, 3)
    off = np.abs(position - right)
    assert off[:found].max() < 500 * COUNT


HIDDEN = {
    "feedback": (0.1, {"velocity_p": 0.1, "velocity_i": 0.1}),
    "position gain": (10.0, {"position_p": 10.0}),
    "velocity gain": (0.2, {"velocity_p": 0.2, "velocity_i": 0.2, "position_p": 5.0}),
}


@pytest.mark.parametrize(("step", "slower"), [(STEP, 1.0), (4e-3, 0.25), (5e-3, 0.2)])
@pytest.mark.parametrize("name", HIDDEN)
def test_gains_that_feed_forward_hides_are_named_with_their_factor(name, step, slower):
    """Feed-forward moves the axis nearly by itself, so torques are nearly as they should be."""
    factor, changes = HIDDEN[name]
    loop = replace(
        GOOD,
        position_p=slower * GOOD.position_p,
        velocity_p=slower * GOOD.velocity_p,
        velocity_i=slower**2 * GOOD.velocity_i,
    )
    held = replace(loop, **{key: by * getattr(loop, key) for key, by in changes.items()})
    fine = COUNT / 16
    target, _ = trial_path(loop, fine, step=step)
    position, torque = Axis(held).run(target, 0.02, 3, fine, step)
    one = watch(loop, noise=0.02, encoder=drive(loop).noise / 16, step=step)
    said = [
        text
        for q, t, r in zip(position, torque, target, strict=True)
        for _, text in one.take([q], [t], [r], [0.0], fresh=True)
    ]
    told = [text for text in said if text.startswith(f"its {name} is ")]
    assert told, said[:1]
    assert float(told[-1].split(" is ")[1].split()[0]) == pytest.approx(factor, rel=0.4, abs=0.3)


def test_the_noise_of_the_first_torque_is_no_wrong_gain():
    """All later ones are told against it, so it is no noise that comes anew with each cycle."""
    fine, said = COUNT / 4096, []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        way = rng.uniform(30, 3000) * fine * rng.choice([-1, 1])
        creeps = 1 - np.exp(-np.arange(80) * STEP / rng.uniform(0.01, 0.1))
        target, noise = np.round(way * creeps / fine) * fine, rng.uniform(0.05, 0.5)
        position, torque = Axis(GOOD).run(target, noise, seed, fine)
        loop = drive(GOOD, noise=drive(GOOD).noise / 4096)
        learned = Learned(np.array([4 * noise]), np.array([0.3]), np.zeros(1))
        one = IdentityWatch([loop], STEP, np.array([0.1 * noise]), learned, ["N m"])
        for q, t, r in zip(position, torque, target, strict=True):
            said += [text for _, text in one.take([q], [t], [r], [0.0], fresh=True)]
    assert not said


def test_positions_that_are_told_a_cycle_late_are_no_wrong_gain():
    """Old, slow gains hardly show it; new ones, of another size, do."""
    noise = 0.02
    old = replace(GOOD, position_p=6.0, velocity_p=15.0 * INERTIA, velocity_i=60.0 * INERTIA)
    fine = COUNT / 16
    target, _ = trial_path(GOOD, fine)
    learning = IdentityWatch(
        [drive(old, noise=drive(old).noise / 16)], STEP, np.array([0.01]), None, ["N m"]
    )
    learning.stand(still=False)
    position, torque = Axis(old).run(np.tile(target, 20), noise, 3, fine)
    first_alarm(learning, np.roll(position, 1), torque, np.tile(target, 20))
    one = IdentityWatch(
        [drive(GOOD, noise=drive(GOOD).noise / 16)],
        STEP,
        np.array([0.01]),
        learning.learned(),
        ["N m"],
    )
    position, torque = Axis(GOOD).run(target, noise, 4, fine)
    assert first_alarm(one, np.roll(position, 1), torque, target) is None


def test_what_comes_again_and_again_for_a_sample_is_seen_and_a_single_one_is_not():
    """Gains a hundred times too high answer each count of the encoder for a sample or two."""
    still, told = np.zeros(400), np.zeros(400)
    quantum = np.array([0.02])
    learned = Learned(np.array([0.02]), np.array([0.3]), np.zeros(1))
    for every, seen in ((11, True), (150, False)):
        told[:] = 0.0
        told[60::every] = told[61::every] = 5.0
        one = IdentityWatch([drive(GOOD)], STEP, quantum, learned)
        found = first_alarm(one, still, told, still)
        assert (found is not None) == seen
        assert found is None or found < 60 + 50


def test_a_filter_that_was_not_written_shows_in_the_first_answer():
    target, hold = trial_path(GOOD)
    held = replace(GOOD, filters=(Biquad.low_pass(40.0, 0.7),))
    position, torque = Axis(held).run(target, 0.02, 3)
    found = first_alarm(watch(GOOD, noise=0.02), position, torque, target)
    assert found is not None
    assert found <= hold + 30


def test_a_drive_whose_old_torque_did_not_follow_from_its_parameters_is_not_judged():
    target, _ = trial_path(GOOD)
    other = replace(GOOD, velocity_p=8 * GOOD.velocity_p, inertia_ff=0.0)
    position, torque = Axis(other).run(target, 0.02, 3)
    before = IdentityWatch([drive(GOOD)], STEP, np.array([0.02]), None)
    for n, (q, t, r) in enumerate(zip(position, torque, target, strict=True)):
        before.stand(still=n < 100)
        assert not before.take([q], [t], [r], [0.0], fresh=True)
    after = watch(GOOD, before.learned(), noise=0.02)
    assert "old parameters" in after.why_not[0]
    assert first_alarm(after, position, torque, target) is None


@pytest.mark.parametrize("spike", [-3.5, 2.0])
def test_what_enabling_did_to_the_first_torque_is_no_difference(spike):
    """The target steps by a count when a drive is enabled: its feed-forward kicks for a cycle or two."""
    target, _ = trial_path(GOOD)
    position, torque = Axis(GOOD).run(target, 0.02, 3)
    torque = np.array(torque, dtype=float)
    torque[:2] += [spike, -0.5 * spike]
    assert first_alarm(watch(GOOD, noise=0.02), position, torque, target) is None


def test_nothing_is_said_of_gains_that_nobody_can_read():
    target, _ = trial_path(GOOD)
    position, torque = Axis(replace(GOOD, velocity_p=10 * GOOD.velocity_p)).run(target)
    one = watch(GOOD, why_not="velocity_p can not be read")
    assert one.why_not == ("velocity_p can not be read",)
    assert first_alarm(one, position, torque, target) is None


def test_samples_that_did_not_come_are_no_mismatch():
    target, hold = trial_path(GOOD)
    position, torque = Axis(GOOD).run(target, 0.02, 1)
    one = watch(GOOD, noise=0.02)
    for n, (q, t, r) in enumerate(zip(position, torque, target, strict=True)):
        missing = n % 90 == 7
        at = max(n - 3, 0) if missing else n
        found = one.take(
            [position[at] if missing else q],
            [torque[at] if missing else t],
            [r],
            [0.0],
            fresh=not missing,
        )
        assert not found
    assert hold * STEP > BLIND


def test_cycles_are_compared_unbroken_only_some_time_after_a_sample_that_did_not_come():
    target, hold = trial_path(GOOD)
    position, torque = Axis(GOOD).run(target, 0.02, 1)
    one = watch(GOOD, noise=0.02)
    seen = []
    for n, (q, t, r) in enumerate(zip(position, torque, target, strict=True)):
        one.take([q], [t], [r], [0.0], fresh=n != hold)
        seen.append(one.unbroken)
    assert hold - 25 < seen[hold - 1] < hold
    assert max(seen[hold : hold + 100]) == 0
    assert seen[hold + 150] == pytest.approx(50, abs=8)


def test_the_torque_of_a_locked_axis_is_the_same_by_both_ways():
    target, _ = trial_path(GOOD, hold=5)
    _, torque = Axis(GOOD, friction=1e9).run(target[:40])
    expected = locked_torque(drive(GOOD), target[:40], STEP)
    assert expected[1:] == pytest.approx(torque[1:], rel=0.02, abs=0.01 * np.abs(torque).max())


def test_references_and_positions_are_two_parts_of_one_torque():
    expected = ExpectedTorque([drive(GOOD)] * 2, STEP)
    targets = np.array([[1e-3] * 3 + [0.0], [0.0] * 4])
    parts = np.array([expected.advance(targets, np.full((2, 4), 1e-3)) for _ in range(20)])
    rises = np.diff(parts[-2:], axis=0)[0]
    reference, position = rises[FROM_REFERENCE].sum(axis=0), rises[FROM_POSITION].sum(axis=0)
    assert reference[0] == pytest.approx(-position[0], rel=1e-6), "it stands at its target"
    assert reference[0] == pytest.approx(GOOD.velocity_i * GOOD.position_p * 1e-3 * STEP, rel=1e-6)
    assert rises[0, 0] == pytest.approx(reference[0], rel=1e-6), "its position gain does it all"
    assert np.all(parts[:, 0, 1] == 0)


def work(position, torque, rest=0.0):
    one = WorkWatch(
        *(np.array([one]) for one in (rest, COUNT, LIMIT, 1e-3 * LIMIT, INERTIA / STEP**2)), ["rad"]
    )
    for n, (q, t) in enumerate(zip(position, torque, strict=True)):
        found = one.take([q], [t], fresh=True)
        if found:
            return n, found[0][1]
    return None


@settings(max_examples=40, deadline=None)
@given(
    bandwidth=st.floats(15.0, 150.0),
    friction=st.floats(0.0, 4.0),
    part=st.floats(-1.0, 1.0),
    noise=st.floats(0.0, 0.02),
    spring=st.floats(3.0, 40.0),
    seed=st.integers(0, 2**31),
)
def test_a_motor_that_pushes_the_right_way_does_no_negative_work(
    bandwidth, friction, part, noise, spring, seed
):
    """Dry friction may have held any part of itself in what is taken for the torque at rest."""
    loop = AxisLoop(bandwidth / 4, bandwidth * INERTIA, bandwidth**2 / 5 * INERTIA, 1.0, INERTIA)
    target, _ = trial_path(loop)
    stiffness = 0.4 * INERTIA * (2 * np.pi * spring) ** 2
    axis = Axis(loop, friction=friction, spring=stiffness)
    position, torque = axis.run(target, noise * LIMIT, seed)
    assert work(position, torque, 0.98 * part * friction) is None


@pytest.mark.parametrize("bandwidth", [12.0, 40.0, 120.0])
def test_a_motor_that_pushes_the_wrong_way_is_found_while_its_torque_is_small(bandwidth):
    loop = AxisLoop(bandwidth / 4, bandwidth * INERTIA, bandwidth**2 / 5 * INERTIA, 1.0, INERTIA)
    target, _ = trial_path(loop)
    position, torque = Axis(loop, sign=-1.0).run(target, 0.02, 5)
    found = work(position, torque)
    assert found is not None
    row, text = found
    assert "against its own torque" in text
    assert np.abs(torque[:row]).max() < 0.3 * LIMIT


def test_who_hardly_saw_the_old_controllers_does_not_judge_the_new_ones():
    path = np.zeros(600)
    for every, judged in ((10**6, True), (50, False)):
        learning = IdentityWatch([drive(GOOD)], STEP, np.array([0.01]))
        for n in range(path.size):
            learning.take([0.0], [0.0], [0.0], [0.0], fresh=n % every != every - 1)
        learned = learning.learned()
        assert (learned.seen > 0.5) == judged
        assert (watch(GOOD, learned).why_not == ("",)) == judged


@pytest.mark.parametrize(("error", "velocity"), [(1e-4, 3.0), (0.5, 0.02)])
def test_a_first_answer_keeps_following_error_and_velocity(error, velocity):
    limits = replace(LIMITS, following_error=error, velocity=velocity)
    soft = AxisLoop(5.0, 0.05 * INERTIA, 0.0, 0.0)
    free, kept = (first_answer([drive(soft)], COUNT, one, 3.0, STEP) for one in (LIMITS, limits))
    assert np.abs(free).max() > error or np.abs(np.diff(free)).max() > velocity * STEP
    assert np.abs(kept).max(initial=0.0) <= 0.25 * error
    assert np.abs(np.diff(kept)).max(initial=0.0) <= 0.8 * velocity * STEP * (1 + 1e-9)


@pytest.mark.parametrize("unsure", [0.0, 0.15])
def test_a_torque_at_rest_that_was_told_of_a_creeping_axis_is_no_reversed_motor(unsure):
    """Told as -0.12 while the integrator still unwound; now the axis coasts back without any."""
    known = (np.array([one]) for one in (-0.12, COUNT, LIMIT, 1e-3, INERTIA / STEP**2))
    one = WorkWatch(*known, ["rad"], unsure=np.array([unsure]))
    position = np.round(np.linspace(40, 20, 400)) * COUNT
    found = [one.take([q], [0.01], fresh=True) for q in position.tolist()]
    assert any(found) == (unsure == 0)


@pytest.mark.parametrize("spring", [1.5, 2.5, 5.0])
def test_what_swings_when_a_sample_is_lost_is_no_reversed_motor(spring):
    """A soft loop is pushed by its own load; what that took up before the gap nobody knows any more."""
    soft, load = AxisLoop(4.0, 20.0 * INERTIA, 30.0 * INERTIA, 1.0), 0.6 * INERTIA
    stiffness = 0.4 * load * (2 * np.pi * spring) ** 2
    u = np.arange(500) / 500
    nudge = 0.02 * u**3 * (10 - 15 * u + 6 * u * u)
    path = np.concatenate([np.zeros(50), nudge, np.full(500, 0.02), 0.02 - nudge, np.zeros(500)])
    position, torque = Axis(soft, load=load, spring=stiffness).run(path)
    rest = (np.array([one]) for one in (0.0, COUNT, LIMIT, 1e-3 * LIMIT, INERTIA / STEP**2))
    known = tuple(rest)
    for lost in range(60, path.size, 41):
        record, judge = WorkRecord(), WorkWatch(*known, ["rad"])
        for one in (record, judge):
            one.begin(moves=True)
            for n, (q, t) in enumerate(zip(position, torque, strict=True)):
                assert not one.take([q], [t], fresh=n != lost)
        assert record.most(WorkWatch(*known, ["rad"])) <= 1.0, "nor is it learned as usual"
        judge.begin(moves=True)
        assert any(judge.take([-1e-6 * n * n], [1.0], fresh=True) for n in range(200)), (
            "it looks again"
        )


def test_a_lost_sample_ends_what_is_reckoned_of_work():
    work = WorkWatch(
        *(np.array([one]) for one in (0.0, COUNT, LIMIT, 1e-3 * LIMIT, INERTIA / STEP**2)), ["rad"]
    )
    guarded = TrialWatch(["x"], Blind(), Guards(watch(GOOD), work))
    guarded.begin()
    for n in range(200):
        guarded.take([n * COUNT], [-5.0], [0.0], [0.0], fresh=n % 20 != 19, late=0.0)
        assert n % 20 != 19 or work.missing == 0.0


@pytest.mark.parametrize(
    ("late", "moves", "after", "held_up"),
    [
        (0.015, True, 40, 0.015),
        (0.015, True, 60, 0.0),
        (0.015, False, 1, 0.0),
        (0.002, True, 1, 0.0),
        (0.002, False, 1, 0.0),
    ],
)
def test_an_alarm_says_whether_the_host_was_late_shortly_before(late, moves, after, held_up):
    """Of cycles of 10 ms; within half a second; more than a quarter of a cycle; while targets moved."""

    class Swings(Blind):
        now = False

        def take(self, position, torque, smooth):
            return Alarm("x: swings", "x", frozenset({"x"})) if self.now else None

    swings = Swings()
    watched = TrialWatch(["x"], swings, Guards(), cycle_time=0.01)
    watched.begin()
    for n in range(5 + after):
        target = [float(n if moves else min(n, 3))]
        at = late if n == 5 else 0.0
        watched.take([0.0], [0.0], target, [0.0], fresh=not at, late=at)
    swings.now = True
    alarm = watched.take([0.0], [0.0], target, [0.0], fresh=True, late=0.0)
    assert alarm.held_up == held_up
    swings.strays = True
    strayed = watched.take([0.0], [0.0], target, [0.0], fresh=True, late=0.0)
    assert strayed.held_up == 0.0, "where an axis is has nothing to do with it"
    swings.strays = False
    watched.begin()
    assert watched.take([0.0], [0.0], [0.0], [0.0], fresh=True, late=0.0).held_up == 0.0


@pytest.mark.parametrize("by_torque", [True, False])
def test_what_friction_leaves_of_an_excitation_is_foreseen_with_the_feed_forward_that_acts(
    monkeypatch, by_torque
):
    """References excite with the feed-forward off that can be switched off; offsets with all of it."""
    given = []
    nothing = np.zeros(100)
    monkeypatch.setattr(
        trial_records, "excited", lambda _, servos, *__: given.append(servos) or (nothing, nothing)
    )
    monkeypatch.setattr(trial_records, "measured_sensitivity", lambda *_: None)
    lines = SimpleNamespace(
        by_torque=np.array([by_torque]), axis=np.zeros(1, int), number=np.ones(1, int), samples=100
    )
    one = SimpleNamespace(cycle_time=STEP, reference=np.zeros((1, 1)), torque=np.zeros((1, 1)))
    trial = SimpleNamespace(excitation=SimpleNamespace(experiments=(one,)))
    plan = SimpleNamespace(lines=lines, new=("all",), bare=("what stays",), trial=trial)
    trial_records.TrialRecords(plan, None, None)._rubbing(None, lines, 0)
    assert given == [plan.new if by_torque else plan.bare]
