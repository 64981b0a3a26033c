"""The trial of loops through the bus, and its watch: an oscillation is stopped within 50 ms."""

import signal
import struct
from dataclasses import dataclass, replace
from unittest.mock import patch

import numpy as np
import pytest

from drives.errors import OscillationError, SafetyStopError, UserStopError
from drives.sim.faults import Fault, MotorReversed
from drives.sim.firmware import Parameter
from fieldtool.experiment.axes import Axes
from fieldtool.experiment.verification.steps import Steps
from fieldtool.experiment.verification.trial import HOLD_TIME, Trial, TrialMove, run_trial
from fieldtool.experiment.verification.watch import TrialWatch

STEP = 0.001
TABLE, ARM = 11, 12


@dataclass(frozen=True)
class Gains(Fault):
    """A loop's gains become so many times larger, in the drive itself."""

    factor: float = 1.0
    parameters: tuple[Parameter, ...] = (Parameter.VELOCITY_P, Parameter.VELOCITY_I)

    def set(self, machine, *, present):
        k = machine.node(self.node_id).axis
        for parameter in self.parameters:
            factor = self.factor if present else 1 / self.factor
            machine.axes.set(k, parameter, machine.axes.get(k, parameter) * factor)


def move(axis, distance, seconds, torque):
    u = np.arange(round(seconds / STEP) + 1) * STEP / seconds
    reference = distance * u**3 * (10 - 15 * u + 6 * u * u)
    return TrialMove(axis, reference, round(0.5 / STEP), np.array(torque), 0.2)


def trial():
    moves = (move(0, 0.5, 0.5, [3.0, 3.0]), move(1, -0.5, 0.5, [3.0, 3.0]))
    return Trial(STEP, moves, None, np.zeros(2), np.zeros(2))


def axes_of(group):
    counts = np.array([drive.scaling.position for drive in group.drives])
    limits = tuple(drive.limits for drive in group.drives)
    return Axes(group.axes, limits, np.zeros(2), ("rad", "rad"), counts)


def try_it(bench, kept, stop=lambda: False, trusts_loops=False):
    with bench.connected(stop) as group:
        return run_trial(
            group, trial(), axes_of(group), kept.append, "after", trusts_loops=trusts_loops
        )


class Observer:
    """Hears every statusword and torque on the bus, by virtual time: what really happened, and when."""

    def __init__(self, bench):
        self.rows, self._machine, self.start = [], bench.machine, bench.machine.sync_count
        bench.machine.listen(self)

    def __call__(self, time, cob_id, data):
        if 0x180 < cob_id < 0x200 and len(data) == 8:
            statusword, _, torque = struct.unpack("<Hih", data)
            enabled = statusword & 0x6F == 0x27
            count = self._machine.sync_count
            self.rows.append((1e-9 * time, cob_id - 0x180, enabled, 0.004 * torque, count))

    def off_at(self):
        """When the last drive lost its power, s."""
        return max(t for t, _, enabled, *_ in self.rows if enabled)

    def torque(self, node, after, healthy):
        """Times of a drive's torques since so many SYNCs, and what they are beside those of a healthy
        trial, (n,) each: what the fault does, without what is commanded."""
        found = {}
        for one in (self, healthy):
            rows = [(c - one.start, t, torque) for t, n, _, torque, c in one.rows if n == node]
            found[one] = {count: (t, torque) for count, t, torque in rows}
        both = sorted(c for c in found[self] if c > after and c in found[healthy])
        times = np.array([found[self][c][0] for c in both])
        return times, np.array([found[self][c][1] - found[healthy][c][1] for c in both])

    @staticmethod
    def began(times, torques, level, window=0.1):
        """When the torque first swung by so much within a short time, s; None: never."""
        width = round(window / STEP)
        for k in range(times.size):
            if np.ptp(torques[max(0, k - width) : k + 1]) >= level:
                return times[k]
        return None

    @staticmethod
    def period(times, torques, level):
        """The longest period of the torque's turns by at least half a level, s; 0 with less than two."""
        turns, extreme, rising = [], 0, None
        for k, torque in enumerate(torques):
            back = torque - torques[extreme]
            if rising is None and abs(back) > level / 2:
                rising = back > 0
            if rising is not None and abs(back) > level / 2 and (back > 0) != rising:
                turns.append(times[extreme])
                rising, extreme = not rising, k
            elif rising is not None and (back > 0) == rising:
                extreme = k
        return 2 * max(np.diff(turns), default=0.0)


