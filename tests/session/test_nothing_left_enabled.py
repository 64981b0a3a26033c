"""After a motion, however it ended: off, or said so, with the drive's own fail-safe still armed."""

import re

import can
import numpy as np
import pytest

from drives.canopen_drive import CanopenMotion
from drives.errors import BusError, NothingMovedError, SafetyStopError, SdoAbortError
from drives.sim.faults import SdoRefused, SdoSilent
from drives.sim.frame_faults import PdoLate
from drives.sim.host_faults import InterfaceDown
from drives.sim.lockstep_bus import LockstepBus
from fieldtool.workflow.session import never, open_session

TABLE, ARM = 11, 12
HOLD = 400


def held(position, cycles=HOLD):
    targets = np.tile(position, (cycles, 1))
    return lambda before: targets if before is None else None


def node(bench, node_id):
    return next(n for n in bench.machine.nodes if n.node_id == node_id)


def test_a_drive_that_leaves_operational_is_switched_off_by_sdo(bench):
    """Its PDOs are dead then, both ways; only an SDO can reach it."""
    with (
        bench.connected() as group,
        pytest.raises(SafetyStopError, match="table: node 11") as stop,
        group.motion(0.002) as motion,
    ):
        moved = False

        def source(before):
            nonlocal moved
            if moved:
                bench.machine.receive(0x000, bytes([0x80, TABLE]))  # somebody's NMT command
            moved = True
            return np.tile(motion.position, (50, 1))

        motion.stream(source)
    assert bench.powered() == {}
    assert not [n for n in getattr(stop.value, "__notes__", []) if "MAY STILL" in n]
    assert bench.changed() == {}


def test_a_drive_that_can_not_be_switched_off_keeps_its_fail_safe(bench):
    """Deaf to PDOs and to 0x6040 by SDO: only its own heartbeat consumer can stop it."""
    bench.inject(SdoSilent(TABLE, 0x6040, 0))
    with (
        bench.connected() as group,
        pytest.raises(SafetyStopError) as stop,
        group.motion(0.002) as motion,
    ):
        begun = False

        def source(before):
            nonlocal begun
            if begun:
                bench.machine.receive(0x000, bytes([0x80, TABLE]))
            begun = True
            return np.tile(motion.position, (50, 1))

        motion.stream(source)
    notes = " ".join(getattr(stop.value, "__notes__", []))
    assert "table: node 11 does not answer" in notes
    assert "MAY STILL BE ENABLED" in notes
    assert "emergency stop" in notes
    assert any("left armed" in text for text in group.warnings)
    assert node(bench, TABLE).dictionary.read(0x1016, 1) != 0
    assert (
        node(bench, TABLE).dictionary.read(0x6060, 0) == 8
    )  # its old mode has its own old targets
    assert group.drives[0].left_changed
    assert node(bench, ARM).dictionary.read(0x6060, 0) != 8
    with bench.connected() as again:  # time passes, and no heartbeat comes
        again.line.wait(1.0)
    assert bench.powered() == {}


def test_an_error_that_becomes_a_stop_keeps_the_warning(bench):
    """The error that leaves is another one than the one that stopped the axes."""
    bench.inject(SdoSilent(TABLE, 0x6040, 0))
    with (
        bench.connected() as group,
        pytest.raises(SafetyStopError, match="is gone") as stop,
        group.motion(0.002) as motion,
    ):

        def source(before):
            if before is None:
                return np.tile(motion.position, (50, 1))
            bench.machine.receive(0x000, bytes([0x80, TABLE]))
            raise BusError("the bus is gone")

        motion.stream(source)
    assert "MAY STILL BE ENABLED" in " ".join(getattr(stop.value, "__notes__", []))


def test_the_last_target_stays_the_target_while_the_axis_is_switched_off(bench):
    bench.listen()
    with bench.connected() as group, group.motion(0.002) as motion:
        ramp = np.zeros((800, 2))
        ramp[:, 0] = 0.5 * (1 - np.cos(np.pi * np.arange(800) / 799)) / 2
        motion.stream(lambda before: motion.position + ramp if before is None else None)
        reached = motion.position[0]
    outputs = [f.data for f in bench.heard() if f.cob_id == 0x200 + TABLE]
    unit = 2 * np.pi / 2**20
    targets = [int.from_bytes(data[2:6], "little", signed=True) * unit for data in outputs]
    words = [int.from_bytes(data[0:2], "little") for data in outputs]
    last_enabled = max(k for k, word in enumerate(words) if word == 0x0F)
    assert reached == pytest.approx(0.5, abs=0.02)
    assert len(targets) > last_enabled + 1
    assert targets[last_enabled + 1 :] == pytest.approx([0.5] * len(targets[last_enabled + 1 :]))


