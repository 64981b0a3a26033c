"""A recording refuses what contradicts itself, and says where."""

from dataclasses import replace

import numpy as np
import pytest

from fieldtool.records.recording import (
    AxisInfo,
    Controller,
    Experiment,
    Recording,
    Segment,
    grid_fault,
)
from tests.seeds import fresh_seed

PERIOD = 0.002
AXES = (AxisInfo("x", "rotary"), AxisInfo("slide", "linear", torque_unit="N", position_unit="m"))


def experiment(n: int = 50, **changes: object) -> Experiment:
    time = np.arange(n) * PERIOD
    values = {
        "name": "sweep",
        "kind": "stepped_sine",
        "driven": ("x",),
        "free": ("slide",),
        "period": None,
        "time": time,
        "position": np.column_stack([np.sin(time), np.cos(time)]),
        "torque": np.zeros((n, 2)),
    }
    return Experiment(**(values | changes))  # type: ignore[arg-type]


def recording(*experiments: Experiment) -> Recording:
    return Recording(PERIOD, AXES, experiments)


def test_a_good_one_is_taken_and_can_not_be_changed() -> None:
    good = recording(experiment(segments=(Segment(0, 50, 10.0, 1),)))
    assert good.experiment("sweep").samples == 50
    with pytest.raises(ValueError, match="read-only"):
        good.experiments[0].position[0, 0] = 1.0
    with pytest.raises(KeyError, match="no experiment 'other'"):
        good.experiment("other")


@pytest.mark.parametrize(
    ("edit", "row", "words"),
    [
        (lambda t: np.delete(t, 17), 17, r"1 sample\(s\) missing"),
        (lambda t: np.delete(t, [17, 18, 19]), 17, r"3 sample\(s\) missing"),
        (lambda t: np.insert(t, 20, t[19] + 1e-5), 20, "doubled"),
        (lambda t: t + np.where(np.arange(t.size) >= 30, 0.05 * PERIOD, 0.0), 30, "jumps"),
        (lambda t: t * 2, 1, "steps of 0.004 s, the sample period is given as 0.002 s"),
        (lambda t: t * 1.005, 49, "mean time step"),
    ],
)
def test_a_gap_in_time_is_named_by_row(edit, row: int, words: str) -> None:  # type: ignore[no-untyped-def]
    time = edit(np.arange(50) * PERIOD)
    n = time.size
    broken = experiment(n=n, time=time)
    with pytest.raises(ValueError, match=rf"row {row}: .*{words}"):
        recording(broken)


def test_jitter_of_a_clock_is_no_gap() -> None:
    seed = fresh_seed()
    jitter = np.random.default_rng(seed).uniform(-0.004, 0.004, 1000) * PERIOD
    assert grid_fault(np.arange(1000) * PERIOD + jitter, PERIOD) is None


def test_time_running_back_is_refused_at_once() -> None:
    time = np.arange(50) * PERIOD
    time[8] = time[7]
    with pytest.raises(ValueError, match="does not rise in row 8"):
        experiment(time=time)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"position": np.zeros((49, 2))}, r"position must have the shape \(50, axes\)"),
        ({"torque": np.zeros((50, 3))}, r"torque must have the shape \(50, 2\)"),
        ({"velocity": np.full((50, 2), np.nan)}, "velocity of axis number 0 in row 0"),
        ({"statusword": np.zeros((50, 1), np.uint16)}, "statusword must have the shape"),
        ({"statusword": np.full((50, 2), 70000)}, "statuswords must be whole numbers"),
        ({"extra": {"x.load": np.zeros(3)}}, "extra signal x.load must have the shape"),
        ({"segments": (Segment(40, 60, 1.0),)}, "longer than the 50 rows"),
        ({"segments": (Segment(0, 20, 1.0), Segment(10, 30, 1.0))}, "begins before"),
        ({"kind": "sweep"}, "kind must be one of"),
        ({"period": 0.0}, "period must be positive"),
        ({"time": np.zeros(0)}, "time must have one row"),
    ],
)
def test_a_faulty_experiment_is_refused(changes: dict[str, object], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        experiment(**changes)


def test_a_value_that_is_no_number_is_named_by_row() -> None:
    torque = np.zeros((50, 2))
    torque[31, 1] = np.nan
    with pytest.raises(ValueError, match="torque of axis number 1 in row 31"):
        experiment(torque=torque)


def test_an_axis_without_reference_is_a_column_of_nan_but_a_hole_is_refused() -> None:
    reference = np.zeros((50, 2))
    reference[:, 1] = np.nan
    assert experiment(position_reference=reference).samples == 50
    reference[4, 0] = np.nan
    with pytest.raises(ValueError, match="position_reference of axis number 0 in row 4"):
        experiment(position_reference=reference)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"driven": ("y",)}, "driven axes .'y'. are not among"),
        ({"free": ("x",)}, "can not be driven and free"),
        ({"extra": {"load": np.zeros(50)}}, "must be called AXIS.NAME"),
        ({"extra": {"x.torque": np.zeros(50)}}, "has the name of a signal of its own"),
        ({"segments": (Segment(0, 50, 10.0, 2),)}, "holds 1.0000 periods of 10 Hz"),
        ({"segments": (Segment(0, 50, 250.0),)}, "half the sample rate"),
    ],
)
def test_an_experiment_that_does_not_fit_the_machine_is_refused(
    changes: dict[str, object], words: str
) -> None:
    with pytest.raises(ValueError, match=words):
        recording(experiment(**changes))


def test_names_must_differ() -> None:
    with pytest.raises(ValueError, match=r"experiment names must differ.*sweep"):
        recording(experiment(), experiment())
    with pytest.raises(ValueError, match="axes of different names"):
        Recording(PERIOD, (AXES[0], AXES[0]))


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"name": "a.b"}, "axis name 'a.b'"),
        ({"name": " a"}, "axis name"),
        ({"kind": "linear"}, "a linear axis has positions in m and torques in N or A"),
        ({"torque_unit": "kN"}, "torque unit must be one of"),
        ({"masses": 0}, "masses must be at least 1"),
        ({"motor_inertia": -1.0}, "motor_inertia must be positive"),
    ],
)
def test_a_faulty_axis_is_refused(changes: dict[str, object], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        replace(AXES[0], **changes)  # type: ignore[arg-type]


def test_a_controller_has_no_negative_gains() -> None:
    with pytest.raises(ValueError, match="velocity_i must be finite and not negative"):
        Controller(1.0, 1.0, -1.0, 1.0)


@pytest.mark.parametrize(
    "changes", [{"start": 5, "stop": 5}, {"frequency": 0.0}, {"periods": 0}, {"start": -1}]
)
def test_a_faulty_segment_is_refused(changes: dict[str, float]) -> None:
    with pytest.raises(ValueError, match="segment"):
        replace(Segment(0, 10, 1.0, 1), **changes)  # type: ignore[arg-type]
