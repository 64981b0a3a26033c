"""The fast plan's runner on a fake machine that a model moves, faults on request; growth; clipping.

The fake does not imitate: drives, a bus, quantisation, quick stops; it keeps no limits.
"""

import re
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace

import numpy as np
import pytest
from scipy.linalg import expm

from drives.api import AxisLimits, Capture, Source, Targets, joined
from drives.errors import SafetyStopError, UserStopError
from fieldtool.errors import LoopUnstableError, NotEnoughDataError
from fieldtool.experiment.axes import Axes
from fieldtool.experiment.multisine.clipping import clipped_samples
from fieldtool.experiment.multisine.growth import GrowthWatch
from fieldtool.experiment.multisine.plan import (
    MultisinePlan,
    orthogonal_experiments,
    random_odd_lines,
)
from fieldtool.experiment.multisine.runner import MultisineProgress, run_multisine
from fieldtool.records.closed_loop import AxisLoop, ClosedLoop
from fieldtool.records.model import AxisModel, Coupling, Estimate, MachineModel
from fieldtool.records.recording import Experiment
from tests.seeds import fresh_seed

STEP, SAMPLES, SETTLE = 0.005, 400, 400
LIMITS = AxisLimits((-2.0, 2.0), 8.0, 400.0, 1e5, 1.0)
Spoil = Callable[[np.ndarray, np.ndarray, np.ndarray], None]
"""Changes rows (n,), positions and torques of a block in place."""


def machine() -> MachineModel:
    """An axis of two masses, mode at about 8 Hz, coupled to a rigid one."""

    def exact(*values: float) -> tuple[Estimate, ...]:
        return tuple(Estimate(v) for v in values)

    return MachineModel(
        (
            AxisModel("x", "rotary", exact(20.0, 20.0), exact(25_000.0), exact(60.0)),
            AxisModel("y", "rotary", exact(30.0), (), (), Estimate(30.0)),
        ),
        (Coupling(("x", "y"), 4.0),),
    )


@dataclass
class FakeGroup:
    """Axes that a model moves.  Rows are counted from where the excitation begins."""

    spoil: Spoil = lambda *_: None
    missing: frozenset[int] = frozenset()
    fail: tuple[int, Exception] | None = None
    motions: list[bool] = field(default_factory=list)
    streams: list[Capture] = field(default_factory=list)
    entered: int = 0
    row: int = 0

    @contextmanager
    def motion(
        self, cycle_time: float, free: tuple[str, ...] = (), torque_offset: bool = False
    ) -> Iterator["FakeMotion"]:
        assert free == ()
        self.motions.append(torque_offset)
        self.entered += 1
        try:
            yield FakeMotion(self, cycle_time, torque_offset)
        finally:
            self.entered -= 1


class FakeMotion:
    def __init__(self, group: FakeGroup, cycle_time: float, torque_offset: bool) -> None:
        self.group, self.cycle_time, self.torque_offset = group, cycle_time, torque_offset
        model = machine()
        loops = tuple(AxisLoop(4.0, 20 * a.total_mass, 80 * a.total_mass, 0.0) for a in model.axes)
        self.loop = ClosedLoop(model, loops)
        a, b_r, _, self._c_x, self._c_r, _ = self.loop._matrices()
        b_t, _ = self.loop._offset_matrices()
        self._n = a.shape[0]
        block = np.zeros((self._n + 4,) * 2)
        block[: self._n] = np.hstack([a, b_r, b_t])
        self._step = expm(block * cycle_time)[: self._n]
        self._x = np.zeros(self._n)
        self._targets = 0

    @property
    def position(self) -> np.ndarray:
        return self._x[self.loop.model.first_masses]

    def stream(self, source: Source) -> Capture:
        group = self.group
        captures: list[Capture] = []
        previous: Capture | None = None
        self._targets += 1
        excited = self._targets % 2 == 0  # the stream before brings the axes to their centres
        while (block := source(previous)) is not None:
            if isinstance(block, Targets):
                assert self.torque_offset
                targets, offset = block.position, block.torque_offset
            else:
                targets, offset = block, np.zeros_like(block)
            position, torque = np.empty_like(targets), np.empty_like(targets)
            for k, (r, u) in enumerate(zip(targets, offset, strict=True)):
                position[k] = self.position
                torque[k] = self._c_x @ self._x + self._c_r @ r + u
                self._x = self._step @ np.concatenate([self._x, r, u])
            rows = group.row + np.arange(targets.shape[0])
            missing: tuple[int, ...] = ()
            if excited:
                group.spoil(rows, position, torque)
                missing = tuple(np.flatnonzero(np.isin(rows, list(group.missing))).tolist())
                group.row += rows.size
            previous = Capture(
                0,
                targets.copy(),
                position,
                torque,
                np.full(targets.shape, 0x1237, dtype=np.uint16),
                missing,
                offset if self.torque_offset else None,
            )
            captures.append(previous)
            if excited and group.fail is not None and group.row > group.fail[0]:
                error = group.fail[1]
                if isinstance(error, SafetyStopError | UserStopError):
                    error.capture = joined(captures)
                raise error
        if excited:
            group.streams.append(joined(captures))
        return joined(captures)


