"""A velocity fed forward between linear targets is a staircase: against its own Fourier sum."""

from dataclasses import replace

import numpy as np
import pytest

from fieldtool.frf.held_targets import LINEAR_TARGETS, folded_phasors, folds
from fieldtool.records.recording import AxisInfo, Controller, Recording

PERIOD, LAG, FINE = 0.004, 0.0011, 400


def recording(share: float) -> Recording:
    controller = Controller(1e-9, 3.0, 1e-9, 100.0)  # no position gain: the stairs alone
    axis = AxisInfo("a", "rotary", 1, None, 10.0, None, controller, "N m", "rad")
    return Recording(PERIOD, (axis,), (), "", {LINEAR_TARGETS: f"a={LAG!r}/{share!r}"})


@pytest.mark.parametrize("cycles", [3, 11, 25])
@pytest.mark.parametrize("share", [1.0, 0.4])
def test_sampled_stairs_less_the_correction_are_the_stairs_fundamental(cycles, share):
    rows = 250
    omega = 2 * np.pi * cycles / (rows * PERIOD)
    sent = np.cos(omega * PERIOD * np.arange(rows) + 0.3)
    slope = (sent - np.roll(sent, 1)) / PERIOD  # from one target to the next, from its SYNC on
    torque = 3.0 * share * slope
    stairs = np.repeat(torque, FINE)
    time = PERIOD / FINE * (np.arange(stairs.size) + 0.5)
    true = 2 / stairs.size * np.exp(-1j * omega * (time + LAG)) @ stairs  # shown so much later
    shown = np.roll(torque, 1)  # what a SYNC samples, LAG late: the stair before it
    sampled = 2 / rows * np.exp(-1j * omega * PERIOD * np.arange(rows)) @ shown
    target = 2 / rows * np.exp(-1j * omega * PERIOD * np.arange(rows)) @ sent
    frequency = np.array([omega / (2 * np.pi)])
    folded = folded_phasors(recording(share), frequency, np.array([[target]]))[0, 0]
    assert sampled - folded == pytest.approx(true, rel=2e-4)


def test_of_motion_that_does_not_repeat_it_is_the_same_to_second_order():
    rows, omega = 250, 2 * np.pi * 3 / (250 * PERIOD)
    sent = np.cos(omega * PERIOD * np.arange(rows))
    bends, stair = folds(recording(1.0))
    course = (bends.course(sent, bends.size) + stair.course(sent, stair.size))[3:]
    target = np.array([[1.0 + 0j]])
    frequency = np.array([omega / (2 * np.pi)])
    folded = folded_phasors(recording(1.0), frequency, target)[0, 0]
    wanted = (folded * np.exp(1j * omega * PERIOD * np.arange(rows))).real[3:]
    assert course == pytest.approx(wanted, abs=0.005 * np.abs(wanted).max())


@pytest.mark.parametrize("kind", [0, 1])
def test_its_slope_is_the_derivative_by_its_size(fresh_rng, kind):
    sent, step = fresh_rng.normal(size=50), 1e-6
    fold = folds(recording(1.0))[kind]
    change = fold.course(sent, fold.size + step) - fold.course(sent, fold.size - step)
    slope = fold.slope(sent, fold.size)
    assert np.any(slope)
    assert change / (2 * step) == pytest.approx(slope, abs=1e-6 * np.abs(slope).max())


def test_how_a_drive_interpolates_may_be_unknown():
    known = recording(1.0)
    unknown = replace(known, source={LINEAR_TARGETS: "a=?/1.0"})
    pairs = list(zip(folds(unknown), folds(known), strict=True))
    assert [one.kind for one, _ in pairs] == ["bends", "stair"]
    for one, other in pairs:
        assert one.gain == other.gain
        assert abs(one.size - other.size) < 2 * one.std
        assert one.std > 2 * other.std
