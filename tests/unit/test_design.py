"""The design on random machines: within the bound on what the machine really is, and never worse."""

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import yaml
from scipy.linalg import solve_continuous_lyapunov

from fieldtool.design.axis_problem import AxisProblem
from fieldtool.design.decide import KEPT, design
from fieldtool.design.design import find
from fieldtool.design.drive_side import GAINS, DriveSide, Hold
from fieldtool.design.loops import Loops, system_matrix
from fieldtool.design.machine import machine_of, respond
from fieldtool.design.moves import TestMove
from fieldtool.design.no_worse import arrival
from fieldtool.design.predict import frequencies, predict
from fieldtool.design.robust import check
from fieldtool.design.rule import DesignError, rule
from fieldtool.design.search import LOW_PASS, NOTCH, Best
from fieldtool.design.servo import Servo, Timing
from fieldtool.design.shaping import NAMES, best_shaper, impulses, vibration_left
from fieldtool.design.start import slower
from fieldtool.design.tuning import as_parameters
from fieldtool.design.tuning_file import read_tuning, tuning_as_dict
from fieldtool.design.uncertainty import samples_of
from fieldtool.records.model import AxisModel, Correlation, Coupling, Estimate, MachineModel
from fieldtool.records.yaml_file import write_yaml

RandomModel = Callable[..., MachineModel]
TIMING = Timing(0.22e-3, 0.125e-3, 0.004)


def with_errors(model: MachineModel, relative: float, rng: np.random.Generator) -> MachineModel:
    """What an identification would say of a machine: values off by errors that it knows of."""

    def off(one: Estimate) -> Estimate:
        std = relative * abs(one.value)
        return Estimate(
            one.value * float(np.exp(relative * np.clip(rng.standard_normal(), -2, 2))), std
        )

    axes = tuple(
        replace(
            a,
            masses=tuple(off(e) for e in a.masses),
            springs=tuple(off(e) for e in a.springs),
            dampers=tuple(off(e) for e in a.dampers),
        )
        for a in model.axes
    )
    return replace(
        model,
        axes=axes,
        couplings=tuple(replace(c, std=relative * abs(c.value)) for c in model.couplings),
    )


def sides_of(model: MachineModel, present: list[Servo] | None = None) -> list[DriveSide]:
    return [
        DriveSide(
            axis.name,
            None,
            TIMING,
            torque_limit=200.0 * axis.total_mass,
            resolution=2 * np.pi / 2**20,
            present=None
            if present is None
            else {**as_parameters(present[k]), "velocity_filter": 1e4},
        )
        for k, axis in enumerate(model.axes)
    ]


@pytest.mark.parametrize("lengths", [(1,), (2,), (3, 1), (2, 2)], ids=str)
def test_within_the_bound_on_the_true_machine(
    lengths: tuple[int, ...], random_model: RandomModel, fresh_rng: np.random.Generator
) -> None:
    """Designed from a model with errors; judged by eigenvalues and a grid on the machine itself."""
    true = random_model(fresh_rng, lengths, friction=bool(fresh_rng.integers(2)))
    sides = sides_of(true)
    tuning = design(with_errors(true, 0.02, fresh_rng), sides, response="stiff")
    servos = tuple(s.servo(a.parameters) for s, a in zip(sides, tuning.axes, strict=True))
    assert np.linalg.eigvals(system_matrix(machine_of(true), servos)).real.max() < 0
    peaks = check([machine_of(true)], servos).peaks[0]
    assert peaks.max() <= 2.05
    assert tuning.prediction is not None
    for axis in tuning.prediction.axes:
        assert axis.margins.sensitivity_peak <= 2.0 * 1.02
        assert axis.peak_torque <= 200.0 * true.axes[tuning.prediction.axes.index(axis)].total_mass
    # not slower than the rule that it began with, on the machine itself; sooner or stiffer
    ruled = tuple(Servo(loop, timing=TIMING) for loop in rule(true))
    old = predict(true, ruled, tuning.moves)
    new = predict(true, servos, tuning.moves)
    total = [sum(arrival(a) for a in one.axes) for one in (old, new)]
    assert total[1] <= 1.25 * total[0]
    stiffer = [b.compliance / a.compliance for a, b in zip(old.axes, new.axes, strict=True)]
    assert total[1] < 0.9 * total[0] or min(stiffer) < 0.9


