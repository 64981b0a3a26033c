"""An inertia that couples two motors: in the design, in the twin, beside one of last masses."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from fieldtool.design.decide import design
from fieldtool.design.machine import machine_of, respond
from fieldtool.design.rule import DesignError
from fieldtool.design.uncertainty import samples_of
from fieldtool.records.model import AxisModel, Coupling, Estimate, MachineModel
from fieldtool.workflow.criticising import final_model
from fieldtool.workflow.twin_effects import rebuilt


def axis(name: str, load: float = 0.002, std: float = 1e-3) -> AxisModel:
    def known(value: float) -> Estimate:
        return Estimate(value, std * value)

    return AxisModel(
        name, "rotary", (known(0.05), known(load)), (known(200.0),), (Estimate(0.05, 0.01),)
    )


def coupled(inertia: float, location: str | None) -> dict[str, Any]:
    found: dict[str, Any] = {
        "effect": "coupling_inertia",
        "axis": ["a", "b"],
        "parameters": {"inertia": {"value": inertia, "std": 1e-4, "unit": "kg m2"}},
    }
    return found if location is None else {**found, "location": location}


def model(location: str | None, inertia: float = 0.01, load: float = 0.002) -> MachineModel:
    return MachineModel((axis("a", load), axis("b", load)), (), (coupled(inertia, location),))


@pytest.mark.parametrize(("location", "stiff"), [("motor", 0.01), ("load", 0.0), (None, 0.0)])
def test_a_coupling_acts_where_its_location_says(location: str | None, stiff: float) -> None:
    """Far above the resonances a motor feels its own mass, and what is coupled to it directly."""
    machine = machine_of(model(location, load=0.03))
    w = 100 * float(machine.modes.max())
    masses = np.linalg.inv(respond(machine, np.array([w])).motors[0] * (1j * w) ** 2).real
    assert masses == pytest.approx(np.array([[0.05, stiff], [stiff, 0.05]]), abs=1e-4)
    low = 1e-3 * float(machine.modes.min())
    whole = np.linalg.inv(respond(machine, np.array([low])).motors[0] * (1j * low) ** 2).real
    assert whole == pytest.approx(np.array([[0.08, 0.01], [0.01, 0.08]]), rel=1e-3)


def test_a_machine_with_coupled_motors_is_designed() -> None:
    """The coupling is larger than the last masses, which it does not join."""
    tuning = design(model("motor"))
    assert max(axis.sensitivity_peak for axis in tuning.axes) <= 1.7 * 1.02


@pytest.mark.parametrize(("location", "inertia"), [("load", 0.01), ("motor", -0.06)])
def test_a_coupling_that_no_machine_has_is_said(location: str, inertia: float) -> None:
    place = "motors" if location == "motor" else "last masses"
    with pytest.raises(
        DesignError, match=rf"coupling_inertia {inertia:.4g} of a - b at the {place}\).* nothing is"
    ):
        design(model(location, inertia))


def test_machines_that_are_drawn_are_machines(fresh_rng: np.random.Generator) -> None:
    doubtful = model("load", 0.0019)
    wide = MachineModel((axis("a", std=0.3), axis("b", std=0.3)), (), doubtful.effects)
    for one in samples_of(wide, 30, fresh_rng):
        assert np.linalg.eigvalsh(machine_of(one).mass)[0] > 0


@pytest.mark.parametrize(
    ("location", "place"), [("motor", "motor"), ("load", "load"), (None, "load")]
)
def test_the_simulated_twin_has_it_there_too(location: str | None, place: str) -> None:
    chains = {"a": ("rotary", (200.0,)), "b": ("rotary", (200.0,))}
    (part,) = rebuilt(model(location).effects, chains).between
    assert part == {
        "effect": "coupling_inertia",
        "axes": ["a", "b"],
        "inertia": 0.01,
        "location": place,
    }


@pytest.mark.parametrize(("location", "new"), [("motor", True), ("load", False)])
@pytest.mark.parametrize("pair", [("a", "b"), ("b", "a")])
def test_a_coupling_of_motors_is_new_beside_one_of_last_masses(
    location: str, new: bool, pair: tuple[str, str]
) -> None:
    axes = (axis("a"), axis("b"))
    known = MachineModel(axes, (Coupling(("a", "b"), 0.001, 1e-5),))
    extended = MachineModel(axes, known.couplings, (coupled(0.01, "motor"),))
    cause = SimpleNamespace(effect="coupling_inertia", axis=pair, location=location)
    found: Any = SimpleNamespace(criticism=SimpleNamespace(causes=(cause,), model=extended))
    assert (final_model(found, known) is extended) is new
    assert final_model(found, extended) is extended, "it has both, and keeps its own numbers"
