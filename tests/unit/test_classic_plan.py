"""The classic plan on random machines: amplitudes, frequencies, sweeps, and the forecast's refusals.

Steady states are worked out here from the equation of motion with the loops as extra stiffness, in
one linear system for chain and controller, and once more in time.
"""

from collections.abc import Callable
from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest

from drives.api import AxisLimits
from fieldtool.errors import PlanRefusedError
from fieldtool.experiment.forecast import Setting, forecast
from fieldtool.experiment.stepped.design import (
    CYCLE_TIMES,
    CYCLES_A_PERIOD,
    HIGH,
    SHARE_OF_LIMITS,
    chosen_cycle_time,
    classic_plan,
    refined_plan,
    undamped_modes,
)
from fieldtool.experiment.stepped.plan import Sweep, SweepPlan, Tone
from fieldtool.records.closed_loop import AxisLoop
from fieldtool.records.model import MachineModel

RandomModel = Callable[..., MachineModel]
LENGTHS = [(1,), (3,), (2, 2), (1, 3), (3, 1, 2)]


def setting_for(model: MachineModel, rng: np.random.Generator) -> Setting:
    loops, limits = [], []
    for axis in model.axes:
        total, w = axis.total_mass, 2 * np.pi * rng.uniform(0.8, 1.6)
        loops.append(AxisLoop(w / 4, total * w, total * w * w / 4))
        low = -rng.uniform(0.8, 1.5)
        limits.append(
            AxisLimits((low, low + 2.6), 3.0, 60.0, 60.0 * total * rng.uniform(0.3, 1), 0.5)
        )
    centre = np.array([sum(one.travel) / 2 + rng.uniform(-0.1, 0.1) for one in limits])
    return Setting(model, tuple(loops), tuple(limits), centre)


def steady_use(setting: Setting, sweep: Sweep, tone: Tone) -> float:
    """Largest share of any limit that a tone uses at steady state."""
    model, s = setting.model, 2j * np.pi * tone.frequency
    n, m = model.mass_matrix.shape[0], len(model.axes)
    # unknowns: n positions, m torques
    system = np.zeros((n + m, n + m), dtype=complex)
    system[:n, :n] = model.mass_matrix * s * s + model.damping_matrix * s + model.stiffness_matrix
    right = np.zeros(n + m, dtype=complex)
    driven = model.names.index(sweep.driven)
    for k, (name, motor) in enumerate(zip(model.names, model.first_masses, strict=True)):
        system[motor, n + k] = -1.0
        system[n + k, n + k] = 1.0
        if name in sweep.free:
            continue
        loop = setting.loops[k]
        pi = loop.velocity_p + loop.velocity_i / s
        system[n + k, motor] = pi * (loop.position_p + s)
        if k == driven:
            right[n + k] = pi * (loop.position_p + s * loop.velocity_ff) * tone.amplitude
    found = np.linalg.solve(system, right)
    use, w = 0.0, abs(s)
    for k, (name, limits) in enumerate(zip(model.names, setting.limits, strict=True)):
        q, torque = found[model.first_masses[k]], found[n + k]
        low, high = limits.travel
        use = max(
            use,
            abs(q) / (high - setting.centre[k]),
            abs(q) / (setting.centre[k] - low),
            w * abs(q) / limits.velocity,
            w * w * abs(q) / limits.acceleration,
            abs(torque) / limits.torque,
        )
        if name not in sweep.free:
            reference = tone.amplitude if k == driven else 0.0
            use = max(use, abs(reference - q) / limits.following_error)
    return use


@pytest.fixture(params=LENGTHS, ids=str)
def setting(
    request: pytest.FixtureRequest, random_model: RandomModel, fresh_rng: np.random.Generator
) -> Setting:
    model = random_model(fresh_rng, request.param, friction=bool(fresh_rng.integers(0, 2)))
    return setting_for(model, fresh_rng)


def both_plans(setting: Setting) -> list[SweepPlan]:
    names = setting.model.names
    resonances, _ = undamped_modes(setting.model)
    ratios = np.full(resonances.size, 0.01)
    step = chosen_cycle_time(setting.model, 0.001)
    return [classic_plan(setting, names, step), refined_plan(setting, ratios, step)]


def test_no_tone_uses_more_than_its_share_of_any_limit(setting: Setting) -> None:
    uses = [
        steady_use(setting, sweep, tone)
        for plan in both_plans(setting)
        for sweep in plan.sweeps
        for tone in sweep.tones
    ]
    assert max(uses) <= SHARE_OF_LIMITS * (1 + 1e-6)
    # and amplitudes are not small for nothing: away from modes the share is used
    assert np.quantile(uses, 0.8) > 0.5 * SHARE_OF_LIMITS


