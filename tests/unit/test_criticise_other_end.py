"""A further mass at motor or load: the same to the motor, and told apart by damping alone."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from fieldtool.criticise.criticise import criticise
from fieldtool.criticise.effects.base import Parameter
from fieldtool.criticise.effects.springs import ExtraMode
from fieldtool.criticise.search.hypothesis import Hypothesis
from fieldtool.criticise.search.machine import Machine
from fieldtool.criticise.search.other_end import at_other_end
from fieldtool.criticise.simulate.structure import Structure
from fieldtool.records.model import AxisModel, Coupling, Estimate, MachineModel
from tests.unit.test_criticise_search import MODEL, recorded

NUMBER = st.floats(0.2, 5.0)


def mode(location, frequency=20.0):
    """A further mass with wide bounds."""
    return ExtraMode(
        0,
        (
            Parameter("mass", "kg m2", 0.0, 0.0, 1e9, 0.1, linear=True),
            Parameter("frequency", "Hz", frequency, 1e-6, 1e9, 0.1),
            Parameter("damping_ratio", "1", 0.0, 0.0, 0.5, 0.01),
        ),
        location,
    )


def chain(masses, springs, dampers=()):
    """A machine of one axis."""
    parts = [tuple(Estimate(float(v)) for v in each) for each in (masses, springs, dampers)]
    return MachineModel((AxisModel("a", "rotary", *parts, Estimate(0.0), Estimate(0.0)),), ())


def held(machine):
    """Squares of circular frequencies with the motor held are its eigenvalues."""
    whole = Structure.of(machine.model)
    return np.linalg.solve(whole.mass[1:, 1:], whole.stiffness[1:, 1:])


def driving_stiffness(structure, omega):
    """Torque at the motor over its motion, without damping: by a plain inverse, line by line."""
    m, k = structure.mass, structure.stiffness
    return np.array([1.0 / np.linalg.inv(k - w * w * m)[0, 0] for w in omega])


@given(
    st.integers(1, 4).flatmap(
        lambda n: st.tuples(
            st.lists(NUMBER, min_size=n + 1, max_size=n + 1),
            st.lists(NUMBER, min_size=n, max_size=n),
        )
    ),
    st.floats(0.01, 1.0),
    st.floats(0.5, 3.0),
    st.sampled_from(["motor", "load"]),
)
def test_the_motor_does_not_tell_both_ends_without_damping(parts, mass, ratio, location):
    masses, springs = parts[0], 1000.0 * np.array(parts[1])
    frequency = ratio * np.sqrt(springs[0] / masses[1]) / (2 * np.pi)
    machine = Machine.of(chain(masses, springs), np.ones(1))
    own = np.sqrt(np.linalg.eigvals(held(machine)).real) / (2 * np.pi)
    assume(np.abs(np.log(own / frequency)).min() > 0.01)  # of two modes alike one has no mass
    values = {"mass": mass, "frequency": frequency, "damping_ratio": 0.0}
    hypothesis = Hypothesis(machine, machine.start, (mode(location),), (values,))
    other = at_other_end(hypothesis)
    assert other is not None
    assert other.effects[-1].location != location
    omega = 2 * np.pi * frequency * np.array([0.13, 0.57, 0.91, 1.37, 2.9, 7.3])
    here, there = (driving_stiffness(h.structure, omega) for h in (hypothesis, other))
    # Near an antiresonance both are large; what the motor feels is then their inverse.
    assert there == pytest.approx(here, rel=1e-6, abs=1e-6 * np.abs(here).max())


@given(st.lists(NUMBER, min_size=3, max_size=3), st.floats(0.01, 0.3), st.floats(0.5, 3.0))
def test_there_and_back_is_the_same_machine(masses, mass, ratio):
    springs = np.array([900.0, 1700.0])
    machine = Machine.of(chain(masses, springs), np.ones(1))
    frequency = ratio * np.sqrt(springs[0] / masses[1]) / (2 * np.pi)
    own = np.sqrt(np.linalg.eigvals(held(machine)).real) / (2 * np.pi)
    assume(np.abs(np.log(own / frequency)).min() > 0.01)
    values = {"mass": mass, "frequency": frequency, "damping_ratio": 0.01}
    begun = Hypothesis(machine, machine.start, (mode("motor"),), (values,))
    back = at_other_end(at_other_end(begun))
    assert back.base == pytest.approx(begun.base, rel=1e-6)
    assert back.values[-1] == pytest.approx(values, rel=1e-6)


def test_a_single_mass_has_no_other_end():
    machine = Machine.of(chain([1.0], []), np.ones(1))
    values = {"mass": 0.1, "frequency": 10.0, "damping_ratio": 0.01}
    hypothesis = Hypothesis(machine, machine.start, (mode("motor"),), (values,))
    assert at_other_end(hypothesis) is None


def test_what_a_coupling_does_not_allow_is_not_tried():
    """Most of the last mass goes behind it: it alone does not bear the coupling that it had."""
    a = chain([1.0, 1.0], [1.0], [0.01]).axes[0]
    machine = MachineModel((a, replace(a, name="b")), (Coupling(("a", "b"), 0.6),))
    start = Machine.of(machine, np.ones(2))
    values = {"mass": 0.03, "frequency": 5.0 / (2 * np.pi), "damping_ratio": 0.01}
    hypothesis = Hypothesis(start, start.start, (mode("motor"),), (values,))
    assert start.physical(start.start)
    assert at_other_end(hypothesis) is None


def test_a_further_mass_is_found_at_the_end_where_it_is(fresh_rng):
    """A good fit with the mass at the motor is not led to the load by small steps."""
    axis = MODEL.axes[0]
    mass, frequency = float(fresh_rng.uniform(0.003, 0.006)), float(fresh_rng.uniform(16.0, 19.0))
    w = 2 * np.pi * frequency
    print("mass", mass, "frequency", frequency)
    longer = replace(
        axis,
        masses=(*axis.masses, Estimate(mass)),
        springs=(*axis.springs, Estimate(mass * w * w)),
        dampers=(*axis.dampers, Estimate(2 * 0.01 * w * mass)),
    )
    alone = replace(MODEL, couplings=())
    recording = recorded(fresh_rng, 0.0, replace(alone, axes=(longer, MODEL.axes[1])))
    first = criticise(recording, alone, alone).criticism.causes[0]
    assert (first.effect, first.axis, first.location) == ("extra_mode", "a", "load")
    assert first.parameters["frequency"].value == pytest.approx(frequency, rel=0.01)
    assert first.parameters["mass"].value == pytest.approx(mass, rel=0.1)
