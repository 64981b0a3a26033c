"""Orthogonal multisines through the bus, on the packaged turntable: periodic, independent, stoppable."""

from dataclasses import dataclass, replace
from importlib.resources import files

import numpy as np
import pytest
import yaml

from drives.errors import SafetyStopError, UserStopError
from drives.parameters import read_parameters
from drives.sim.faults import Fault, NodeVanishes
from drives.sim.firmware import Parameter
from fieldtool.errors import LoopUnstableError
from fieldtool.experiment.axes import Axes
from fieldtool.experiment.forecast import Setting
from fieldtool.experiment.multisine.forecast import (
    experiment_peaks,
    forecast_multisine,
    predicted_phasors,
    scaled_to_limits,
)
from fieldtool.experiment.multisine.plan import (
    MultisinePlan,
    orthogonal_experiments,
    random_odd_lines,
)
from fieldtool.experiment.multisine.runner import run_multisine
from fieldtool.records.closed_loop import ClosedLoop, loop_from_parameters
from fieldtool.workflow.models import truth_model
from tests.seeds import fresh_seed

TABLE, ARM = 11, 12
FACTOR = 6.0
"""Times that the gains rise: then the table's loop oscillates at some 8 Hz, growing by e in 0.5 s."""
STEP, SAMPLES, PERIODS, SETTLE = 0.002, 1000, 2, 1000


@dataclass(frozen=True)
class GainsRise(Fault):
    """A loop's position gain and integral gain become so many times larger."""

    factor: float = 1.0

    def set(self, machine, *, present):
        k = machine.node(self.node_id).axis
        for parameter in (Parameter.POSITION_P, Parameter.VELOCITY_I):
            machine.axes.set(k, parameter, machine.axes.get(k, parameter) * self.factor)


@pytest.fixture
def turntable(make_bench):
    text = files("profiles").joinpath("machines/turntable-arm.yaml").read_text(encoding="utf-8")
    return make_bench(yaml.safe_load(text))


def setting_of(bench, group):
    from drives.profile import load_machine

    model = truth_model(load_machine(bench.profile))
    limits = tuple(drive.limits for drive in group.drives)
    loops = tuple(loop_from_parameters(read_parameters(drive)) for drive in group.drives)
    return Setting(model, loops, limits, np.zeros(len(limits)))


def multisines(setting, seed, share=0.4, torque=0.0, **changes):
    rng = np.random.default_rng(seed)
    lines, detection = random_odd_lines(3, 121, 0.2, rng)
    amplitude = np.outer(1 / lines, [1.0, 1.0])
    settings = {"cycle_time": STEP, "samples": SAMPLES, "periods": PERIODS, "settle": SETTLE}
    experiments = orthogonal_experiments(
        lines,
        detection,
        amplitude,
        seed=seed,
        torque=np.full((lines.size, 2), torque, dtype=complex),
        **(settings | changes),
    )
    return scaled_to_limits(MultisinePlan(STEP, experiments), setting, share)


def axes_of(group, setting):
    return Axes(group.axes, setting.limits, setting.centre, ("rad", "rad"))


def line_phasors(experiment, lines, samples=SAMPLES, periods=PERIODS):
    """Position and torque at the excited lines, in each of the last periods: (P, L, M) each."""
    found = []
    for values in (experiment.position, experiment.torque):
        cut = values[-periods * samples :].reshape(periods, samples, -1)
        found.append(np.fft.rfft(cut, axis=1)[:, lines] * 2 / samples)
    return found


def seed_now():
    return fresh_seed()


@pytest.mark.parametrize("torque", [0.0, 0.3])
def test_all_experiments_are_periodic_independent_and_as_predicted(turntable, torque):
    kept, told = [], []
    with turntable.connected() as group, group.without_feed_forward():
        setting = setting_of(turntable, group)
        plan = multisines(setting, seed_now(), torque=torque)
        expected = forecast_multisine(plan, setting)
        errors = experiment_peaks(plan, setting)[:, 4]
        seconds = run_multisine(
            group, plan, axes_of(group, setting), kept.append, told.append, errors
        )
        predicted = [predicted_phasors(one, setting) for one in plan.experiments]
    assert turntable.powered() == {}
    assert not turntable.changed()
    assert seconds == pytest.approx(plan.duration, abs=2 * STEP)
    assert [e.name for e in kept] == ["multisine 1", "multisine 2"]
    lines = plan.lines
    torques = []
    for e, (experiment, one) in enumerate(zip(kept, plan.experiments, strict=True)):
        assert experiment.kind == "multisine"
        assert experiment.complete, experiment.note
        assert not experiment.note
        assert experiment.driven == ("table", "arm")
        assert experiment.free == ()
        assert experiment.period == pytest.approx(SAMPLES * STEP)
        assert experiment.samples == SETTLE + PERIODS * SAMPLES
        np.testing.assert_allclose(
            experiment.position_reference[SETTLE:], one.targets()[SETTLE:], atol=1e-6
        )
        position, pushed = line_phasors(experiment, lines)
        for values, wanted, share in zip(
            (position, pushed), predicted[e], (0.02, 0.05), strict=True
        ):
            scale = np.abs(wanted).max(axis=0)
            assert np.all(np.abs(values[0] - values[1]).max(axis=0) < share * scale)
            # a target acts one cycle after it was sent, and the loops run in time steps
            delay = np.exp(2j * np.pi * one.frequencies * STEP)[:, None]
            assert np.all(np.abs(values.mean(axis=0) * delay - wanted).max(axis=0) < 0.15 * scale)
        torques.append(pushed.mean(axis=0))
        if torque:
            recorded = np.stack(
                [experiment.extra[f"{n}.torque_offset"] for n in setting.model.names]
            )
            np.testing.assert_allclose(
                recorded.T[SETTLE:], one.torque_targets()[SETTLE:], atol=0.6 * 0.004
            )
        else:
            assert not experiment.extra
    pushed = np.stack(torques, axis=2)  # (L, M, E)
    level = np.sqrt(np.mean(np.abs(pushed) ** 2, axis=(0, 2)))
    assert np.linalg.cond(pushed / level[:, None]).max() < 30
    for k, axis in enumerate(expected):
        for experiment in kept:
            assert np.abs(experiment.position[:, k]).max() < 1.15 * axis.excursion
            assert np.abs(experiment.torque[:, k]).max() < 1.25 * axis.torque + 0.05
    done = [p.done for p in told]
    assert done == sorted(done)
    assert done[-1] > 0.8
    assert told[-1].seconds_left == pytest.approx(0.0, abs=plan.experiments[-1].fade * STEP)


