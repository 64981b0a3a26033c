"""The model as a value: matrices against hand-written ones, round trips, what is refused."""

import json
from collections.abc import Callable
from dataclasses import replace
from math import inf, isnan, nan
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldtool.records.model import AxisModel, Correlation, Coupling, Estimate, Kind, MachineModel

RandomModel = Callable[..., MachineModel]


def exact(*values: float) -> tuple[Estimate, ...]:
    return tuple(Estimate(v) for v in values)


MACHINE = MachineModel(
    (
        AxisModel("a", "rotary", exact(1, 2, 3), exact(10, 20), exact(0.1, 0.2), Estimate(0.5)),
        AxisModel("b", "linear", exact(7), (), (), Estimate(0.6), Estimate(0.25)),
        AxisModel("c", "rotary", exact(4, 5), exact(30)),
    ),
    (Coupling(("c", "a"), -0.5), Coupling(("a", "b"), 0.75)),
)


def test_matrices_by_hand() -> None:
    np.testing.assert_array_equal(
        MACHINE.mass_matrix,
        [
            [1, 0, 0, 0, 0, 0],
            [0, 2, 0, 0, 0, 0],
            [0, 0, 3, 0.75, 0, -0.5],
            [0, 0, 0.75, 7, 0, 0],
            [0, 0, 0, 0, 4, 0],
            [0, 0, -0.5, 0, 0, 5],
        ],
    )
    np.testing.assert_array_equal(
        MACHINE.stiffness_matrix,
        [
            [10, -10, 0, 0, 0, 0],
            [-10, 30, -20, 0, 0, 0],
            [0, -20, 20, 0, 0, 0],
            [0, 0, 0, 0, 0, 0],
            [0, 0, 0, 0, 30, -30],
            [0, 0, 0, 0, -30, 30],
        ],
    )
    np.testing.assert_allclose(
        MACHINE.damping_matrix,
        [
            [0.6, -0.1, 0, 0, 0, 0],
            [-0.1, 0.3, -0.2, 0, 0, 0],
            [0, -0.2, 0.2, 0, 0, 0],
            [0, 0, 0, 0.85, 0, 0],
            [0, 0, 0, 0, 0, 0],
            [0, 0, 0, 0, 0, 0],
        ],
        atol=1e-15,
    )
    np.testing.assert_array_equal(MACHINE.first_masses, [0, 3, 4])
    np.testing.assert_array_equal(MACHINE.last_masses, [2, 3, 5])
    assert [axis.total_mass for axis in MACHINE.axes] == [6, 7, 9]
    assert MACHINE.names == ("a", "b", "c")


def test_matrices_are_symmetric_and_springs_hold_no_rigid_motion(
    random_model: RandomModel, fresh_rng: np.random.Generator
) -> None:
    for _ in range(20):
        lengths = tuple(
            int(n) for n in fresh_rng.integers(1, 7, size=int(fresh_rng.integers(1, 5)))
        )
        model = random_model(fresh_rng, lengths)
        for matrix in (model.mass_matrix, model.stiffness_matrix, model.damping_matrix):
            np.testing.assert_array_equal(matrix, matrix.T)
        rigid = np.zeros((sum(lengths), len(lengths)))
        for k, (first, last) in enumerate(zip(model.first_masses, model.last_masses, strict=True)):
            rigid[first : last + 1, k] = 1.0
        for matrix in (model.stiffness_matrix, model.damping_matrix):
            np.testing.assert_allclose(matrix @ rigid, 0, atol=1e-9 * matrix.max(initial=1.0))
        # kinetic energy of all axes at unit speed: masses and, twice, couplings
        ones = np.ones(sum(lengths))
        total = sum(a.total_mass for a in model.axes) + 2 * sum(c.value for c in model.couplings)
        assert ones @ model.mass_matrix @ ones == pytest.approx(total)