def test_tones_are_whole_and_in_the_band(setting: Setting) -> None:
    for plan in both_plans(setting):
        for sweep in plan.sweeps:
            frequencies = [tone.frequency for tone in sweep.tones]
            # rounded to whole blocks, tones at modes close to each other may change places
            assert np.all(np.diff(frequencies) > -0.004 * np.array(frequencies[1:]))
            for tone in sweep.tones:
                assert tone.cycle_time == plan.cycle_time
                assert tone.periods == round(tone.frequency * tone.samples * tone.cycle_time)
                assert tone.frequency * tone.cycle_time <= 1.01 / CYCLES_A_PERIOD
                assert tone.amplitude > 0


def test_the_sweeps_that_the_paper_asks_for(setting: Setting) -> None:
    names, (plan, _) = setting.model.names, both_plans(setting)
    found = [(s.kind, s.driven, s.free) for s in plan.sweeps]
    expected = [("direct, others free", a, tuple(b for b in names if b != a)) for a in names]
    if len(names) > 1:
        expected += [("direct, others locked", a, ()) for a in names]
        expected += [("cross-coupled", b, (a,)) for a, b in combinations(names, 2)]
    assert found == expected
    assert len({s.name for s in plan.sweeps}) == len(plan.sweeps)
    held = [s for s in plan.sweeps if s.kind != "direct, others free"]
    grids = {tuple(t.frequency for t in s.tones) for s in held}
    assert len(grids) <= 1  # one grid, so that the response matrix can be solved at each frequency


def test_the_band_covers_every_mode(setting: Setting) -> None:
    """Modes here come from state-space eigenvalues without damping."""
    model = setting.model
    plan = both_plans(setting)[0]

    def hz(keep: list[int]) -> np.ndarray:
        at = np.ix_(keep, keep)
        squares = np.linalg.eigvals(
            np.linalg.solve(model.mass_matrix[at], model.stiffness_matrix[at])
        )
        found = np.sqrt(np.abs(squares)) / (2 * np.pi)
        return np.sort(found[found > 1e-3])

    every = list(range(model.mass_matrix.shape[0]))
    resonances, antiresonances = undamped_modes(model)
    np.testing.assert_allclose(resonances / (2 * np.pi), hz(every), rtol=1e-6)
    for k, motor in enumerate(model.first_masses):
        locked = hz([i for i in every if i != motor])
        np.testing.assert_allclose(antiresonances[k] / (2 * np.pi), locked, rtol=1e-6)
        modes = np.concatenate([hz(every), locked])
        if not modes.size:
            continue
        tones = np.array([t.frequency for t in plan.sweeps[k].tones])
        assert tones.min() < 0.5 * modes.min()
        assert tones.max() > 1.5 * modes.max()
        grid = tones[tones < 1.1 * modes.max()]
        assert np.all(grid[1:] / grid[:-1] < 1.07)


def test_the_second_pass_is_at_and_beside_every_mode(setting: Setting) -> None:
    resonances, antiresonances = undamped_modes(setting.model)
    plan = both_plans(setting)[1]
    if not resonances.size:
        assert plan.sweeps == ()
        return
    for k, sweep in enumerate(plan.sweeps):
        tones = np.array([t.frequency for t in sweep.tones])
        for mode in np.concatenate([resonances, antiresonances[k]]) / (2 * np.pi):
            near = np.sort(np.abs(tones / mode - 1))
            assert near[0] < 0.005
            assert near[1] < 0.016


def test_the_forecast_is_above_the_steady_state_and_below_the_limits(setting: Setting) -> None:
    plan = both_plans(setting)[0]
    short = replace(plan, sweeps=plan.sweeps[:1] + plan.sweeps[-1:])
    found = forecast(short, setting)
    largest = max(steady_use(setting, s, t) for s in short.sweeps for t in s.tones)
    use = 0.0
    for k, (one, limits) in enumerate(zip(found, setting.limits, strict=True)):
        room = min(setting.centre[k] - limits.travel[0], limits.travel[1] - setting.centre[k])
        shares = (
            one.excursion / room,
            one.velocity / limits.velocity,
            one.acceleration / limits.acceleration,
            one.torque / limits.torque,
            one.following_error / limits.following_error,
        )
        assert max(shares) <= 1.0
        use = max(use, *shares)
    assert use >= 0.9 * largest  # three blocks may be too few to settle, hardly more


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"velocity": 0.01}, r"axis1 would move at .* rad/s, its limit is 0.01 rad/s"),
        ({"acceleration": 0.01}, r"axis1 would accelerate at .* its limit is 0.01 rad/s2"),
        ({"torque": 0.01}, r"axis1 would need a torque of .* N m, its limit is 0.01 N m"),
        ({"following_error": 1e-4}, r"axis1 would have a following error of .* is 0.0001 rad"),
        ({"travel": (-0.001, 0.001)}, r"axis1 would leave its centre by .* its limit is 0.001 rad"),
    ],
)
def test_each_limit_is_refused(
    change: dict[str, object], words: str, random_model: RandomModel, fresh_rng: np.random.Generator
) -> None:
    setting = setting_for(random_model(fresh_rng, (2, 2)), fresh_rng)
    setting = replace(setting, centre=np.zeros(2))
    plan = classic_plan(setting, setting.model.names, 0.001)
    plan = replace(plan, sweeps=plan.sweeps[2:3])
    forecast(plan, setting)
    tight = replace(setting.limits[0], **change)  # type: ignore[arg-type]
    with pytest.raises(PlanRefusedError, match=words) as refusal:
        forecast(plan, replace(setting, limits=(tight, setting.limits[1])))
    assert "sweep axis1 direct, others locked" in str(refusal.value)
    assert "Nothing of it was moved" in str(refusal.value)