def test_a_target_that_jumps_is_never_sent(bench):
    bench.listen()
    with (
        bench.connected() as group,
        pytest.raises(SafetyStopError, match="table: a target would jump by 1 rad"),
        group.motion(0.002) as motion,
    ):
        targets = np.tile(motion.position, (10, 1))
        targets[5:, 0] += 1.0
        motion.stream(lambda before: targets if before is None else None)
    unit = 2 * np.pi / 2**20
    sent = [
        int.from_bytes(f.data[2:6], "little", signed=True) * unit
        for f in bench.heard()
        if f.cob_id == 0x200 + TABLE
    ]
    assert max(abs(target) for target in sent) < 0.1
    assert bench.powered() == {}


@pytest.mark.parametrize("state", [0x06, 0x07])
def test_a_drive_that_was_left_ready_is_enabled_all_the_same(bench, state):
    """Somebody left it in ready to switch on, or switched on."""
    bench.machine.receive(0x600 + TABLE, bytes([0x2B, 0x40, 0x60, 0, 0x06, 0, 0, 0]))
    if state == 0x07:
        bench.machine.receive(0x600 + TABLE, bytes([0x2B, 0x40, 0x60, 0, 0x07, 0, 0, 0]))
    assert node(bench, TABLE).motion.state.name in ("READY_TO_SWITCH_ON", "SWITCHED_ON")
    with bench.connected() as group, group.motion(0.002) as motion:
        motion.stream(held(motion.position, 20))
    assert bench.powered() == {}


@pytest.mark.parametrize(
    ("cob_id", "data", "said"),
    [
        (0x080, b"", "a SYNC"),
        (0x77F, b"\x05", "the host's own heartbeat"),
        (0x200 + ARM, bytes(8), "targets .* for arm"),
    ],
)
def test_another_master_on_the_bus_is_refused(bench, cob_id, data, said):
    other = can.Bus(interface="fieldsim", channel=bench.channel)
    task = other.send_periodic(
        can.Message(arbitration_id=cob_id, data=data, is_extended_id=False), 0.05
    )
    try:
        with (
            pytest.raises(NothingMovedError, match=f"somebody else sends {said}"),
            bench.connected(),
        ):
            pass
    finally:
        task.stop()
        other.shutdown()
    assert bench.powered() == {}


FOREIGN = [
    (0x080, b"", "a SYNC"),
    (0x200 + TABLE, bytes(8), r"targets \(a PDO\) for table"),
    (0x77F, b"\x05", "the host's own heartbeat"),
    (0x000, b"\x81\x00", r"the NMT command reset \(0x81\) to all nodes"),
    (0x600 + ARM, bytes.fromhex("2B40600000000000"), "a write to object 0x6040:00 of arm"),
]
HARMLESS = [
    (0x100, bytes(6)),
    (0x000, b"\x81\x55"),
    (0x600 + ARM, bytes.fromhex("4041600000000000")),
    (0x200 + 99, bytes(8)),
    (0x5FF, bytes(8)),
]


@pytest.mark.parametrize(("cob_id", "data", "said"), FOREIGN)
def test_a_command_that_is_not_ours_stops_every_axis(bench, cob_id, data, said):
    with pytest.raises(SafetyStopError, match=f"somebody else sends {said} on this bus"):
        motion_with(bench, [(cob_id, data)])
    assert bench.powered() == {}


def test_frames_that_command_nothing_are_passed_over(bench):
    """Time stamps, commands to other nodes, somebody who reads an object."""
    capture = motion_with(bench, HARMLESS)
    assert capture.missing == ()
    assert bench.powered() == {}


