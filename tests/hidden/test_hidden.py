"""Something hidden is found by name; nothing hidden gets no name.  Seeds are fresh and printed.

The plant has its own formulas (:mod:`drives.sim.effects`), the library that finds has others
(:mod:`fieldtool.criticise.effects`); an import contract keeps them apart.  How often each is found
at which size is measured by ``tests/benchmarks/bench_hidden.py``; here a few cases say that it works.
"""

from copy import deepcopy

import numpy as np
import pytest
import yaml

from drives.profile import load_machine
from fieldtool import workflow
from fieldtool.criticise.criticise import criticise
from fieldtool.errors import IdentificationError
from tests.hidden.hiding import MAKERS, OF_TWO, draw
from tests.hidden.scoring import cause_of, is_of, numbers, tie_with
from tests.session.conftest import one_axis

CLEAR = 40.0
"""Times the noise floor."""
KINDS = (
    {"effect": "coulomb_friction", "torque": (0.1, 0.3)},
    {"effect": "cogging", "torque": (0.1, 0.3), "periods": 24},
    {"effect": "torque_saturation", "torque": (1.8, 2.0)},
)
"""Effects of a profile, with ranges of their size, N m.

A motor that is cut off at less winds its loop up to the torque limit, and the measurement is stopped; at
more, the plan's torques are hardly cut off.
"""


def found(seed, effect):
    """Whether the effect stands first, or in a tie with the experiment that would tell; and numbers."""
    case = draw(seed, (effect,), CLEAR, axes=2 if effect in OF_TWO else 1)
    model = case.machine.model
    criticism = criticise(case.recording, model, model).criticism
    hidden = case.hidden[0]
    print(seed, effect, [(c.effect, c.axis) for c in criticism.causes], criticism.verdict)
    first = criticism.causes[0] if criticism.causes else None
    right = first is not None and (
        is_of(hidden, first.effect, first.axis) or tie_with(hidden, first)
    )
    held = criticism.held_out
    before = sum(e.torque**2 for e in held.error_before.values())
    after = sum(e.torque**2 for e in held.error_after.values())
    assert after <= before  # nothing is adopted that makes unseen data worse
    cause = cause_of(hidden, criticism)
    told = numbers(case, hidden, cause).values() if cause else ()
    return right, [n.right for n in told]


def test_what_is_hidden_is_named_first(fresh_rng):
    effects = ["measurement_delay", *fresh_rng.choice(list(MAKERS), 2, replace=False)]
    results = [found(int(fresh_rng.integers(2**31)), str(effect)) for effect in effects]
    # Of the benchmark's cases some 3 % are missed: two of three are once in 370 runs.
    assert sum(right for right, _ in results) >= 2
    assert not results[0][0] or all(
        results[0][1]
    )  # a delay's size is always right where it is found


def test_a_relative_is_no_sure_cause_of_what_the_library_lacks(fresh_rng):
    effect = str(fresh_rng.choice(["measurement_delay", "torque_lag"]))
    case = draw(int(fresh_rng.integers(2**31)), (effect,), CLEAR, axes=1)
    model = case.machine.model
    criticism = criticise(case.recording, model, model, frozenset({effect})).criticism
    print(case.seed, effect, [c.effect for c in criticism.causes], criticism.unexplained)
    assert criticism.verdict in ("unexplained", "partly explained")
    assert criticism.unexplained


def test_nothing_hidden_gets_no_name(fresh_rng):
    named = []
    for _ in range(2):
        case = draw(int(fresh_rng.integers(2**31)), ())
        criticism = criticise(case.recording, case.machine.model, case.machine.model).criticism
        print(case.seed, [c.effect for c in criticism.causes], criticism.verdict)
        named.append(bool(criticism.causes))
    assert not all(named)  # each by chance in 2 % at most: both once in 2500 runs


def test_the_whole_tool_finds_it_over_the_bus(tmp_path, fresh_rng):
    part = dict(KINDS[fresh_rng.integers(len(KINDS))])
    part["torque"] = float(fresh_rng.uniform(*part["torque"]))
    print("hidden", part)
    machine = deepcopy(one_axis())
    machine["simulation"]["seed"] = int(fresh_rng.integers(1000))
    machine["simulation"]["axes"][0]["effects"] = [part]
    path = tmp_path / "machine.yaml"
    machine["bus"]["channel"] = str(path)
    path.write_text(yaml.safe_dump(machine), encoding="utf-8")
    workflow.measure(load_machine(path), tmp_path / "session")
    told = ""
    try:
        workflow.identify(tmp_path / "session")
    except IdentificationError as error:  # cut off so far that no machine is left in the data
        told = " ".join(error.__notes__)
    if told:
        assert part["effect"] == "torque_saturation"
        assert "gives less torque than its drive tells" in told
        return
    criticism = workflow.criticise(tmp_path / "session").criticism
    first = criticism.causes[0]
    assert first.effect == part["effect"] or part["effect"] in {t.effect for t in first.ties}
    held = criticism.held_out
    (axis,) = held.error_before
    assert held.error_after[axis].torque < held.error_before[axis].torque
    if first.effect == "coulomb_friction":
        assert first.parameters["torque"].value == pytest.approx(part["torque"], rel=0.1)
    assert np.isfinite(first.chance)