@pytest.mark.parametrize("lengths", [(1,), (3,), (2, 1)], ids=str)
def test_a_stiffer_response_is_never_slower(
    lengths: tuple[int, ...], random_model: RandomModel, fresh_rng: np.random.Generator
) -> None:
    model = random_model(fresh_rng, lengths)
    widths = []
    for response in ("soft", "normal", "stiff"):
        prediction = design(model, sides_of(model), response=response).prediction
        assert prediction is not None
        widths.append([axis.margins.bandwidth for axis in prediction.axes])
    for softer, stiffer in pairwise(np.array(widths)):
        assert np.all(stiffer >= 0.99 * softer)


def test_an_axis_that_can_not_be_improved_keeps_its_own_and_the_others_are_designed(
    random_model: RandomModel,
) -> None:
    model = random_model(np.random.default_rng(8), (2, 2))
    first = design(model, sides_of(model), response="stiff")
    sides = sides_of(model, [Servo(loop) for loop in rule(model)])
    best = first.axes[0].parameters
    narrow = {"velocity_p": Hold(maximum=0.3 * best["velocity_p"])}  # below what it holds now
    sides[0] = replace(sides[0], present=best, holds=narrow, tunable=frozenset(best))
    tuning = design(model, sides, response="stiff")
    assert tuning.axes[0].parameters == best
    assert any(note.startswith("axis1: nothing better") for note in tuning.notes)
    assert tuning.prediction is not None
    assert tuning.present is not None
    assert arrival(tuning.prediction.axes[1]) < arrival(tuning.present.axes[1])
    assert tuning.prediction.axes[1].compliance < 0.8 * tuning.present.axes[1].compliance
    assert max(a.margins.sensitivity_peak for a in tuning.prediction.axes) <= 2.0 * 1.02


@pytest.mark.parametrize(("seed", "scales"), [(2, (1.0, 4.0)), (2, (4.0, 1.0)), (7, (1.0, 4.0))])
def test_no_response_has_parameters_of_a_softer_one_that_are_slower_than_the_present(
    random_model: RandomModel, seed: int, scales: tuple[float, float]
) -> None:
    model = random_model(np.random.default_rng(seed), (1, 1))
    loops = [slower(Servo(loop), by) for loop, by in zip(rule(model), scales, strict=True)]
    sides = [
        DriveSide(axis.name, torque_limit=200 * axis.total_mass, present=as_parameters(servo))
        for axis, servo in zip(model.axes, loops, strict=True)
    ]
    try:
        tuning = design(model, sides)
    except DesignError:
        return  # nothing is written then
    assert tuning.prediction is not None
    assert tuning.present is not None
    for new, was in zip(tuning.prediction.axes, tuning.present.axes, strict=True):
        assert arrival(new) <= 1.05 * arrival(was)


@pytest.mark.parametrize("seed", [8, None])
def test_an_axis_that_keeps_its_own_is_not_made_worse_by_the_others(
    random_model: RandomModel, fresh_rng: np.random.Generator, seed: int | None
) -> None:
    """On the first machine the other axis arrives in half the time, and leaves this one swinging."""
    rng = fresh_rng if seed is None else np.random.default_rng(seed)
    model = random_model(rng, (2, 1))
    tuning = design(model, sides_of(model, [Servo(loop) for loop in rule(model)]))
    assert tuning.prediction is not None
    assert tuning.present is not None
    for new, was in zip(tuning.prediction.axes, tuning.present.axes, strict=True):
        assert arrival(new) <= 1.05 * arrival(was)


