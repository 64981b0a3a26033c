"""What a drive can hold: steps and ranges at once, and the PID that a cascade becomes."""

from math import floor, inf, isclose

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldtool.design.decide import design
from fieldtool.design.drive_side import GAINS, PID, DriveSide, Hold
from fieldtool.design.rule import DesignError
from fieldtool.records.model import AxisModel, Estimate, MachineModel

NAMES = frozenset({*PID, *GAINS, "inertia_ff"})


def rigid(mass: float) -> MachineModel:
    return MachineModel((AxisModel("x", "rotary", (Estimate(mass, 0.01 * mass),), (), ()),))


def pid_side(hold: Hold, torque: float = 5.0) -> DriveSide:
    return DriveSide("x", NAMES, torque_limit=torque, holds=dict.fromkeys(PID, hold), is_pid=True)


def pid_of(parameters: dict[str, float]) -> tuple[float, float, float]:
    kp, kv, ki = (parameters[name] for name in GAINS)
    return kv * kp + ki, ki * kp, kv


@pytest.mark.parametrize(
    ("hold", "wanted", "held"),
    [
        (Hold(1.0, whole=True, maximum=10.6), 10.6, 10.0),
        (Hold(1.0, whole=True, maximum=10.6), 1e9, 10.0),
        (Hold(1.0, whole=True, minimum=9.4), 9.4, 10.0),
        (Hold(0.1, whole=True, maximum=0.3), 5.0, 0.3),
        (Hold(1.0, -1, whole=True, low=1, high=100, maximum=0.4), 0.4, 1 / 3),
    ],
)
def test_rounding_stays_inside_of_the_range(hold: Hold, wanted: float, held: float) -> None:
    assert hold.nearest(wanted) == held
    assert hold.minimum <= hold.nearest(wanted) <= hold.maximum


@given(st.floats(1e-3, 1e3), st.floats(-50.0, 50.0), st.floats(0.0, 60.0), st.floats(-100.0, 100.0))
def test_what_is_held_is_the_step_inside_of_the_range_that_is_next(scale, low, width, wanted):
    """Against all steps there are."""
    hold = Hold(scale, whole=True, minimum=low * scale, maximum=(low + width) * scale)
    inside = [n for n in range(floor(low), floor(low + width) + 1) if low <= n <= low + width]
    found = hold.nearest(wanted * scale) / scale
    assert isclose(found, round(found), rel_tol=1e-6, abs_tol=1e-6) or not inside
    if inside:
        assert low - 1e-6 <= found <= low + width + 1e-6
        assert abs(found - wanted) <= min(abs(n - wanted) for n in inside) + 1e-6


def test_bounds_of_whole_numbers_are_what_can_be_held() -> None:
    assert Hold(1.0, whole=True, low=0, high=100, minimum=0.4, maximum=10.6).bounds == (1.0, 10.0)
    assert Hold(maximum=10.6).bounds == (-inf, 10.6)


def test_a_gain_never_rounds_to_no_loop() -> None:
    side = pid_side(Hold(0.01, whole=True, low=0, high=1e4))
    held = side.held({"position_p": 20.0, "velocity_p": 0.004, "velocity_i": 0.05})
    assert held["velocity_p"] == pytest.approx(0.01)
    p, i, d = pid_of(held)
    assert [n / 0.01 for n in (p, i, d)] == pytest.approx([13.0, 42.0, 1.0])
    cascade = DriveSide("x", holds={"velocity_p": Hold(0.5, whole=True, low=0, high=9)})
    assert cascade.held({"velocity_p": 0.1})["velocity_p"] == 0.5


def test_an_integral_that_no_cascade_has_becomes_the_most_that_one_has() -> None:
    side = pid_side(Hold(0.01, whole=True, low=0, high=1e4))
    p, i, d = pid_of(side.held({"position_p": 4.0, "velocity_p": 0.004, "velocity_i": 0.016}))
    assert (p, d) == pytest.approx((0.03, 0.01))
    assert i == pytest.approx(0.02), "P^2 / 4 D = 0.0225"
    real = pid_side(Hold(1.0, maximum=0.03))
    p, i, d = pid_of(real.held({"position_p": 4.0, "velocity_p": 0.01, "velocity_i": 0.04}))
    assert i == pytest.approx(p * p / (4 * d), rel=2e-3)


def test_an_integral_that_can_not_be_little_enough_is_said() -> None:
    holds = dict.fromkeys(PID, Hold(0.01, whole=True, low=4, high=4))
    holds["pid_i"] = Hold(0.01, whole=True, low=10, high=90)
    with pytest.raises(DesignError, match=r"x: the least I that its drive holds .* is too much"):
        DriveSide("x", holds=holds, is_pid=True).held(dict.fromkeys(GAINS, 0.1))


def test_a_small_motor_on_a_drive_of_coarse_steps_is_designed_and_said() -> None:
    side = pid_side(Hold(0.002, whole=True, low=0, high=1e5), 0.1)
    tuning = design(rigid(1e-5), [side])
    assert tuning.axes[0].parameters["velocity_p"] == pytest.approx(0.002)
    assert any("one step of its drive" in n and "pid_d 0.002 N m s/rad" in n for n in tuning.notes)


