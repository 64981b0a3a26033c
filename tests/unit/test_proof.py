"""Pulses that show whether an encoder counts, on motors of Newton's and Coulomb's laws."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace

import numpy as np
import pytest

from drives.api import AxisLimits, Capture, Source, Targets, joined
from drives.errors import SafetyStopError
from fieldtool.experiment.axes import Axes
from fieldtool.experiment.directions import check_directions
from fieldtool.experiment.proof import PROOF_SHARES, Proof

STEP, INNER = 0.002, 20
INERTIA, COUNT = 0.04, 2 * np.pi / 2**20
LIMITS = AxisLimits((-2.0, 2.0), 10.0, 400.0, 6.0, 0.5)
AXES = Axes(
    ("x", "y"),
    (LIMITS, LIMITS),
    np.zeros(2),
    ("rad", "rad"),
    np.full(2, COUNT),
    np.full(2, INERTIA),
    np.full(2, 30.0),
    torque_offsets=(True, True),
)


@dataclass
class Motors:
    """Two motors under position loops; gives motions and is the motion."""

    friction: tuple[float, float] = (0.0, 0.0)
    stuck: bool = False
    """Whether the second one's encoder is."""
    count: float = COUNT
    gain: float = 2.0
    """N m s/rad, of the velocity loop."""
    weight: float = 0.0
    """N m, of which the loops take over more and more: 0.15 s."""
    cycle_time: float = STEP
    asked: bool = False
    """Whether torque offsets were asked for."""
    angle: np.ndarray = field(default_factory=lambda: np.zeros(2))
    speed: np.ndarray = field(default_factory=lambda: np.zeros(2))
    farthest: np.ndarray = field(default_factory=lambda: np.zeros(2))
    most: np.ndarray = field(default_factory=lambda: np.zeros(2))
    row: int = 0

    @contextmanager
    def motion(self, cycle_time: float, torque_offset: bool = False) -> Iterator["Motors"]:
        assert cycle_time == STEP
        self.asked = torque_offset
        yield self

    @property
    def position(self) -> np.ndarray:
        shown = np.round(self.angle / self.count) * self.count
        return shown * np.array([1.0, 0.0]) if self.stuck else shown

    def stream(self, source: Source) -> Capture:
        captures: list[Capture] = []
        while (block := source(captures[-1] if captures else None)) is not None:
            targets = block if isinstance(block, np.ndarray) else block.position
            extra = block.torque_offset if isinstance(block, Targets) else np.zeros(targets.shape)
            rows = [self._cycle(*row) for row in zip(targets, extra, strict=True)]
            position, torque = (np.array([r[k] for r in rows]) for k in (0, 1))
            words = np.zeros(targets.shape, dtype=np.uint16)
            captures.append(Capture(self.row, targets, position, torque, words))
            self.row += len(rows)
        return joined(captures)

    def _cycle(self, target: np.ndarray, extra: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        torque = np.zeros(2)
        for _ in range(INNER):
            speed = np.where([False, self.stuck], 0.0, self.speed)
            sinks = self.weight * np.exp(-self.row * STEP / 0.15)
            torque = self.gain * (15.0 * (target - self.position) - speed) + extra - sinks
            for k in range(2):
                if self.speed[k] == 0 and abs(torque[k]) <= self.friction[k]:
                    continue
                way = np.sign(self.speed[k] or torque[k])
                speed_then = (
                    self.speed[k] + STEP / INNER * (torque[k] - way * self.friction[k]) / INERTIA
                )
                self.speed[k] = 0.0 if self.speed[k] * speed_then < 0 else speed_then
            self.angle = self.angle + STEP / INNER * self.speed
        self.farthest = np.maximum(self.farthest, np.abs(self.angle))
        self.most = np.maximum(self.most, np.abs(torque))
        return self.position, torque


def proof(motors: Motors, axes: Axes = AXES, k: int = 1) -> Proof:
    """Stream one axis' pulses."""
    one = Proof(axes, k, np.zeros(2), STEP, np.full(2, 1e-4), lambda *_: None)
    motors.stream(one)
    return one


@pytest.mark.parametrize("offsets", [True, False])
def test_a_stuck_encoder_is_seen_before_its_motor_has_gone_a_degree(offsets):
    axes = AXES if offsets else replace(AXES, torque_offsets=())
    motors = Motors(stuck=True)
    with pytest.raises(SafetyStopError, match=r"y: does not move by its encoder.*brake") as stop:
        proof(motors, axes)
    assert stop.value.power_off == {"y"}, "its loop sees nothing: no quick stop"
    assert motors.farthest[1] < np.radians(0.3 if offsets else 6.0)
    assert abs(motors.speed[1]) < 0.05, (
        "what is left of a stuck motor's speed goes on after the stop"
    )


def test_what_is_said_of_the_way_gone_unseen_is_about_what_it_was():
    motors = Motors(stuck=True)
    with pytest.raises(SafetyStopError) as stop:
        proof(motors)
    said = float(str(stop.value).split("at most ")[1].split()[0])
    assert 0.7 * motors.farthest[1] < said < 2.0 * motors.farthest[1]


@pytest.mark.parametrize("friction", [0.0, 0.02, 0.1, 0.2])
@pytest.mark.parametrize("count", [COUNT, 2 * np.pi / 8000])
def test_a_sound_encoder_answers_whatever_the_friction(fresh_rng, friction, count):
    torque = friction * LIMITS.torque * float(fresh_rng.uniform(0.8, 1.0))
    motors = Motors((torque, torque), count=count)
    one = proof(motors, replace(AXES, resolution=np.full(2, count)))
    assert one.answered
    assert motors.most[1] <= max(2.2 * torque, 0.12 * LIMITS.torque) * 1.5


@pytest.mark.parametrize("stuck", [False, True])
def test_a_weight_sinks_until_its_loop_has_taken_it_over(stuck):
    """Sinking is no noise of the encoder that pulses would have to stand out from."""
    motors = Motors(weight=0.05, stuck=stuck)
    if stuck:
        with pytest.raises(SafetyStopError, match="y: does not move by its encoder"):
            proof(motors)
    else:
        assert proof(motors).answered
        assert motors.most[1] < 4 * PROOF_SHARES[0] * LIMITS.torque


def test_what_goes_to_and_fro_has_moved():
    """Two counts one way and two the other, of an encoder so coarse that friction hides the rest."""
    one = Proof(AXES, 1, np.zeros(2), STEP, np.full(2, 1e-4), lambda *_: None)
    capture, rows_done = None, 0
    while (targets := one(capture)) is not None and not one.answered:
        rows, pulse = targets.position.shape[0], targets.torque_offset[:, 1]
        position = np.stack([np.zeros(rows), 2 * COUNT * np.sign(pulse)], axis=1)
        torque = targets.torque_offset
        words = np.zeros((rows, 2), dtype=np.uint16)
        capture = Capture(rows_done, targets.position, position, torque, words)
        rows_done += rows
    assert one.answered


def test_an_axis_that_is_shaken_is_told_by_how_much(fresh_rng):
    """It was said to have moved by less than 3 counts, which a look at the screen disproves."""
    one = Proof(AXES, 1, np.zeros(2), STEP, np.full(2, 1e-4), lambda *_: None)
    capture, rows_done, frequency = None, 0, float(fresh_rng.uniform(11.0, 40.0))
    with pytest.raises(SafetyStopError) as stop:
        while (targets := one(capture)) is not None:
            rows = targets.position.shape[0]
            swing = (
                20 * COUNT * np.sin(2 * np.pi * frequency * STEP * (rows_done + np.arange(rows)))
            )
            position = np.stack([np.zeros(rows), swing], axis=1)
            words = np.zeros((rows, 2), dtype=np.uint16)
            capture = Capture(rows_done, targets.position, position, targets.torque_offset, words)
            rows_done += rows
    said = str(stop.value)
    assert "something shakes it by more than these pulses do" in said
    assert "counts" not in said
    changed, rest = (
        float(said.partition(words)[2].split(maxsplit=1)[0])
        for words in ("position by", "it did by")
    )
    assert changed == pytest.approx(40 * COUNT, rel=0.1)
    assert rest == pytest.approx(40 * COUNT, rel=0.1)


def test_the_first_pulses_are_enough_without_friction():
    motors = Motors()
    assert proof(motors).answered
    assert motors.most[1] < 2 * PROOF_SHARES[0] * LIMITS.torque


def test_soft_loops_can_not_tell_and_say_nothing():
    """A loop that gives little torque, against friction: it is not sure, and no reason to stop."""
    soft = replace(AXES, torque_offsets=(), stiffness=np.full(2, 1.0))
    one = proof(Motors((2.0, 2.0), gain=1 / 15), soft)
    assert (one.asks, one.answered) == (True, False)


def test_at_the_end_of_its_travel_targets_stay_inside():
    low = replace(LIMITS, travel=(-1e-4, 2.0))
    axes = replace(AXES, torque_offsets=(), limits=(LIMITS, low))
    assert not Proof(axes, 1, np.zeros(2), STEP, np.full(2, 1e-4), lambda *_: None).asks


def test_at_the_end_of_its_travel_offsets_push_no_further():
    low = replace(LIMITS, travel=(-1e-6, 2.0))
    assert not Proof(
        replace(AXES, limits=(LIMITS, low)), 1, np.zeros(2), STEP, np.full(2, 1e-4), lambda *_: None
    ).asks


def test_pulses_keep_the_torque_limit_on_top_of_what_the_axis_holds():
    """An axis that hangs needs most of its torque already."""
    held = 0.9 * LIMITS.torque
    axes, wanted = AXES, []
    one = Proof(axes, 1, np.zeros(2), STEP, np.full(2, 1e-4), lambda *_: None)
    capture = None
    while (targets := one(capture)) is not None:
        assert isinstance(targets, Targets)
        wanted.append(held + np.abs(targets.torque_offset[:, 1]).max())
        rows = targets.position.shape[0]
        torque = np.tile([0.0, held], (rows, 1)) + targets.torque_offset
        words = np.zeros((rows, 2), dtype=np.uint16)
        capture = Capture(0, targets.position, np.zeros((rows, 2)), torque, words)
    assert held < max(wanted) <= LIMITS.torque


def test_the_direction_check_begins_with_it():
    kept = []
    motors = Motors(stuck=True)
    with pytest.raises(SafetyStopError, match="y: does not move by its encoder"):
        check_directions(motors, AXES, STEP, kept.append)
    assert motors.asked
    assert motors.farthest[1] < np.radians(0.3)