def plan(
    seed: int = 1, size: float = 0.05, torque: float = 0.0, **changes: object
) -> MultisinePlan:
    rng = np.random.default_rng(seed)
    lines, detection = random_odd_lines(3, 41, 0.2, rng)
    settings: dict[str, object] = {"periods": 3, "settle": SETTLE, "samples": SAMPLES}
    tail = changes.pop("tail", 0)
    made = orthogonal_experiments(
        lines,
        detection,
        size * np.ones((lines.size, 2)) / lines[:, None],
        cycle_time=STEP,
        seed=seed,
        torque=np.full((lines.size, 2), torque + 0j),
        **(settings | changes),  # type: ignore[arg-type]
    )
    return MultisinePlan(STEP, tuple(replace(one, tail=tail) for one in made))


def axes(limits: AxisLimits = LIMITS) -> Axes:
    return Axes(("x", "y"), (limits, limits), np.zeros(2), ("rad", "rad"))


def run(
    group: FakeGroup, the_plan: MultisinePlan, of: Axes | None = None, errors: float | None = None
) -> tuple[list[Experiment], list[MultisineProgress], float]:
    kept: list[Experiment] = []
    told: list[MultisineProgress] = []

    def keep(experiment: Experiment) -> None:
        assert group.entered == 0  # the disk may be slow
        kept.append(experiment)

    expected = None if errors is None else np.full((len(the_plan.experiments), 2), errors)
    seconds = run_multisine(group, the_plan, of or axes(), keep, told.append, expected)
    return kept, told, seconds


def failing(
    group: FakeGroup, the_plan: MultisinePlan, of: Axes | None = None, errors: float | None = None
) -> tuple[list[Experiment], Exception]:
    kept: list[Experiment] = []
    expected = None if errors is None else np.full((len(the_plan.experiments), 2), errors)
    with pytest.raises(Exception) as caught:  # noqa: PT011  # which one, the caller looks at
        run_multisine(group, the_plan, of or axes(), kept.append, lambda _: None, expected)
    assert group.entered == 0
    return kept, caught.value  # type: ignore[return-value]


def last_rows(experiment: Experiment, periods: int = 3) -> np.ndarray:
    whole: np.ndarray = experiment.position[-periods * SAMPLES :]
    return whole.reshape(periods, SAMPLES, -1)