def motion_with(bench, frames):
    """Hold the position, block by block, with a frame of somebody else's in each."""
    other = can.Bus(interface="fieldsim", channel=bench.channel)
    left = list(frames)
    try:
        with bench.connected() as group, group.motion(0.002) as motion:

            def source(before):
                if before is not None and not left:
                    return None
                if before is not None:
                    cob_id, data = left.pop(0)
                    other.send(can.Message(arbitration_id=cob_id, data=data, is_extended_id=False))
                return np.tile(motion.position, (10, 1))

            return motion.stream(source)
    finally:
        other.shutdown()


BUS_OFF = 0x040
CLASSES = [1 << bit for bit in range(10) if 1 << bit != BUS_OFF]
LIKE_OURS = [base + node for base in (0x080, 0x180, 0x200, 0x300) for node in (TABLE, ARM)]
"""Classes of error frames (``linux/can/error.h``): of one kind, and some that equal our identifiers."""


@pytest.fixture
def kernel_errors(monkeypatch):
    """Have error frames read as the Linux kernel encodes them."""
    monkeypatch.setattr(LockstepBus, "overruns", 0, raising=False)


@pytest.mark.usefixtures("kernel_errors")
@pytest.mark.parametrize("kind", [*CLASSES, *LIKE_OURS])
def test_an_error_frame_is_nobodys_whatever_its_class(bench, kind):
    frame = can.Message(arbitration_id=kind, is_extended_id=False, is_error_frame=True, dlc=8)
    capture = motion_among(bench, frame)
    assert capture.missing == ()
    assert bench.powered() == {}


@pytest.mark.usefixtures("kernel_errors")
def test_an_adapter_that_goes_off_the_bus_stops_every_axis(bench):
    frame = can.Message(arbitration_id=BUS_OFF, is_extended_id=False, is_error_frame=True, dlc=8)
    with pytest.raises(SafetyStopError, match="the adapter went off the bus: bus off"):
        motion_among(bench, frame)
    assert bench.powered() == {}


@pytest.mark.parametrize("how", [{"is_extended_id": True}, {"is_remote_frame": True}])
@pytest.mark.parametrize("identifier", [0x080, 0x77F, *LIKE_OURS, 0x600 + ARM])
def test_what_is_no_frame_of_canopen_is_nobodys(bench, identifier, how):
    frame = can.Message(arbitration_id=identifier, dlc=8, **{"is_extended_id": False, **how})
    capture = motion_among(bench, frame)
    assert capture.missing == ()
    assert bench.powered() == {}


def motion_among(bench, frame):
    """Hold the position, with a frame before each SYNC and one after each of the table's PDOs."""
    other = can.Bus(interface="fieldsim", channel=bench.channel)

    def after(_time, cob_id, _data):
        if cob_id == 0x180 + TABLE:
            other.send(frame)

    def source(before):
        if before is not None and before.first_sync > 50:
            return None
        other.send(frame)
        return motion.position[None, :]

    try:
        with bench.connected() as group, group.motion(0.002) as motion:
            bench.machine.listen(after)
            return motion.stream(source)
    finally:
        other.shutdown()


@pytest.mark.parametrize("kind", [0x080, 0x200 + ARM])
def test_an_error_frame_is_no_other_master(bench, kind):
    other = can.Bus(interface="fieldsim", channel=bench.channel)
    frame = can.Message(arbitration_id=kind, is_extended_id=False, is_error_frame=True, dlc=8)
    task = other.send_periodic(frame, 0.05)
    try:
        with bench.connected() as group:
            assert group.line.troubles
    finally:
        task.stop()
        other.shutdown()


def test_short_emergencies_and_empty_heartbeats_do_no_harm(bench):
    other = can.Bus(interface="fieldsim", channel=bench.channel)
    try:
        with (
            bench.connected() as group,
            pytest.raises(SafetyStopError, match="table: node 11 reports emergency 0x8130"),
            group.motion(0.002) as motion,
        ):
            frames = [(0x700 + TABLE, b""), (0x080 + TABLE, b"\x30\x81")]

            def source(before):
                if not frames:
                    return None
                cob_id, data = frames.pop(0)
                other.send(can.Message(arbitration_id=cob_id, data=data, is_extended_id=False))
                return np.tile(motion.position, (20, 1))

            motion.stream(source)
    finally:
        other.shutdown()
    assert bench.powered() == {}