numbers = st.floats(allow_nan=False, allow_infinity=False)
estimates = st.builds(
    Estimate, numbers, st.one_of(st.sampled_from([nan, inf]), st.floats(0, 1e300))
)
effects = st.fixed_dictionaries(
    {
        "effect": st.sampled_from(["backlash", "measurement_delay", "gravity"]),
        "axis": st.just("x0"),
        "parameters": st.dictionaries(
            st.sampled_from(["width", "delay"]),
            st.fixed_dictionaries({"value": numbers, "std": st.none(), "unit": st.just("rad")}),
        ),
    }
)


@st.composite
def machines(draw: st.DrawFn) -> MachineModel:
    axes = []
    for k in range(draw(st.integers(1, 4))):
        n = draw(st.integers(1, 4))
        few = st.lists(estimates, min_size=n - 1, max_size=n - 1)
        frictions = [draw(st.one_of(st.just(Estimate(0.0)), estimates)) for _ in range(2)]
        # a friction of zero is "not there", so its error is not kept
        frictions = [f if f.value else Estimate(0.0) for f in frictions]
        masses = draw(st.lists(estimates, min_size=n, max_size=n))
        dampers = tuple(draw(few)) if draw(st.booleans()) else ()
        kind: Kind = draw(st.sampled_from(("rotary", "linear")))
        axes.append(AxisModel(f"x{k}", kind, tuple(masses), tuple(draw(few)), dampers, *frictions))
    pairs = [(f"x{i}", f"x{j}") for i in range(len(axes)) for j in range(i)]
    couplings = [Coupling(pair, draw(numbers), draw(st.floats(0, 1e9))) for pair in pairs]
    model = MachineModel(tuple(axes), tuple(couplings), tuple(draw(st.lists(effects, max_size=2))))
    names = draw(st.lists(st.sampled_from(sorted(model.numbers)), unique=True, max_size=3))
    if not names:
        return model
    shares = st.floats(-1.0, 1.0)
    rows = tuple((*draw(st.tuples(*[shares] * k)), 1.0) for k in range(len(names)))
    return replace(model, correlation=Correlation(tuple(names), rows))


@given(machines())
def test_models_survive_json(model: MachineModel) -> None:
    data = json.loads(json.dumps(model.as_dict(), allow_nan=False))
    again = MachineModel.from_dict(data)
    assert again.as_dict() == model.as_dict()
    assert repr(again) == repr(model)  # NaN is equal to NaN here
    for one, other in zip(again.axes, model.axes, strict=True):
        assert one.masses[0].value == other.masses[0].value
        assert isnan(one.masses[0].std) == isnan(other.masses[0].std)


@given(machines())
def test_numbers_have_names_and_come_back(model: MachineModel) -> None:
    assert repr(model.with_numbers({})) == repr(model)
    name = sorted(model.numbers)[-1]
    changed = model.with_numbers({name: Estimate(0.125, 0.5)})
    assert changed.numbers[name] == Estimate(0.125, 0.5)
    assert {k: repr(v) for k, v in changed.numbers.items() if k != name} == {
        k: repr(v) for k, v in model.numbers.items() if k != name
    }


def test_plain_numbers_and_missing_parts() -> None:
    model = MachineModel.from_dict(
        {
            "format": "fieldtool-model/1",
            "axes": [{"name": "x", "kind": "rotary", "masses": [1, {"value": 2}], "springs": [3]}],
            "couplings": None,
        }
    )
    assert model.axes[0].masses[1].value == 2.0
    assert model.axes[0].dampers == ()
    assert model.couplings == ()
    assert model.effects == ()


def changed(**changes: Any) -> dict[str, Any]:
    data = {
        "format": "fieldtool-model/1",
        "axes": [{"name": "x", "kind": "rotary", "masses": [1], "springs": []}],
        "couplings": [],
        "effects": [],
    } | changes
    return {key: value for key, value in data.items() if value is not ...}


