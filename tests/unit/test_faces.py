"""Makers' faces: the firmware's formulas against the host's profiles, and the makers' own ways."""

from dataclasses import replace

import can
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drives.canopen_drive import CanopenDrive, setup
from drives.canopen_drive.conversion import Conversion
from drives.canopen_drive.line import Line
from drives.canopen_drive.recovery import HOST_LOST, lost_its_host, recover
from drives.cia402 import PowerState
from drives.errors import DriveFaultError, NotSupportedError, SdoAbortError
from drives.objects import ObjectAddress, ObjectInfo, decode, encode
from drives.parameters import DriveBackup, DriveRecord, HeldObject, JournalEntry, Phase
from drives.parameters.access import take_over, unlock
from drives.parameters.bring_back import bring_back
from drives.parameters.changes import (
    changes_back_to,
    planned_changes,
    read_loop,
    read_parameters,
)
from drives.profile import load_drive, load_machine
from drives.sim.emergency import ErrorRegister
from drives.sim.faces import Motor, face_names, face_of
from drives.sim.faces.others import PASSWORD
from drives.sim.lockstep_bus import LockstepBus
from drives.sim.machine import SimulatedDrive, SimulatedMachine
from drives.sim.plant import ChainParameters
from drives.sim.servo_kernel import Parameter
from tests.faces import own_profile

CASCADE = ("position_p", "velocity_p", "velocity_i")
GAINS = {"position_p": 12.0, "velocity_p": 0.8, "velocity_i": 4.0, "velocity_filter": 150.0}


def simulated(face: str, **changes) -> SimulatedDrive:
    chain = ChainParameters((0.02,), (), (), 0.02)
    return SimulatedDrive(
        "x",
        5,
        chain,
        4.0,
        12.0,
        encoder_counts_per_rev=8192,
        gains=GAINS,
        face=face_of(face),
        **changes,
    )


@pytest.fixture
def connected():
    """Return a drive of a face as the host sees it, and its node."""
    open_buses = []

    def connect(face: str, profile=None, **axis_changes):
        bus = LockstepBus(machine=SimulatedMachine((simulated(face),)))
        open_buses.append(bus)
        axis = load_machine("turntable-arm").axes[0]
        axis = axis.model_copy(update={"name": "x", "node_id": 5, **axis_changes})
        drive = CanopenDrive(Line(bus), axis, profile or load_drive(face))
        return drive, bus.machine.node(5), bus

    yield connect
    for bus in open_buses:
        bus.shutdown()


# --- units ---------------------------------------------------------------------------------------


