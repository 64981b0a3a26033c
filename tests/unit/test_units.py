"""Quantities with units: every factor against a second source, and what is refused."""

from math import isclose, pi

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drives.units import UNITS, AxisScaling, parse_quantity, position_factor, unit_on

KNOWN = [  # text, dimension, SI value worked out by hand
    ("180 deg", "angle", pi),
    ("1 rev", "angle", 2 * pi),
    ("5 mrad", "angle", 0.005),
    ("-1.5 rad", "angle", -1.5),
    ("60 rpm", "angular velocity", 2 * pi),
    ("2 rev/s", "angular velocity", 4 * pi),
    ("90 deg/s", "angular velocity", pi / 2),
    ("1 rev/s2", "angular acceleration", 2 * pi),
    ("360 deg/s2", "angular acceleration", 2 * pi),
    ("360 deg/s²", "angular acceleration", 2 * pi),
    ("120 m/min", "velocity", 2.0),
    ("250 mm/s", "velocity", 0.25),
    ("250 mm", "length", 0.25),
    ("12.5 um", "length", 1.25e-5),
    ("9810 mm/s2", "acceleration", 9.81),
    ("6 N m", "torque", 6.0),
    ("6 Nm", "torque", 6.0),
    ("6 N.m", "torque", 6.0),
    ("6 N·m", "torque", 6.0),
    ("6 N*m", "torque", 6.0),
    ("250 mN m", "torque", 0.25),
    ("1.5 kNm", "torque", 1500.0),
    ("2 kN", "force", 2000.0),
    ("3 kg cm2", "inertia", 3e-4),
    ("3 kg·m²", "inertia", 3.0),
    ("40 g cm2", "inertia", 4e-6),
    ("500 g", "mass", 0.5),
    ("4 ms", "time", 0.004),
    ("125us", "time", 1.25e-4),
    ("1 kHz", "frequency", 1000.0),
    ("  +.5e1   Hz ", "frequency", 5.0),
]


@pytest.mark.parametrize(("text", "dimension", "value"), KNOWN)
def test_known_quantities(text: str, dimension: str, value: float) -> None:
    assert parse_quantity(text, dimension) == pytest.approx(value, rel=1e-15)


def test_every_unit_was_tried_or_is_the_base_unit() -> None:
    tried = {
        (dimension, unit)
        for text, dimension, _ in KNOWN
        for unit in UNITS[dimension]
        if text.replace(" ", "").endswith(unit.replace(" ", ""))
    }
    untried = {(d, u) for d, units in UNITS.items() for u in units} - tried
    assert all(UNITS[d][u] == 1.0 for d, u in untried), untried


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (90, r"90 has no unit: write it with one, as 90 rad \(or mrad, deg, rev\)"),
        (True, "needs a number with one of the units rad, mrad, deg, rev, got True"),
        (None, "got None"),
        ("90", "got '90'"),
        ("deg", "got 'deg'"),
        ("", "got ''"),
        ("90 deg/s", "unit 'deg/s' does not fit"),
        ("90 degrees", "unit 'degrees' does not fit"),
        ("1,5 rad", "write the number with a point: 1.5 rad"),
        ("1 2 rad", "unit '2 rad' does not fit"),
        ("nan rad", "got 'nan rad'"),
        ("inf rad", "got 'inf rad'"),
        ("1e400 rad", "too large"),
        ("90 Deg", "unit 'Deg' does not fit"),
    ],
)
def test_what_is_no_angle_is_refused(text: object, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        parse_quantity(text, "angle")


def test_milli_and_mega_are_not_confused() -> None:
    with pytest.raises(ValueError, match="unit 'MN m'"):
        parse_quantity("1 MN m", "torque")


@given(
    st.floats(-1e12, 1e12),
    st.sampled_from([(d, u) for d, units in UNITS.items() for u in units]),
)
def test_any_number_with_any_unit(number: float, unit: tuple[str, str]) -> None:
    dimension, name = unit
    value = parse_quantity(f"{number!r} {name}", dimension)
    assert value == number * UNITS[dimension][name]


@given(
    st.floats(1e-9, 1e3), st.floats(1e-6, 1e3), st.floats(-1e6, 1e6), st.floats(-1e4, 1e4)
)  # fmt: skip
def test_drive_units_are_the_nearest(p: float, t: float, position: float, torque: float) -> None:
    scaling = AxisScaling(p, p, t)
    near, full = scaling.position_units(position), scaling.torque_units(torque)
    assert abs(near * p - position) <= p * (0.5 + 1e-9 * abs(near))
    assert abs(full * t - torque) <= t * (0.5 + 1e-9 * abs(full))
    assert scaling.position_units(near * p) == near


@pytest.mark.parametrize(
    "factors", [(0.0, 1.0, 1.0), (1.0, -1.0, 1.0), (1.0, 1.0, float("nan")), (1.0, 1.0, 0.0)]
)
def test_scales_must_be_positive(factors: tuple[float, float, float]) -> None:
    with pytest.raises(ValueError, match="scale factors must be positive"):
        AxisScaling(*factors)


def test_position_factor_by_hand() -> None:
    assert position_factor("rotary", 10_000, 1, None) == pytest.approx(2 * pi / 10_000)
    # a linear scale with 10 000 counts in 5 mm: half a micrometre a count
    assert position_factor("linear", 10_000, 1, 0.005) == pytest.approx(0.5e-6)
    # 2^20 counts in two revolutions
    assert position_factor("rotary", 2**20, 2, None) == pytest.approx(2 * pi * 2 / 2**20)


@given(st.integers(1, 2**31), st.integers(1, 1000))
def test_counts_of_one_turn_make_one_turn(counts: int, revolutions: int) -> None:
    turn = counts / revolutions
    assert isclose(position_factor("rotary", counts, revolutions, None) * turn, 2 * pi)
    assert isclose(position_factor("linear", counts, revolutions, 0.01) * turn, 0.01)


@pytest.mark.parametrize("numbers", [(0, 1), (1, 0), (-5, 1)])
def test_zero_in_the_drive_is_refused(numbers: tuple[int, int]) -> None:
    with pytest.raises(ValueError, match=r"0x608F = .* must be positive"):
        position_factor("rotary", *numbers, None)


@pytest.mark.parametrize("feed", [None, 0.0, -0.01])
def test_a_linear_axis_needs_its_feed(feed: float | None) -> None:
    with pytest.raises(ValueError, match="`feed`"):
        position_factor("linear", 1000, 1, feed)


def test_units_on_linear_axes() -> None:
    rotary = ["N m s/rad", "N m/rad", "N m", "kg m2", "rad", "rad/s", "1/s", "Hz", "1"]
    linear = ["N s/m", "N/m", "N", "kg", "m", "m/s", "1/s", "Hz", "1"]
    assert [unit_on("linear", unit) for unit in rotary] == linear
    assert [unit_on("rotary", unit) for unit in rotary] == rotary