def test_an_axis_whose_drive_is_too_coarse_keeps_its_own(
    random_model: RandomModel, fresh_rng: np.random.Generator
) -> None:
    """The other one is designed anew, unless each way to do so would make this one worse."""
    changed = False
    for _ in range(6):
        model = random_model(fresh_rng, (2, 1))
        sides = sides_of(model, [Servo(loop) for loop in rule(model)])
        best, other = (dict(side.present or {}) for side in sides)
        coarse = {"velocity_p": Hold(40.0 * best["velocity_p"], whole=True, low=1, high=9)}
        sides[0] = replace(sides[0], holds=coarse)
        try:
            tuning = design(model, sides)
        except DesignError:
            continue  # the rule's gains do not keep the margin either
        assert tuning.axes[0].parameters == {n: best[n] for n in tuning.axes[0].parameters}
        assert any(note.startswith("axis1") and KEPT in note for note in tuning.notes)
        assert tuning.bound == pytest.approx(1.7)
        if changed := tuning.axes[1].parameters["velocity_p"] != other["velocity_p"]:
            break
    assert changed


def test_a_softer_response_is_not_forced_on_an_axis_that_is_within_the_bound(
    random_model: RandomModel,
) -> None:
    """What a stiff design left in the drive is faster than a normal one: kept, unless soft is asked."""
    model = random_model(np.random.default_rng(8), (2,))
    first = design(model, sides_of(model), response="stiff")
    (side,) = sides_of(model)
    held = [replace(side, present={**first.axes[0].parameters, "velocity_filter": 600.0})]
    normal, soft = (design(model, held, response=name) for name in ("normal", "soft"))
    for tuning in (normal, soft):
        assert tuning.prediction is not None
        assert tuning.prediction.axes[0].margins.sensitivity_peak <= 1.02 * tuning.bound
    assert normal.prediction is not None
    assert normal.present is not None
    assert arrival(normal.prediction.axes[0]) <= 1.05 * arrival(normal.present.axes[0])
    assert soft.bound == pytest.approx(1.4)


def test_filters_of_a_drive_that_can_not_set_them_stay(random_model: RandomModel) -> None:
    model = random_model(np.random.default_rng(9), (2,))
    (side,) = sides_of(model, [Servo(loop) for loop in rule(model)])
    fixed = {"filter1_type": 2.0, "filter1_frequency": 180.0, "filter1_pole_damping": 0.7}
    names = frozenset({"position_p", "velocity_p", "velocity_i"})
    tuning = design(model, [replace(side, tunable=names, present={**side.present, **fixed})])
    assert set(tuning.axes[0].parameters) == names
    assert "low-pass at 180 Hz" in tuning.axes[0].reason


@pytest.mark.parametrize(("lacking", "tried"), [("", {LOW_PASS, NOTCH}), ("zero", {LOW_PASS})])
def test_a_filter_without_a_damping_of_its_zeros_is_no_notch(
    random_model: RandomModel, monkeypatch: pytest.MonkeyPatch, lacking: str, tried: set[str]
) -> None:
    model = random_model(np.random.default_rng(9), (2,))
    (side,) = sides_of(model)
    names = {f"filter{k}_{n}" for k in (1, 2)
             for n in ("type", "frequency", "zero_damping", "pole_damping")}  # fmt: skip
    if lacking:
        names = {name for name in names if lacking not in name}
    seen = set()

    def noted(_problem: AxisProblem, best: Best, _evaluations: int, _spread: float = 0.0) -> Best:
        seen.update(best.space.slots)
        return best

    monkeypatch.setattr("fieldtool.design.search.improve", noted)
    design(model, [replace(side, tunable=frozenset({*GAINS, *names}))], response="soft")
    assert seen == tried


def test_the_three_responses_keep_their_margins(
    random_model: RandomModel, fresh_rng: np.random.Generator
) -> None:
    model = random_model(fresh_rng, (2, 1))
    for response, bound in (("soft", 1.4), ("normal", 1.7)):
        tuning = design(model, sides_of(model), response=response)
        assert tuning.bound == pytest.approx(bound)
        assert tuning.prediction is not None
        assert all(a.margins.sensitivity_peak <= 1.02 * bound for a in tuning.prediction.axes)
        middle = next(p for p in tuning.trade if p.factor == 1.0)
        for k, axis in enumerate(tuning.prediction.axes):
            assert middle.sensitivity_peak[k] == pytest.approx(axis.margins.sensitivity_peak)