@settings(max_examples=60, deadline=None)
@given(
    face=st.sampled_from(["epos4", "epos4-dual-loop", "novanta", "reference"]),
    position_p=st.floats(0.5, 200),
    velocity_p=st.floats(0.01, 50),
    ratio=st.floats(0.05, 0.8),
    constant=st.floats(0.02, 2.0),
    counts=st.integers(1000, 2**20),
)
def test_what_the_host_writes_is_what_the_firmware_understands(
    tmp_path_factory, face, position_p, velocity_p, ratio, constant, counts
):
    velocity_i = (
        ratio * velocity_p * position_p
    )  # slower than the position loop, as designs have it
    profile = load_drive(face)
    if face == "novanta":
        profile = load_drive(own_profile("novanta", tmp_path_factory.mktemp("own")))
        typed = {
            n: p.model_copy(update={"told_type": "REAL32"}) for n, p in profile.parameters.items()
        }
        profile = profile.model_copy(update={"parameters": typed})
    turn = 6.283185307179586
    motor = Motor(4.0, 12.0, constant, counts, counts / turn, {})
    raw_constant = round(constant * 1e6)
    conversion = Conversion(
        "x", profile, {"torque_constant": raw_constant * 1e-6, "counts_per_rev": counts}
    )
    wanted = dict(zip(CASCADE, (position_p, velocity_p, velocity_i), strict=True))
    held = conversion.as_held(wanted)
    memory = {(0x3001, 5): raw_constant}
    physical: dict[str, float] = {}
    for name, parameter in profile.parameters.items():
        source = parameter.follows or name
        if source not in held:
            continue
        raw = conversion.raw(name, held[source], physical)
        if parameter.type == "UNSIGNED32" and not 0 <= raw < 2**32:
            return  # the drive can not hold it: planned_changes refuses it
        stored = decode(parameter.type, encode(parameter.type, raw))
        memory[parameter.object.index, parameter.object.subindex] = stored
        physical[name] = conversion.physical(name, stored, physical)
    reference = {
        e.key: e.default for o in face_of(face).objects for e in o.entries if e.key not in memory
    }
    settings_ = face_of(face).loops(motor).settings(lambda i, s: {**reference, **memory}[i, s])
    found = [settings_[Parameter[name.upper()]] for name in CASCADE]
    loop = conversion.as_cascade(physical)
    assert [loop[name] for name in CASCADE] == pytest.approx(found, rel=1e-9)
    step = {"reference": 1e-3, "epos4": 0, "epos4-dual-loop": 1e-3, "novanta": 0}[face]
    for name, value in zip(CASCADE, found, strict=True):
        near = 0.02 if face == "epos4" else 1e-3  # small gains are a few thousand uA
        assert value == pytest.approx(wanted[name], rel=near, abs=0.51 * step)


@pytest.mark.parametrize("face", face_names())
def test_every_face_begins_with_the_gains_that_it_was_given(connected, face):
    own = {"profile": load_drive("reference")} if load_drive(face).eds_path is None else {}
    _, node, bus = connected(face, **own)
    held = [bus.machine.axes.get(0, Parameter[name.upper()]) for name in CASCADE]
    assert held == pytest.approx([GAINS[name] for name in CASCADE], rel=1e-3)
    assert node.face.name == face


def test_the_host_reads_the_same_loop_as_the_firmware_runs(connected):
    for face in ("epos4", "epos4-dual-loop", "reference"):
        drive, _, bus = connected(face)
        drive.read_scaling()
        loop = read_loop(drive)
        held = [bus.machine.axes.get(0, Parameter[name.upper()]) for name in CASCADE]
        assert [loop[name] for name in CASCADE] == pytest.approx(held, rel=1e-9)


def test_scales_come_from_where_the_profile_says(connected):
    drive, node, _ = connected("epos4")
    scaling = drive.read_scaling()
    assert scaling.position == pytest.approx(6.283185307179586 / 8192)
    assert scaling.velocity == pytest.approx(6.283185307179586 / 60)  # 0x60A9: revolutions a minute
    assert drive.rated_torque == pytest.approx(4.0)
    assert node.dictionary.read(0x6076, 0) == 4_000_000  # uN m, computed by the drive


# --- conditions, units that are not known --------------------------------------------------------


def test_a_gain_whose_unit_was_changed_in_the_drive_is_not_understood(connected):
    drive, node, _ = connected("epos4")
    drive.read_scaling()
    node.dictionary.write(0x30A1, 9, 0xFD040300)  # mA/(rad s)
    assert "pid_i" not in read_parameters(drive)
    with pytest.raises(NotSupportedError, match="its unit is known only while object 0x30A1:09 is"):
        planned_changes(drive, dict.fromkeys(CASCADE, 1.0))


def test_numbers_that_a_drive_held_in_another_unit_are_not_brought_back(connected):
    drive, node, _ = connected("epos4")
    drive.read_scaling()
    address = drive.profile.parameters["pid_i"].object
    held = {address: node.dictionary.read(0x30A1, 2)}
    node.dictionary.write(0x30A1, 9, 0xFD040300)
    assert not any(change.differs for change in changes_back_to(drive, held))  # nothing to write
    held[address] += 1
    with pytest.raises(
        NotSupportedError, match=r"pid_i: its unit is known only.*Nothing was written"
    ):
        changes_back_to(drive, held)