def test_a_drive_behind_a_gear_is_refused(make_bench):
    bench = make_bench(objects={TABLE: {(0x6091, 1): 50, (0x6091, 2): 1}})
    with pytest.raises(NothingMovedError, match=r"0x6091 is 50/1"), bench.connected():
        pass


def test_what_a_motion_left_is_said_when_a_later_step_fails(bench):
    """The motion itself ended well, so it has no error that could say so."""
    with (
        pytest.raises(NothingMovedError, match="later") as refused,
        open_session(bench.profile, bench.out, None, never) as (_, group),
    ):
        with group.motion(0.002) as motion:
            bench.inject(SdoRefused(ARM, 0x6007, 0))
            motion.stream(held(motion.position))
        raise NothingMovedError("something later")
    assert bench.changed() == {ARM: {"0x6007:00": (1, 3)}}
    (note,) = refused.value.__notes__
    assert note.startswith("could not be put back: arm, object 0x6007:00: the drive refused")


@pytest.mark.parametrize("how", [SdoRefused, SdoSilent])
@pytest.mark.parametrize("place", [(0x6007, 0), (0x2010, 4)])
def test_what_a_drive_refuses_once_axes_have_moved_is_a_stop(bench, how, place):
    """As the next motion is set up, or feed-forward is switched off for it."""
    said = rf"arm, object 0x{place[0]:04X}.* Axes had moved before\. All are disabled now\."
    with bench.connected() as group:
        with group.motion(0.002) as motion:
            motion.stream(held(motion.position))
        bench.inject(how(ARM, *place))
        with (
            pytest.raises(SafetyStopError, match=said),
            group.without_feed_forward(),
            group.motion(0.002),
        ):
            pass
    assert bench.powered() == {}


def test_what_a_drive_refuses_before_any_motion_is_no_stop(bench):
    bench.inject(SdoRefused(ARM, 0x6007))
    with (
        bench.connected() as group,
        pytest.raises(SdoAbortError, match="arm, object 0x6007:00: the drive refused"),
        group.motion(0.002),
    ):
        pass


@pytest.mark.parametrize("how", [SdoRefused, SdoSilent])
def test_a_drive_that_refuses_its_set_up_in_a_sweep_is_no_refusal_before_motion(bench, how):
    bench.in_sweep.append((how(ARM, 0x6007), 0))
    outcome = bench.measure()
    assert outcome.code == 4, outcome.err
    assert "arm, object 0x6007:00" in outcome.err
    assert "Axes had moved before. All are disabled now." in outcome.err
    assert "could not be put back: arm, object 0x6007:00" in outcome.err
    assert bench.powered() == {}


LATE = "arm: node 12 answers a SYNC later than 0.9 of the cycle of 2 ms"


def test_pdos_that_come_late_for_good_are_said_before_an_axis_is_enabled(bench):
    bench.inject(PdoLate(ARM))
    with (
        bench.connected() as group,
        pytest.raises(NothingMovedError, match=rf"{LATE}, .* No axis was enabled\. Check the bus"),
        group.motion(0.002),
    ):
        pass
    assert bench.powered() == {}


def test_pdos_that_come_late_in_a_motion_are_not_told_as_if_nothing_had_moved(bench):
    with (
        bench.connected() as group,
        pytest.raises(SafetyStopError, match=rf"{LATE}, .* at the end of a motion") as stopped,
        group.motion(0.002) as motion,
    ):
        bench.inject(PdoLate(ARM))
        motion.stream(held(motion.position))
    assert not re.search("(?i)nothing was moved|no axis was enabled", str(stopped.value))
    assert bench.powered() == {}


@pytest.fixture
def closing_fails(monkeypatch):
    """An adapter's library that complains where the adapter is closed; return how often it did."""
    shutdown, closed = LockstepBus.shutdown, []

    def failing(bus):
        shutdown(bus)
        closed.append(bus)
        raise can.CanOperationError("Could not write to serial device")

    monkeypatch.setattr(LockstepBus, "shutdown", failing)
    return closed


def test_what_may_be_enabled_is_said_though_the_bus_can_not_be_closed(bench, closing_fails):
    bench.in_sweep.append((InterfaceDown(), 0))
    outcome = bench.measure()
    assert outcome.code == 4, outcome.err
    assert "Network is down" in outcome.err
    for sentence in ("table: node 11 does not answer", "arm: node 12 does not answer"):
        assert sentence in outcome.err
    assert "MAY STILL BE ENABLED" in outcome.err
    assert closing_fails


