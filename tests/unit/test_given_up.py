"""New parameters that are worse where settling does not show it: softer, or farther off the path."""

from dataclasses import replace

import numpy as np
import pytest

from fieldtool.design.decide import design
from fieldtool.design.design import Does, Task
from fieldtool.design.drive_side import DriveSide
from fieldtool.design.figures import STRAYS, strays
from fieldtool.design.given_up import given_up, no_sooner
from fieldtool.design.machine import machine_of
from fieldtool.design.moves import typical_move
from fieldtool.design.no_worse import SOFTER, TICK, arrival, no_worse, predicted, softer_than
from fieldtool.design.predict import AxisPrediction
from fieldtool.design.servo import Servo, Timing
from fieldtool.design.start import plain_start, slower
from fieldtool.design.tuning import as_parameters
from fieldtool.records.closed_loop import AxisLoop
from fieldtool.records.model import AxisModel, Estimate, MachineModel

MASS = 0.05
PRESENT = Servo(AxisLoop(20.0, 4.0, 40.0, 1.0, MASS), timing=Timing(2e-3, 0.5e-3))
"""Stiff, and its feed-forward leaves nothing to settle."""
SOFT = slower(PRESENT, 0.6)


def task_of(kind: str = "rotary", bound: float = 1.7) -> Task:
    """A rigid axis whose drive holds PRESENT."""
    model = MachineModel((AxisModel("x", kind, (Estimate(MASS, 0.0),), (), ()),))
    side = DriveSide("x", None, PRESENT.timing, 10.0, 1e-6, {}, as_parameters(PRESENT), kind=kind)
    move = typical_move("x", (-2.0, 2.0), 6.0, 60.0, 10.0, MASS)
    rng = np.random.default_rng(1)
    task = Task(model, (side,), (move,), bound, 1e3, [machine_of(model)], rng, lambda *_: None)
    task.most = 2.0
    task.plain = plain_start(model, task.sides, task.machines, task.top)
    task.does = [Does()]
    return task


def both(task: Task, new: Servo) -> tuple[AxisPrediction, AxisPrediction]:
    now, was = (predicted(task, (one,), spread=False).axes[0] for one in (new, PRESENT))
    assert now.margins.sensitivity_peak <= was.margins.sensitivity_peak < 1.7
    assert arrival(now) <= 1.05 * arrival(was), "settling alone does not show it"
    return now, was