def test_what_has_no_known_unit_is_not_written(connected):
    drive, node, _ = connected("epos4")
    drive.read_scaling()
    before = dict(node.dictionary.parameters())
    with pytest.raises(NotSupportedError) as refused:
        planned_changes(drive, {"inertia_ff": 0.01})
    assert str(refused.value) == (
        "x, inertia_ff, object 0x30A1:05: what its unit is worth is not known, so it is neither "
        "understood nor written. Give `scale` in a drive profile of your own."
    )
    assert node.dictionary.parameters() == before


def test_a_pid_that_no_cascade_has_is_refused(connected):
    drive, node, _ = connected("epos4")
    drive.read_scaling()
    node.dictionary.write(0x30A1, 2, 2**31)
    with pytest.raises(NotSupportedError, match="is none that position P and velocity PI could be"):
        read_loop(drive)


def test_gains_that_differ_by_schedule_are_refused(connected):
    drive, node, _ = connected("epos4-dual-loop")
    drive.read_scaling()
    node.dictionary.write(0x30AE, 2, 99_000)
    with pytest.raises(NotSupportedError, match="while they differ the drive changes its gains"):
        read_loop(drive)


# --- the makers' own ways ------------------------------------------------------------------------


def test_objects_that_a_maker_does_not_show_do_not_exist_on_the_bus(connected):
    drive, node, _ = connected("epos4")
    hidden = ObjectInfo(ObjectAddress(0x608F, 1), "UNSIGNED32", "encoder increments")
    assert drive.read_optional(hidden) is None
    assert (0x608F, 1) in node.dictionary.hidden
    with pytest.raises(SdoAbortError, match="read-only"):
        drive.write(ObjectInfo(ObjectAddress(0x6076), "UNSIGNED32", "rated torque"), 1)


def test_a_latch_is_set_after_writing_and_keeps_the_other_bits(connected):
    drive, node, _ = connected("epos4-dual-loop")
    node.dictionary.force(0x30AE, 0x40, 0x2)  # the filter is on
    seen = []
    latched = node.dictionary.effects[0x30AE, 0x40]
    node.dictionary.effects[0x30AE, 0x40] = lambda value: (seen.append(value), latched(value))
    take_over(drive, {ObjectAddress(0x30AE, 0x10)})
    assert seen == [0x3]
    assert node.dictionary.read(0x30AE, 0x40) == 0x2
    take_over(drive, {ObjectAddress(0x30AE, 0x20)})  # velocity P waits for no latch
    assert seen == [0x3]


def dual_loop_going_back(entries):
    """Return the record and the backup of a drive whose filter's coefficient was 1000."""
    info = ObjectInfo(ObjectAddress(0x30AE, 0x10), "UNSIGNED32", "main_filter_a")
    entry = JournalEntry(info, 1000, 2000)
    record = DriveRecord("x", 5, 0, 0, 0, 7, (entry,) * entries, Phase.GOING_BACK)
    latch = ObjectInfo(ObjectAddress(0x30AE, 0x40), "UNSIGNED16", "latch")
    held = (HeldObject(info, 1000), HeldObject(latch, 0x2))
    return record, DriveBackup("x", 5, 0, 0, 7, 0, held)