def test_what_time_shows_is_what_frequency_says(
    random_model: RandomModel, fresh_rng: np.random.Generator
) -> None:
    """Energy of the answer to a torque impulse: by Lyapunov's equation, and by frequencies."""
    model = random_model(fresh_rng, (2, 1))
    sides = sides_of(model)
    tuning = design(model, sides)
    servos = tuple(s.servo(a.parameters) for s, a in zip(sides, tuning.axes, strict=True))
    A = system_matrix(machine_of(model), servos)
    n = model.mass_matrix.shape[0]
    kick = np.zeros(A.shape[0])
    kick[n : 2 * n] = np.linalg.inv(model.mass_matrix)[:, 0]
    energy = float(solve_continuous_lyapunov(A, -np.outer(kick, kick))[0, 0])
    grid = frequencies(machine_of(model), np.linalg.eigvals(A).astype(complex))
    omega = np.unique(np.concatenate([np.linspace(1e-3, 3000, 30_001), grid]))
    loops = Loops(respond(machine_of(model), omega), servos)
    size = np.abs(loops.compliance[:, 0, 0]) ** 2
    assert energy == pytest.approx(float(np.trapezoid(size, omega)) / np.pi, rel=0.05)


def test_rounded_to_what_the_drive_holds_and_checked_again(random_model: RandomModel) -> None:
    model = random_model(np.random.default_rng(4), (2,))
    (side,) = sides_of(model)
    coarse = {
        "velocity_p": Hold(0.5, whole=True, low=0, high=65535),
        "position_p": Hold(1.0, whole=True, low=0, high=255),
        "velocity_i": Hold(10.0, whole=True, low=0, high=65535),
    }
    tuning = design(model, [replace(side, holds=coarse)])
    found = tuning.axes[0].parameters
    assert found["velocity_p"] % 0.5 == 0.0
    assert found["position_p"] == round(found["position_p"])
    assert found["velocity_i"] % 10 == 0.0
    servo = side.servo(found)
    assert check([machine_of(model)], (servo,)).peaks[0, 0] == pytest.approx(
        tuning.axes[0].sensitivity_peak, rel=1e-3
    )
    assert tuning.axes[0].sensitivity_peak <= 1.7 * 1.02


def test_ranges_that_are_too_small_are_said(random_model: RandomModel) -> None:
    model = random_model(np.random.default_rng(4), (2,))
    (side,) = sides_of(model)
    tiny = {"velocity_p": Hold(1.0, whole=True, low=20000, high=65535)}
    with pytest.raises(
        DesignError, match=r"ranges are too small: (axis1: )?velocity_p .*Nothing is"
    ):
        design(model, [replace(side, holds=tiny)])


def test_a_pid_drive_gets_the_cascade_that_its_numbers_are(random_model: RandomModel) -> None:
    model = random_model(np.random.default_rng(6), (2,))
    (side,) = sides_of(model)
    names = frozenset({"pid_p", "pid_i", "pid_d", "position_p", "velocity_p", "velocity_i"})
    holds = {name: Hold(1.0, whole=True, low=0, high=2**31) for name in ("pid_p", "pid_i", "pid_d")}
    tuning = design(model, [replace(side, tunable=names, holds=holds, is_pid=True)])
    kp, kv, ki = (tuning.axes[0].parameters[n] for n in ("position_p", "velocity_p", "velocity_i"))
    for number in (kv * kp + ki, ki * kp, kv):
        assert number == pytest.approx(round(number), abs=1e-6 * number)
    assert set(tuning.axes[0].parameters) == {"position_p", "velocity_p", "velocity_i"}


def test_uncertainty_that_allows_no_margin_is_said(random_model: RandomModel) -> None:
    """Masses and springs known to a factor of ten, and a bound that is hardly above 1."""
    model = random_model(np.random.default_rng(5), (2, 2))
    axes = tuple(
        replace(
            a,
            masses=tuple(Estimate(e.value, 0.9 * e.value) for e in a.masses),
            springs=tuple(Estimate(e.value, 0.9 * e.value) for e in a.springs),
        )
        for a in model.axes
    )
    with pytest.raises(
        DesignError, match=r"uncertainty does not allow the margin|stable on every machine"
    ):
        design(replace(model, axes=axes), sides_of(model), response="soft", bound=1.14)


