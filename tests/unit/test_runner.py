"""The runner on a fake machine whose motion is simulated by ``ClosedLoop``, faults on request.

The fake does not imitate: drives, a bus, quantisation, quick stops; what it does with limits (it
keeps none) and with speed between two motions (each begins at rest).
"""

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np
import pytest
from scipy.linalg import expm

from drives.api import AxisLimits, Capture, Source, joined
from drives.errors import SafetyStopError, UserStopError
from fieldtool.experiment.axes import Axes
from fieldtool.experiment.directions import check_directions
from fieldtool.experiment.stepped.plan import Sweep, SweepPlan, Tone, tone_near, transition
from fieldtool.experiment.stepped.runner import DRIFTED, OVERLOAD, Progress, run_plan
from fieldtool.records.closed_loop import AxisLoop, ClosedLoop
from fieldtool.records.model import AxisModel, Coupling, Estimate, MachineModel
from fieldtool.records.recording import Experiment
from tests.seeds import fresh_seed

STEP = 0.004
Distort = Callable[[np.ndarray, np.ndarray, np.ndarray], None]
"""Changes references, positions and torques of a whole motion in place."""


def machine(damper: float = 60.0) -> MachineModel:
    """An axis of two masses, mode at about 8 Hz with 5 % damping, coupled to a rigid one."""

    def exact(*values: float) -> tuple[Estimate, ...]:
        return tuple(Estimate(v) for v in values)

    return MachineModel(
        (
            AxisModel("x", "rotary", exact(20.0, 20.0), exact(25_000.0), exact(damper)),
            AxisModel("y", "rotary", exact(30.0), (), (), Estimate(30.0)),
        ),
        (Coupling(("x", "y"), 4.0),),
    )


@dataclass
class FakeGroup:
    """Axes that a model moves; positions last from motion to motion."""

    model: MachineModel
    position: np.ndarray
    distort: Distort = lambda *_: None
    missing: dict[int, tuple[int, ...]] = field(default_factory=dict)
    """Rows that are missing in the block with this number, counted over the motions with tones."""
    fail: tuple[int, BaseException] | None = None
    noise: float = 0.0
    motions: list[tuple[str, ...]] = field(default_factory=list)
    block: int = 0
    entered: int = 0

    @contextmanager
    def motion(self, cycle_time: float, free: tuple[str, ...] = ()) -> Iterator["FakeMotion"]:
        self.motions.append(free)
        self.entered += 1
        try:
            yield FakeMotion(self, cycle_time, free)
        finally:
            self.entered -= 1