@pytest.mark.parametrize(("entries", "set_up"), [(1, False), (1, True), (0, True)])
def test_a_latch_is_set_again_where_bringing_back_was_cut_off_before_it(connected, entries, set_up):
    """Old coefficients that wait for their latch look as if the drive worked with them."""
    drive, node, _ = connected("epos4-dual-loop")
    record, backup = dual_loop_going_back(entries)
    node.dictionary.write(0x30AE, 0x10, 2000)
    node.dictionary.force(0x30AE, 0x40, 0x2)
    seen = []
    latched = node.dictionary.effects[0x30AE, 0x40]
    node.dictionary.effects[0x30AE, 0x40] = lambda value: (
        seen.append((value, node.dictionary.read(0x30AE, 0x10))),
        latched(value),
    )
    node.dictionary.guards[0x30AE, 0x40] = lambda _: 0x08000022
    with pytest.raises(SdoAbortError):
        bring_back(drive, record, backup, set_up=set_up)
    assert node.dictionary.read(0x30AE, 0x10) == 1000
    assert seen == []
    del node.dictionary.guards[0x30AE, 0x40]
    again = bring_back(drive, record, backup, set_up=set_up)
    assert (again.written, again.failed) == ((), {})
    assert seen == [(0x3, 1000)]


@pytest.mark.parametrize("shown", [0x3, 0x2])
def test_a_latch_that_stays_shown_is_nothing_that_could_not_be_brought_back(connected, shown):
    """Where a drive keeps the bit, and where another bit of the object was changed meanwhile."""
    drive, node, _ = connected("epos4-dual-loop")
    record, backup = dual_loop_going_back(1)
    node.dictionary.effects[0x30AE, 0x40] = lambda _: None
    node.dictionary.write(0x30AE, 0x10, 2000)
    node.dictionary.force(0x30AE, 0x40, shown ^ 0x2)
    back = bring_back(drive, record, backup, set_up=False)
    assert [h.value for h in back.written] == [1000, 0x2]
    assert back.failed == {}
    assert node.dictionary.read(0x30AE, 0x40) == 0x3


class TestPassword:
    GAIN = ObjectInfo(ObjectAddress(0x2030), "REAL32", "KR_Pos")

    def test_without_one_nothing_is_written(self, connected):
        drive, _, _ = connected("prbt")
        with pytest.raises(NotSupportedError, match="Give `password` at the axis"):
            unlock(drive)
        with pytest.raises(SdoAbortError):
            drive.write(self.GAIN, 1.5)

    def test_a_wrong_one_is_told_and_not_repeated(self, connected):
        drive, _, _ = connected("prbt", password="guess")
        with pytest.raises(NotSupportedError) as refused:
            unlock(drive)
        assert "the password is wrong" in str(refused.value)
        assert "guess" not in str(refused.value)

    def test_the_right_one_opens(self, connected):
        drive, node, _ = connected("prbt", password=PASSWORD.decode())
        unlock(drive)
        drive.write(self.GAIN, 1.5)
        assert node.dictionary.read(0x2030, 0) == 1.5
        unlock(drive)  # it is open already


