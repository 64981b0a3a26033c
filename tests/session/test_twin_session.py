"""A machine with a hidden effect, and the simulated one rebuilt from what was found: they do alike."""

from copy import deepcopy

import numpy as np
import pytest
import yaml

from drives.profile import load_machine
from fieldtool import workflow
from fieldtool.frf.matrix import SOLVED
from fieldtool.frf.response import load_responses
from fieldtool.identify.likelihood.refine import machine_response
from fieldtool.records.model_file import read_model
from tests.session.conftest import one_axis

KINDS = ("coulomb_friction", "measurement_delay")
SAME = 0.03
"""Relative difference of responses that both machines may have where noise allows less."""


def hidden(rng):
    """Return a machine with one effect of random kind and size, as a profile's part."""
    kind = KINDS[rng.integers(len(KINDS))]
    part = {"effect": kind}
    if kind == "coulomb_friction":
        part["torque"] = float(rng.uniform(0.1, 0.3))
    else:
        part["time"] = float(rng.integers(8, 16)) / 8000
    return part


def criticised(machine, folder):
    """Measure over the virtual bus, identify, criticise; return the criticism."""
    workflow.measure(load_machine(machine), folder)
    workflow.identify(folder)
    return workflow.criticise(folder).criticism


def the(criticism, effect):
    found = [c for c in criticism.causes if c.effect == effect]
    assert found, [c.effect for c in criticism.causes]
    return found[0]


def test_the_machine_rebuilt_from_a_session_behaves_as_the_one_that_was_measured(
    tmp_path, fresh_rng
):
    part = hidden(fresh_rng)
    print("hidden", part)
    machine = deepcopy(one_axis())
    machine["simulation"]["seed"] = int(fresh_rng.integers(1000))
    machine["simulation"]["axes"][0]["effects"] = [part]
    path = tmp_path / "machine.yaml"
    machine["bus"]["channel"] = str(path)
    path.write_text(yaml.safe_dump(machine), encoding="utf-8")
    first = criticised(path, tmp_path / "first")
    cause = the(first, part["effect"])

    twin = workflow.twin(tmp_path / "first")
    assert all("viscous friction at the load" in sentence for sentence in twin.left_out)
    # What is rebuilt is what was found, not what the first machine's profile says.
    (rebuilt,) = twin.profile.simulation.axes[0].effects
    number = "torque" if part["effect"] == "coulomb_friction" else "time"
    assert getattr(rebuilt, number) != part[number]

    again = criticised(twin.profile.path, tmp_path / "again")
    found = the(again, part["effect"])
    parameter = "torque" if part["effect"] == "coulomb_friction" else "delay"
    value, other = cause.parameters[parameter].value, found.parameters[parameter].value
    assert other == pytest.approx(value, rel=0.1)

    # The model identified on the first machine and that identified on its twin; and, where no friction
    # bends what is measured, the first machine's measured response.
    measured = load_responses(tmp_path / "first" / "frequency-response.h5")[SOLVED]
    f, response, std = measured.element(0, 0)
    first_model, model = (read_model(tmp_path / n / "model.yaml") for n in ("first", "again"))
    own, modelled = (
        np.abs(machine_response(m, 2 * np.pi * f)[:, 0, 0]) for m in (first_model, model)
    )
    assert np.all(np.abs(own - modelled) < SAME * modelled)
    if part["effect"] == "measurement_delay":
        assert np.all(np.abs(np.abs(response) - modelled) < SAME * modelled + 4 * std)