def test_good_loops_stand_the_trial_and_everything_is_recorded(bench):
    kept = []
    tried = try_it(bench, kept)
    assert [e.name for e in kept] == ["after: move of table", "after: move of arm"]
    assert all(e.complete for e in kept)
    for k, name in enumerate(("table", "arm")):
        found = tried.move(name)
        away = found.position[:, k] - found.position[0, k]
        assert abs(away[np.argmax(np.abs(away))]) == pytest.approx(0.5, rel=0.1)
        assert abs(away[-1]) < 0.01
    assert np.all(tried.noise < 0.5)
    assert bench.powered() == {}
    assert bench.changed() == {}


def test_ctrl_c_while_the_trial_is_saved_waits_for_the_last(bench):
    kept = []

    def keep(experiment):
        signal.raise_signal(signal.SIGINT)
        kept.append(experiment.name)

    with bench.connected() as group, pytest.raises(KeyboardInterrupt):
        run_trial(group, trial(), axes_of(group), keep, "after", trusts_loops=False)
    assert kept == ["after: move of table", "after: move of arm"]
    assert bench.powered() == {}


@pytest.mark.parametrize("trusts_loops", [False, True])
def test_a_person_who_stops_a_trial_gets_the_power_cut_at_once(bench, trusts_loops):
    """New loops are no brake: a quick stop is left only to those that are known."""
    asked = []
    receive = bench.machine.receive

    def heard(cob_id, data):
        if 0x200 < cob_id < 0x280:
            asked.append(struct.unpack("<H", data[:2])[0])
        return receive(cob_id, data)

    begun = bench.machine.sync_count
    with patch.object(bench.machine, "receive", heard), pytest.raises(UserStopError):
        try_it(bench, [], lambda: bench.machine.sync_count > begun + 900, trusts_loops)
    assert bench.powered() == {}
    assert bench.changed() == {}
    assert any(word & 0xF == 0xF for word in asked)
    assert any(word & 0x6 == 0x2 for word in asked) == trusts_loops, "a quick stop"


def disaster(bench, fault, after):
    """Bring a fault about so many SYNCs after the bus was opened; return error, observer, records."""
    observer, kept = Observer(bench), []
    bench.inject(fault, sync=bench.machine.sync_count + after)
    with pytest.raises(SafetyStopError) as stopped:
        try_it(bench, kept)
    assert bench.powered() == {}
    bench.machine.lift(fault)
    assert bench.changed() == {}, "and nothing temporary is left in the drives"
    return stopped.value, observer, kept


IN_HOLD, IN_NUDGE, BEFORE_MOVE, IN_MOVE = 300, 1200, 4500, 4800
SWINGING = {
    "velocity loop far too hard": (100.0, (Parameter.VELOCITY_P, Parameter.VELOCITY_I)),
    "position and integral too hard": (20.0, (Parameter.POSITION_P, Parameter.VELOCITY_I)),
    "integral far too hard": (400.0, (Parameter.VELOCITY_I,)),
}


@pytest.mark.parametrize("after", [1, IN_HOLD, IN_NUDGE, BEFORE_MOVE, IN_MOVE])
@pytest.mark.parametrize("how", SWINGING)
def test_an_oscillation_that_starts_is_stopped_within_50_ms(bench, how, after):
    """From where the torque swings by a tenth of its limit (a fifth in a move), peak to peak, beside
    that of a healthy trial, until no drive has power; slow ones have one and a half (in a move two and
    a half) of the periods that are seen on the bus.  Some are stopped before they swing by so much."""
    factor, parameters = SWINGING[how]
    healthy = Observer(bench)
    try_it(bench, [])
    error, observer, kept = disaster(bench, Gains(TABLE, factor, parameters), after)
    assert isinstance(error, OscillationError), error
    assert error.axis == "table"
    level, periods = (0.2 * 6.0, 2.5) if after >= BEFORE_MOVE else (0.1 * 6.0, 1.5)
    times, torques = observer.torque(TABLE, after, healthy)
    assert observer.began(times, torques, level / 2) is not None, "the fault does something"
    began, period = observer.began(times, torques, level), observer.period(times, torques, level)
    if began is None:
        assert np.ptp(torques[-round(0.1 / STEP) :]) < level
    else:
        assert observer.off_at() - began <= max(0.05, periods * period), f"{period} s: {error}"
    assert kept, "what was measured until then is kept"
    assert not kept[-1].complete
    assert kept[-1].note
    assert all(e.complete for e in kept[:-1])


