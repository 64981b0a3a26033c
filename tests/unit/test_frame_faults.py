"""Faults of frames, drives and host do what they say, and end when they are lifted."""

import struct
from dataclasses import replace

import can
import pytest

from drives.sim.drive_faults import (
    BrakeClosed,
    CanNotBeEnabled,
    EncoderJumps,
    LimitSwitchHit,
    ModeChanges,
    OperationLost,
    PowerLossWhileStoring,
    SupplySags,
    TorqueLimited,
    TorqueScaleWrong,
)
from drives.sim.frame_faults import (
    HeartbeatLost,
    NodeDuplicated,
    PdoLate,
    PdoMissing,
    PdoShort,
    PdoTwice,
    SdoAnswerLate,
    SdoAnswerWrong,
    StatuswordFrozen,
    Stranger,
    SyncMissed,
)
from drives.sim.host_faults import BusOff, HostKilled, HostStalls, InterfaceDown, ReceiverDead
from drives.sim.lockstep_bus import LockstepBus

UPLOAD = struct.pack("<BHB4x", 0x40, 0x1000, 0)
TYPE = bytes.fromhex("43 00 10 00 92 01 02 00")


@pytest.fixture
def mapped(rig):
    rig.map_pdo(0x1400, 0x1600, 0x201, (0x60400010, 0x607A0020, 0x60710010))
    rig.map_pdo(0x1800, 0x1A00, 0x181, (0x60410010, 0x60640020, 0x60770010))
    rig.nmt(1)
    rig.enable()
    rig.take()
    return rig


def pdos(rig, cycles):
    rig.take()
    rig.cycle(cycles)
    return rig.take(0x181)


@pytest.mark.parametrize(
    ("how", "answer"),
    [
        ("other index", "43 01 10 00 92 01 02 00"),
        ("other sub-index", "43 00 10 01 92 01 02 00"),
        ("other value size", "4B 00 10 00 92 01 02 00"),
        ("truncated", "43 00 10"),
        ("empty", ""),
        ("other specifier", "63 00 10 00 92 01 02 00"),
        ("no specifier", "E3 00 10 00 92 01 02 00"),
    ],
)
def test_an_sdo_answer_is_wrong_once(rig, how, answer):
    rig.machine.inject(SdoAnswerWrong(1, 1, how))
    rig.send(0x601, UPLOAD)
    assert rig.take(0x581) == [bytes.fromhex(answer)]
    rig.send(0x601, UPLOAD)
    assert rig.take(0x581) == [TYPE]


def test_only_segments_have_a_toggle_bit(rig):
    rig.machine.inject(SdoAnswerWrong(1, how="toggle bit"))
    rig.send(0x601, UPLOAD)
    assert rig.take(0x581) == [TYPE]
    rig.send(0x601, struct.pack("<BHB4x", 0x40, 0x1008, 0))
    rig.take()
    rig.send(0x601, bytes((0x60,)) + bytes(7))
    assert rig.take(0x581)[0][0] & 0x10


def test_sdo_answers_late_twice_and_lifted(rig):
    late = SdoAnswerLate(1, delay=0.7)
    rig.machine.inject(late)
    rig.send(0x601, UPLOAD)
    rig.run(0.69)
    assert rig.take(0x581) == []
    rig.run(0.02)
    assert rig.take(0x581) == [TYPE]
    rig.machine.lift(late)
    rig.machine.inject(SdoAnswerWrong(1, how="twice"))
    rig.send(0x601, UPLOAD)
    assert rig.take(0x581) == [TYPE, TYPE]


def test_pdos_missing_late_twice_short(mapped):
    machine = mapped.machine
    missing = PdoMissing(1, 2)
    machine.inject(missing)
    assert len(pdos(mapped, 5)) == 3
    late = PdoLate(1, 1, cycles=1.5)
    machine.inject(late)
    mapped.take()
    mapped.cycle()
    assert mapped.take(0x181) == []
    mapped.cycle()
    assert len(mapped.take(0x181)) == 2
    machine.inject(PdoTwice(1, 1))
    assert len(pdos(mapped, 4)) == 5
    machine.inject(PdoShort(1, 1))
    assert [len(data) for data in pdos(mapped, 2)] == [6, 8]


def test_a_frozen_statusword_shows_nothing_new(mapped):
    frozen = StatuswordFrozen(1)
    mapped.machine.inject(frozen)
    mapped.control(0)
    assert {data[0] & 0x6F for data in pdos(mapped, 3)} == {0x27}
    assert mapped.state() == 0x40, "by SDO it shows the truth"
    mapped.machine.lift(frozen)
    assert {data[0] & 0x4F for data in pdos(mapped, 3)} == {0x40}


def test_syncs_missed(mapped):
    mapped.machine.inject(SyncMissed(1, 3))
    assert len(pdos(mapped, 10)) == 7


def test_no_heartbeat(rig):
    rig.write("H", 0x1017, 0, 100)
    lost = HeartbeatLost(1)
    rig.machine.inject(lost)
    rig.take()
    rig.run(1.0)
    assert rig.take(0x701) == []
    rig.machine.lift(lost)
    rig.run(1.0)
    assert len(rig.take(0x701)) == 10


