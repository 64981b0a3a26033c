"""The fast plan's design: bands, times, limits, bias velocities; by simulation, not by its own sums."""

from dataclasses import replace

import numpy as np
import pytest

from drives.api import AxisLimits
from fieldtool.errors import PlanRefusedError
from fieldtool.experiment.forecast import Setting
from fieldtool.experiment.multisine.design import (
    experiments_for,
    fast_cycle_times,
    mode_band,
    with_bias,
)
from fieldtool.experiment.multisine.plan import MultisineExperiment
from fieldtool.experiment.multisine.unit_inputs import Shape
from fieldtool.identify.likelihood.expected import Noise
from fieldtool.identify.multisine.dry_friction import DryFriction
from fieldtool.identify.multisine.pilot import _explaining
from fieldtool.records.closed_loop import AxisLoop, Biquad
from fieldtool.records.model import AxisModel, Coupling, Estimate, MachineModel
from fieldtool.workflow.adapted import freed_of_friction, with_room_for_torque
from fieldtool.workflow.planning import (
    Wanted,
    narrowest_mode,
    plan_main,
    plan_pilot,
    timing,
    usual_seconds,
)
from tests.seeds import fresh_seed

CYCLE = 0.002


def elastic(name: str, factor: float = 1.0) -> AxisModel:
    return AxisModel(
        name,
        "rotary",
        (Estimate(0.02 * factor), Estimate(0.03 * factor)),
        (Estimate(190.0 * factor),),
        (Estimate(0.03 * factor),),
        Estimate(0.02),
    )


def setting(travel: float = 2.0, filters: tuple[Biquad, ...] = ()) -> Setting:
    rigid = AxisModel("b", "rotary", (Estimate(0.04),), (), (), Estimate(0.015))
    model = MachineModel((elastic("a"), rigid), (Coupling(("a", "b"), 0.009),))
    loop = AxisLoop(15.0, 1.2, 8.0, 0.0, 0.0, filters)
    limits = AxisLimits((-travel, travel), 10.0, 400.0, 6.0, 0.5)
    return Setting(model, (loop, loop), (limits, limits), np.zeros(2))


def simulated(one: MultisineExperiment, where: Setting) -> tuple[np.ndarray, np.ndarray]:
    """Positions and torques along an experiment's targets."""
    targets = one.targets()
    return where.closed_loop(()).simulate(targets - targets[0], one.cycle_time)


def test_every_axis_comes_near_to_a_limit_and_none_passes_it() -> None:
    where = setting()
    plan = experiments_for(where, CYCLE, 1.6, Shape(-0.75), seed=fresh_seed() % 99)
    largest = np.zeros(2)
    for one in plan.experiments:
        position, torque = simulated(one, where)
        velocity = np.gradient(position, CYCLE, axis=0)
        error = np.abs(one.targets() - one.targets()[0] - position).max(axis=0)
        use = [
            np.abs(position).max(axis=0) / 2.0,
            np.abs(velocity).max(axis=0) / 10.0,
            np.abs(np.gradient(velocity, CYCLE, axis=0)).max(axis=0) / 400.0,
            np.abs(torque).max(axis=0) / 6.0,
            error / 0.5,
        ]
        largest = np.maximum(largest, np.max(use, axis=0))
    assert np.all(largest < 0.7)
    assert np.all(largest > 0.3)


def test_lines_cover_the_modes_and_are_odd() -> None:
    where = setting()
    low, high = mode_band(where.model)
    plan = experiments_for(where, CYCLE, 2.0, Shape(-0.5), seed=3)
    f = plan.frequencies
    assert f[0] < 0.5 * low
    assert f[-1] > 1.4 * high
    for one in plan.experiments:
        assert np.all(one.lines % 2 == 1)
        assert 0.1 < one.detection.size / (one.lines.size + one.detection.size) < 0.3
        assert not np.any(one.torque)  # this loop passes all frequencies