def test_an_axis_that_would_be_softer_for_nothing_keeps_its_own(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("fieldtool.design.no_worse.improved", lambda *_: None)
    task = task_of()
    new, was = both(task, SOFT)
    assert new.compliance > SOFTER * was.compliance
    assert no_worse(task, (SOFT,)) == ((PRESENT,), {0})
    assert no_worse(task, (slower(PRESENT, 0.95),)) == ((slower(PRESENT, 0.95),), frozenset())


def test_an_axis_that_would_be_softer_is_designed_anew_as_stiff_as_it_is_now() -> None:
    task = task_of()
    (one,), kept = no_worse(task, (SOFT,))
    assert (one != PRESENT, kept) == (True, frozenset())
    new, was = (predicted(task, (each,), spread=False).axes[0] for each in (one, PRESENT))
    assert new.compliance <= SOFTER * was.compliance
    assert new.margins.sensitivity_peak <= 1.7


def test_a_load_that_swings_settles_sooner_though_stiffness_is_kept() -> None:
    """The quickest arrival takes a motor that gives way; one a little stiffer is nearly as quick."""
    chain = AxisModel(
        "x",
        "rotary",
        (Estimate(1.5, 0.0), Estimate(3.1, 0.0)),
        (Estimate(1850.0, 0.0),),
        (Estimate(2.7, 0.0),),
        Estimate(2.3, 0.0),
    )
    present = as_parameters(Servo(AxisLoop(10.0, 114.0, 1050.0, 1.0)))
    side = DriveSide("x", None, Timing(0.2e-3, 0.1e-3, 1e-3), 230.0, 6e-6, {}, present)
    move = typical_move("x", (-2.0, 2.0), 6.0, 50.0, 230.0, 4.6)
    model = MachineModel((chain,))
    soft, normal = (design(model, [side], [move], response=name) for name in ("soft", "normal"))
    assert normal.present is not None
    [was], [new] = normal.present.axes, normal.prediction.axes
    assert softer_than(soft.prediction.axes[0], was), "what would be refused as too soft"
    assert not softer_than(new, was)
    assert arrival(new) < 0.6 * arrival(was)


def test_a_soft_response_and_a_margin_that_is_asked_for_may_take_stiffness() -> None:
    task = task_of()
    task.softens = True
    assert no_worse(task, (SOFT,)) == ((SOFT,), frozenset())
    peak = both(task, SOFT)[1].margins.sensitivity_peak
    task = task_of(bound=peak / 1.05)
    assert no_worse(task, (SOFT,)) == ((SOFT,), frozenset())


def test_softer_ones_are_taken_where_the_present_ones_do_not_hold_on_every_machine() -> None:
    """They are what keeps the margin there: what is given up for that is only said."""
    task = task_of()
    light = MachineModel((AxisModel("x", "rotary", (Estimate(MASS / 8, 0.0),), (), ()),))
    task.machines.append(machine_of(light))  # on which the present ones are too lively
    assert no_worse(task, (SOFT,)) == ((SOFT,), frozenset())


@pytest.mark.parametrize(
    ("kind", "units"),
    [("rotary", ("rad/(N m)", "N m/(rad s)")), ("linear", ("m/N", "N/(m s)"))],
)
def test_stiffness_that_is_given_up_is_said(kind: str, units: tuple[str, str]) -> None:
    task = task_of(kind)
    new, was = both(task, SOFT)
    told = given_up(task.sides[0], new, was, (SOFT, PRESENT), "normal")
    assert len(told) == 1
    integral = SOFT.loop.position_p * SOFT.loop.velocity_i
    assert f"by up to {new.compliance:.3g} {units[0]}, {was.compliance:.3g} {units[0]} " in told[0]
    assert f"is {integral:.3g} {units[1]}, 800 {units[1]} with the present" in told[0]
    assert told[0].endswith("compare --response stiff, or keep the present ones.")
    assert not given_up(task.sides[0], new, was, (SOFT, PRESENT), "stiff")[0].endswith(
        "present ones."
    )
    slow = replace(PRESENT, loop=replace(PRESENT.loop, velocity_i=40.0 / SOFTER / 1.01))
    [only] = given_up(task.sides[0], was, was, (slow, PRESENT), "normal")
    assert "by up to" not in only
    for one in (PRESENT, slower(PRESENT, 0.95)):
        assert given_up(task.sides[0], *both(task, one), (one, PRESENT), "normal") == []


@pytest.mark.parametrize("factor", [0.99, 1.01])
def test_a_path_that_is_left_farther_is_said(factor: float) -> None:
    """From a fifth more, and half the band, on: the band is what nobody looks into."""
    task = task_of()
    _, was = both(task, PRESENT)
    assert was.move is not None
    was = replace(was, move=replace(was.move, following_error=0.1))
    most = STRAYS * 0.1 + was.move.band / 2
    far = replace(was, move=replace(was.move, following_error=factor * most))
    told = given_up(task.sides[0], far, was, (PRESENT, PRESENT), "normal")
    assert bool(told) == strays(factor * most, 0.1, was.move.band) == (factor > 1)
    if told:
        assert (
            f"up to {factor * most:.3g} rad off its reference, 0.1 rad with the present" in told[0]
        )


def test_without_feed_forward_the_path_is_said_to_be_left() -> None:
    task = task_of()
    late = replace(PRESENT, loop=replace(PRESENT.loop, velocity_ff=0.7))
    now, was = (predicted(task, (one,), spread=False).axes[0] for one in (late, PRESENT))
    [told] = given_up(task.sides[0], now, was, (late, PRESENT), "stiff")
    assert told.startswith("x: on its typical move the motor is up to ")


@pytest.mark.parametrize("kind", ["rotary", "linear"])
def test_a_stiff_response_that_settles_no_sooner_says_so(kind: str) -> None:
    task = task_of(kind)
    new, was = both(task, PRESENT)
    assert new.move is not None
    for ticks, said in ((-1.01, False), (-0.99, True), (0.0, True), (5.0, True)):
        later = new.move.positioning_time + ticks * TICK
        one = replace(new, load=None, move=replace(new.move, positioning_time=later))
        one = replace(one, load=one.move)
        told = no_sooner(task.sides[0], one, replace(was, load=was.move), ("stiff", "normal"))
        assert bool(told) == said
    unit = {"rotary": "rad/(N m)", "linear": "m/N"}[kind]
    assert told[0].endswith(f"{was.compliance:.3g} {unit}."), "as much margin as the softer one"
    less = replace(one, margins=replace(one.margins, sensitivity_peak=3.0))
    [told] = no_sooner(task.sides[0], less, replace(was, load=was.move), ("stiff", "normal"))
    assert told.endswith("--response normal keeps more margin.")
    away = replace(new, move=None)
    assert no_sooner(task.sides[0], away, was, ("stiff", "normal")) == []


def test_a_design_says_where_stiff_settles_no_sooner() -> None:
    """A rigid axis with feed-forward is there when its reference is, whatever the gains."""
    task = task_of()
    told = {
        name: [
            note
            for note in design(task.model, task.sides, task.moves, response=name).notes
            if "no sooner than" in note
        ]
        for name in ("normal", "stiff")
    }
    assert told["normal"] == []
    [note] = told["stiff"]
    assert note.startswith("x: stiff settles no sooner than normal here: ")
