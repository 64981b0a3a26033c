"""The model that later stages use: what was identified and what criticism named, once each."""

from dataclasses import replace
from types import SimpleNamespace

import pytest

from fieldtool.records.model import AxisModel, Coupling, Estimate, MachineModel
from fieldtool.workflow.criticising import final_model

VAGUE, SURE = 0.5, 0.01
COUPLED = Coupling(("a", "b"), 0.001, 1e-5)


def chain(name, error=SURE, viscous=0.0, load=0.0):
    masses = tuple(Estimate(m, error * m) for m in (0.05, 0.02))
    return AxisModel(
        name, "rotary", masses, (Estimate(200.0, error * 200),), (Estimate(0.05),),
        Estimate(viscous), Estimate(load),
    )  # fmt: skip


def effect(name, axis="a", location="motor", **numbers):
    values = {k: {"value": v, "std": 0.01 * v, "unit": "1"} for k, v in numbers.items()}
    return {"effect": name, "axis": axis, "location": location, "parameters": values}


def cause(name, axis="a", location="motor"):
    return SimpleNamespace(effect=name, axis=axis, location=location)


def final(model, extended, *causes):
    return final_model(
        SimpleNamespace(criticism=SimpleNamespace(causes=causes, model=extended)), model
    )


MODEL = MachineModel((chain("a"), chain("b")), (), (effect("coulomb_friction", torque=0.1),))


@pytest.mark.parametrize(("location", "viscous", "load"), [("motor", 0.7, 0.0), ("load", 0.0, 0.7)])
def test_viscous_friction_joins_the_dry_one_that_was_identified(location, viscous, load):
    extended = MachineModel((chain("a", VAGUE, viscous, load), chain("b", VAGUE)))
    found = final(MODEL, extended, cause("viscous_friction", "a", location))
    assert (found.axes[0].viscous_friction.value, found.axes[0].load_friction.value) == (
        viscous,
        load,
    )
    assert found.axes[0].masses == MODEL.axes[0].masses
    assert found.axes[1] == MODEL.axes[1]
    assert found.effects == MODEL.effects


def test_another_form_of_the_friction_takes_the_place_of_the_one_that_was_identified():
    late = effect("measurement_delay", "b", delay=1e-3)
    model = replace(
        MODEL, axes=(chain("a", viscous=0.3), chain("b")), effects=(*MODEL.effects, late)
    )
    named = effect("asymmetric_friction", coulomb_positive=0.1, viscous_positive=0.2)
    extended = MachineModel((chain("a", VAGUE), chain("b", VAGUE)), (), (named,))
    found = final(model, extended, cause("asymmetric_friction"))
    assert found.effects == (late, named)
    assert found.axes[0].viscous_friction.value == 0.0  # it is in the other


def test_the_same_on_another_axis_takes_no_place():
    named = effect("coulomb_friction", "b", torque=0.2)
    extended = MachineModel((chain("a", VAGUE), chain("b", VAGUE)), (), (named,))
    assert final(MODEL, extended, cause("coulomb_friction", "b")).effects == (*MODEL.effects, named)


def test_a_coupling_of_the_last_masses_that_is_named_joins_the_model():
    extended = MachineModel((chain("a", VAGUE), chain("b", VAGUE)), (COUPLED,))
    found = final(MODEL, extended, cause("coupling_inertia", ("a", "b"), "load"))
    assert found.couplings == (COUPLED,)
    assert found.effects == MODEL.effects


def test_a_coupling_that_is_too_large_for_the_masses_as_they_were_comes_with_its_own():
    heavy = [replace(chain(n, VAGUE), masses=(Estimate(1.0), Estimate(1.0))) for n in "ab"]
    extended = MachineModel(tuple(heavy), (Coupling(("a", "b"), 0.5),))
    assert final(MODEL, extended, cause("coupling_inertia", ("a", "b"), "load")) is extended


def test_a_coupling_of_the_motors_is_another_one_than_that_of_the_last_masses():
    model = replace(MODEL, couplings=(Coupling(("b", "a"), 0.001),))
    named = effect("coupling_inertia", ["a", "b"], inertia=0.002)
    extended = MachineModel((chain("a", VAGUE), chain("b", VAGUE)), (COUPLED,), (named,))
    found = final(model, extended, cause("coupling_inertia", ("a", "b"), "motor"))
    assert found.couplings == model.couplings
    assert found.effects == (*MODEL.effects, named)
    last = final(model, extended, cause("coupling_inertia", ("a", "b"), "load"))
    assert last is model  # it has it, whatever the order of its axes


def test_a_model_whose_effects_join_two_axes_is_criticised_again():
    spring = effect("coupling_spring", ["a", "b"], stiffness=10.0)
    model = replace(MODEL, effects=(spring,))
    extended = MachineModel((chain("a"), chain("b")), (), (spring,))
    assert final(model, extended, cause("coupling_spring", ("a", "b"))) is model
    assert final(MODEL, extended, cause("coupling_spring", ("a", "b"))) is extended