@pytest.mark.parametrize("torque", [0.0, 2.0])
def test_experiments_follow_each_other_and_are_periodic(torque: float) -> None:
    the_plan = plan(torque=torque)
    group = FakeGroup()
    kept, told, seconds = run(group, the_plan, errors=0.2)
    assert [e.name for e in kept] == ["multisine 1", "multisine 2"]
    for experiment, one in zip(kept, the_plan.experiments, strict=True):
        assert experiment.complete
        assert experiment.note == ""
        assert experiment.samples == one.rows
        assert experiment.position_reference is not None
        rows = experiment.position_reference[SETTLE:]
        np.testing.assert_allclose(rows, one.targets()[SETTLE:], atol=1e-12)
        periods = last_rows(experiment)
        assert np.abs(periods[2] - periods[1]).max() < 1e-3 * np.abs(periods).max()
        offsets = [experiment.extra[f"{n}.torque_offset"] for n in "xy"] if torque else []
        if torque:
            np.testing.assert_allclose(
                np.stack(offsets, 1)[SETTLE:], one.torque_targets()[SETTLE:], atol=1e-9
            )
    (stream,) = group.streams
    assert group.motions == [bool(torque)]
    references = stream.position_reference
    assert references.shape[0] == round(the_plan.duration / STEP)
    assert seconds == pytest.approx(the_plan.duration)
    np.testing.assert_allclose(references[[0, -1]], 0.0, atol=1e-12)
    inside = np.abs(np.diff(np.concatenate([e.one_period() for e in the_plan.experiments]), 2, 0))
    usual = np.median(np.sort(inside, axis=0)[-40:], axis=0)
    assert np.all(np.abs(np.diff(references, 2, axis=0)).max(axis=0) < 3 * usual)  # no jump between
    done = [p.done for p in told]
    assert done == sorted(done)
    assert 0 < done[0] < 0.1
    assert 0.8 < done[-1] <= 1
    assert [p.experiment for p in told] == sorted(p.experiment for p in told)
    assert {p.period for p in told} == {0, 1, 2, 3}
    left = [p.seconds_left for p in told]
    assert left == sorted(left, reverse=True)
    assert np.diff([p.machine_time for p in told]).max() < 0.4


TAIL = 130
"""Rows that a late cycle spoils here."""


def late(*missing: int) -> Spoil:
    """A machine that is pushed away where a sample is missing, and comes back within the tail."""

    def spoil(rows: np.ndarray, position: np.ndarray, torque: np.ndarray) -> None:
        for row in missing:
            after = (rows >= row) & (rows < row + TAIL)
            position[after] += 0.01
            torque[after] += 100.0

    return spoil


