"""Relatives: what tells them apart has to be in the data before either has a name for sure."""

from dataclasses import replace

import numpy as np
import pytest

from fieldtool.criticise.effects.base import Mark
from fieldtool.criticise.effects.torque import torque_candidates
from fieldtool.criticise.search.fit import fit
from fieldtool.criticise.search.marks import Reading, readings
from fieldtool.criticise.search.prepare import prepare, reweighted
from fieldtool.criticise.search.search import settled
from fieldtool.criticise.simulate.inverse import passed_on
from fieldtool.criticise.simulate.structure import Structure
from tests.unit.test_criticise_search import FINE, MODEL, STEP, recorded


def lagging(recording, time):
    """The drive reports what its current loop follows: the torque of the lag's equation, run backwards.

    The shaft's torque is the reported one through a first-order lag, so the report leads by its inverse;
    made here in frequency, whole periods at a time.
    """

    def led(torque):
        rows = torque.shape[0]
        s = 2j * np.pi * np.fft.rfftfreq(rows, STEP)
        return np.fft.irfft(np.fft.rfft(torque) * (1 + s * time), rows)

    def changed(e):
        torque = e.torque.copy()
        torque[:, 1] = led(torque[:, 1])
        return replace(e, torque=torque)

    return replace(recording, experiments=tuple(changed(e) for e in recording.experiments))


def read(recording, kind, other):
    """What a fit with an effect shows of the mark against its relative."""
    prepared, before = settled(*_started(prepare(recording, MODEL)))
    context = prepared.context(before.hypothesis)
    (effect,) = [e for e in torque_candidates(context) if (e.name, e.axis) == (kind, 1)]
    found = fit(prepared.simulator, before.hypothesis.with_effect(effect))
    prepared = reweighted(prepared, found.hypothesis)
    found = fit(prepared.simulator, found.hypothesis)
    (reading,) = readings(prepared, found, effect, {other})
    return reading


def _started(prepared):
    return prepared, prepared.start


def test_only_the_cause_shows_its_own_mark(fresh_rng):
    """A delay or a lag, looked at as either.

    Looked at as what it is not, more than noise is left, and the number beside it may be anything: it
    is not sure.  Looked at as what it is, it is near 0.
    """
    time = float(fresh_rng.integers(8, 14)) * STEP / FINE
    kinds = ("measurement_delay", "torque_lag")
    truth = str(fresh_rng.choice(kinds))
    late = truth == "measurement_delay"
    recording = recorded(fresh_rng, time) if late else lagging(recorded(fresh_rng, 0.0), time)
    for kind, other in (kinds, kinds[::-1]):
        reading = read(recording, kind, other)
        assert reading.shown != ("its relative's" if kind == truth else "its own"), (truth, reading)
        assert kind != truth or abs(reading.number) < 0.5, (truth, reading)
        assert kind == truth or not reading.sure or reading.number > 0.5, (truth, reading)


@pytest.mark.parametrize(
    ("number", "std", "special", "shown"),
    [
        (0.1, 0.02, False, "its own"),
        (0.1, 0.2, False, "neither"),
        (0.9, 0.2, False, "neither"),
        (0.9, 0.02, False, "its relative's"),
        (0.5, 0.02, False, "neither"),  # known well, and of another kind
        (0.9, 0.2, True, "its own"),  # a special case keeps its name until the number is not 0
        (0.4, 0.01, True, "its own"),  # not 0, but of no size
        (0.9, 0.05, True, "its relative's"),
        (-3.0, 0.05, True, "its own"),
    ],
)
def test_whose_mark_is_shown_follows_from_number_and_standard_error(number, std, special, shown):
    mark = Mark("other", "what tells", "number", 1.0, special=special)
    assert Reading(mark, number, std).shown == shown
    assert special or Reading(mark, number, std, sure=False).shown == "neither"
    if special and abs(number) > 0.5 and abs(number) > 5 * std:
        either = replace(mark, either_sign=True, or_else="a zero that is off")
        assert Reading(either, number, std).shown == "neither"


def test_a_torque_at_the_last_mass_is_passed_on_as_springs_and_couplings_say(fresh_rng):
    """Against the response of the free machine: motors that hold still answer what would move them."""
    structure = Structure.of(MODEL)
    omega = 2 * np.pi * float(fresh_rng.uniform(2.0, 60.0))
    whole = structure.stiffness + 1j * omega * structure.damping - omega**2 * structure.mass
    response = np.linalg.inv(whole)
    motors = structure.motors
    for axis in range(2):
        moved = response[motors, structure.ends[axis]]
        needed = -np.linalg.solve(response[np.ix_(motors, motors)], moved)
        passed = passed_on(structure, omega)[:, axis]
        assert np.abs(needed - passed).max() < 1e-3 * max(np.abs(needed).max(), 1e-3)