@pytest.mark.parametrize("factor", [0.1, 0.15, 0.2])
def test_a_loop_that_swings_slowly_goes_little_beyond_what_is_foreseen(bench, factor):
    """A velocity loop that is too soft swings at some 4 Hz, as slowly as the quick move itself turns."""
    quick = replace(
        move(0, 0.8, 0.45, [5.8, 5.8]), half_period=0.06, swings=(0.6, 0.02), astray=0.05
    )
    one = Trial(STEP, (quick,), None, np.zeros(2), np.zeros(2))
    kept, fault = [], Gains(TABLE, factor, (Parameter.VELOCITY_P,))
    bench.inject(fault, sync=bench.machine.sync_count + 2500)
    with bench.connected(lambda: False) as group, pytest.raises(OscillationError) as stopped:
        run_trial(group, one, axes_of(group), kept.append, "after", trusts_loops=False)
    assert stopped.value.axis == "table"
    bench.machine.lift(fault)
    assert bench.powered() == {}
    (made,) = kept
    ways = np.sign(quick.distance) * (made.position[:, 0] - made.position_reference[0, 0])
    assert ways.min() > -0.15
    assert ways.max() < 0.8 + 0.15


@pytest.mark.parametrize("after", [1, IN_HOLD, IN_NUDGE, IN_MOVE])
def test_a_loop_of_the_wrong_sign_is_stopped_while_it_has_hardly_moved(bench, after):
    error, observer, _ = disaster(bench, MotorReversed(ARM), after)
    assert isinstance(error, OscillationError), error
    assert error.axis == "arm"
    torques = [abs(torque) for _, node, _, torque, _ in observer.rows if node == ARM]
    assert max(torques) < 4.0, "it was stopped below its limit of 6 N m"


def test_ctrl_c_ends_a_trial_with_all_drives_off(bench):
    asked = 0

    def stop():
        nonlocal asked
        asked += 1
        return asked > 1500

    with pytest.raises(UserStopError):
        try_it(bench, [], stop)
    assert bench.powered() == {}
    assert bench.changed() == {}


@pytest.mark.parametrize(("hidden", "asked"), [(0, 1), (2, 3), (9, 4)])
def test_a_first_answer_that_late_cycles_hid_is_asked_for_again(bench, hidden, asked):
    probe = np.repeat([1.0, 2.0, 1.0, 0.0], 5) * 2 * np.pi / 2**20
    streams, unseen = [], iter([False] * hidden)
    with bench.connected() as group:
        axes = axes_of(group)
        one = replace(trial().moves[0], probe=probe, answer=1.0)
        stream = Steps._stream

        def noted(self, path, k, name, **more):
            streams.append(path.copy())
            return stream(self, path, k, name, **more)

        with (
            patch.object(Steps, "_stream", noted),
            patch.object(TrialWatch, "saw", lambda *_: next(unseen, True)),
        ):
            again = replace(trial(), moves=(one,))
            run_trial(group, again, axes, lambda _: None, "after", trusts_loops=True)
    answers = [path for path in streams if np.abs(path).max() < 1e-4]
    assert len(answers) == asked
    assert all(np.count_nonzero(path) == np.count_nonzero(probe) for path in answers)


def test_the_trial_holds_before_it_moves(bench):
    """Nothing is commanded before all axes have stood still."""
    bench.listen()
    try_it(bench, [])
    targets = {}
    for frame in bench.heard():
        if frame.cob_id in (0x200 + TABLE, 0x200 + ARM):
            word, target, _ = struct.unpack("<Hih", frame.data)
            if word == 0x0F:
                targets.setdefault(frame.cob_id, []).append(target)
    for sent in targets.values():
        assert len(set(sent[: round(HOLD_TIME / STEP)])) == 1
        assert len(set(sent)) > 100