def test_the_limit_itself_is_the_border(
    random_model: RandomModel, fresh_rng: np.random.Generator
) -> None:
    setting = setting_for(random_model(fresh_rng, (2,)), fresh_rng)
    plan = classic_plan(setting, ["axis1"], 0.001)
    plan = replace(plan, sweeps=(replace(plan.sweeps[0], tones=plan.sweeps[0].tones[:5]),))
    (found,) = forecast(plan, setting)
    for what in ("velocity", "acceleration", "torque", "following_error"):
        value = getattr(found, what)
        for factor, fits in ((1.001, True), (0.999, False)):
            limits = replace(setting.limits[0], **{what: factor * value})
            tight = replace(setting, limits=(limits,))
            if fits:
                assert forecast(plan, tight) == (found,)
            else:
                with pytest.raises(PlanRefusedError, match="its limit is"):
                    forecast(plan, tight)


def test_a_linear_axis_is_refused_in_its_units(
    random_model: RandomModel, fresh_rng: np.random.Generator
) -> None:
    setting = setting_for(random_model(fresh_rng, (1, 1)), fresh_rng)
    plan = classic_plan(setting, setting.model.names, 0.001)
    assert setting.model.axes[1].kind == "linear"
    tight = replace(setting.limits[1], torque=0.01)
    with pytest.raises(
        PlanRefusedError, match=r"axis2 would need a torque of [\d.]+ N, .* 0.01 N\."
    ):
        forecast(plan, replace(setting, limits=(setting.limits[0], tight)))


def test_unstable_gains_are_refused(
    random_model: RandomModel, fresh_rng: np.random.Generator
) -> None:
    setting = setting_for(random_model(fresh_rng, (2, 1)), fresh_rng)
    plan = classic_plan(setting, setting.model.names, 0.001)
    wrong = replace(setting.loops[0], velocity_p=-setting.loops[0].velocity_p)
    with pytest.raises(PlanRefusedError, match=r"sweep axis1 .* not stable"):
        forecast(plan, replace(setting, loops=(wrong, setting.loops[1])))


def test_an_axis_that_may_not_float(
    random_model: RandomModel, fresh_rng: np.random.Generator
) -> None:
    setting = setting_for(random_model(fresh_rng, (2, 1)), fresh_rng)
    with pytest.raises(PlanRefusedError, match=r"axis2 may not \(`may_float`"):
        classic_plan(setting, ["axis1"], 0.001)
    alone = setting_for(random_model(fresh_rng, (3,)), fresh_rng)
    assert len(classic_plan(alone, [], 0.001).sweeps) == 1  # nothing else floats


def test_the_cycle_time_follows_from_modes_and_bus(
    random_model: RandomModel, fresh_rng: np.random.Generator
) -> None:
    for _ in range(20):
        model = random_model(fresh_rng, (2, 3))
        resonances, antiresonances = undamped_modes(model)
        top = max(resonances.max(), *(a.max() for a in antiresonances)) / (2 * np.pi)
        fitting = [t for t in CYCLE_TIMES if t * CYCLES_A_PERIOD * HIGH * top <= 1]
        assert chosen_cycle_time(model, 0.001) == max(fitting)
        assert chosen_cycle_time(model, max(fitting)) == max(fitting)
        with pytest.raises(PlanRefusedError, match=r"fastest mode needs .* the bus allows"):
            chosen_cycle_time(model, max(fitting) + 0.001)


def test_the_choice_about_friction_is_shown(
    random_model: RandomModel, fresh_rng: np.random.Generator
) -> None:
    setting = setting_for(random_model(fresh_rng, (2, 1)), fresh_rng)
    plan = classic_plan(setting, setting.model.names, 0.001)
    lowest = min(t.frequency for s in plan.sweeps[2:] for t in s.tones)
    assert any(f"down to {lowest:.2g} Hz" in note for note in plan.notes)