@pytest.mark.parametrize(
    ("hold", "said"),
    [
        (Hold(1e-6, whole=True, low=0, high=1000), r"too small: x: pid_p .* holds 0 to 0\.001"),
        (Hold(0.2, whole=True, low=0, high=0), "x: its drive holds no pid_p above 0"),
        (Hold(40.0, whole=True, low=0, high=1e6), "x: .* its steps are too coarse"),
    ],
)
def test_a_pid_that_does_not_fit_is_said_by_what_the_drive_is_told(hold: Hold, said: str) -> None:
    with pytest.raises(DesignError, match=said):
        design(rigid(0.05), [pid_side(hold)])


def test_a_pid_at_the_end_of_its_range_is_said() -> None:
    tuning = design(rigid(0.05), [pid_side(Hold(0.001, whole=True, low=0, high=1e4))])
    assert any("the largest that its drive holds: pid_p 10 N m/rad" in n for n in tuning.notes)


def test_a_pid_stays_one_where_the_unit_of_its_integral_is_not_known() -> None:
    """P and D are rounded as what the drive is told, and the whole velocity is fed forward."""
    hold = Hold(0.01, whole=True, low=0, high=1e4)
    side = DriveSide("x", NAMES, holds={"pid_p": hold, "pid_d": hold}, is_pid=True)
    held = side.held({"position_p": 20.0, "velocity_p": 0.104, "velocity_i": 0.05})
    p, i, d = pid_of(held)
    assert (p, d) == (pytest.approx(2.13), pytest.approx(0.10))
    assert i == pytest.approx(1.0), "as it was"
    assert side.servo(held).loop.velocity_ff == 1.0
    p, i, d = pid_of(side.held({"position_p": 4.0, "velocity_p": 0.004, "velocity_i": 0.016}))
    assert i == pytest.approx(p * p / (4 * d), rel=2e-3), "no cascade has more"
    assert DriveSide("x").servo(held).loop.velocity_ff == 0.0
    given = DriveSide("x", present=dict(held) | {"velocity_ff": 0.0}, is_pid=True).present_servo
    assert given is not None
    assert given.loop.velocity_ff == 1.0, "a PID feeds the whole velocity forward now, too"


@given(st.floats(0.02, 5.0), st.floats(0.1, 50.0), st.floats(0.1, 3.0))
def test_a_gain_is_rounded_beside_what_its_scale_goes_with_became(velocity, position, ratio):
    """Read back by the conversion's own formula, each gain is within half a step of what was wanted.

    The drive's velocity_i is in steps of 0.05 1/s of its velocity_p, which has steps of its own and is
    far from the present one.
    """
    holds = {
        "velocity_p": Hold(0.01, whole=True, low=0, high=1e6),
        "velocity_i": Hold(0.05, whole=True, low=0, high=1e6, times={"velocity_p": 1}),
        "position_p": Hold(2.0, -1, whole=True, low=1, high=1e6, times={"velocity_p": -1}),
    }
    present = {"velocity_p": 0.337, "velocity_i": 1.0, "position_p": 10.0}
    side = DriveSide("x", frozenset(GAINS), holds=holds, present=present)
    integral = ratio * position * velocity
    wanted = {"position_p": position, "velocity_p": velocity, "velocity_i": integral}
    held = side.held(wanted)
    p = round(held["velocity_p"] / 0.01)
    i = round(held["velocity_i"] / (0.05 * 0.01 * p))
    reciprocal = max(round(2.0 / (0.01 * p) / held["position_p"]), 1)
    assert held["velocity_p"] == pytest.approx(0.01 * p)
    assert held["velocity_i"] == pytest.approx(0.05 * 0.01 * p * i), "a whole number in the drive"
    assert held["position_p"] == pytest.approx(2.0 / (0.01 * p) / reciprocal)
    assert abs(held["velocity_p"] - velocity) <= 0.5 * 0.01 * (1 + 1e-9)
    assert abs(held["velocity_i"] - integral) <= 0.5 * 0.05 * 0.01 * p * (1 + 1e-9)
    steps = 2.0 / (0.01 * p) / position
    assert abs(reciprocal - steps) <= 0.5 * (1 + 1e-9) or steps < 1


def test_what_a_scale_goes_with_and_nobody_knows_holds_anything() -> None:
    hold = Hold(0.05, whole=True, low=0, high=10, times={"velocity_p": 1})
    assert Hold(0.05, whole=True, times={"velocity_p": -1}).beside({"velocity_p": 0.0}) == Hold()
    side = DriveSide("x", holds={"velocity_i": hold})
    assert side.held({"velocity_i": 1.2345})["velocity_i"] == 1.2345
    assert side.held({"velocity_p": 2.0, "velocity_i": 1.2345})["velocity_i"] == pytest.approx(1.0)
    assert side.out_of_range({"velocity_p": 2.0, "velocity_i": 1.01}) == [
        "velocity_i 1.01 N m/rad (the drive holds 0 to 1 N m/rad)"
    ]
