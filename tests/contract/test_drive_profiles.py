"""Every drive profile against the EDS file of its drive: what it names is there, as it says."""

from pathlib import Path

import pytest

from drives import objects
from drives.canopen_drive import CanopenDrive
from drives.canopen_drive.line import Line
from drives.canopen_drive.torque_offset import TORQUE_OFFSET
from drives.objects import ObjectAddress
from drives.profile import DriveProfile, load_drive, load_machine, packaged
from drives.profile.eds import info_at, read_eds, readable, variable_at, variables, writable
from drives.profile.match import Presented, best_matches
from drives.sim.faces.face import Face, FixedLoops
from drives.sim.faces.merge import dressed
from drives.sim.lockstep_bus import LockstepBus
from drives.sim.machine import SimulatedDrive, SimulatedMachine
from drives.sim.plant import ChainParameters

EDS = Path(__file__).parents[3] / "shared" / "eds"
REAL = sorted(p for p in EDS.glob("*") if p.suffix in (".eds", ".dcf")) if EDS.is_dir() else []
SHIPPED = [name for name in packaged("drives") if load_drive(name).eds_path is not None]
USED = [
    objects.DEVICE_TYPE,
    objects.ABORT_CONNECTION,
    objects.CONSUMER_HEARTBEAT,
    objects.CONTROLWORD,
    objects.ENCODER_COUNTS,
    objects.ENCODER_REVOLUTIONS,
    objects.ERROR_BEHAVIOUR,
    objects.FEED_CONSTANT,
    objects.FEED_REVOLUTIONS,
    objects.GEAR_MOTOR,
    objects.GEAR_SHAFT,
    objects.INTERPOLATION_INDEX,
    objects.INTERPOLATION_VALUE,
    objects.MODE,
    objects.MODE_DISPLAY,
    objects.POSITION_ACTUAL,
    objects.PRODUCER_HEARTBEAT,
    objects.PRODUCT_CODE,
    objects.QUICK_STOP_OPTION,
    objects.RATED_TORQUE,
    objects.REVISION,
    objects.SERIAL_NUMBER,
    objects.STATUSWORD,
    objects.STORE_ALL,
    objects.SUPPORTED_MODES,
    objects.SYNC_PERIOD,
    objects.TARGET_POSITION,
    objects.TARGET_TORQUE,
    objects.TORQUE_ACTUAL,
    objects.VELOCITY_UNIT,
    objects.VENDOR_ID,
    TORQUE_OFFSET,
]
"""Every standard object that the host side uses."""
PROFILE_OF = {
    "maxon_epos4_0x1018.eds": ("epos4", "epos4-dual-loop"),
    "cob_Elmo.dcf": ("elmo-gold",),
    "cob_ElmoSimplIQ.dcf": ("elmo-simpliq",),
    "cob_Schunk_0_63.dcf": ("prbt",),
    "prbt_0_1.dcf": ("prbt",),
    "ros2canopen_cia402_slave.eds": (),
    "canopen_example_e35.eds": (),
}


def named(profile: DriveProfile) -> list[tuple[ObjectAddress, str | None]]:
    """Objects that a profile names, with the type that it expects."""
    found: list[tuple[ObjectAddress, str | None]] = []
    for parameter in profile.parameters.values():
        told = None if parameter.told_type == "unknown" else parameter.told_type
        found.append((parameter.object, told))
        if parameter.only_if is not None:
            found.append((parameter.only_if.object, parameter.only_if.type))
    found += [(q.object, q.type) for q in profile.quantities.values()]
    found += [(latch.object, latch.type) for latch in profile.latches]
    found += [(address, None) for one in profile.filters for address in one.objects]
    if profile.unlock is not None:
        found.append((profile.unlock.object, "VISIBLE_STRING"))
        if profile.unlock.level is not None:
            found.append((profile.unlock.level, "UNSIGNED8"))
    if not isinstance(profile.position, str):
        scale = profile.position
        found += [(a, None) for a in (scale.counts, scale.revolutions) if a and a != "machine"]
    if not isinstance(profile.torque, str):
        found.append((profile.torque.per_mille_of, None))
    if profile.store is not None and not isinstance(profile.store, str):
        found.append((profile.store.object, "UNSIGNED32"))
    return found


@pytest.mark.skipif(not REAL, reason="no EDS files of real drives beside the project")
@pytest.mark.parametrize("path", REAL, ids=lambda p: p.name)
class TestRealEds:
    def test_is_read(self, path):
        dictionary = read_eds(path)
        entries = variables(dictionary)
        assert len(entries) > 100
        assert info_at(dictionary, objects.CONTROLWORD.address).type == "UNSIGNED16"
        assert any(writable(v) for v in entries)

    def test_the_profiles_made_for_it_fit_best(self, path):
        found = best_matches(Presented.of_eds(read_eds(path)))
        wanted = PROFILE_OF[path.name]
        best = [m.profile.name for m in found if m.fits][: len(wanted) or 1]
        assert tuple(best) == (wanted or ("cia402",))

    def test_what_its_profiles_name_is_there(self, path):
        for name in PROFILE_OF[path.name]:
            profile = load_drive(name).with_eds(path)
            assert disagreements(profile) == []

    def test_copies_that_ship_are_whole(self, path):
        if not PROFILE_OF[path.name]:
            pytest.skip("not shipped")
        folder = Path(load_drive("reference").path).parent
        assert path.read_bytes() in [p.read_bytes() for p in folder.glob("*.[de][cd][fs]")]