def test_behind_a_low_pass_torque_offsets_excite() -> None:
    dull = setting()
    slow = AxisLoop(1.5, 0.15, 0.1, 0.0, 0.0, (Biquad.low_pass(10.0, 0.7),))
    dull = replace(dull, loops=(slow, slow))
    plan = experiments_for(dull, CYCLE, 2.0, Shape(-0.75), seed=3, offsets=(True, False))
    one = plan.experiments[0]
    assert np.any(one.torque[:, 0])
    assert not np.any(one.torque[:, 1])
    by_torque = np.abs(one.torque[:, 0]) > 0
    assert np.all(one.frequencies[by_torque] > 5.0)
    assert np.all(np.abs(one.reference[by_torque, 0]) == 0)


def test_the_pilot_and_the_main_plan_fill_the_time() -> None:
    where = setting()
    noise = Noise(np.full(2, 0.004), np.full(2, 2e-6))
    greedy = Wanted(1e-7, 1e-7, 1e-7, 1e-7)
    for seconds, cycle in ((12.0, CYCLE), (20.0, CYCLE), (20.013, 0.001), (13.7, 0.005)):
        times = timing(where, seconds)
        pilot = plan_pilot(where, cycle, times, 1)
        main = plan_main(where, cycle, noise, times, greedy, 2)
        total = pilot.duration + main.plan.duration
        assert 0.3 * seconds < total <= seconds
        assert main.reached > 1


def slower(where: Setting, factor: float) -> Setting:
    """The same axes with weaker springs: all modes lower by this factor."""
    axes = tuple(
        replace(axis, springs=tuple(Estimate(s.value / factor**2) for s in axis.springs))
        for axis in where.model.axes
    )
    return replace(where, model=replace(where.model, axes=axes))


def test_a_slower_machine_than_was_thought_gets_fewer_periods() -> None:
    where, noise = setting(), Noise(np.full(2, 0.004), np.full(2, 2e-6))
    times = timing(where, 20.0)
    assert times.periods == 3
    found = plan_main(slower(where, 5.0), CYCLE, noise, times, Wanted(), 2)
    assert {one.periods for one in found.plan.experiments} == {2}
    assert found.plan.duration <= times.seconds_left


def test_a_time_that_is_too_short_for_a_slower_machine_is_named_with_what_is_enough() -> None:
    where, noise = setting(), Noise(np.full(2, 0.004), np.full(2, 2e-6))
    slow = slower(where, 15.0)
    with pytest.raises(PlanRefusedError, match=r"slowest motion .* Hz.*--time \d+") as caught:
        plan_main(slow, CYCLE, noise, timing(where, 12.0), Wanted(), 2)
    enough = float(str(caught.value).rsplit("--time ", 1)[1].rstrip(")"))
    times = timing(where, enough)  # the next run begins with the same machine as last accepted
    plan = plan_main(slow, CYCLE, noise, times, Wanted(), 2).plan
    assert 12.0 < plan.duration <= enough


def test_a_modest_wish_takes_less_time() -> None:
    where = setting()
    noise = Noise(np.full(2, 0.004), np.full(2, 2e-6))
    times = timing(where, 40.0)
    modest = plan_main(where, CYCLE, noise, times, Wanted(0.5, 0.5, 0.9, 0.9), 2)
    greedy = plan_main(where, CYCLE, noise, times, Wanted(1e-7, 1e-7, 1e-7, 1e-7), 2)
    assert modest.plan.duration <= greedy.plan.duration
    assert modest.reached <= 1
    assert 12.0 <= usual_seconds(where.model) <= 60.0


def test_the_narrowest_mode_is_the_least_damped() -> None:
    model = MachineModel((elastic("a"),), ())
    frequency, width = narrowest_mode(model)
    mass = 0.02 * 0.03 / 0.05
    assert frequency == pytest.approx(np.sqrt(190 / mass) / (2 * np.pi), rel=0.02)
    assert width == pytest.approx(0.03 / mass / (2 * np.pi), rel=0.35)  # motor friction damps too


