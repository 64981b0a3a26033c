"""Motion that an encoder does not show, on a motor of Newton's and Coulomb's laws with a cascade.

The motor, its friction and its loop are integrated here in SI, in small steps; the watch sees counts and
per mille of torque, once a cycle.
"""

from dataclasses import dataclass, field

import numpy as np
import pytest

from drives.canopen_drive.unseen import Learned, Unseen

CYCLE, INNER = 0.002, 16
INERTIA, LIMIT, RATED = 0.04, 6.0, 4.0
UNIT = RATED / 1000
WINDOW = np.radians(30)
FILTERED = 0.06
"""Of the velocity filter, for each inner step: weaker ones let loops with coarse encoders hum in step
with the bus, so that the sampled torque is not the mean one."""


@dataclass
class Motor:
    """A motor with dry friction under a position loop, which sees only its encoder."""

    counts: float
    """A turn."""
    friction: float
    weight: float = 0.0
    position_p: float = 15.0
    velocity_p: float = 2.0
    velocity_i: float = 15.0
    angle: float = 0.0
    speed: float = 0.0
    stuck_at: int | None = None
    sign: float = 1.0
    """-1: its phases are swapped."""
    sum: float = 0.0
    torque: float = 0.0
    _before: int = 0
    _filtered: float = 0.0
    rng: np.random.Generator = field(default_factory=lambda: np.random.default_rng(1))

    def __post_init__(self) -> None:
        self.sum = self.weight
        self._before = self.encoder

    @property
    def scale(self) -> float:
        return 2 * np.pi / self.counts

    @property
    def encoder(self) -> int:
        return self.stuck_at if self.stuck_at is not None else round(self.angle / self.scale)

    def cycle(self, target: float) -> tuple[int, int]:
        """Let a cycle pass; return what the drive shows then."""
        step = CYCLE / INNER
        for _ in range(INNER):
            now = self.encoder
            self._filtered += FILTERED * ((now - self._before) * self.scale / step - self._filtered)
            self._before = now
            error = self.position_p * (target - now * self.scale) - self._filtered
            self.sum += step * self.velocity_i * error
            self.torque = float(np.clip(self.velocity_p * error + self.sum, -LIMIT, LIMIT))
            self._move(self.sign * self.torque - self.weight, step)
        noise = self.rng.normal(0.0, 0.002)
        return self.encoder, round((self.torque + noise) / UNIT)

    def _move(self, pushed: float, step: float) -> None:
        """Stick or slide."""
        if self.speed == 0 and abs(pushed) <= self.friction:
            return
        way = np.sign(self.speed) if self.speed else np.sign(pushed)
        speed = self.speed + step * (pushed - way * self.friction) / INERTIA
        self.speed = 0.0 if self.speed * speed < 0 else speed
        self.angle += step * self.speed


def watch_of(motor: Motor, learned: Learned | None = None, prior: float = INERTIA) -> Unseen:
    push = UNIT / prior * CYCLE**2 / motor.scale
    floor = 2 + 0.03 * LIMIT / UNIT
    return Unseen(learned or Learned(), push, round(WINDOW / motor.scale), floor, CYCLE)


def pulses(motor: Motor, watch: Unseen) -> None:
    """Push it out of rest, harder and harder, and nudge it: what comes before every measurement."""
    for _ in range(60):
        watch.take(*motor.cycle(0.0))
    for size in (0.02, 0.05, 0.1, 0.2, 0.3):
        for row in range(12):
            motor.sum += size * LIMIT * np.sin(2 * np.pi * row / 12)
            shown = motor.cycle(0.0)
            motor.sum -= size * LIMIT * np.sin(2 * np.pi * row / 12)
            watch.take(*shown)
    nudge = 0.04 * np.sin(np.linspace(0, np.pi, 600)) ** 2
    for target in np.concatenate([np.zeros(100), nudge, np.zeros(100)]):
        watch.take(*motor.cycle(float(target)))