def test_two_nodes_of_one_id(mapped):
    mapped.machine.inject(NodeDuplicated(1))
    first, second = pdos(mapped, 1)
    assert first[0] & 0x6F == 0x27
    assert second[0] & 0x4F == 0x40
    mapped.send(0x601, UPLOAD)
    assert len(set(mapped.take(0x581))) == 2


def test_a_stranger_is_heard_by_all(mapped):
    stranger = Stranger(1, 0x000, b"\x80\x01", period=0.01, times=2)
    mapped.machine.inject(stranger)
    mapped.run(0.1)
    assert len(mapped.take(0x000)) == 2
    assert pdos(mapped, 3) == [], "the node left operational"


def test_an_encoder_jumps_and_a_torque_is_shown_wrong(mapped):
    before = mapped.read("i", 0x6064)
    mapped.machine.inject(EncoderJumps(1, 5_000))
    mapped.run(0.000125)
    assert mapped.read("i", 0x6064) == pytest.approx(before + 5_000, abs=50)
    mapped.run(0.002)
    torque = mapped.machine.axes.measured_torque_per_mille(0)
    scale = TorqueScaleWrong(1, 10.0)
    mapped.machine.inject(scale)
    assert torque != 0
    assert mapped.machine.axes.measured_torque_per_mille(0) == pytest.approx(10 * torque, abs=5)
    mapped.machine.lift(scale)
    assert mapped.machine.axes.measured_torque_per_mille(0) == torque


def test_a_closed_brake_holds_whatever_the_torque(mapped):
    brake = BrakeClosed(1)
    mapped.machine.inject(brake)
    position = mapped.read("i", 0x6064)
    mapped.send(0x201, struct.pack("<Hih", 0x0F, position + 20_000, 0))
    mapped.cycle(100)
    assert mapped.read("i", 0x6064) == position
    assert mapped.read("h", 0x6077) > 500
    mapped.machine.lift(brake)
    mapped.cycle(100)
    assert mapped.read("i", 0x6064) > position + 10_000


def test_drives_that_leave_operation_enabled(mapped):
    mapped.machine.inject(OperationLost(1))
    assert mapped.state() == 0x40
    assert mapped.emergencies() == []
    mapped.enable()
    mapped.machine.inject(LimitSwitchHit(1))
    assert mapped.statusword() & 0x086F == 0x0807
    mapped.run(1.0)
    mapped.control(0)
    closed = CanNotBeEnabled(1)
    mapped.machine.inject(closed)
    for word in (0x06, 0x07, 0x0F):
        mapped.control(word)
    assert mapped.state() == 0x23
    mapped.machine.lift(closed)
    mapped.enable()


def test_supply_and_torque_limits(mapped):
    mapped.machine.inject(TorqueLimited(1, share=0.02))
    position = mapped.read("i", 0x6064)
    mapped.send(0x201, struct.pack("<Hih", 0x0F, position + 50_000, 0))
    mapped.cycle(10)
    assert mapped.read("h", 0x6077) == pytest.approx(20, abs=2)
    mapped.machine.inject(SupplySags(1))
    mapped.run(0.004)
    assert mapped.state() == 0x27
    mapped.run(1.0)
    assert mapped.emergencies() == [0x3220]
    assert mapped.state() == 0x08


def test_a_mode_changes_by_itself(mapped):
    mapped.machine.inject(ModeChanges(1, 10))
    assert mapped.read("b", 0x6061) == 10


def test_power_lost_while_storing_keeps_what_was_stored_before(rig):
    rig.write("I", 0x2010, 1, 1_111)
    rig.machine.inject(PowerLossWhileStoring(1))
    rig.send(0x601, struct.pack("<BHB4s", 0x23, 0x1010, 1, b"save"))
    rig.run(1.0)
    assert rig.take(0x581) == []
    assert rig.take(0x701) == [b"\0"]
    assert rig.machine.node(1).memory.stored == {}
    assert rig.read("I", 0x2010, 1) == 30_000


# --- the host and its adapter --------------------------------------------------------------------


@pytest.fixture
def bus(rig):
    rig.run(0.01)
    bus = LockstepBus(machine=rig.machine)
    yield bus
    bus.shutdown()


def request():
    return can.Message(arbitration_id=0x601, data=UPLOAD, is_extended_id=False)


def answers(bus):
    bus.send(request())
    return bus.recv(0.1) is not None


def test_a_sound_adapter_and_what_ails_it(bus):
    machine = bus.machine
    assert answers(bus)
    machine.inject(ReceiverDead())
    assert not answers(bus)
    machine.lift(ReceiverDead())
    assert answers(bus)
    machine.inject(HostKilled())
    assert not answers(bus)
    machine.inject(BusOff())
    with pytest.raises(can.CanOperationError, match="bus off"):
        bus.send(request())
    machine.inject(InterfaceDown())
    for attempt in (lambda: bus.send(request()), lambda: bus.recv(0.1)):
        with pytest.raises(can.CanOperationError, match="Network is down"):
            attempt()
    machine.lift(InterfaceDown())
    assert answers(bus)


def test_a_host_that_stands_still_for_a_while(bus):
    machine, began = bus.machine, bus.machine.now
    machine.inject(replace(HostStalls(), seconds=0.25))
    assert answers(bus)
    assert machine.now == pytest.approx(began + 0.25)
    assert answers(bus)
    assert machine.now == pytest.approx(began + 0.25)