@pytest.mark.parametrize("command", ["scan", "check"])
def test_what_was_found_is_said_though_the_bus_can_not_be_closed(bench, closing_fails, command):
    outcome = bench.command(command, bench.profile)
    assert outcome.code == 0, outcome.err
    assert closing_fails


class Flood:
    """From now on another frame waits whenever the host has taken one, which takes so long."""

    def __init__(self, monkeypatch, each=1e-4):
        self.begun, self.each, self.recv, self.left = False, each, LockstepBus.recv, 50_000
        monkeypatch.setattr(LockstepBus, "recv", lambda bus, timeout=None: self(bus, timeout))

    def __call__(self, bus, timeout):
        if not self.begun:
            return self.recv(bus, timeout)
        self.left -= 1
        assert self.left > 0, "the host takes frames for ever"
        bus.clock.wait_until(bus.clock.now() + self.each)
        return can.Message(arbitration_id=0x123, data=bytes(8), is_extended_id=False)


def test_frames_without_end_stop_every_axis(bench, monkeypatch):
    """Nothing is heard of the drives any more, but they hear: quick stop, then off."""
    flood = Flood(monkeypatch)
    begun_at = None
    with (
        bench.connected() as group,
        pytest.raises(SafetyStopError, match=r"faster .* 0x123: for 2 cycles") as stop,
        group.motion(0.002) as motion,
    ):

        def source(before):
            nonlocal begun_at
            if before is not None:
                flood.begun, begun_at = True, bench.machine.sync_count
                monkeypatch.setattr(CanopenMotion, "_make_sure_off", off_by_then)
            return np.tile(motion.position, (50, 1))

        make_sure = CanopenMotion._make_sure_off

        def off_by_then(motion):
            assert bench.powered() == {}, "before the last resort"
            assert bench.machine.sync_count - begun_at < 10
            make_sure(motion)

        motion.stream(source)
    assert stop.value.capture.rows > 50
    assert bench.powered() == {}
    notes = " ".join(stop.value.__notes__)
    assert notes.count("MAY STILL BE ENABLED") == 2, "nothing of it was heard"


def test_frames_of_before_are_not_taken_for_those_of_this_cycle(bench):
    """What waits behind a flood is old when it comes."""
    with bench.connected() as group, group.motion(0.002) as motion:
        motion._line.send(can.Message(arbitration_id=0x080, is_extended_id=False))
        motion._sync.behind.append(0x123)
        assert not motion._collect(bench.machine.now + 0.001)
        assert [channel.missing for channel in motion._channels] == [1, 1]
        motion._sync.behind.clear()
        assert motion._collect(bench.machine.now + 0.001)
        assert [channel.missing for channel in motion._channels] == [0, 0]


def test_a_collection_ends_though_frames_go_on(bench, monkeypatch):
    flood = Flood(monkeypatch)
    with bench.connected() as group, group.motion(0.002) as motion:
        flood.begun = True
        begun = bench.machine.now
        assert not motion._collect(begun + 0.0018)
        assert bench.machine.now - begun == pytest.approx(0.002, abs=2e-4)
        flood.begun = False


@pytest.mark.parametrize(
    ("fault", "said"),
    [(SdoSilent(ARM, 0x6061), "arm, object 0x6061:00: node 12 did not answer"), (None, "is down")],
    ids=["one object", "the bus"],
)
def test_a_doubt_that_can_not_be_settled_at_the_end_is_a_stop(bench, monkeypatch, fault, said):
    """Axes have moved: this is no refusal before motion."""
    check = CanopenMotion._check_mode

    def failing(motion, channel):
        bench.inject(fault or InterfaceDown())
        check(motion, channel)

    monkeypatch.setattr(CanopenMotion, "_check_mode", failing)
    with (
        bench.connected() as group,
        pytest.raises(SafetyStopError, match=f"{said}.* with all axes disabled: .* is kept"),
        group.motion(0.002) as motion,
    ):
        motion.stream(held(motion.position, 20))
    assert bench.powered() == {}