@pytest.mark.parametrize("how", ["node", "user"])
def test_a_stop_in_the_middle_keeps_the_data_and_disables_the_drives(turntable, how):
    kept, stop = [], False

    def told(progress):
        nonlocal stop
        if progress.experiment == 2 and progress.period == 1:
            if how == "node":
                turntable.inject(NodeVanishes(ARM))
            stop = how == "user"

    with turntable.connected(lambda: stop) as group:
        setting = setting_of(turntable, group)
        plan = multisines(setting, seed_now())
        error = SafetyStopError if how == "node" else UserStopError
        with pytest.raises(error) as stopped:
            run_multisine(group, plan, axes_of(group, setting), kept.append, told)
    assert [(e.name, e.complete) for e in kept] == [("multisine 1", True), ("multisine 2", False)]
    assert kept[1].note == str(stopped.value)
    assert SETTLE < kept[1].samples < SETTLE + SAMPLES
    assert set(turntable.powered()) <= ({ARM} if how == "node" else set())


def test_a_loop_that_becomes_unstable_is_named_and_the_data_are_kept(turntable):
    """The limit of its torque may stop it before it is known from noise, in one of ten."""
    fault = GainsRise(TABLE, FACTOR)
    for attempt in range(4):
        kept, raised = [], False

        def told(progress):
            nonlocal raised
            if progress.experiment == 2 and progress.period == 2 and not raised:
                raised = True
                turntable.inject(fault)

        with turntable.connected() as group, group.without_feed_forward():
            setting = setting_of(turntable, group)
            plan = multisines(setting, seed_now() + attempt, share=0.03, periods=4)
            with pytest.raises((SafetyStopError, LoopUnstableError)) as error:
                run_multisine(group, plan, axes_of(group, setting), kept.append, told)
        assert turntable.powered() == {}
        assert (kept[0].name, kept[0].complete) == ("multisine 1", True)
        for cut in kept[1:]:  # tried again where it did not come to a steady state
            assert cut.name.startswith("multisine 2")
            assert not cut.complete
        assert len(kept) > 1
        if isinstance(error.value, LoopUnstableError):
            break
        assert "is above the limit" in str(error.value)
        turntable.machine.lift(fault)
    assert isinstance(error.value, LoopUnstableError)
    assert "Lower the drive's gains" in str(error.value)
    assert error.value.frequency == pytest.approx(growing_mode(setting, FACTOR), rel=0.25)


def growing_mode(setting, factor):
    """Frequency at which the model's loops become unstable with the table's gains raised, Hz."""
    table = setting.loops[0]
    raised = replace(
        table, position_p=factor * table.position_p, velocity_i=factor * table.velocity_i
    )
    loops = (raised, *setting.loops[1:])
    modes = np.linalg.eigvals(ClosedLoop(setting.model, loops).system_matrix())
    return float(np.abs(modes[np.argmax(modes.real)].imag)) / (2 * np.pi)


def test_bias_velocities_keep_the_axes_moving(turntable):
    kept = []
    with turntable.connected() as group, group.without_feed_forward():
        setting = setting_of(turntable, group)
        plan = multisines(setting, seed_now(), share=0.2)
        bias = np.array([0.15, -0.1])
        plan = MultisinePlan(STEP, tuple(replace(e, bias=bias) for e in plan.experiments))
        forecast_multisine(plan, setting)
        seconds = run_multisine(group, plan, axes_of(group, setting), kept.append)
    assert seconds == pytest.approx(plan.duration, abs=4 * STEP)
    for experiment, one in zip(kept, plan.experiments, strict=True):
        assert experiment.complete
        ways = experiment.position[-1] - experiment.position[-1 - SAMPLES]
        np.testing.assert_allclose(ways, bias * SAMPLES * STEP, atol=2e-3)
        np.testing.assert_allclose(experiment.position[0], one.start, atol=1e-3)