def sweep(rng: np.random.Generator, rows: int, size: float) -> np.ndarray:
    """Return a sum of sines that fades in."""
    time = np.arange(rows) * CYCLE
    rows_in = np.minimum(time / 0.3, 1.0)
    sines = [
        np.sin(2 * np.pi * f * time + rng.uniform(0, 2 * np.pi)) / f for f in rng.uniform(1, 12, 5)
    ]
    return size * rows_in * np.sum(sines, axis=0)


@pytest.mark.parametrize("counts", [4000, 60_000, 2**20])
@pytest.mark.parametrize("friction", [0.0, 0.2, 1.2])
def test_a_sound_axis_is_no_alarm(fresh_rng, counts, friction):
    """Whatever it does, at rest and in sweeps; its prior inertia may be wrong by a factor of two."""
    motor = Motor(counts, friction, weight=float(fresh_rng.uniform(-0.5, 0.5)))
    watch = watch_of(motor, prior=INERTIA * float(fresh_rng.choice([0.5, 1.0, 2.0])))
    pulses(motor, watch)
    for target in sweep(fresh_rng, 3000, float(fresh_rng.uniform(0.02, 0.3))):
        watch.take(*motor.cycle(target))
        assert not watch.alarm


def gone_until_alarm(
    rng: np.random.Generator, counts: float, friction: float, over_gaps: bool
) -> tuple[str, float]:
    """Let the encoder stick in a sweep; return the alarm, and how far the axis went until then."""
    motor = Motor(counts, friction)
    watch = watch_of(motor)
    gaps = Gaps(rng, motor, watch)
    if over_gaps:
        pulses_over(gaps, motor)
    else:
        pulses(motor, watch)
    assert watch.knows
    when = int(rng.integers(400, 1200))
    for row, target in enumerate(sweep(rng, 3000, 0.3)):
        if row == when:
            motor.stuck_at, before = motor.encoder, motor.angle
        if over_gaps:
            gaps.follow(float(target))
        else:
            watch.take(*motor.cycle(float(target)))
        if watch.alarm:
            assert row >= when
            return watch.alarm, abs(motor.angle - before)
    raise AssertionError("it was never found")


def stuck_is_found(
    rng: np.random.Generator, counts: float, friction: float, over_gaps: bool
) -> None:
    """It is always found, and soon: torques above friction, below what friction may be, go unseen."""
    allowed = max(512 * 2 * np.pi / counts, np.radians(5.0))  # 23 degrees with 8000 counts
    draws = 5 if friction else 1
    found = [gone_until_alarm(rng, counts, friction, over_gaps) for _ in range(draws)]
    far = [f"{alarm}: {np.degrees(gone):.2f} degrees" for alarm, gone in found if gone >= allowed]
    assert len(far) <= draws // 3, far


@pytest.mark.parametrize("counts", [8000, 60_000, 2**20])
@pytest.mark.parametrize("friction", [0.0, 1.2])
def test_a_stuck_encoder_is_found_before_it_has_gone_far(fresh_rng, counts, friction):
    stuck_is_found(fresh_rng, counts, friction, over_gaps=False)


def test_an_axis_that_was_pushed_away_coasts_on_unseen_under_less_torque():
    """Friction alone slows it: what goes on pushing it, though weaker than friction may be, counts."""

    alarms = []
    for share_after in (0.95, 0.2):
        motor = Motor(8000, 1.2)
        watch = watch_of(motor)
        pulses(motor, watch)
        hold = 1.8 * watch._learned.friction + 0.03 * LIMIT / UNIT + 2
        position, _ = motor.cycle(0.0)
        pull, share = watch._learned.pull, 1.3
        for _ in range(300):
            watch.take(position, round(pull + share * hold))
            if abs(watch.way) > 0.5 * watch.at_rest:
                share = share_after
        alarms.append(watch.alarm)
    assert alarms == ["pushed", ""]


def test_an_axis_that_stops_dead_at_speed_is_found_in_two_cycles(fresh_rng):
    motor = Motor(2**20, 0.0)
    watch = watch_of(motor)
    pulses(motor, watch)
    rows = 0
    for target in sweep(fresh_rng, 2000, 0.3):
        watch.take(*motor.cycle(target))
        if motor.stuck_at is not None:
            rows += 1
            if watch.alarm:
                break
        elif abs(motor.speed) > 0.5 and watch._learned.samples > 300:
            motor.stuck_at = motor.encoder
    assert (watch.alarm, rows) == ("dead", 2)


