"""The check of directions where friction holds an axis beside its target, or its encoder is coarse."""

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np
import pytest

from drives.api import AxisLimits, Capture, Source, joined
from drives.errors import SafetyStopError
from fieldtool.experiment.axes import Axes
from fieldtool.experiment.directions import check_directions

STEP = 0.004
TRAVEL = 4.0
NUDGE, ALLOWED, MOVE = 0.002 * TRAVEL, 0.001 * TRAVEL, 0.02 * TRAVEL
LIMITS = AxisLimits((-TRAVEL / 2, TRAVEL / 2), 4.0, 80.0, 1e5, 0.5)
Law = Callable[[int, np.ndarray, np.ndarray], np.ndarray]
"""Position of the axes, relative to their start, from row, target and position before."""


class Group:
    """Axes that follow a law; it gives motions and is the motion."""

    def __init__(self, law: Law, resolution: float = 0.0, start: tuple[float, float] = (0, 0)):
        self.law, self.resolution, self.start = law, resolution, np.array(start, dtype=float)
        self.now, self.row, self.cycle_time, self.free = np.zeros(2), 0, STEP, (False, False)
        self.torque_offsets = (False, False)

    @contextmanager
    def motion(self, cycle_time: float, free: tuple[str, ...] = ()) -> Iterator["Group"]:
        assert (cycle_time, free) == (STEP, ())
        yield self

    @property
    def position(self) -> np.ndarray:
        counts = self.start + self.now
        return (
            counts if not self.resolution else np.round(counts / self.resolution) * self.resolution
        )

    def stream(self, source: Source) -> Capture:
        captures: list[Capture] = []
        while (block := source(captures[-1] if captures else None)) is not None:
            assert isinstance(block, np.ndarray)
            rows = []
            for target in block:
                self.now = self.law(self.row, target - self.start, self.now)
                self.row += 1
                rows.append(self.position)
            zeros = np.zeros(block.shape)
            captures.append(
                Capture(self.row - len(rows), block, np.array(rows), zeros, zeros.astype(np.uint16))
            )
        return joined(captures)


def check(group: Group) -> int:
    resolution = np.full(2, group.resolution) if group.resolution else None
    axes = Axes(("x", "y"), (LIMITS, LIMITS), np.zeros(2), ("rad", "rad"), resolution)
    kept: list[str] = []
    check_directions(group, axes, STEP, lambda e: kept.append(e.name))
    assert len(kept) == 2
    return group.row


def friction(lag: float) -> Law:
    """Each axis stands until its target is farther away than this; then it trails by as much."""

    def law(_row: int, target: np.ndarray, now: np.ndarray) -> np.ndarray:
        return np.clip(now, target - lag, target + lag)

    return law


def test_friction_may_hold_an_axis_beside_its_target(fresh_rng):
    lag = fresh_rng.uniform(0.5 * NUDGE, 0.95 * NUDGE)
    rows = check(Group(friction(lag), start=tuple(fresh_rng.uniform(-0.5, 0.5, 2))))
    assert rows * STEP < 40.0, "standing beside the target is standing: no waiting for the timeout"


def test_a_coarse_encoder_is_no_wrong_direction(fresh_rng):
    """Its noise of two counts each way, as the fault was found: 4 counts where 2.7 were commanded."""
    count = 2 * np.pi / 2000
    noise = np.random.default_rng(int(fresh_rng.integers(2**31)))

    def law(_row: int, target: np.ndarray, _now: np.ndarray) -> np.ndarray:
        return target + noise.uniform(-2.0, 2.0, 2) * count

    check(Group(law, count))


@pytest.mark.parametrize(("when", "slowest"), [(200, 1.2e-5), (2500, 6e-5)])
def test_an_axis_that_walks_away_is_still_found(fresh_rng, when, slowest):
    """However slowly: each move is judged from where it begins, but none from beyond the nudge."""
    speed = fresh_rng.uniform(1.0, 2.0) * slowest * fresh_rng.choice([-1.0, 1.0])

    def law(row: int, target: np.ndarray, now: np.ndarray) -> np.ndarray:
        return np.array([target[0], target[1] + speed * max(row - when, 0)])

    group = Group(law)
    with pytest.raises(SafetyStopError, match="y: ") as stop:
        check(group)
    assert stop.value.axis == "y"
    assert stop.value.runaway
    assert abs(group.now[1]) < 2 * MOVE


def test_in_the_nudges_no_axis_is_judged_from_beyond_its_nudge():
    """The second axis drifts between nudges, always slower than any one move would show."""

    def law(row: int, target: np.ndarray, now: np.ndarray) -> np.ndarray:
        return np.array([target[0], -6e-6 * row])

    group = Group(law)
    with pytest.raises(SafetyStopError, match="y: ") as stop:
        check(group)
    assert stop.value.runaway
    assert abs(group.now[1]) < 1.01 * (NUDGE + ALLOWED)


def test_a_reversed_axis_with_a_coarse_encoder_is_found():
    count = 2 * np.pi / 2000

    def law(_row: int, target: np.ndarray, _now: np.ndarray) -> np.ndarray:
        return target * np.array([1.0, -1.0])

    group = Group(law, count)
    with pytest.raises(SafetyStopError, match="y: moves the wrong way") as stop:
        check(group)
    assert stop.value.axis == "y"
    assert abs(group.now[1]) < ALLOWED + 5 * count


def test_ctrl_c_while_moves_are_saved_waits_for_the_last():
    kept = []

    def keep(experiment):
        signal.raise_signal(signal.SIGINT)
        kept.append(experiment.name)

    axes = Axes(("x", "y"), (LIMITS, LIMITS), np.zeros(2), ("rad", "rad"))
    with pytest.raises(KeyboardInterrupt):
        check_directions(Group(friction(0.0)), axes, STEP, keep)
    assert kept == ["direction check of x", "direction check of y"]