class FakeMotion:
    """Goes on block by block as :meth:`ClosedLoop.simulate` would in one go (a test compares)."""

    def __init__(self, group: FakeGroup, cycle_time: float, free: tuple[str, ...]) -> None:
        self.group, self.cycle_time, self.free = group, cycle_time, free
        loops = tuple(
            None
            if axis.name in free
            else AxisLoop(4.0, 20 * axis.total_mass, 80 * axis.total_mass, 0.0)
            for axis in group.model.axes
        )
        self.loop = ClosedLoop(group.model, loops)
        self.start = group.position.copy()
        self.rng = np.random.default_rng(5)
        a, b_r, _, c_x, c_r, _ = self.loop._matrices()
        self._size, m = a.shape[0], self.start.size
        block = np.zeros((self._size + 2 * m,) * 2)
        block[: self._size, : self._size], block[: self._size, self._size : -m] = a, b_r
        block[self._size : -m, -m:] = np.eye(m)
        self._step, self._torque = expm(block * cycle_time)[: self._size], (c_x, c_r)
        self._states = np.zeros((1, self._size))
        self._references = np.empty((0, m))

    @property
    def position(self) -> np.ndarray:
        return self.group.position.copy()

    def _simulated(self, block: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """References, positions and torques from the motion's start to this block's end."""
        first = self._references.shape[0]
        self._references = np.concatenate([self._references, block])
        r = self._references[max(first - 1, 0) :] - self.start
        states = [self._states[-1]]
        for now, then in pairwise(r):  # from each row to the next
            states.append(
                self._step @ np.concatenate([states[-1], now, (then - now) / self.cycle_time])
            )
        if not first:
            self._states = np.array(states)
        else:
            self._states = np.concatenate([self._states, states[1:]])
        c_x, c_r = self._torque
        position = self._states[:, self.loop.model.first_masses] + self.start
        torque = self._states @ c_x.T + (self._references - self.start) @ c_r.T
        return self._references, position, torque

    def stream(self, source: Source) -> Capture:
        group = self.group
        captures: list[Capture] = []
        previous: Capture | None = None
        while (block := source(previous)) is not None:
            before = self._references.shape[0]
            tone = not np.all(block == block[0]) and len(captures) > 0
            references, position, torque = self._simulated(block)
            group.distort(references, position, torque)
            torque = torque + group.noise * self.rng.standard_normal(torque.shape)
            rows = slice(before, references.shape[0])
            missing = group.missing.get(group.block, ()) if tone else ()
            group.block += tone
            previous = Capture(
                before,
                references[rows].copy(),
                position[rows].copy(),
                torque[rows].copy(),
                np.full(block.shape, 0x1237, dtype=np.uint16),
                missing,
            )
            captures.append(previous)
            group.position = position[-1].copy()
            if group.fail is not None and tone and group.block > group.fail[0]:
                error = group.fail[1]
                if isinstance(error, SafetyStopError | UserStopError):
                    error.capture = joined(captures)
                raise error
        return joined(captures)


def test_the_fake_moves_as_the_closed_loop_does() -> None:
    group = FakeGroup(machine(), np.array([0.1, -0.2]))
    motion = FakeMotion(group, STEP, ("y",))
    seed = fresh_seed()
    targets = motion.start + np.cumsum(np.random.default_rng(seed).normal(size=(200, 2)), axis=0)
    blocks = iter([targets[:1], targets[1:3], targets[3:150]])
    captures = [motion.stream(lambda _: next(blocks, None))]
    captures.append(motion.stream(lambda before: targets[150:] if before is None else None))
    position, torque = motion.loop.simulate(targets - motion.start, STEP)
    found = joined(captures)
    np.testing.assert_allclose(found.position, position + motion.start, atol=1e-10)
    np.testing.assert_allclose(found.torque, torque, atol=1e-7)


LIMITS = AxisLimits((-2.0, 2.0), 4.0, 80.0, 1e5, 2.0)


def axes(limits: AxisLimits = LIMITS) -> Axes:
    return Axes(("x", "y"), (limits, limits), np.zeros(2))


def plan(*frequencies: float, amplitude: float = 0.05, free: tuple[str, ...] = ("y",)) -> SweepPlan:
    tones = tuple(tone_near(f, amplitude, STEP) for f in frequencies)
    return SweepPlan(STEP, (Sweep("direct, others free", "x", free, tones),))


def run(
    group: FakeGroup, the_plan: SweepPlan, of: Axes | None = None
) -> tuple[list[Experiment], list[Progress], float]:
    kept: list[Experiment] = []
    told: list[Progress] = []
    seconds = run_plan(group, the_plan, of or axes(), kept.append, told.append)
    assert group.entered == 0
    return kept, told, seconds


def phasor(values: np.ndarray, tone: Tone | float, step: float = STEP) -> np.ndarray:
    frequency = tone if isinstance(tone, float) else tone.frequency
    turning = np.exp(-2j * np.pi * frequency * step * np.arange(values.shape[0]))
    found: np.ndarray = 2 / values.shape[0] * turning @ values
    return found


def test_a_tone_is_recorded_settled_and_only_settled() -> None:
    the_plan = plan(0.7, 3.0, 7.5, 9.0)
    group = FakeGroup(machine(), np.zeros(2))
    (experiment,), _, seconds = run(group, the_plan)
    sweep = the_plan.sweeps[0]
    assert seconds == pytest.approx(experiment.samples * STEP)
    assert (experiment.driven, experiment.free) == (("x",), ("y",))
    assert experiment.complete
    assert len(experiment.segments) == len(sweep.tones)
    loops = FakeMotion(group, STEP, ("y",)).loop
    for segment, tone in zip(experiment.segments, sweep.tones, strict=True):
        assert segment.settled
        assert segment.note == ""
        assert segment.frequency == tone.frequency
        assert segment.stop - segment.start == sweep.blocks * tone.samples
        assert segment.periods == sweep.blocks * tone.periods
        rows = slice(segment.start, segment.stop)
        measured = [phasor(v[rows], tone) for v in (experiment.position, experiment.torque)]
        G = measured[0] / measured[1][0]
        references = np.zeros((60 * tone.samples, 2))
        turns = tone.frequency * STEP * np.arange(references.shape[0])
        references[:, 0] = tone.amplitude * np.sin(2 * np.pi * turns)
        late = [phasor(v[-tone.samples :], tone) for v in loops.simulate(references, STEP)]
        wanted = late[0] / late[1][0]
        np.testing.assert_allclose(G / np.abs(wanted[0]), wanted / np.abs(wanted[0]), atol=1e-3)
        # the images of a reference that is linear from SYNC to SYNC alias into the torque: 0.8 %
        position, torque = loops.response(np.array([2 * np.pi * tone.frequency]), 0)
        assert G[0] == pytest.approx(position[0, 0] / torque[0, 0], rel=0.02)
        assert np.abs(measured[1][1]) == 0.0  # the floating axis has no torque


def test_settling_takes_longer_where_a_mode_rings() -> None:
    """The transient of a lightly damped mode dies out over many blocks; the segment comes after it."""
    slow, quick = machine(damper=2.0), machine(damper=200.0)
    starts = []
    the_plan = plan(7.6, free=("x",))
    the_plan = replace(the_plan, sweeps=(replace(the_plan.sweeps[0], driven="y"),))
    for model in (quick, slow):
        (experiment,), _, _ = run(FakeGroup(model, np.zeros(2)), the_plan)
        starts.append(experiment.segments[0].start)
    assert starts[1] > starts[0] + 3 * tone_near(7.6, 1.0, STEP).samples


def test_what_never_settles_is_recorded_and_marked() -> None:
    def growing(_r: np.ndarray, position: np.ndarray, _t: np.ndarray) -> None:
        position[:, 0] *= 1 + 0.02 * STEP * np.arange(position.shape[0])

    the_plan = plan(3.0)
    sweep = replace(the_plan.sweeps[0], settle_blocks=6)
    group = FakeGroup(machine(), np.zeros(2), distort=growing)
    (experiment,), _, _ = run(group, replace(the_plan, sweeps=(sweep,)))
    (segment,) = experiment.segments
    assert not segment.settled
    assert "not settled" in segment.note
    way = experiment.samples - 6 * sweep.tones[0].samples
    assert segment.stop - segment.start == sweep.blocks * sweep.tones[0].samples
    assert way > 0


def test_noise_alone_does_not_keep_a_tone_from_settling() -> None:
    group = FakeGroup(machine(), np.zeros(2), noise=20.0)
    (experiment,), _, _ = run(group, plan(3.0, 9.0))
    assert [s.settled for s in experiment.segments] == [True, True]


@pytest.mark.parametrize("what", ["torque", "travel"])
def test_an_overload_halves_the_amplitude_until_it_fits(what: str) -> None:
    group = FakeGroup(machine(), np.zeros(2))
    (experiment,), _, _ = run(group, plan(3.0, amplitude=0.4))
    torque = np.abs(experiment.torque[:, 0]).max()
    travel = np.abs(experiment.position[:, 0]).max()
    limits = (
        replace(LIMITS, torque=0.4 * torque)
        if what == "torque"
        else replace(LIMITS, travel=(-0.4 * travel, 0.4 * travel))
    )
    kept, told, _ = run(FakeGroup(machine(), np.zeros(2)), plan(3.0, amplitude=0.4), axes(limits))
    (segment,) = kept[0].segments
    references = kept[0].position_reference
    assert references is not None
    amplitude = np.abs(phasor(references[segment.start : segment.stop], 3.0)[0])
    assert amplitude == pytest.approx(0.1, rel=1e-2)  # 0.4 and 0.2 are above 0.8 * 0.4, 0.1 is not
    assert told[-1].amplitude == pytest.approx(0.1)
    rows = slice(segment.start, segment.stop)
    assert np.abs(kept[0].torque[rows, 0]).max() <= OVERLOAD * limits.torque
    assert np.abs(kept[0].position[rows, 0]).max() <= OVERLOAD * limits.travel[1]
    assert segment.settled


def test_a_floating_axis_that_drifts_is_brought_back() -> None:
    drift = 0.08  # rad/s

    def drifting(references: np.ndarray, position: np.ndarray, _t: np.ndarray) -> None:
        if references.shape[0] > 900 and np.ptp(references[:, 1]) == 0:
            position[:, 1] += drift * STEP * np.arange(position.shape[0])

    the_plan = plan(3.0, 4.0, 5.0, 6.0)
    group = FakeGroup(machine(), np.zeros(2), distort=drifting)
    kept, told, _ = run(group, the_plan)
    assert len(kept) > 1
    assert [e.name for e in kept[1:]] == [
        f"{kept[0].name}, from tone {1 + sum(len(e.segments) for e in kept[:k])}"
        for k in range(1, len(kept))
    ]
    frequencies = [s.frequency for e in kept for s in e.segments]
    assert frequencies == [t.frequency for t in the_plan.sweeps[0].tones]  # each tone once
    room = axes().room[1]
    for experiment in kept[:-1]:
        last = experiment.segments[-1]
        middle = experiment.position[last.start : last.stop, 1]
        assert np.abs(middle).max() > DRIFTED * room * 0.9
    for experiment in kept[1:]:
        assert abs(experiment.position[0, 1]) < 0.02 * room  # begins where the centre is
    # each stretch of tones comes after a motion in which all axes are held and centred
    assert group.motions == [(), ("y",)] * len(kept)
    done = [p.done for p in told]
    assert done == sorted(done)


def way_and_block(the_plan: SweepPlan) -> tuple[int, int]:
    """Rows of the way to the first tone, and of one of its blocks."""
    tone = the_plan.sweeps[0].tones[0]
    return transition(tone, None).size, tone.samples


@pytest.mark.parametrize("spoiled", range(5))
def test_a_missing_pdo_has_the_block_measured_again(spoiled: int) -> None:
    (clean,), _, _ = run(FakeGroup(machine(), np.zeros(2)), plan(3.0))
    way, n = way_and_block(plan(3.0))
    first = (clean.segments[0].start - way) // n  # this block agrees with the one before
    assert clean.segments[0].start == way + first * n
    assert first <= 2
    group = FakeGroup(machine(), np.zeros(2), missing={spoiled: (17,)})
    (experiment,), _, _ = run(group, plan(3.0))
    (segment,) = experiment.segments
    assert segment.settled
    assert segment.stop - segment.start == 3 * n
    again = max(first, spoiled + 2)  # another block, and one that agrees with it
    assert segment.start == way + again * n
    assert experiment.samples == clean.samples + (again - first) * n


def test_no_spoiled_row_is_ever_in_a_segment() -> None:
    """Also when so many blocks are spoiled that the time allowed runs out."""
    the_plan = plan(3.0)
    sweep = replace(the_plan.sweeps[0], settle_blocks=5, blocks=2)
    the_plan = replace(the_plan, sweeps=(sweep,))
    way, n = way_and_block(the_plan)
    seed = fresh_seed()
    rng = np.random.default_rng(seed)
    for _ in range(20):
        missing: dict[int, tuple[int, ...]] = {
            int(k): (0,) for k in np.flatnonzero(rng.random(8) < 0.4)
        }
        (experiment,), _, _ = run(FakeGroup(machine(), np.zeros(2), missing=missing), the_plan)
        for segment in experiment.segments:
            spoiled = [way + k * n for k in missing]
            assert not any(segment.start <= row < segment.stop for row in spoiled)


def test_progress_rises_to_the_end() -> None:
    free = plan(3.0, 6.0).sweeps[0]
    held = replace(free, kind="direct, others locked", driven="y", free=())
    cross = replace(free, kind="cross-coupled", driven="y", free=("x",))
    the_plan = SweepPlan(STEP, (free, held, cross))
    _, told, seconds = run(FakeGroup(machine(), np.zeros(2)), the_plan)
    done, times = [p.done for p in told], [p.machine_time for p in told]
    assert done == sorted(done)
    assert times == sorted(times)
    assert set(np.round(np.array(done) * 6, 9)) == set(range(6))
    assert min(done) >= 0
    assert max(done) < 1
    assert times[-1] <= seconds
    # no gap of more than the way to a tone and one block of it
    assert np.diff(times).max() <= 2 * max(t.block_time for t in free.tones) + 3.0
    assert {(p.sweep, p.sweeps, p.tones) for p in told} == {(k, 3, 2) for k in (1, 2, 3)}
    assert told[-1].name == cross.name


@pytest.mark.parametrize("error", [SafetyStopError("torque", axis="x"), UserStopError("user")])
def test_what_was_recorded_until_a_stop_is_kept(error: Exception) -> None:
    group = FakeGroup(machine(), np.zeros(2), fail=(12, error))
    kept: list[Experiment] = []
    with pytest.raises(type(error)):
        run_plan(group, plan(3.0, 6.0, 9.0), axes(), kept.append)
    assert group.entered == 0
    (experiment,) = kept
    assert not experiment.complete
    assert experiment.note == str(error)
    assert experiment.samples > 1000
    assert all(s.stop <= experiment.samples for s in experiment.segments)


def test_a_sweep_that_is_distrusted_at_its_end_is_kept() -> None:
    """Its drive turns out to have left its mode, say: seen once all axes are off."""

    class Distrusted(FakeGroup):
        @contextmanager
        def motion(self, cycle_time: float, free: tuple[str, ...] = ()) -> Iterator["FakeMotion"]:
            with super().motion(cycle_time, free) as motion:
                yield motion
            if free:
                raise SafetyStopError("do not rely on it")

    kept: list[Experiment] = []
    with pytest.raises(SafetyStopError):
        run_plan(Distrusted(machine(), np.zeros(2)), plan(3.0, 6.0), axes(), kept.append)
    (experiment,) = kept
    assert (experiment.complete, experiment.note) == (False, "do not rely on it")
    assert len(experiment.segments) == 2


def test_ctrl_c_while_a_sweep_is_saved_waits_for_it() -> None:
    kept: list[str] = []

    def keep(experiment: Experiment) -> None:
        signal.raise_signal(signal.SIGINT)
        kept.append(experiment.name)

    with pytest.raises(KeyboardInterrupt):
        run_plan(FakeGroup(machine(), np.zeros(2)), plan(3.0), axes(), keep)
    assert kept == ["x direct, others free"]


def test_axes_are_centred_before_each_sweep() -> None:
    group = FakeGroup(machine(), np.array([0.6, -0.9]))
    (experiment,), _, _ = run(group, plan(3.0))
    np.testing.assert_allclose(experiment.position[0], 0.0, atol=2e-3)
    assert group.motions == [(), ("y",)]


def test_directions_are_right() -> None:
    group = FakeGroup(machine(), np.array([0.3, 0.0]))
    kept: list[Experiment] = []
    check_directions(group, axes(), STEP, kept.append)
    assert [e.name for e in kept] == ["direction check of x", "direction check of y"]
    for k, experiment in enumerate(kept):
        moved = np.ptp(experiment.position, axis=0)
        assert moved[k] == pytest.approx(0.02 * 4.0, rel=0.3)
        assert moved[1 - k] < 0.2 * moved[k]


def reversed_axis(references: np.ndarray, position: np.ndarray, _t: np.ndarray) -> None:
    position[:, 1] = 2 * references[0, 1] - position[:, 1]


def blocked_axis(references: np.ndarray, position: np.ndarray, _t: np.ndarray) -> None:
    position[:, 1] = references[0, 1]


def too_fine_encoder(references: np.ndarray, position: np.ndarray, _t: np.ndarray) -> None:
    position[:, 1] = references[0, 1] + 10 * (position[:, 1] - references[0, 1])


def reversed_torque(_r: np.ndarray, _p: np.ndarray, torque: np.ndarray) -> None:
    torque *= -1


@pytest.mark.parametrize(
    ("fault", "axis", "words"),
    [
        (reversed_axis, "y", "y: moves the wrong way"),
        (blocked_axis, "y", "y: does not follow: half of 0.08 "),
        (too_fine_encoder, "y", "y: (does not follow|moved by|moves)"),
        (reversed_torque, "x", "x: the torque that starts a positive move is negative"),
    ],
)
def test_an_axis_that_goes_wrong_is_found(fault: Distort, axis: str, words: str) -> None:
    group = FakeGroup(machine(), np.zeros(2), distort=fault)
    kept: list[Experiment] = []
    with pytest.raises(SafetyStopError, match=words) as stop:
        check_directions(group, axes(), STEP, kept.append)
    assert stop.value.axis == axis
    assert group.entered == 0