class TestLostHost:
    def lose(self, drive, node, bus) -> None:
        drive.write(ObjectInfo(ObjectAddress(0x1016, 1), "UNSIGNED32", "consumer"), 127 << 16 | 50)
        beat = can.Message(arbitration_id=0x77F, data=[5], is_extended_id=False)
        bus.send(beat)
        bus.clock.wait_until(bus.clock.now() + 0.5)
        assert drive.power_state() is PowerState.FAULT

    def test_an_epos4_needs_a_reset_of_the_communication_first(self, connected):
        drive, node, bus = connected("epos4")
        self.lose(drive, node, bus)
        drive.write(ObjectInfo(ObjectAddress(0x6040), "UNSIGNED16", "controlword"), 0)
        drive.write(ObjectInfo(ObjectAddress(0x6040), "UNSIGNED16", "controlword"), 0x80)
        assert drive.power_state() is PowerState.FAULT  # a fault reset alone is ignored
        said = recover(drive)
        assert "0x8130" in said
        assert "communication reset" in said
        assert drive.power_state() is PowerState.SWITCH_ON_DISABLED

    def test_a_profile_that_does_not_know_the_way_sends_nothing(self, connected):
        profile = load_drive("epos4").model_copy(update={"recovery": "unknown"})
        drive, node, bus = connected("epos4", profile)
        self.lose(drive, node, bus)
        assert recover(drive) is None
        assert drive.power_state() is PowerState.FAULT

    def test_another_fault_is_left_to_a_person(self, connected):
        drive, node, _ = connected("epos4")
        node.motion.fault(0x2310, 2)
        assert recover(drive) is None
        assert drive.power_state() is PowerState.FAULT

    @pytest.mark.parametrize("face", ["epos4", "reference"])
    @pytest.mark.parametrize("code", HOST_LOST)
    @pytest.mark.parametrize(
        ("others", "bits"), [(0x2310, ErrorRegister.CURRENT), (0x4310, ErrorRegister.TEMPERATURE)]
    )
    @pytest.mark.parametrize("order", ["before", "after"])
    @pytest.mark.parametrize("ended", ["none", "lost host", "other", "register not supported"])
    def test_a_fault_beside_the_lost_host_is_left_to_a_person(
        self, connected, face, code, others, bits, order, ended
    ):
        drive, node, _ = connected(face)
        errors = [(others, bits), (code, ErrorRegister.COMMUNICATION)]
        for one in errors if order == "before" else reversed(errors):
            node.motion.fault(*one)
        if ended == "register not supported":  # all but its generic bit may be missing
            node.dictionary.set_read_callback(0x1001, 0, lambda: ErrorRegister.GENERIC)
        elif ended != "none":
            node.emergency.clear(code if ended == "lost host" else others)
        assert lost_its_host(drive) is None
        assert recover(drive) is None
        assert drive.power_state() is PowerState.FAULT
        with pytest.raises(DriveFaultError, match=f"0x{others:04X}"):
            drive.check_idle()

    @pytest.mark.parametrize("face", ["epos4", "reference"])
    @pytest.mark.parametrize("codes", [(0x8130,), (0x8120,), (0x8120, 0x8130), (0x8130, 0x8120)])
    def test_errors_of_the_communication_alone_are_the_lost_host(self, connected, face, codes):
        drive, node, _ = connected(face)
        for code in codes:
            node.motion.fault(code, ErrorRegister.COMMUNICATION)
        assert lost_its_host(drive) == codes[-1]
        assert f"0x{codes[-1]:04X}" in recover(drive)
        assert drive.power_state() is PowerState.SWITCH_ON_DISABLED


def test_the_same_machine_whatever_its_face():
    """The face changes what is seen, not what is behind: hardware and plant are the same."""
    one, other = simulated("reference"), simulated("epos4")
    assert replace(one, face=other.face).hardware == one.hardware


@pytest.mark.parametrize(
    ("cycle", "said"),
    [
        (0.0005, "not 1 to 255 times"),
        (0.002, "shorter than 4 ms, the shortest that drive profile epos4 allows"),
        (0.2, "longer than 100 ms, the longest that drive profile epos4 allows"),
        (0.007, "no multiple of 2 ms, as drive profile epos4 wants it"),
    ],
)
def test_cycles_that_the_drive_can_not_follow_are_refused(connected, cycle, said):
    profile = load_drive("epos4")
    sync = profile.sync.model_copy(update={"shortest": 0.004, "multiple": 0.002})
    drive, node, _ = connected("epos4", profile.model_copy(update={"sync": sync}))
    with pytest.raises(NotSupportedError, match=said):
        setup.cycle(drive, cycle, setup.TemporaryObjects(drive))
    setup.cycle(drive, 0.006, setup.TemporaryObjects(drive))  # this one it can
    assert node.dictionary.read(0x60C2, 1) == 6


def test_a_drive_without_a_target_that_the_pdos_carry_is_refused(connected):
    drive, node, _ = connected("prbt")
    with pytest.raises(NotSupportedError, match="the drive has no target torque 0x6071"):
        setup.process_data(drive, setup.TemporaryObjects(drive))
    assert not node.nmt.operational
