"""A light mass on a lightly damped spring is found wherever its narrow peak is; shares of noise."""

from dataclasses import replace

import numpy as np
import pytest

from fieldtool.criticise.criticise import criticise
from fieldtool.criticise.evidence.lines import NO_NOISE
from fieldtool.criticise.search.prepare import prepare
from fieldtool.records.model import Estimate
from tests.unit.test_criticise_search import MODEL, numbers, recorded

ALONE = replace(MODEL, couplings=())
"""Two axes that know nothing of each other."""


def with_absorber(mass, frequency, damping):
    """The second axis as a chain of two masses, the last of which the model lacks."""
    w = 2 * np.pi * frequency
    axis = ALONE.axes[1]
    chain = replace(
        axis,
        masses=(*axis.masses, Estimate(mass)),
        springs=numbers(mass * w * w),
        dampers=numbers(2 * damping * w * mass),
    )
    return replace(ALONE, axes=(ALONE.axes[0], chain))


def test_a_narrow_peak_is_found_between_any_frequencies(fresh_rng):
    mass, frequency = float(fresh_rng.uniform(5e-4, 2e-3)), float(fresh_rng.uniform(5.0, 18.0))
    damping = float(fresh_rng.uniform(0.008, 0.02))
    print("mass", mass, "frequency", frequency, "damping", damping)
    recording = recorded(fresh_rng, 0.0, with_absorber(mass, frequency, damping))
    first = criticise(recording, ALONE, ALONE).criticism.causes[0]
    assert (first.effect, first.axis, first.location) == ("extra_mode", "b", "motor")
    assert first.parameters["frequency"].value == pytest.approx(frequency, rel=0.02)
    assert first.parameters["mass"].value == pytest.approx(mass, rel=0.1)


def test_periods_that_differ_in_one_experiment_are_no_noise(fresh_rng):
    quiet = recorded(fresh_rng, 0.0)
    experiments = list(quiet.experiments)
    loud = experiments[1]
    burst = 0.3 * fresh_rng.normal(size=loud.torque.shape)
    experiments[1] = replace(loud, torque=loud.torque + burst)
    lines = prepare(replace(quiet, experiments=tuple(experiments)), MODEL).simulator.lines
    power = [np.sum(np.abs(one.raw(one.motion.torque)) ** 2, axis=0) for one in lines]
    for k in range(2):
        granted = NO_NOISE * max(1.0, power[1][k] / power[0][k])
        assert np.all(lines[1].noise[:, k] <= 1.001 * granted * lines[0].noise[:, k])
    # Without its neighbours the burst would all be noise.
    alone = prepare(replace(quiet, experiments=(experiments[1],)), MODEL).simulator.lines
    assert np.median(alone[0].noise) > 20 * NO_NOISE * np.median(lines[1].noise)
