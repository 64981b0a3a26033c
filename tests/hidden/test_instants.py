"""A spring that changes within what no fit sees: named, and the instant told by all data."""

import numpy as np
import pytest

from drives.sim.effects import StiffnessChange
from fieldtool.criticise.criticise import criticise
from fieldtool.criticise.search.instants import tried_unseen
from fieldtool.criticise.search.significance import Comparison
from tests.hidden.hiding import built_in
from tests.hidden.plant_recordings import random_machine, record

STARTED, PAUSE, LENGTH = 1.0, 1.0, 20.0
"""s: the plant runs before the first experiment, and between two of them; and that of one."""


def test_a_change_that_no_fit_sees_has_the_instant_of_unseen_data(fresh_rng):
    rng = fresh_rng
    into = float(rng.uniform(7.0, 17.0))
    factor = float(rng.uniform(0.8, 0.9))
    print("factor", factor, "into the second experiment", into, "s")
    moment = STARTED + LENGTH + PAUSE + into
    for _ in range(5):  # others may be kept unseen, and one in sixteen changes is not found
        machine = next(
            m
            for m in iter(lambda: random_machine(rng, 1), None)
            if len(m.plant.chains[0].masses) == 2
        )
        changed = built_in(machine, [(0, StiffnessChange(factor, moment, 0.05, 1))])
        recording = record(changed, int(rng.integers(2**31)))
        criticised = criticise(recording, machine.model, machine.model)
        found = criticised.criticism
        if "multisine 2" in found.held_out.experiments and found.causes:
            break
    assert found.held_out.experiments == ("multisine 2", "multisine 4")
    first = found.causes[0]
    assert (first.effect, first.axis) == ("stiffness_change", "axis1")
    assert first.parameters["change"].value == pytest.approx(factor - 1.0, rel=0.1)
    assert first.parameters["time"].value == pytest.approx(LENGTH + into, abs=0.5)
    assert np.all(np.array([e.torque for e in found.held_out.error_after.values()]) < 0.03)
    # Twenty instants of the second experiment, and forty around the best: each might do it by chance.
    search = criticised.found
    effect = search.accepted[0].tried.effect
    assert tried_unseen(search.prepared.simulator, search.after.hypothesis, effect) == 62


def test_the_best_of_many_is_less_sure():
    one = Comparison(2.0, 1.0, 5.0, 1e-5, 60)
    assert one.best_of(62).p == pytest.approx(62e-5)
    assert one.best_of(10**6).p == 1.0
    assert one.best_of(1) == one