AXIS: dict[str, Any] = {"name": "x", "kind": "rotary", "masses": [1], "springs": []}


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (changed(format="fieldtool-model/2"), "format must be fieldtool-model/1"),
        (changed(format=...), "format must be fieldtool-model/1, got None"),
        (changed(axes=...), "'axes' is missing"),
        (changed(extra=1), r"model has unknown keys \['extra'\]"),
        (changed(axes=[AXIS | {"kind": "round"}]), "kind must be rotary or linear, got 'round'"),
        (changed(axes=[AXIS | {"mass": 1}]), r"axis has unknown keys \['mass'\]"),
        (changed(axes=[{"name": "x", "kind": "rotary"}]), "'masses' is missing"),
        (changed(axes=[{"kind": "rotary", "masses": [1]}]), "'name' is missing"),
        (changed(axes=[AXIS | {"masses": []}]), "a chain has at least one mass"),
        (changed(axes=[AXIS | {"masses": ["1"]}]), "expected a number, got '1'"),
        (changed(axes=[AXIS | {"masses": [True]}]), "expected a number, got True"),
        (changed(axes=[AXIS | {"masses": [None]}]), "expected a number, got None"),
        (changed(axes=[AXIS | {"masses": [{"std": 1}]}]), "'value' is missing"),
        (changed(axes=[AXIS | {"masses": [{"value": 1, "error": 2}]}]), "number has unknown keys"),
        (changed(axes=[AXIS | {"masses": [nan]}]), "finite"),
        (changed(axes=[AXIS | {"masses": [inf]}]), "finite"),
        (changed(axes=[AXIS | {"springs": [1]}]), "1 masses need 0 springs, got 1"),
        (changed(axes=[AXIS | {"dampers": [1]}]), "0 springs need as many dampers, got 1"),
        (changed(axes=[AXIS, AXIS]), r"names must differ, got \['x', 'x'\]"),
        (changed(couplings=[{"axes": ["x", "y"], "value": 1}]), "x - y does not join two axes"),
        (changed(couplings=[{"axes": ["x", "x"], "value": 1}]), "x - x does not join two axes"),
        (changed(couplings=[{"value": 1}]), "'axes' is missing"),
        (
            changed(effects=[{"effect": "viscous_friction", "axis": "y", "parameters": {}}]),
            "viscous friction is on axis 'y'",
        ),
        (changed(effects=[{"effect": "viscous_friction", "axis": "x"}]), "'parameters' is missing"),
        (changed(correlation={"names": ["x.mass[1]"]}), "'rows' is missing"),
        (
            changed(correlation={"names": ["x.mass[2]"], "rows": [[1.0]]}),
            r"names \['x.mass\[2\]'\]",
        ),
        (changed(correlation={"names": ["x.mass[1]"], "rows": [[1.0, 0]]}), "one row a name"),
        (changed(correlation={"names": ["x.mass[1]"] * 2, "rows": [[1], [0, 1]]}), "number twice"),
        (changed(correlation={"names": ["x.mass[1]"], "rows": [[1.5]]}), "outside of -1 to 1"),
        (changed(correlation={"names": ["x.mass[1]"], "rows": [[0.5]]}), "has to end with 1"),
    ],
)
def test_what_is_no_model_is_refused(data: dict[str, Any], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        MachineModel.from_dict(data)


def test_friction_is_an_effect_with_its_unit() -> None:
    effects = MACHINE.as_dict()["effects"]
    assert [e["axis"] for e in effects] == ["a", "b"]
    assert effects[0]["parameters"]["coefficient"]["unit"] == "N m s/rad"
    assert effects[1]["parameters"]["load_coefficient"]["unit"] == "N s/m"
    assert "load_coefficient" not in effects[0]["parameters"]


def test_load_friction_alone_survives() -> None:
    axis = replace(MACHINE.axes[1], viscous_friction=Estimate(0.0))
    again = MachineModel.from_dict(MachineModel((axis,)).as_dict()).axes[0]
    assert (again.viscous_friction.value, again.load_friction.value) == (0.0, 0.25)