def test_present_parameters_that_are_better_are_kept(random_model: RandomModel) -> None:
    """The design's own result, with a quicker move than a rougher second design finds, stays."""
    model = random_model(np.random.default_rng(8), (2,))
    first = design(model, sides_of(model), response="stiff")
    (side,) = sides_of(model)
    held = [replace(side, present={**first.axes[0].parameters})]
    second = design(model, held, response="stiff")
    assert second.present is not None
    assert second.prediction is not None
    assert arrival(second.prediction.axes[0]) <= 1.05 * arrival(second.present.axes[0])


def test_what_can_not_be_read_or_written_is_said(random_model: RandomModel) -> None:
    model = random_model(np.random.default_rng(3), (1,))
    (side,) = sides_of(model)
    lacking = replace(side, tunable=frozenset({"position_p"}), unreadable="no backup.")
    tuning = design(model, [lacking])
    assert tuning.present is None
    assert any(
        "velocity_p, velocity_i" in note and "maker's software" in note for note in tuning.notes
    )
    assert any("can not be compared: no backup." in note for note in tuning.notes)
    assert set(tuning.axes[0].parameters) == {"position_p", "velocity_p", "velocity_i"}
    with pytest.raises(DesignError, match="--bound above"):
        design(model, [side], bound=1.05)
    with pytest.raises(DesignError, match="there are soft, normal, stiff"):
        design(model, [side], response="hard")


def test_friction_backlash_and_delay_are_told(random_model: RandomModel) -> None:
    model = random_model(np.random.default_rng(3), (2,))
    effects = (
        {
            "effect": "coulomb_friction",
            "axis": "axis1",
            "location": "motor",
            "parameters": {"torque": 3.0},
        },
        {
            "effect": "backlash",
            "axis": "axis1",
            "location": "spring 1",
            "parameters": {"half_gap": 0.001},
        },
        {"effect": "measurement_delay", "axis": "axis1", "parameters": {"delay": 0.002}},
    )
    tuning = design(replace(model, effects=effects), sides_of(model))
    text = " ".join(tuning.notes)
    assert "dry friction of 3 N m may hold the motor up to" in text
    assert "backlash of 0.002 rad" in text
    assert "2 ms late" in text
    servo = sides_of(model)[0].servo(tuning.axes[0].parameters)
    late = machine_of(model)
    late = replace(late, lag=late.lag + 0.002)
    soft = machine_of(
        replace(
            model,
            axes=(
                replace(model.axes[0], springs=(Estimate(0.3 * model.axes[0].springs[0].value),)),
            ),
        )
    )
    assert check([late, soft], (servo,)).peaks.max() <= 1.7 * 1.02


def test_a_tuning_survives_its_file(tmp_path: Path, random_model: RandomModel) -> None:
    model = random_model(np.random.default_rng(2), (2, 1))
    tuning = design(model, sides_of(model, [Servo(loop) for loop in rule(model)]))
    write_yaml(tmp_path / "tuning.yaml", tuning_as_dict(tuning))
    again = read_tuning(tmp_path / "tuning.yaml")
    assert tuning_as_dict(again) == tuning_as_dict(tuning)
    assert again.moves == tuning.moves
    old = yaml.safe_load((tmp_path / "tuning.yaml").read_text())
    short = {k: old[k] for k in ("format", "axes")}  # parameters alone
    (tmp_path / "tuning.yaml").write_text(yaml.safe_dump(short))
    assert read_tuning(tmp_path / "tuning.yaml").axes == tuning.axes


def test_drawn_machines_are_machines_and_spread_as_they_should() -> None:
    chain = AxisModel("x", "rotary", (Estimate(2.0, 0.2), Estimate(1.0, 0.05)), (Estimate(500.0, 50.0),),
                      (Estimate(0.5),))  # fmt: skip
    model = MachineModel((chain, replace(chain, name="y")), (Coupling(("x", "y"), 0.9, 0.2),))
    drawn = samples_of(model, 300, np.random.default_rng(1))
    assert min(np.linalg.eigvalsh(one.mass_matrix)[0] for one in drawn) > 0
    masses = np.array([one.axes[0].masses[0].value for one in drawn])
    assert np.log(masses).std() == pytest.approx(0.1, rel=0.2)
    assert np.array([one.couplings[0].value for one in drawn]).std() > 0.05


