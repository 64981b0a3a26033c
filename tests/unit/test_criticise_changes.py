"""What changed of a machine since it was last accepted: nothing that did is called unchanged."""

from dataclasses import replace

import pytest

from fieldtool.criticise.changes import change_sentences
from fieldtool.records.model import AxisModel, Coupling, Estimate, MachineModel


def sure(*values):
    return tuple(Estimate(v, 0.001 * v) for v in values)


def chain(name, masses, springs, dampers=(), kind="rotary", load=0.0):
    return AxisModel(
        name, kind, sure(*masses), sure(*springs), sure(*dampers), load_friction=Estimate(load)
    )


TABLE = chain("table", (0.04, 0.01), (100.0,), (0.1,))


@pytest.mark.parametrize(
    ("was", "now", "sentence"),
    [
        (TABLE, TABLE, "table: unchanged since it was last accepted."),
        (
            TABLE,
            chain("table", (0.02, 0.01, 0.09), (300.0, 50.0), (0.1, 0.1)),
            "table: 2 masses -> 3; total inertia 0.05 -> 0.12 kg m2.",
        ),
        (TABLE, chain("table", (0.05,), ()), "table: 2 masses -> 1."),
        (
            chain("arm", (5.0,), (), kind="linear"),
            replace(chain("arm", (4.0, 2.0), (9e3,), kind="linear", load=3.0)),
            "arm: 1 mass -> 2; total mass 5 -> 6 kg, load friction 0 -> 3 N s/m.",
        ),
        (
            TABLE,
            replace(TABLE, load_friction=Estimate(0.2, 0.01)),
            "table: load friction 0 -> 0.2 N m s/rad; mass 1, mass 2, spring 1 unchanged.",
        ),
        (
            replace(TABLE, load_friction=Estimate(0.2, 0.01)),
            replace(TABLE, load_friction=Estimate(0.22, 0.02)),
            "table: unchanged since it was last accepted.",
        ),
        (
            TABLE,
            chain("table", (0.04, 0.02), (100.0,), (0.1,)),
            "table: mass 2 0.01 -> 0.02 kg m2; mass 1, spring 1 unchanged.",
        ),
    ],
)
def test_a_chain_is_unchanged_where_all_of_it_is(was, now, sentence):
    assert change_sentences(MachineModel((was,)), MachineModel((now,))) == (sentence,)


def test_all_numbers_by_one_factor_are_a_wrong_scale_of_the_torque():
    now = chain("table", (0.08, 0.02), (200.0,), (0.1,))
    (sentence,) = change_sentences(MachineModel((TABLE,)), MachineModel((now,)))
    assert "by the same factor of 2: as of a wrong scale of the torque" in sentence


@pytest.mark.parametrize(
    ("was", "now", "words"),
    [
        ((0.02, 1e-4), None, ["a - b: coupling 0.02 -> 0 kg m2."]),
        (None, (0.02, 1e-4), ["a - b: coupling 0 -> 0.02 kg m2."]),
        ((0.02, 1e-4), (0.03, 1e-4), ["a - b: coupling 0.02 -> 0.03 kg m2."]),
        ((0.02, 1e-4), (0.02, 1e-4), []),
        ((0.02, 0.01), None, []),
    ],
    ids=["gone", "new", "larger", "the same", "was not known"],
)
def test_a_coupling_that_is_gone_is_a_change(was, now, words):
    axes = chain("a", (0.04,), ()), chain("b", (0.05,), ())

    def machine(held, pair):
        return MachineModel(axes, (Coupling(pair, *held),) if held else ())

    sentences = change_sentences(machine(was, ("a", "b")), machine(now, ("a", "b")))
    assert list(sentences[2:]) == words
    turned = change_sentences(machine(was, ("a", "b")), machine(now, ("b", "a")))
    assert len(turned) == len(sentences)


def test_a_coupling_of_a_turning_and_a_sliding_axis_is_in_kg_m():
    axes = chain("a", (0.04,), ()), chain("b", (5.0,), (), kind="linear")
    held = MachineModel(axes, (Coupling(("a", "b"), 0.02, 1e-4),))
    assert change_sentences(held, MachineModel(axes))[-1] == "a - b: coupling 0.02 -> 0 kg m."
