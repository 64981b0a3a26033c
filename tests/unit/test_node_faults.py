"""Injected faults do what they say, when they are told to, and end when lifted."""

import struct

import pytest

from drives.sim import faults

ENABLED, REACTING, FAULT = 0x27, 0x0F, 0x08


@pytest.fixture
def mapped(rig):
    rig.map_pdo(0x1400, 0x1600, 0x201, (0x60400010, 0x607A0020, 0x60710010))
    rig.map_pdo(0x1800, 0x1A00, 0x181, (0x60410010, 0x60640020, 0x60770010))
    rig.nmt(1)
    rig.enable()
    rig.take()
    return rig


def test_node_vanishes_at_a_sync_and_comes_back(mapped):
    gone = faults.NodeVanishes(1)
    mapped.machine.inject(gone, at_sync=mapped.machine.sync_count + 6)
    mapped.cycle(20)
    assert len(mapped.take(0x181)) == 5
    mapped.send(0x601, bytes((0x40, 0, 0x10, 0, 0, 0, 0, 0)))
    mapped.send(0x201, struct.pack("<Hih", 0, 0, 0))
    assert mapped.take() == []
    mapped.machine.lift(gone)
    mapped.cycle()
    assert len(mapped.take(0x181)) == 1
    assert mapped.state() == ENABLED, "what was sent meanwhile was not heard"


def test_others_go_on_when_one_vanishes(rig_of):
    rig = rig_of(2)
    rig.machine.inject(faults.NodeVanishes(1))
    assert rig.read("I", 0x1000, 0, node=2) == 0x00020192


def test_drive_fault_at_a_time(mapped):
    mapped.machine.inject(faults.DriveFault(1, 0x4310, 0x08, b"\1"), at_time=0.0405)
    mapped.run(0.1)
    times = [(t, d) for t, cob, d in mapped.frames if cob == 0x81]
    assert times == [(40_500_000, struct.pack("<HB5s", 0x4310, 0x09, b"\1"))]
    mapped.run(1.0)
    assert mapped.state() == FAULT


def test_warning_only(mapped):
    warning = faults.EmergencyOnly(1)
    mapped.machine.inject(warning)
    assert mapped.emergencies() == [0x4210]
    assert mapped.state() == ENABLED
    mapped.machine.lift(warning)
    assert mapped.emergencies() == [0]


def test_no_tpdos(mapped):
    mute = faults.NoTransmitPdos(1)
    mapped.machine.inject(mute)
    mapped.cycle(5)
    assert mapped.take(0x181) == []
    assert mapped.read("I", 0x1000)
    mapped.machine.lift(mute)
    mapped.cycle()
    assert len(mapped.take(0x181)) == 1


def test_sdo_refused(rig, aborted):
    refused = faults.SdoRefused(1, 0x2010, 2, 0x08000022)
    rig.machine.inject(refused)
    with aborted(0x08000022):
        rig.write("I", 0x2010, 2, 5)
    with aborted(0x08000022):
        rig.read("I", 0x2010, 2)
    rig.write("I", 0x2010, 1, 5)
    rig.machine.lift(refused)
    assert rig.read("I", 0x2010, 2) == 2_000


def test_sdo_silent(rig):
    rig.machine.inject(faults.SdoSilent(1, 0x2010, 2))
    rig.take()
    rig.send(0x601, struct.pack("<BHB4x", 0x40, 0x2010, 2))
    rig.run(1.0)
    assert rig.take() == []
    assert rig.read("I", 0x2010, 1) == 30_000


def test_written_value_is_kept_differently(rig):
    rig.machine.inject(faults.WriteAltered(1, 0x2010, 1, 12_000))
    rig.write("I", 0x2010, 1, 15_000)
    assert rig.read("I", 0x2010, 1) == 12_000


def test_store_fails(rig):
    rig.machine.inject(faults.StoreFails(1))
    rig.write("I", 0x2010, 1, 1_111)
    rig.take()
    rig.send(0x601, struct.pack("<BHB4s", 0x23, 0x1010, 1, b"save"))
    rig.run(0.3)
    assert rig.take(0x581) == [bytes.fromhex("80 10 10 01 00 00 06 06")]
    rig.machine.node(1).power_cycle()
    assert rig.read("I", 0x2010, 1) == 30_000


def test_power_loss(rig):
    rig.write("I", 0x2010, 1, 1_111)
    rig.machine.inject(faults.PowerLoss(1), at_time=0.5)
    rig.run(0.6)
    assert rig.take(0x701) == [b"\0"]
    assert rig.read("I", 0x2010, 1) == 30_000


def ramp(rig, cycles=300, per_cycle=200):
    for k in range(1, cycles):
        rig.send(0x201, struct.pack("<Hih", 0x0F, per_cycle * k, 0))
        rig.cycle()
        if rig.state() != ENABLED:
            return


def test_stuck_encoder_ends_in_a_following_error(mapped):
    mapped.write("I", 0x6065, 0, 5_000)
    mapped.machine.inject(faults.EncoderStuck(1))
    ramp(mapped)
    assert mapped.emergencies() == [0x8611]
    assert mapped.read("i", 0x6064) == 0


def test_motor_that_turns_the_wrong_way_runs_off(mapped):
    mapped.write("I", 0x6065, 0, 5_000)
    mapped.machine.inject(faults.MotorReversed(1))
    ramp(mapped)
    assert mapped.emergencies() == [0x8611]
    assert mapped.read("i", 0x6064) < 0


def test_wrong_use_is_named(rig):
    with pytest.raises(KeyError, match="no simulated node 9"):
        rig.machine.inject(faults.NodeVanishes(9))
    with pytest.raises(ValueError, match="not both"):
        rig.machine.inject(faults.NodeVanishes(1), at_time=1.0, at_sync=5)
    rig.run(1.0)
    with pytest.raises(ValueError, match="has passed"):
        rig.machine.inject(faults.NodeVanishes(1), at_time=0.5)
    with pytest.raises(ValueError, match="has passed"):
        rig.machine.inject(faults.NodeVanishes(1), at_sync=0)