def disagreements(profile: DriveProfile) -> list[str]:
    """What a profile names and its EDS file has otherwise; and standard objects nobody mentions."""
    dictionary = read_eds(profile.eds_path)
    found = []
    for address, told in named(profile):
        if address in profile.absent:
            continue
        if variable_at(dictionary, address) is None and dictionary.get(address.index) is None:
            found.append(f"{address} is not in {profile.eds}")
        info = info_at(dictionary, address)
        if told is not None and (info is None or info.type != told):
            found.append(f"{address} is {info.type if info else 'nothing'}, not {told}")
    found += [
        f"{address} is there, though the profile says it is not"
        for address in profile.absent
        if variable_at(dictionary, address) is not None
    ]
    for used in USED:
        info = info_at(dictionary, used.address)
        if info is None and used.address not in profile.absent:
            found.append(
                f"{used.address} ({used.name}) is missing, and the profile does not say so"
            )
        if info is not None and info.type != used.type:
            found.append(f"{used.address} ({used.name}) is {info.type}, not {used.type}")
    return found


@pytest.mark.parametrize("name", SHIPPED)
def test_a_packaged_profile_agrees_with_the_eds_that_it_ships(name):
    assert disagreements(load_drive(name)) == []


@pytest.mark.parametrize("name", packaged("drives"))
def test_a_packaged_profile_says_where_its_facts_come_from(name):
    profile = load_drive(name)
    assert profile.sources or name == "reference"
    assert profile.name == name


def test_the_check_sees_a_wrong_type_and_a_missing_object():
    epos4 = load_drive("epos4")
    wrong = epos4.parameters["pid_p"].model_copy(update={"told_type": "REAL32"})
    lost = epos4.parameters["pid_d"].model_copy(update={"object": ObjectAddress(0x5555, 1)})
    other = epos4.model_copy(
        update={
            "parameters": {"pid_p": wrong, "pid_d": lost},
            "absent": (ObjectAddress(0x1010, 1),),
        }
    )
    said = " ".join(disagreements(other))
    assert "0x30A1:01 is UNSIGNED32, not REAL32" in said
    assert "0x5555:01 is not in" in said
    assert "0x1010:01 is there" in said
    assert "0x608F:01 (encoder increments) is missing" in said


@pytest.fixture
def dressed_drive():
    """Return a drive that shows the objects of an EDS file, as the host sees it, and its node."""
    buses = []

    def connect(path: Path):
        described, hidden = dressed(path)
        face = Face("dressed", FixedLoops, described, hidden)
        chain = ChainParameters((0.02,), (), (), 0.0)
        bus = LockstepBus(
            machine=SimulatedMachine((SimulatedDrive("x", 5, chain, 4, 8, face=face),))
        )
        buses.append(bus)
        axis = load_machine("turntable-arm").axes[0]
        axis = axis.model_copy(update={"name": "x", "node_id": 5})
        return CanopenDrive(Line(bus), axis, load_drive("cia402").with_eds(path)), bus.machine.node(
            5
        )

    yield connect
    for bus in buses:
        bus.shutdown()


@pytest.mark.skipif(not REAL, reason="no EDS files of real drives beside the project")
@pytest.mark.parametrize("path", REAL, ids=lambda p: p.name)
class TestSimulatedFromRealEds:
    def test_the_host_reads_every_object_with_its_own_type(self, path, dressed_drive):
        drive, node = dressed_drive(path)
        count = 0
        for variable in variables(drive.dictionary):
            info = drive.info(ObjectAddress(variable.index, variable.subindex))
            if info is None or not readable(variable):
                continue
            value = drive.read(info)  # raises if host and drive do not agree on its size
            if not isinstance(value, str):
                assert value == node.dictionary.read(variable.index, variable.subindex)
            count += 1
        assert count > 80

    def test_what_the_file_does_not_have_is_not_there(self, path, dressed_drive):
        drive, _ = dressed_drive(path)
        for used in USED:
            there = variable_at(drive.dictionary, used.address) is not None
            assert (drive.read_optional(used) is not None) == there

    def test_a_type_other_than_the_standards_is_taken_from_the_file(self, path, dressed_drive):
        drive, node = dressed_drive(path)
        own = drive.info(TORQUE_OFFSET.address)
        if own is None or own.type == TORQUE_OFFSET.type:
            pytest.skip("its torque offset is the standard's, or not there")
        drive.write(TORQUE_OFFSET, -1234)  # INTEGER16 by name, INTEGER32 on the wire
        assert node.dictionary.read(0x60B2, 0) == -1234
        assert drive.read(TORQUE_OFFSET) == -1234