class Gaps:
    """A bus that loses samples now and then, or is late: every 25 cycles at least."""

    def __init__(self, rng: np.random.Generator, motor: Motor, watch: Unseen) -> None:
        self._rng, self._motor, self._watch = rng, motor, watch
        self._next = 0
        self._row = 0
        self._target = 0.0

    def take(self, position: int, torque: int) -> None:
        """Hand the sample on, unless it is lost; a late one comes after the motor had more time."""
        cycles, self._row = 1.0, self._row + 1
        if self._row >= self._next:
            self._next = self._row + int(self._rng.integers(3, 25))
            for _ in range(int(self._rng.integers(1, 3))):
                cycles += 1
                position, torque = self._motor.cycle(self._target)
        self._watch.take(position, torque, cycles)

    def follow(self, target: float) -> None:
        self._target = float(target)
        self.take(*self._motor.cycle(self._target))


def pulses_over(gaps: Gaps, motor: Motor) -> None:
    """Do as ``pulses`` does, on that bus."""
    gaps.follow(0.0)
    pulses(motor, gaps)  # type: ignore[arg-type]


@pytest.mark.parametrize("counts", [4000, 60_000, 2**20])
@pytest.mark.parametrize("friction", [0.0, 0.2, 1.2])
def test_a_bus_that_loses_a_cycle_now_and_then_is_no_alarm(fresh_rng, counts, friction):
    motor = Motor(counts, friction, weight=float(fresh_rng.uniform(-0.5, 0.5)))
    watch = watch_of(motor, prior=INERTIA * float(fresh_rng.choice([0.5, 1.0, 2.0])))
    gaps = Gaps(fresh_rng, motor, watch)
    pulses_over(gaps, motor)
    for target in sweep(fresh_rng, 3000, float(fresh_rng.uniform(0.02, 0.3))):
        gaps.follow(target)
        assert not watch.alarm


@pytest.mark.parametrize("counts", [8000, 60_000, 2**20])
@pytest.mark.parametrize("friction", [0.0, 1.2])
def test_a_stuck_encoder_is_found_on_a_bus_that_loses_cycles(fresh_rng, counts, friction):
    """As far on as where none is lost: an axis that is pushed away is pushed in a lost cycle too."""
    stuck_is_found(fresh_rng, counts, friction, over_gaps=True)


def test_an_axis_that_stops_dead_in_a_lost_cycle_is_found_soon_after(fresh_rng):
    motor = Motor(2**20, 0.0)
    watch = watch_of(motor)
    pulses(motor, watch)
    lost, before = 0, 0.0
    for target in sweep(fresh_rng, 2000, 0.3):
        position, torque = motor.cycle(target)
        if motor.stuck_at is None and abs(motor.speed) > 0.5 and watch._learned.samples > 300:
            motor.stuck_at, before, lost = motor.encoder, motor.angle, 1
            continue
        watch.take(position, torque, 1.0 + lost)
        lost = 0
        if watch.alarm:
            break
    assert watch.alarm == "dead"
    assert abs(motor.angle - before) < np.radians(1.0)


def test_nothing_is_judged_across_a_pause():
    motor = Motor(2**20, 0.0)
    watch = watch_of(motor)
    pulses(motor, watch)
    position, torque = motor.cycle(0.0)
    for k in range(50):
        watch.take(position + 100 * k, torque)
    watch.take(position + 5000, torque, 40.0)
    for _ in range(5):
        watch.take(position + 5000, torque)
    assert not watch.alarm


def test_what_was_learned_lasts_from_motion_to_motion():
    """And what belongs to a cycle time goes with it."""
    learned = Learned()
    motor = Motor(2**20, 0.6)
    pulses(motor, watch_of(motor, learned))
    assert 0.8 * 0.6 / UNIT <= learned.friction < 3 * 0.6 / UNIT
    assert learned.samples
    Unseen(learned, 1.0, 1000, 10.0, 2 * CYCLE)
    assert (learned.samples, learned.change) == (0, 0)
    assert learned.friction > 0
