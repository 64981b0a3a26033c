"""Multisines as values: lines, orthogonality, crest factors, targets, and their forecast."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from drives.api import AxisLimits
from fieldtool.errors import PlanRefusedError
from fieldtool.experiment.forecast import Setting
from fieldtool.experiment.multisine.forecast import (
    experiment_peaks,
    forecast_multisine,
    predicted_phasors,
    scaled_to_limits,
)
from fieldtool.experiment.multisine.phases import crest_factors, low_crest, orthogonal_phases
from fieldtool.experiment.multisine.plan import (
    MultisineExperiment,
    MultisinePlan,
    orthogonal_experiments,
    random_odd_lines,
)
from fieldtool.records.closed_loop import AxisLoop, Biquad
from fieldtool.records.model import MachineModel

RandomModel = Callable[..., MachineModel]
STEP = 0.004


def experiments(
    rng: np.random.Generator, axes: int, last: int = 101, **changes: object
) -> tuple[MultisineExperiment, ...]:
    lines, detection = random_odd_lines(3, last, 0.2, rng)
    amplitude = rng.uniform(0.5, 1.0, (lines.size, axes)) / lines[:, None]
    settings: dict[str, object] = {
        "cycle_time": STEP,
        "samples": 1000,
        "periods": 2,
        "settle": 900,
        "seed": int(rng.integers(2**31)),
    }
    return orthogonal_experiments(lines, detection, amplitude, **(settings | changes))  # type: ignore[arg-type]


@pytest.fixture
def setting(random_model: RandomModel, fresh_rng: np.random.Generator) -> Setting:
    """Two or three axes under well damped loops, limits that nothing reaches."""
    lengths = tuple(int(n) for n in fresh_rng.integers(1, 4, int(fresh_rng.integers(2, 4))))
    model = random_model(fresh_rng, lengths, friction=True)
    loops = tuple(
        AxisLoop(2.0, 15 * a.total_mass, 25 * a.total_mass, 0.0, 0.0, (Biquad.low_pass(80, 0.7),))
        for a in model.axes
    )
    limits = AxisLimits((-1.0, 3.0), 50.0, 1e4, 1e6, 4.0)
    whole = Setting(model, loops, (limits,) * len(lengths), np.full(len(lengths), 0.5))
    if not whole.closed_loop(()).stable:
        pytest.skip("loops of a random machine are not stable")
    return whole


# -- lines ----------------------------------------------------------------------------------------


def test_one_line_of_each_group_is_left_out_and_all_are_odd(fresh_rng: np.random.Generator) -> None:
    for _ in range(30):
        first, count = int(fresh_rng.integers(1, 60)), int(fresh_rng.integers(1, 80))
        group = int(fresh_rng.integers(2, 8))
        lines, detection = random_odd_lines(first, first + count, 1 / group, fresh_rng)
        every = np.sort(np.concatenate([lines, detection]))
        expected = [k for k in range(first, first + count + 1) if k % 2]
        assert every.tolist() == expected
        assert detection.size == len(expected) // group
        for k, line in enumerate(detection):
            assert line in expected[k * group : (k + 1) * group]


def test_which_line_is_left_out_is_random(fresh_rng: np.random.Generator) -> None:
    found = {tuple(random_odd_lines(1, 199, 0.25, fresh_rng)[1].tolist()) for _ in range(10)}
    assert len(found) == 10


@pytest.mark.parametrize(("first", "last", "share"), [(4, 4, 0.2), (1, 9, 0.7), (1, 9, -0.1)])
def test_bands_without_lines_are_refused(first: int, last: int, share: float) -> None:
    with pytest.raises(ValueError, match=r"odd line|share"):
        random_odd_lines(first, last, share, np.random.default_rng(0))


# -- orthogonality and crest factors --------------------------------------------------------------


@pytest.mark.parametrize("axes", range(1, 14))
def test_the_mixing_is_unitary_and_of_modulus_one(axes: int) -> None:
    for count in (axes, axes + 1, 2 * axes):
        W = orthogonal_phases(axes, count)
        assert W.shape == (axes, count)
        np.testing.assert_allclose(W @ W.conj().T, count * np.eye(axes), atol=1e-9)
        np.testing.assert_allclose(np.abs(W), 1.0)
    real = axes in (1, 2, 4, 8, 12)
    assert np.isrealobj(np.real_if_close(orthogonal_phases(axes, axes))) == real


def test_fewer_experiments_than_axes_are_refused() -> None:
    with pytest.raises(ValueError, match="2 experiments can not tell the inputs of 3 axes apart"):
        orthogonal_phases(3, 2)


@pytest.mark.parametrize("axes", [1, 2, 3, 4, 5])
def test_experiments_are_orthogonal_at_every_line(
    axes: int, fresh_rng: np.random.Generator
) -> None:
    made = experiments(fresh_rng, axes, torque=None)
    assert len(made) == axes
    assert len({one.name for one in made}) == axes
    U = np.stack([one.reference for one in made], axis=2)
    for line in U:
        gram = line @ line.conj().T
        size = np.sqrt(np.diag(gram).real)
        np.testing.assert_allclose(gram / np.outer(size, size), np.eye(axes), atol=1e-9)


@pytest.mark.parametrize("axes", [1, 2, 3, 6])
def test_crest_factors_are_small_in_every_experiment(
    axes: int, fresh_rng: np.random.Generator
) -> None:
    lines = np.sort(fresh_rng.choice(np.arange(3, 151, 2), 40, replace=False))
    amplitude = np.ones((40, axes)) * fresh_rng.uniform(0.1, 10, axes)
    made = orthogonal_experiments(
        lines,
        np.empty(0, dtype=np.int_),
        amplitude,
        cycle_time=STEP,
        samples=4000,
        periods=2,
        settle=1000,
        seed=int(fresh_rng.integers(2**31)),
    )
    for one in made:
        values = one.one_period()
        found = np.abs(values).max(axis=0) / values.std(axis=0)
        assert np.all(found < 2.2)
        np.testing.assert_allclose(crest_factors(one.reference, lines), found, rtol=0.02)


def test_weighted_peaks_are_below_those_of_random_phases(fresh_rng: np.random.Generator) -> None:
    lines = np.arange(5, 85, 2)
    shape = (lines.size, 3)
    amplitude = fresh_rng.uniform(0.5, 1, shape)
    weights = fresh_rng.standard_normal((*shape, 6)) + 1j * fresh_rng.standard_normal((*shape, 6))
    mixing = orthogonal_phases(3, 3)

    def peak(phases: np.ndarray) -> float:
        t = np.exp(2j * np.pi * np.outer(np.arange(800) / 800, lines))
        outputs = np.einsum(
            "kie,kiq->keq", (amplitude * np.exp(1j * phases))[:, :, None] * mixing, weights
        )
        return float(np.abs(np.real(np.einsum("tk,keq->teq", t, outputs))).max())

    phases = low_crest(lines, amplitude, int(fresh_rng.integers(2**31)), weights, mixing)
    others = [peak(fresh_rng.uniform(0, 2 * np.pi, shape)) for _ in range(20)]
    assert peak(phases) < 0.9 * min(others)


# -- targets --------------------------------------------------------------------------------------


def test_targets_begin_and_end_at_rest_and_are_periodic(fresh_rng: np.random.Generator) -> None:
    for one in experiments(fresh_rng, 3, settle=int(fresh_rng.integers(400, 2000))):
        targets = one.targets()
        assert targets.shape == (one.rows, 3)
        counted = targets[one.settle :].reshape(one.periods, one.samples, 3)
        np.testing.assert_allclose(counted[0], one.one_period(), atol=1e-12)
        np.testing.assert_allclose(counted[1], counted[0], atol=1e-12)
        spectrum = np.fft.rfft(counted[0], axis=0) * 2 / one.samples
        np.testing.assert_allclose(spectrum[one.lines], one.reference, atol=1e-12)
        rest = np.delete(np.abs(spectrum), one.lines, axis=0)
        assert rest.max() < 1e-12  # nothing at detection lines, even lines or 0
        np.testing.assert_allclose(targets[0], 0.0, atol=1e-15)
        whole = np.concatenate([np.zeros((3, 3)), targets, one.ending(), np.zeros((3, 3))])
        inside = np.concatenate([one.one_period()] * 3)
        for order in (1, 2):
            steps = np.abs(np.diff(whole, order, axis=0)).max(axis=0)
            assert np.all(steps < 1.1 * np.abs(np.diff(inside, order, axis=0)).max(axis=0))
        assert one.fade >= min(one.samples / one.lines[0], one.settle)
        assert one.fade <= one.settle


def test_a_bias_velocity_leads_from_one_side_to_the_other(fresh_rng: np.random.Generator) -> None:
    bias = np.array([0.2, -0.1])
    one = experiments(fresh_rng, 2, bias=bias)[0]
    targets = np.concatenate([one.targets(), one.ending()])
    np.testing.assert_allclose(targets[0], one.start, atol=1e-12)
    np.testing.assert_allclose(targets[-1], -one.start, atol=1e-9)
    np.testing.assert_allclose(targets[-1] - targets[0], bias * STEP * one.rows, atol=1e-9)
    counted = targets[one.settle : one.rows]
    np.testing.assert_allclose(
        counted[one.samples :] - counted[: one.samples],
        np.tile(bias * STEP * one.samples, (one.samples, 1)),
        atol=1e-9,
    )
    assert np.abs(np.diff(targets, axis=0)[[0, -1]]).max() < 1e-6


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"lines": np.array([3, 4])}, "odd"),
        ({"lines": np.array([5, 3])}, "rise"),
        ({"lines": np.array([3, 501])}, "half the sampling rate"),
        ({"detection": np.array([5])}, "differ"),
        ({"settle": 3}, "run-in"),
        ({"bias": np.zeros(3)}, "bias"),
        ({"reference": np.zeros((2, 2), dtype=complex)}, "excites nothing"),
        ({"torque": np.full((2, 2), np.nan + 0j)}, "finite"),
        ({"torque": np.zeros((3, 2), dtype=complex)}, "phasors"),
    ],
)
def test_experiments_that_make_no_sense_are_refused(
    change: dict[str, object], message: str
) -> None:
    lines = np.array([3, 5])
    fine = MultisineExperiment(
        "x",
        STEP,
        1000,
        lines,
        np.array([7]),
        np.ones((2, 2), dtype=complex),
        np.zeros((2, 2), dtype=complex),
        2,
        100,
        np.zeros(2),
    )
    with pytest.raises(ValueError, match=message):
        replace(fine, **change)  # type: ignore[arg-type]


def test_a_plan_counts_all_that_is_streamed(fresh_rng: np.random.Generator) -> None:
    still = experiments(fresh_rng, 2, settle=100)
    biased = experiments(fresh_rng, 2, settle=100, bias=np.array([0.1, 0.0]), name="biased")
    plan = MultisinePlan(STEP, (*still, *biased))
    assert [len(row) for row in plan.streams] == [2, 1, 1]
    rows = 4 * (100 + 2000) + sum(row[-1].fade + 1 for row in plan.streams)
    assert plan.duration == pytest.approx(rows * STEP)
    with pytest.raises(ValueError, match="names of their own"):
        MultisinePlan(STEP, (*still, *still))


# -- forecast -------------------------------------------------------------------------------------


@pytest.mark.parametrize("with_torque", [False, True])
def test_the_simulation_comes_to_the_steady_state_of_the_formula(
    setting: Setting, fresh_rng: np.random.Generator, with_torque: bool
) -> None:
    """Cycles are short here, so that the holds between samples do not matter."""
    axes, step = len(setting.loops), 0.001
    lines = np.array([1, 5, 9, 13])
    made = orthogonal_experiments(
        lines,
        np.empty(0, dtype=np.int_),
        np.full((4, axes), 0.01),
        cycle_time=step,
        samples=4000,
        periods=1,
        settle=36000,
        seed=int(fresh_rng.integers(2**31)),
        torque=np.full((4, axes), 3.0 + 2.0j) if with_torque else None,
    )
    one = made[0]
    offset = one.torque_targets() if with_torque else None
    found = setting.closed_loop(()).simulate(one.targets(), step, offset)
    for values, wanted in zip(found, predicted_phasors(one, setting), strict=True):
        phasors = np.fft.rfft(values[-4000:], axis=0)[lines] * 2 / 4000
        np.testing.assert_allclose(phasors, wanted, atol=0.02 * np.abs(wanted).max())


def test_what_is_scaled_to_the_limits_touches_one_of_them(
    setting: Setting, fresh_rng: np.random.Generator
) -> None:
    plan = MultisinePlan(STEP, experiments(fresh_rng, len(setting.loops)))
    share = float(fresh_rng.uniform(0.2, 0.9))
    scaled = scaled_to_limits(plan, setting, share)
    limits = setting.limits[0]
    allowed = np.array(
        [1.5, limits.velocity, limits.acceleration, limits.torque, limits.following_error]
    )
    shares = experiment_peaks(scaled, setting) / allowed[:, None]
    assert shares.max() == pytest.approx(share, rel=1e-6)
    again = scaled_to_limits(scaled.scaled(7.0), setting, share)
    np.testing.assert_allclose(
        again.experiments[0].reference, scaled.experiments[0].reference, rtol=1e-6
    )
    forecast_multisine(scaled, setting)
    with pytest.raises(
        PlanRefusedError, match=r"experiment multisine \d: axis\d would .* its limit is"
    ):
        forecast_multisine(scaled.scaled(1.02 / share), setting)


def test_a_bias_takes_its_part_of_the_limits(
    setting: Setting, fresh_rng: np.random.Generator
) -> None:
    axes = len(setting.loops)
    one = experiments(fresh_rng, axes, bias=np.full(axes, 0.05))[0]
    plan = MultisinePlan(STEP, (one,))
    travel = 0.05 * STEP * one.rows
    found = experiment_peaks(scaled_to_limits(plan, setting, 0.6), setting)[0]
    assert np.all(found[0] > 0.99 * travel / 2)
    assert np.all(found[0] <= 0.6 * 1.5 * (1 + 1e-6))
    too_fast = MultisinePlan(
        STEP, (replace(one, bias=np.full(axes, 2 * 0.6 * 1.5 / (STEP * one.rows))),)
    )
    with pytest.raises(PlanRefusedError, match="bias velocity of"):
        scaled_to_limits(too_fast, setting, 0.5)


def test_unstable_loops_are_refused(setting: Setting, fresh_rng: np.random.Generator) -> None:
    wild = replace(setting.loops[0], velocity_p=-setting.loops[0].velocity_p)
    plan = MultisinePlan(STEP, experiments(fresh_rng, len(setting.loops)))
    with pytest.raises(PlanRefusedError, match="not stable"):
        forecast_multisine(plan, replace(setting, loops=(wild, *setting.loops[1:])))