@pytest.mark.parametrize(
    ("missing", "more"),
    [
        ((100,), 0),
        ((SETTLE - 5,), 1),
        ((SETTLE + 5,), 1),
        ((SETTLE + SAMPLES + 5,), 2),
        ((SETTLE + 3 * SAMPLES - 1,), 3),
        ((SETTLE + 5, SETTLE + 200, SETTLE + SAMPLES + 300, SETTLE + 2 * SAMPLES + 7), 3),
        ((SETTLE + 50, SETTLE + SAMPLES + 50, SETTLE + 2 * SAMPLES + 50), 3),
        (tuple(SETTLE + k * SAMPLES + 150 * k % SAMPLES for k in range(4)), 3),
        (tuple(SETTLE + k * SAMPLES + 150 * k % SAMPLES for k in range(8)), 3),
    ],
)
def test_what_a_late_cycle_spoils_is_measured_again(missing: tuple[int, ...], more: int) -> None:
    """Periods in a row that nothing disturbed; late again and again, with what others have in place of
    what is.  All that came is kept.
    """
    spoil = late(*missing)
    (plain, _), _, _ = run(FakeGroup(), plan())
    kept, told, _ = run(FakeGroup(spoil, missing=frozenset(missing)), plan(tail=TAIL - 1))
    *before, whole = [one for one in kept if one.name.startswith("multisine 1")]
    assert whole.name == "multisine 1"
    assert whole.complete
    assert whole.samples == SETTLE + 3 * SAMPLES
    jolts = [
        np.abs(np.diff(one.position[SETTLE // 2 :], 2, axis=0)).max() for one in (whole, plain)
    ]
    assert not more or jolts[0] < 1.05 * jolts[1] + 4e-4, "nor in what stands for its run-in"
    assert kept[-1].name == "multisine 2"
    np.testing.assert_allclose(last_rows(whole), last_rows(plain), atol=2e-4)
    np.testing.assert_allclose(
        whole.position_reference[SETTLE:], plain.position_reference[SETTLE:], atol=1e-12
    )
    assert np.array_equal(whole.time, plain.time)
    assert not [p for p in told if p.period > 3 or p.seconds_left < 0]
    if not more:
        assert not before
        assert whole.note == ""
        return
    (every,) = before
    assert (every.name, every.kind, every.complete) == ("multisine 1, as it came", "other", False)
    assert every.samples == SETTLE + (3 + more) * SAMPLES
    assert f"{more} periods more, because cycles were late or samples missing" in every.note
    assert re.match(r"periods \d to \d of those that were measured", whole.note)
    pushed = np.zeros((every.samples, 2))
    spoil(np.arange(every.samples), pushed, np.zeros_like(pushed))
    assert np.ptp(every.position - pushed, axis=0) == pytest.approx(
        np.ptp(plain.position, axis=0), rel=0.02
    ), "as it came"


def test_too_many_gaps_end_it_with_a_sentence() -> None:
    gaps = frozenset(range(SETTLE, 100_000, SAMPLES // 2))
    kept, error = failing(FakeGroup(missing=gaps), plan())
    assert isinstance(error, NotEnoughDataError)
    assert "3 whole periods of 2 s without a missing sample were not to be had in 18" in str(error)
    (experiment,) = kept
    assert not experiment.complete
    assert experiment.kind == "multisine"
    assert experiment.samples == SETTLE + 18 * SAMPLES


def test_with_a_bias_velocity_it_is_not_begun_for_ever() -> None:
    gaps = frozenset(range(SETTLE, 100_000, SAMPLES // 2))
    kept, error = failing(FakeGroup(missing=gaps), plan(bias=np.array([0.04, -0.02]), periods=2))
    assert isinstance(error, NotEnoughDataError)
    assert (
        "2 whole periods of 2 s without a missing sample were not to be had in 3 attempts"
        in str(error)
    )
    assert [e.name for e in kept] == [
        "multisine 1, attempt 1",
        "multisine 1, attempt 2",
        "multisine 1",
    ]
    assert not any(e.complete for e in kept)


def test_with_a_bias_velocity_a_spoiled_experiment_is_repeated() -> None:
    bias = np.array([0.04, -0.02])
    group = FakeGroup(missing=frozenset({SETTLE + 7}))
    kept, _, _ = run(group, plan(bias=bias, periods=2))
    assert [(e.name, e.kind, e.complete) for e in kept] == [
        ("multisine 1, attempt 1", "other", False),
        ("multisine 1", "multisine", True),
        ("multisine 2", "multisine", True),
    ]
    for experiment in kept[1:]:
        moved = experiment.position[-1] - experiment.position[-1 - SAMPLES]
        np.testing.assert_allclose(moved, bias * STEP * SAMPLES, atol=1e-3)
    assert len(group.streams) == 3
    for stream in group.streams:
        np.testing.assert_allclose(stream.position_reference[0], -bias * STEP * 1200 / 2, atol=1e-9)


@pytest.mark.parametrize("what", ["torque", "travel"])
def test_an_overload_halves_the_amplitude_until_it_fits(what: str) -> None:
    (first, second), _, _ = run(FakeGroup(), plan())
    both = (first, second)
    if what == "torque":
        peak = max(np.abs(e.torque).max() for e in both)
        limits = replace(LIMITS, torque=0.6 * peak)
    else:
        peak = max(np.abs(e.position).max() for e in both)
        limits = replace(LIMITS, travel=(-0.6 * peak, 0.6 * peak))
    group = FakeGroup()
    kept, told, _ = run(group, plan(), axes(limits))
    good = [e for e in kept if e.complete]
    assert [e.name for e in good] == ["multisine 1", "multisine 2"]
    given_up = [e for e in kept if not e.complete]
    assert given_up
    for experiment in given_up:
        assert experiment.kind == "other"
        assert "repeated with half the amplitude" in experiment.note
    halved = [e for e in good if "1/4" in e.note or "1/2" in e.note]
    assert len(halved) == len({e.name.split(",")[0] for e in given_up})
    for experiment in halved:
        assert np.abs(experiment.torque).max() <= 0.8 * limits.torque
        assert np.abs(experiment.position).max() <= 0.8 * limits.travel[1]
    for stream in group.streams:
        np.testing.assert_allclose(stream.position_reference[[0, -1]], 0.0, atol=1e-12)
    assert [p.done for p in told] == sorted(p.done for p in told)


def test_an_axis_that_stays_overloaded_stops_it() -> None:
    def stuck(_: np.ndarray, __: np.ndarray, torque: np.ndarray) -> None:
        torque[:, 1] += 90_000

    group = FakeGroup(spoil=stuck)
    kept, error = failing(group, plan())
    assert isinstance(error, SafetyStopError)
    assert error.axis == "y"
    assert "4 times halved" in str(error)
    assert [e.name for e in kept] == [f"multisine 1, attempt {k}" for k in (1, 2, 3, 4)] + [
        "multisine 1"
    ]
    assert not any(e.complete for e in kept)
    assert len(group.streams) == 5


@pytest.mark.parametrize("error", [SafetyStopError("torque", axis="x"), UserStopError("user")])
def test_what_was_recorded_until_a_stop_is_kept(error: Exception) -> None:
    rows = SETTLE + 3 * SAMPLES
    kept, found = failing(FakeGroup(fail=(rows + 900, error)), plan())
    assert found is error
    assert [(e.name, e.complete) for e in kept] == [("multisine 1", True), ("multisine 2", False)]
    assert kept[0].samples == rows
    assert 900 <= kept[1].samples <= 960
    assert kept[1].note == str(error)


def test_an_error_of_the_program_keeps_what_was_finished() -> None:
    plan_of = plan(bias=np.array([0.01, 0.0]))
    kept, found = failing(FakeGroup(fail=(2500, RuntimeError("defect"))), plan_of)
    assert str(found) == "defect"
    assert [e.name for e in kept] == ["multisine 1"]


def test_ctrl_c_while_experiments_are_saved_waits_for_the_last() -> None:
    kept: list[str] = []

    def keep(experiment: Experiment) -> None:
        signal.raise_signal(signal.SIGINT)
        kept.append(experiment.name)

    with pytest.raises(KeyboardInterrupt):
        run_multisine(FakeGroup(), plan(), axes(), keep)
    assert kept == ["multisine 1", "multisine 2"]


# -- unstable loops -------------------------------------------------------------------------------


def growing(start: int, frequency: float, tau: float, size: float, to: str = "position") -> Spoil:
    def spoil(rows: np.ndarray, position: np.ndarray, torque: np.ndarray) -> None:
        t = STEP * np.maximum(rows - start, 0)
        swing = np.where(t > 0, size * np.exp(t / tau), 0.0) * np.sin(2 * np.pi * frequency * t)
        (position if to == "position" else torque)[:, 0] += swing

    return spoil


@pytest.mark.parametrize(("frequency", "tau"), [(17.0, 0.15), (6.0, 0.5), (2.0, 2.0), (1.2, 4.0)])
@pytest.mark.parametrize("to", ["position", "torque"])
def test_a_growing_oscillation_is_named(frequency: float, tau: float, to: str) -> None:
    scale = 1e-4 if to == "position" else 10.0
    start = SETTLE + 2 * SAMPLES
    noise = np.random.default_rng(fresh_seed()).standard_normal

    def spoil(rows: np.ndarray, position: np.ndarray, torque: np.ndarray) -> None:
        growing(start, frequency, tau, scale, to)(rows, position, torque)
        position += 1e-5 * noise(position.shape)
        torque += noise(torque.shape)

    group = FakeGroup(spoil=spoil)
    kept, error = failing(group, plan(periods=30))
    assert isinstance(error, LoopUnstableError), error
    assert error.axis == "x"
    assert error.frequency == pytest.approx(frequency, rel=0.15)
    assert f"{error.frequency:.3g} Hz" in str(error)
    assert "Lower the drive's gains" in str(error)
    (experiment,) = kept
    assert not experiment.complete
    assert experiment.note == str(error)
    error_now = experiment.position_reference - experiment.position  # type: ignore[operator]
    assert np.abs(error_now).max() < 0.9 * LIMITS.following_error
    assert np.abs(experiment.torque).max() < 0.9 * LIMITS.torque
    (stream,) = group.streams
    np.testing.assert_allclose(stream.position_reference[-1], 0.0, atol=1e-12)
    assert stream.rows - experiment.samples < 1.0 / STEP  # ends at once


def test_in_the_first_period_the_forecast_tells_what_is_not_expected() -> None:
    spoil = growing(SETTLE // 2, 9.0, 0.3, 1e-4)
    kept, error = failing(FakeGroup(spoil=spoil), plan(), errors=0.05)
    assert isinstance(error, LoopUnstableError)
    assert error.frequency == pytest.approx(9.0, rel=0.15)
    assert kept[0].samples <= SETTLE + SAMPLES


def test_a_growing_oscillation_that_ends_in_a_safety_stop_is_named() -> None:
    stop = SafetyStopError("x: following error 1.01 rad is above the limit", axis="x")
    start = SETTLE + 2 * SAMPLES
    group = FakeGroup(spoil=growing(start, 25.0, 0.06, 1e-3), fail=(start + 60, stop))
    kept, error = failing(group, plan())
    assert isinstance(error, LoopUnstableError)
    assert error.frequency == pytest.approx(25.0, rel=0.2)
    assert error.__cause__ is stop
    assert any("following error 1.01" in note for note in error.__notes__)
    assert [e.complete for e in kept] == [False]


def test_a_torque_that_swings_above_the_band_is_an_unstable_loop() -> None:
    def swinging(rows: np.ndarray, _: np.ndarray, torque: np.ndarray) -> None:
        torque[:, 1] += np.where(rows > 900, 95_000 * np.sin(2 * np.pi * 60.0 * STEP * rows), 0.0)

    kept, error = failing(FakeGroup(spoil=swinging), plan())
    assert isinstance(error, LoopUnstableError)
    assert error.axis == "y"
    assert error.frequency == pytest.approx(60.0, rel=0.05)
    assert len(kept) == 1


@pytest.mark.parametrize("kind", ["noise", "stick-slip", "bump", "decay"])
def test_no_alarm_where_nothing_grows_by_itself(kind: str, fresh_rng: np.random.Generator) -> None:
    """Errors of up to the size of the limit that do not repeat, but are not growing oscillations."""
    level = float(fresh_rng.uniform(0.1, 0.3))
    M, n = 2, 24_000
    t = STEP * np.arange(n)[:, None]
    base = 0.3 * np.sin(2 * np.pi * 1.5 * t) * np.ones(M)
    if kind == "noise":
        extra = level * fresh_rng.standard_normal((n, M))
    elif kind == "stick-slip":  # a random walk that slips back, noise of a low-pass
        drive = fresh_rng.standard_normal((n + 400, M))
        smooth = np.apply_along_axis(
            lambda v: np.convolve(v, np.hanning(60), "valid")[:n], 0, drive
        )
        extra = np.clip(level * smooth / smooth.std(), -0.6, 0.6)
    elif kind == "bump":
        at = fresh_rng.uniform(20, 100, (6, 1, 1))
        width = fresh_rng.uniform(0.05, 0.5)
        extra = np.sum(np.exp(-(((t - at) / width) ** 2)), axis=0) * level * 2 * np.ones(M)
    else:
        extra = np.exp(-t / 3) * np.sin(2 * np.pi * 4 * t) * 3 * level * np.ones(M)
    watch = GrowthWatch(SAMPLES, SETTLE, np.ones(M), np.ones(M), np.full(M, 0.4), STEP)
    signal = base + extra
    for begin in range(0, n, 50):
        block = signal[begin : begin + 50]
        growth = watch.take(block, 0.5 * block)
        assert growth is None, f"{growth} at {begin * STEP:.2f} s"


@pytest.mark.parametrize("seed", [32, 67, 205, 2456734483])
def test_friction_that_comes_and_goes_is_no_growing_oscillation(seed: int) -> None:
    """Larger and larger three times in a row, and out of what the last seconds showed: by chance."""
    test_no_alarm_where_nothing_grows_by_itself("stick-slip", np.random.default_rng(seed))


def test_what_swung_long_ago_does_not_hide_an_oscillation_that_grows() -> None:
    n, start = 8000, 6000
    t = STEP * np.arange(n)[:, None]
    once = 0.2 * np.sin(2 * np.pi * 7 * t) * (np.abs(t - 10) < 3)
    size = 0.01 * np.exp(np.maximum(t - STEP * start, 0) / 0.5) * (t > STEP * start)
    signal = 0.3 * np.sin(2 * np.pi * 1.5 * t) + once + size * np.sin(2 * np.pi * 6 * t)
    watch = GrowthWatch(SAMPLES, SETTLE, np.ones(1), np.ones(1), np.full(1, 0.4), STEP)
    found = [(k, watch.take(signal[k : k + 50], 0 * signal[k : k + 50])) for k in range(0, n, 50)]
    first, growth = next(one for one in found if one[1] is not None)
    assert first >= start
    assert growth.frequency == pytest.approx(6.0, rel=0.15)
    assert growth.share < 0.9


# -- clipping -------------------------------------------------------------------------------------


def test_a_torque_at_its_limit_is_said() -> None:
    def cut_off(_: np.ndarray, __: np.ndarray, torque: np.ndarray) -> None:
        np.clip(torque[:, 0], -top, top, out=torque[:, 0])

    (clean, _), _, _ = run(FakeGroup(), plan())
    top = 0.6 * np.abs(clean.torque[:, 0]).max()
    kept, _, _ = run(FakeGroup(spoil=cut_off), plan())
    assert "torque of x was at its limit in" in kept[0].note
    assert "torque of y" not in kept[0].note
    counted = int(kept[0].note.split(" in ")[1].split()[0])
    assert counted == pytest.approx(np.count_nonzero(np.abs(clean.torque[:, 0]) >= top), rel=0.5)


@pytest.mark.parametrize("quantum", [1e-9, 0.002, 0.005])
@pytest.mark.parametrize("noise", [0.0, 0.003])
def test_clipping_is_told_from_peaks(
    quantum: float, noise: float, fresh_rng: np.random.Generator
) -> None:
    unseen = 0
    for _ in range(20):
        lines = np.arange(3, int(fresh_rng.integers(21, 61)), 2)
        phases = fresh_rng.uniform(0, 2 * np.pi, lines.size)
        t = np.arange(4000) / 2000
        torque = np.sin(2 * np.pi * np.outer(t, lines) + phases).sum(axis=1)
        torque = torque / np.abs(torque).max()

        def seen(values: np.ndarray) -> np.ndarray:
            measured = values + noise * fresh_rng.standard_normal(values.size)
            rounded: np.ndarray = np.round(measured / quantum) * quantum
            return rounded

        assert clipped_samples(seen(torque)) == 0
        clipped = np.clip(torque, -0.5, 0.5)
        at_limit = np.count_nonzero(np.abs(clipped) >= 0.5)
        if noise == 0.0 and at_limit > 40:
            found = clipped_samples(seen(clipped))
            assert found < 2.0 * at_limit + 20
            unseen += found < 0.5 * at_limit
    assert unseen <= 1  # coarse steps hide the flat tops of one in 3000


def test_a_short_run_in_after_a_long_fade_keeps_its_periods_clean() -> None:
    """The experiment before is over when the next one's periods begin, whatever their run-ins."""
    first, _ = plan(settle=700).experiments
    _, second = plan(settle=100).experiments
    assert first.fade > second.settle
    kept, _, _ = run(FakeGroup(), MultisinePlan(STEP, (first, second)))
    assert kept[1].position_reference is not None
    np.testing.assert_allclose(
        kept[1].position_reference[-3 * SAMPLES :], np.tile(second.one_period(), (3, 1)), atol=1e-12
    )