def test_modes_too_fast_for_the_bus_are_refused() -> None:
    where = setting()
    assert fast_cycle_times(where.model, 0.001)[0] == 0.001
    assert fast_cycle_times(where.model, 0.0015)[0] == 0.002
    with pytest.raises(PlanRefusedError, match="the bus allows 9 ms"):
        fast_cycle_times(where.model, 0.009)


def test_an_unstable_loop_is_refused() -> None:
    where = setting()
    wild = replace(where.loops[0], filters=(Biquad.low_pass(6.0, 0.7),))
    with pytest.raises(PlanRefusedError, match="not stable"):
        experiments_for(replace(where, loops=(wild, wild)), CYCLE, 1.6, Shape(-0.75), seed=1)


def test_with_a_bias_velocity_an_axis_never_reverses() -> None:
    where = setting(travel=20.0)
    plan = experiments_for(where, CYCLE, 1.6, Shape(-0.75), seed=4)
    found = with_bias(plan, where, (0,))
    assert found is not None
    biased, factor = found
    assert 0.1 <= factor <= 1
    for one in biased.experiments:
        assert one.bias[1] == 0
        position, _ = simulated(one, where)
        velocity = np.gradient(position[:, 0], CYCLE)[one.settle :]
        assert np.all(np.sign(velocity) == np.sign(one.bias[0]))
        assert np.all(np.abs(one.start + position) <= 20.0)
    assert biased.experiments[0].bias[0] == -biased.experiments[1].bias[0]


def test_short_travel_leaves_no_bias() -> None:
    where = setting(travel=0.4)
    plan = experiments_for(where, CYCLE, 1.6, Shape(-0.75), seed=4)
    assert with_bias(plan, where, (0,)) is None


@pytest.mark.parametrize(
    ("travel", "word"), [(40.0, "do not reverse"), (0.6, "two amplitude levels")]
)
def test_what_is_done_about_friction_is_said(travel: float, word: str) -> None:
    where = setting(travel=travel)
    noise = Noise(np.full(2, 0.004), np.full(2, 2e-6))
    main = plan_main(where, CYCLE, noise, timing(where, 12.0), Wanted(), 2)
    friction = DryFriction(
        ("a", "b"), (Estimate(0.5, 0.01), Estimate(0.0, 0.1)), np.array([0.1, 0])
    )
    freed = freed_of_friction(main, where, noise, friction)
    assert any(word in note for note in freed.plan.notes)
    assert bool(np.any(freed.plan.experiments[0].bias)) == (travel > 1)
    assert freed_of_friction(main, where, noise, None) is main


def test_friction_and_noise_get_room_beside_the_excitation() -> None:
    where = setting()
    noise = Noise(np.full(2, 0.004), np.full(2, 2e-6))
    main = plan_main(where, CYCLE, noise, timing(where, 12.0), Wanted(), 2)
    assert with_room_for_torque(main, where, noise, np.zeros(2)) is main
    beside = np.array([3.6, 0.1])
    assert main.moves[0].torque + beside[0] > 6.0
    weaker = with_room_for_torque(main, where, noise, beside)
    assert weaker.moves[0].torque + beside[0] < 6.0
    assert weaker.reached > main.reached  # what it will tell is reckoned anew
    assert any(note.startswith("a: friction and noise") for note in weaker.plan.notes)


def test_plans_can_be_made_where_one_axis_alone_shows_noise() -> None:
    """As told by a pilot in which one axis stuck and slipped, and the other had none at all."""
    where = setting()
    size = np.exp(-np.arange(40) / 8.0)
    response = size[:, None, None] * np.array([[1.0, 0.3], [0.3, 1.0]], complex)
    scatter = np.random.default_rng(fresh_seed()).uniform(0.5, 2.0)
    powers = np.abs(response[:, :, 1]) ** 2 * scatter  # the second axis' torque made them all
    noise = _explaining([(response, powers, 1000)], rounds=3)
    assert noise.torque[0] < 1e-3 * noise.torque[1]
    main = plan_main(where, CYCLE, noise, timing(where, 12.0), Wanted(), 2)
    assert np.all(np.isfinite(main.accuracy.std))
