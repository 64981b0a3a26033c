"""Whatever goes wrong while axes move: all of them are stopped, within 3 cycles, and data are kept."""

import struct
from dataclasses import dataclass

import numpy as np
import pytest

from drives.errors import SafetyStopError
from drives.sim.faults import (
    DriveFault,
    EmergencyOnly,
    EncoderStuck,
    Fault,
    MotorReversed,
    NodeVanishes,
    NoTransmitPdos,
    PowerLoss,
)

TABLE, ARM = 11, 12
COUNTS = 2**20 / (2 * np.pi)
QUICK_STOP, DISABLE = 0x02, 0x00


@dataclass(frozen=True)
class NoMoreHeartbeats(Fault):
    """The node's heartbeat stays away, all else works."""

    def set(self, machine, *, present):
        machine.node(self.node_id).heartbeat.start(0)


@dataclass(frozen=True)
class Pushed(Fault):
    """Something hits the axis: its motor has another speed all at once."""

    speed: float = 0.0

    def set(self, machine, *, present):
        state = machine.axes._state  # its own: set_state refuses while axes are on
        motor = machine.axes.plant.motors[machine.node(self.node_id).axis]
        state[state.size // 2 + motor] += self.speed


@dataclass(frozen=True)
class PdosComeBack(Fault):
    def set(self, machine, *, present):
        machine.node(self.node_id).pdo.muted = False


def reaction(frames, violated_at):
    """Return for each axis how many SYNCs after ``violated_at`` the stop command acts."""
    cycles = {}
    for node in (TABLE, ARM):
        first = next(
            f
            for f in frames
            if f.cob_id == 0x200 + node
            and f.sync >= violated_at
            and struct.unpack_from("<H", f.data)[0] in (QUICK_STOP, DISABLE)
        )
        cycles[node] = first.sync + 1 - violated_at
    return cycles


MID_SWEEP = [
    (NodeVanishes(TABLE), "table: node 11 sent no PDO for 2 cycles", "cable", 3),
    (NodeVanishes(ARM), "arm: node 12 sent no PDO for 2 cycles", "cable", 3),
    (NoTransmitPdos(ARM), "arm: node 12 sent no PDO for 2 cycles", "cable", 3),
    (EmergencyOnly(ARM), "arm: node 12 reports emergency 0x4210 (device temp", "cause", 3),
    (DriveFault(TABLE), "table: node 11 reports emergency 0x2310", "cause", 3),
    (DriveFault(ARM, 0x8611), "arm: node 12 reports emergency 0x8611 (following", "cause", 3),
    (PowerLoss(TABLE), "table: node 11 left NMT operational (it rebooted)", "supply", 3),
    (NoMoreHeartbeats(ARM), "arm: node 12 sent no heartbeat for 0.35 s", "supply", 355),
    (Pushed(TABLE, 20.0), "table: ", "above the limit", 3),
    (EncoderStuck(TABLE), "table: stands ", "its encoder does not count", 100),
    (MotorReversed(TABLE), "table: ", "", 400),
]


@pytest.mark.parametrize(
    ("fault", "sentence", "advice", "within"), MID_SWEEP, ids=lambda v: str(v)[:24]
)
def test_trouble_in_a_sweep_stops_every_axis(bench, fault, sentence, advice, within):
    bench.in_sweep.append((fault, 0))
    bench.listen()
    outcome = bench.measure()
    assert outcome.code == 4, outcome.err
    assert sentence in outcome.err
    assert advice in outcome.err
    assert "all axes were stopped" in outcome.err
    frames = bench.heard()
    cycles = reaction(frames, bench.mid_sweep)
    assert max(cycles.values()) <= within, cycles
    assert len(set(cycles.values())) == 1, f"both axes in the same cycle: {cycles}"
    if isinstance(fault, NodeVanishes):  # nobody can tell it: its heartbeat consumer does
        bench.machine.advance_to(bench.machine.time + 1_000_000_000)
        assert "could not be put back" in outcome.err
        assert "Switch the drive off and on" in outcome.err
        other = {TABLE: ARM, ARM: TABLE}[fault.node_id]
        assert not [f for f in frames if f.cob_id == 0x80 + other], (
            "the host's heartbeat went on while the lost one was waited for"
        )
    assert bench.powered() == {}
    recording = bench.recording()
    assert [e.complete for e in recording.experiments] == [True, True, False]
    assert recording.experiments[-1].samples > 1000
    assert sentence in recording.experiments[-1].note
    gone = (fault.node_id,) if isinstance(fault, NodeVanishes | PowerLoss) else ()
    assert bench.changed(*gone) == {}


def test_a_drive_in_fault_state_without_emergency_stops_the_sweep(bench, monkeypatch):
    node = bench.machine.node(ARM)
    monkeypatch.setattr(node.emergency, "report", lambda *_: None)
    bench.in_sweep.append((DriveFault(ARM), 0))
    outcome = bench.measure()
    assert outcome.code == 4
    assert "arm: the drive left operation enabled: statusword 0x" in outcome.err
    assert "fault" in outcome.err
    assert bench.powered() == {}


@pytest.mark.parametrize("watches", [True, False])
def test_a_motor_that_turns_around_in_mid_sweep_is_cut_off(make_bench, watches):
    """Also where the drive itself does not watch its following error."""
    bench = make_bench(objects={} if watches else {TABLE: {(0x6065, 0): 2**32 - 1}})
    bench.in_sweep.append((MotorReversed(TABLE), 0))
    bench.listen()
    assert bench.measure().code == 4
    frames = bench.heard()
    stopped = bench.mid_sweep + reaction(frames, bench.mid_sweep)[TABLE]
    rows = _inputs(frames, TABLE)
    speeds = np.abs(_speeds(frames, TABLE))
    at_stop = speeds[np.searchsorted(rows[1:, 0], stopped)]
    assert at_stop < 10.5
    assert speeds.max() < 1.6 * at_stop + 2.5, f"{speeds.max():.2f} after {at_stop:.2f} rad/s"
    on = np.isin(rows[:, 1] & 0x6F, (0x27, 0x07)) | (rows[:, 1] & 0x4F == 0x0F)
    powered = int(rows[on, 0].max()) - stopped
    assert powered < 60, f"under power for {powered} cycles more"


# --- the direction check -------------------------------------------------------------------------


def _inputs(frames, node):
    rows = [(f.sync, *struct.unpack("<Hih", f.data)) for f in frames if f.cob_id == 0x180 + node]
    return np.array(rows)


def _speeds(frames, node, *, powered_only=False, cycle=0.001):
    rows = _inputs(frames, node)
    speed = np.diff(rows[:, 2]) / COUNTS / (np.diff(rows[:, 0]) * cycle)
    on = (rows[1:, 1] & 0x6F == 0x27) | (rows[1:, 1] & 0x6F == 0x07)
    return speed[on] if powered_only else speed


@pytest.mark.parametrize("node", [TABLE, ARM])
def test_an_axis_that_moves_the_wrong_way_is_stopped_at_once(bench, node):
    name = {TABLE: "table", ARM: "arm"}[node]
    bench.inject(MotorReversed(node))
    bench.listen()
    outcome = bench.measure()
    assert outcome.code == 4
    assert f"{name}: " in outcome.err
    assert "the wrong way" in outcome.err
    assert "motor's phases" in outcome.err
    frames = bench.heard()
    rows = _inputs(frames, node)
    on = rows[:, 1] & 0x6F == 0x27
    travelled = np.abs(rows[on, 2] - rows[0, 2]).max() / COUNTS
    assert travelled < np.deg2rad(0.4), f"{np.rad2deg(travelled):.3f} degrees under power"
    fastest = np.abs(_speeds(frames, node)).max()
    assert fastest < 0.3, f"{fastest:.3f} rad/s of 10 allowed"
    peak = np.abs(rows[:, 2] - rows[0, 2]).max() / COUNTS  # with hardly any friction it coasts
    assert peak < np.deg2rad(30)
    bench.machine.advance_to(bench.machine.time + 5_000_000_000)
    assert abs(bench.machine.axes.position_counts(node - TABLE)) / COUNTS < np.deg2rad(40)
    assert bench.powered() == {}
    assert bench.changed() == {}
    assert not bench.recording().experiments[-1].complete


def test_a_stuck_encoder_is_found_before_the_axis_is_fast(bench):
    bench.inject(EncoderStuck(TABLE))
    outcome = bench.measure()
    assert outcome.code == 4
    assert "table: does not move by its encoder" in outcome.err
    assert "its power was cut" in outcome.err
    axes = bench.machine.axes
    bench.machine.advance_to(bench.machine.time + 5_000_000_000)
    assert abs(axes.state[axes.plant.motors[0]]) < 15.0, "nearly all of it without power: it coasts"
    assert bench.powered() == {}


def test_swapped_sign_of_torque_is_named(bench, monkeypatch):
    """0x607E turned around for the torque only: the axis follows, the torque has the wrong sign."""
    measured = bench.machine.axes.latch

    def turned():
        position, torque, velocity = measured()
        return position, -torque, velocity

    monkeypatch.setattr(bench.machine.axes, "latch", turned)
    outcome = bench.measure()
    assert outcome.code == 4
    assert "torque that starts a positive move is negative" in outcome.err
    assert "0x607E" in outcome.err
    assert bench.powered() == {}


def test_a_healthy_axis_near_the_end_of_its_travel_is_checked_inwards(bench):
    """The check must not push an axis out of its travel."""
    with bench.connected() as group, group.motion(0.004) as motion:
        way = np.linspace(0, np.deg2rad(119.5), 1500)
        way = np.concatenate([way, np.full(200, way[-1])])
        motion.stream(_once(np.stack([way, 0 * way], axis=1)))
    bench.listen()
    bench.in_sweep.append((NodeVanishes(ARM), 0))
    assert "sent no PDO" in bench.measure().err
    rows = _inputs(bench.heard(), TABLE)
    assert rows[:, 2].max() / COUNTS < np.deg2rad(120)
    assert rows[:, 2].min() / COUNTS < np.deg2rad(118), "it was moved inwards"


# --- limits, through the motion alone ------------------------------------------------------------


def _once(targets):
    return lambda before: targets if before is None else None


def _ramp(speed, rows=1500, cycle=0.002):
    return np.stack([speed * cycle * np.arange(rows), np.zeros(rows)], axis=1)


def _ramp_to(size, speed, rows=1000, cycle=0.002):
    way = np.minimum(speed * cycle * np.arange(rows), size)
    return np.stack([way, np.zeros(rows)], axis=1)


LIMITS = [
    ("velocity", "0.5 rad/s", _ramp(0.7, 1000), "velocity 0.5", lambda _, v, t: abs(v) > 0.505),
    (
        "torque",
        "0.4 N m",
        _ramp(1.0, 500),
        "torque .* is above the limit 0.4 N m",
        lambda p, v, t: abs(t) * 0.004 > 0.4,
    ),
    (
        "following_error",
        "2 deg",
        _ramp(3.0, 300),
        "following error 0.0.* is above the limit 0.0349",
        None,
    ),
    (
        "travel",
        ["-5 deg", "5 deg"],
        _ramp_to(np.deg2rad(4.95), 2.0),
        "is outside the travel",
        lambda p, v, t: p / COUNTS > np.deg2rad(5),
    ),
]


@pytest.mark.parametrize(("limit", "value", "targets", "sentence", "violates"), LIMITS)
def test_a_limit_passed_stops_every_axis_in_the_next_cycle(
    make_bench, profile_of_two, limit, value, targets, sentence, violates
):
    profile_of_two["axes"][0]["limits"][limit] = value
    if limit != "following_error":
        profile_of_two["axes"][0]["limits"].setdefault("following_error", "60 deg")
    bench = make_bench(profile_of_two)
    bench.listen()
    with (
        bench.connected() as group,
        pytest.raises(SafetyStopError, match=f"table: .*{sentence}") as stop,
        group.motion(0.002) as motion,
    ):
        motion.stream(_once(targets))
    assert stop.value.axis == "table"
    assert "all axes were stopped" in str(stop.value)
    frames = bench.heard()
    rows = _inputs(frames, TABLE)
    speeds = np.diff(rows[:, 2], prepend=rows[0, 2]) / COUNTS / 0.002
    if violates is None:
        violated = next(
            _target_row(frames, row) for row in rows if _following_error(frames, row) > 0.0349
        )
    else:
        violated = next(
            int(row[0]) for row, v in zip(rows, speeds, strict=True) if violates(row[2], v, row[3])
        )
    cycles = reaction(frames, violated)
    assert set(cycles.values()) == {1}, cycles
    assert bench.powered() == {}
    assert bench.changed() == {}
    assert stop.value.capture.rows > 0, "what was recorded is kept"


def _target_row(_frames, row):
    return int(row[0])


def _following_error(frames, row):
    sent = [
        struct.unpack("<Hih", f.data)
        for f in frames
        if f.cob_id == 0x200 + TABLE and f.sync == row[0] - 1
    ]
    if not sent or sent[-1][0] != 0x0F or row[1] & 0x6F != 0x27:
        return 0.0
    return abs(sent[-1][1] - row[2]) / COUNTS


def test_a_target_outside_the_travel_is_never_sent(bench):
    bench.listen()
    with (
        bench.connected() as group,
        pytest.raises(SafetyStopError, match=r"arm: a target of 2\.2 rad is outside the travel"),
        group.motion(0.002) as motion,
    ):
        motion.stream(_once(np.array([[0.0, 0.0], [0.0, 2.2]])))
    largest = max(
        struct.unpack("<Hih", f.data)[1] for f in bench.heard() if f.cob_id == 0x200 + ARM
    )
    assert largest < 1000
    assert bench.powered() == {}


def test_axes_are_watched_while_they_are_being_enabled(bench, monkeypatch):
    """A slow brake on one axis must not leave a runaway of another one unseen."""
    arm = bench.machine.node(ARM)
    obey = arm.motion.write_controlword
    monkeypatch.setitem(arm._setters, (0x6040, 0), lambda w: obey(0x07 if w == 0x0F else w))
    arm.pdo.start()
    bench.inject(MotorReversed(TABLE))
    bench.inject(Pushed(TABLE, 1e-3), 60)
    bench.listen()
    with (
        bench.connected() as group,
        pytest.raises(SafetyStopError, match="table: "),
        group.motion(0.002),
    ):
        pytest.fail("the arm can not be enabled")
    speed = np.abs(_speeds(bench.heard(), TABLE, powered_only=True, cycle=0.002)).max()
    assert speed < 10.5
    assert bench.powered() == {}


# --- PDOs that do not come -----------------------------------------------------------------------


def test_one_missing_pdo_is_tolerated_and_its_block_measured_again(small_bench):
    from fieldtool.experiment.axes import Axes
    from fieldtool.experiment.stepped.plan import Sweep, SweepPlan, tone_near
    from fieldtool.experiment.stepped.runner import run_plan

    bench = small_bench
    tone = tone_near(5.0, 0.05, 0.002)
    plan = SweepPlan(0.002, (Sweep("direct, others free", "table", (), (tone,)),))

    def rows_of_one_run():
        kept = []
        with bench.connected() as group:
            axes = Axes(group.axes, tuple(d.limits for d in group.drives), np.zeros(1))
            run_plan(group, plan, axes, kept.append)
        return kept[0]

    begin = bench.machine.sync_count
    plain = rows_of_one_run()
    length = bench.machine.sync_count - begin
    settled = plain.segments[0]
    from_end = plain.samples - (settled.start + settled.stop) // 2
    at = bench.machine.sync_count + length - from_end - 5
    bench.inject(NoTransmitPdos(TABLE), at)
    bench.inject(PdosComeBack(TABLE), at + 1)
    again = rows_of_one_run()
    assert again.complete
    assert again.samples > plain.samples, "the spoiled block was measured again"
    (segment,) = again.segments
    repeated = np.flatnonzero(
        (np.diff(again.position[:, 0]) == 0) & (np.diff(again.torque[:, 0]) == 0)
    )
    inside = [r for r in repeated if segment.start <= r + 1 < segment.stop]
    moving = [r for r in inside if abs(np.gradient(again.position[:, 0])[r]) > 1e-5]
    assert moving == []
    assert any(abs(np.gradient(again.position[:, 0])[r]) > 1e-5 for r in repeated), "it happened"
    assert bench.powered() == {}


# --- the host dies -------------------------------------------------------------------------------


class _HostDiesError(Exception):
    """Nothing is sent any more."""


@pytest.mark.parametrize("watched", [True, False])
def test_drives_stop_by_themselves_when_the_host_dies(bench, watched):
    """In full motion nothing is sent any more; without 0x1016 the drives would stay enabled."""
    with bench.connected() as group:
        try:
            with group.motion(0.002) as motion:
                motion.stream(_once(_ramp(2.0, rows=300)))
                speed = bench.machine.axes.velocity(0)
                assert speed > 1.0
                assert set(bench.powered()) == {TABLE, ARM}
                if not watched:
                    for node in bench.machine.nodes:
                        node.dictionary.write(0x1016, 1, 0)
                clock = group.line.clock
                clock.wait_until(clock.now() + 0.19)
                assert set(bench.powered()) == {TABLE, ARM}
                clock.wait_until(clock.now() + 0.4)
                if watched:
                    assert bench.powered() == {}
                    stopped = bench.machine.axes.position(0)
                    clock.wait_until(clock.now() + 1.0)
                    assert bench.machine.axes.position(0) == pytest.approx(stopped, abs=0.2), (
                        "only what swung in the springs is left; 2 rad/s would have been 2 rad"
                    )
                else:
                    assert set(bench.powered()) == {TABLE, ARM}, "the test can fail"
                raise _HostDiesError
        except _HostDiesError:
            pass
    assert bench.powered() == {}


def test_a_bus_that_dies_in_motion_is_no_refusal_before_motion(bench, monkeypatch):
    """The adapter is unplugged: exit code 4, data kept, and the drives stop by themselves."""
    from drives.sim.lockstep_bus import LockstepBus

    send = LockstepBus.send
    import can

    def unplugged(self, message, timeout=None):
        if bench.sweeps:
            raise can.CanOperationError("adapter is gone")
        send(self, message, timeout)

    monkeypatch.setattr(LockstepBus, "send", unplugged)
    outcome = bench.measure()
    assert outcome.code == 4, outcome.err
    assert "adapter is gone" in outcome.err
    assert "heartbeat" in outcome.err
    bench.machine.advance_to(bench.machine.time + 1_000_000_000)
    assert bench.powered() == {}
    assert bench.recording().experiments[-1].samples > 1000
    assert not bench.recording().experiments[-1].complete


def test_a_full_disk_does_not_hide_why_the_machine_was_stopped(bench, monkeypatch):
    from fieldtool.errors import OutputError
    from fieldtool.records.recording import RecordingWriter

    append = RecordingWriter.append

    def full(self, experiment):
        if not experiment.complete:
            raise OutputError("recording.h5 can not be written: no room")
        append(self, experiment)

    monkeypatch.setattr(RecordingWriter, "append", full)
    bench.in_sweep.append((EmergencyOnly(ARM), 0))
    outcome = bench.measure()
    assert outcome.code == 4
    assert "0x4210" in outcome.err
    assert "no room" in outcome.err
    assert bench.powered() == {}


def test_a_drive_that_refuses_to_be_put_back_is_named(bench):
    from drives.sim.faults import SdoRefused

    bench.in_sweep.append((EmergencyOnly(ARM), 0))
    bench.in_sweep.append((SdoRefused(ARM, 0x6007, 0, 0x08000022), 0))
    outcome = bench.measure()
    assert outcome.code == 4
    assert "could not be put back: arm, object 0x6007:00" in outcome.err
    assert bench.changed(ARM) == {}
    assert set(bench.changed()[ARM]) == {"0x6007:00"}, "everything else was put back"