def test_drawn_machines_err_together_as_the_model_says() -> None:
    """A sum that is known well, of parts that are not."""
    chain = AxisModel(
        "x", "rotary", (Estimate(1.0, 0.2), Estimate(1.0, 0.2)), (Estimate(500.0, 5.0),)
    )
    names = ("x.mass[1]", "x.mass[2]")
    together = Correlation(names, ((1.0,), (-0.999, 1.0)))
    rng = np.random.default_rng(1)
    for correlation, spread in ((None, 0.2 * np.sqrt(2)), (together, 0.05)):
        drawn = samples_of(MachineModel((chain,), correlation=correlation), 400, rng)
        masses = np.array([[e.value for e in one.axes[0].masses] for one in drawn])
        assert np.log(masses).std(axis=0) == pytest.approx([0.2, 0.2], rel=0.2)
        assert masses.sum(axis=1).std() == pytest.approx(spread, rel=0.3)


@pytest.mark.parametrize("std", [1e-3, np.inf])
def test_a_number_that_is_all_but_unknown_is_drawn_all_the_same(std: float) -> None:
    chain = AxisModel(
        "x", "rotary", (Estimate(1.0), Estimate(1.0)), (Estimate(500.0),), (Estimate(1e-9, std),)
    )
    drawn = samples_of(MachineModel((chain,)), 50, np.random.default_rng(1))
    dampers = [one.axes[0].dampers[0].value for one in drawn]
    assert all(0 < one < 1e-6 for one in dampers)
    assert max(dampers) > 10 * min(dampers)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("damping", [0.0, 0.05, 0.2])
def test_shapers_cancel_their_vibration(name: str, damping: float) -> None:
    """By formula, and by an oscillator that gets the impulses."""
    a, t = impulses(name, 3.0, damping)
    assert a.sum() == pytest.approx(1.0)
    left = vibration_left(a, t, 3.0, damping)
    allowed = {"ZV": 1e-9, "ZVD": 1e-9, "MZV": 0.01, "EI": 0.051}[name]
    assert left <= allowed
    w, wd = 6 * np.pi, 6 * np.pi * np.sqrt(1 - damping**2)
    late = t[-1] + np.linspace(0, 2 * np.pi / wd, 2001)
    q = sum(
        ai * np.exp(-damping * w * (late - ti)) * np.sin(wd * (late - ti))
        for ai, ti in zip(a, t, strict=True)
    )
    one = np.exp(-damping * w * (late - t[-1])) * np.sin(wd * (late - t[-1]))
    assert np.abs(q).max() <= max(
        1.1 * allowed * np.abs(one).max() * np.exp(damping * w * t[-1]), 1e-9
    )


def test_the_shortest_shaper_that_holds_for_all_frequencies() -> None:
    assert best_shaper("x", np.array([5.0]), 0.05, 10.0).shaper == "ZV"
    wide = best_shaper("x", np.array([5.0, 4.3, 5.7]), 0.05, 10.0)
    assert wide.shaper in ("EI", "ZVD")
    assert wide.left < 0.1
    assert "5 Hz" in wide.sentence
    assert sum(wide.amplitudes) == pytest.approx(1.0)


def test_a_search_begins_below_the_drives_own_ranges(random_model: RandomModel) -> None:
    """The largest value that a drive holds is a bound of the search, not a surprise at its end."""
    model = random_model(np.random.default_rng(11), (1,))
    (side,) = sides_of(model)
    free = design(model, [side]).axes[0].parameters
    most = 0.5 * free["velocity_p"]
    task = find(
        model, [replace(side, holds={"velocity_p": Hold(maximum=most)})],
        [TestMove("axis1", 1.0, 4.0, 40.0, 400.0)], 1.7, None, 1, lambda *_: None,
    )  # fmt: skip
    assert task.servos[0].loop.velocity_p <= most * (1 + 1e-9)
