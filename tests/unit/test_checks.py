"""Judgements of the check before the first motion: pure values in, findings out."""

from dataclasses import replace

import numpy as np
import pytest

from drives.api import AxisLimits
from drives.canopen_drive.settings import DriveSettings
from fieldtool.experiment.checks.finding import Finding, worst
from fieldtool.experiment.checks.motion import TinyMove, judge_move, judged_moves, tiny_move
from fieldtool.experiment.checks.settings import judge_fail_safe, judge_settings
from fieldtool.experiment.stepped.plan import smooth_move
from fieldtool.records.recording import Experiment

LIMITS = AxisLimits((-2.0, 2.0), 10.0, 400.0, 6.0, 0.5)
SOUND = DriveSettings(
    position=0.3,
    torque=(0.01, -0.01),
    count=6e-6,
    rated_torque=4.0,
    warning=False,
    internal_limit=False,
    travel=(-2.5, 2.5),
    velocity=20.0,
    acceleration=1000.0,
    max_torque=12.0,
    following_error=1.0,
    consumer_heartbeat=0,
    abort_connection=0,
    error_behaviour=0,
    quick_stop=2,
)


def judged(settings: DriveSettings, limits: AxisLimits = LIMITS) -> dict[str, Finding]:
    return {f.check: f for f in judge_settings("x", settings, limits, "rad", "N m")}


def test_a_sound_drive_passes_everything() -> None:
    assert {f.status for f in judged(SOUND).values()} == {"pass"}
    assert all(f.axis == "x" and f.todo == "" for f in judged(SOUND).values())


def test_a_drive_without_limits_of_its_own_passes() -> None:
    bare = replace(
        SOUND, travel=None, velocity=None, acceleration=None, max_torque=None, following_error=None
    )
    assert {f.status for f in judged(bare).values()} == {"pass"}


@pytest.mark.parametrize(
    ("change", "check", "status"),
    [
        ({"travel": (-1.9, 2.5)}, "travel limits", "fail"),
        ({"travel": (-2.5, 1.9)}, "travel limits", "fail"),
        ({"velocity": 9.9}, "velocity limit", "warn"),
        ({"acceleration": 399.0}, "acceleration limit", "warn"),
        ({"max_torque": 5.9}, "torque limit", "warn"),
        ({"following_error": 0.4}, "following error limit", "warn"),
        ({"rated_torque": 0.004}, "torque unit", "fail"),
        ({"count": 0.1}, "position unit", "fail"),
        ({"torque": (0.3, 0.3)}, "torque at rest", "fail"),
        ({"torque": (-0.3, -0.3)}, "torque at rest", "fail"),
        ({"position": 2.01}, "position", "fail"),
        ({"position": -2.01}, "position", "fail"),
        ({"position": 1.99}, "position", "warn"),
        ({"warning": True}, "warnings", "warn"),
        ({"internal_limit": True}, "warnings", "warn"),
    ],
)
def test_each_thing_that_is_wrong_is_found_alone(change, check: str, status: str) -> None:
    found = judged(replace(SOUND, **change))
    wrong = {name: f.status for name, f in found.items() if f.status != "pass"}
    if check != "torque unit":  # a wrong rated torque is wrong at rest as well
        assert wrong == {check: status}
    assert found[check].status == status
    assert found[check].todo


@pytest.mark.parametrize(
    ("change", "reaction", "word"),
    [
        ({"consumer_heartbeat": None}, 3, "no heartbeat consumer (0x1016)"),
        ({"abort_connection": None}, 3, "no abort connection option (0x6007)"),
        ({}, None, "does not know"),
    ],
)
def test_a_drive_that_can_not_stop_by_itself_fails(change, reaction, word: str) -> None:
    found = judge_fail_safe("x", replace(SOUND, **change), reaction)
    assert (found.status, word in found.found) == ("fail", True)


def experiment(position: np.ndarray, torque: np.ndarray, target: np.ndarray) -> Experiment:
    n = target.size
    column = {"position": position, "torque": torque, "position_reference": target}
    return Experiment(
        name="direction check of x",
        kind="moves",
        driven=("x",),
        free=(),
        period=None,
        time=np.arange(n) * 1e-3,
        statusword=np.zeros((n, 1), dtype=np.uint16),
        **{key: values[:, None] for key, values in column.items()},
    )


@pytest.mark.parametrize("size", [0.08, -0.08])
@pytest.mark.parametrize("start", [0.0, -1.3])
def test_a_tiny_move_is_read_from_its_recording(size: float, start: float) -> None:
    rest, away = np.zeros(300), np.full(300, size)
    there = smooth_move(size, 0.2, 10.0, 1e-3, 1.0)
    target = start + np.concatenate([rest, there, away, size - there, rest])
    inertia, load, friction = 0.05, 0.7, 0.2
    velocity = np.gradient(target, 1e-3)
    torque = inertia * np.gradient(velocity, 1e-3) + load + friction * np.sign(velocity)
    move = tiny_move(experiment(target * 0.9 + 0.1 * start, torque, target), 0)
    assert move.commanded == pytest.approx(0.08)
    assert move.moved == pytest.approx(0.9 * 0.08, rel=1e-6)
    assert move.holding == pytest.approx(load, rel=5e-3)
    assert move.needed == pytest.approx(friction, rel=0.3)


@pytest.mark.parametrize(
    ("move", "expected"),
    [
        (TinyMove(0.08, 0.079, 0.1, 0.5), ("pass", "pass", "pass")),
        (TinyMove(0.08, 0.05, 0.1, 0.5), ("warn", "pass", "pass")),
        (TinyMove(0.08, 0.079, 0.1, 4.0), ("pass", "warn", "pass")),
        (TinyMove(0.08, 0.079, -2.5, 0.5), ("pass", "pass", "warn")),
    ],
)
def test_moves_are_judged(move: TinyMove, expected: tuple[str, ...]) -> None:
    found = judge_move("x", move, LIMITS, "rad", "N m")
    assert [f.check for f in found] == ["direction", "brake and friction", "load at rest"]
    assert tuple(f.status for f in found) == expected
    assert all(bool(f.todo) == (f.status != "pass") for f in found)


def test_a_move_that_was_cut_short_is_not_judged() -> None:
    target = np.linspace(0, 1, 50)
    whole = experiment(target, target, target)
    assert judged_moves([replace(whole, complete=False)], ["x"], [LIMITS], ["rad"], ["N m"]) == ()
    assert len(judged_moves([whole], ["x"], [LIMITS], ["rad"], ["N m"])) == 3


def test_the_worst_counts() -> None:
    ordered = ("pass", "not tried", "warn", "fail")
    for k, status in enumerate(ordered):
        findings = [Finding("c", s, "") for s in ordered[: k + 1]]
        assert worst(findings) == status
    assert worst([]) == "pass"
