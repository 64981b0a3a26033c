"""Faces from a user's own files: what they say is what the drive does, and what they lack is told."""

from dataclasses import astuple
from math import pi

import pytest
import yaml
from durand.services.sdo.server import SDODomainAbort
from hypothesis import example, given, settings
from hypothesis import strategies as st

from drives.canopen_drive import connect
from drives.errors import ProfileError
from drives.objects import ObjectAddress
from drives.profile import load_drive, load_machine
from drives.profile.eds import info_at, read_eds, variables
from drives.profile.schema import json_schema
from drives.sim.faces import Motor, face_of
from drives.sim.faces.eds_entries import EdsFile
from drives.sim.faces.merge import shipped
from drives.sim.faces.others import PASSWORD
from drives.sim.faces.own import own_face
from drives.sim.machine import simulated_machine
from drives.sim.servo_kernel import Parameter
from fieldtool.workflow.profiling import new_profile
from fieldtool.workflow.session import resolved
from tests.faces import machine_of, simulated

KP, TN, TAKE_OVER, POSITION_KP, KEEP, KEPT = (
    (0x2200, 1), (0x2200, 2), (0x2200, 3), (0x2201, 0), (0x2300, 0), (0x2301, 0),
)  # fmt: skip
SIGNATURE = 0x4B454550


@pytest.fixture
def machine(tmp_path):
    return machine_of(("own", "reference"), tmp_path)


# --- against the faces that were written by hand ---------------------------------------------------


@pytest.mark.parametrize("name", ["reference", "epos4", "epos4-dual-loop"])
@settings(max_examples=15, deadline=None)
@given(
    constant=st.floats(0.1, 2.0),
    counts=st.integers(1000, 2**20),
    outer=st.floats(0.5, 40),
    inner=st.floats(0.05, 0.5),
)
@example(constant=0.1, counts=1000, outer=1.0, inner=0.0546875)  # half a unit
def test_files_alone_give_the_face_that_was_written_by_hand(name, constant, counts, outer, inner):
    gains = {"position_p": outer, "velocity_p": inner, "velocity_i": 0.3 * inner * outer}
    if name == "reference":
        gains |= {"velocity_ff": 0.5, "filter1_type": 1, "filter1_frequency": 90.0}
    motor = Motor(4.0, 12.0, round(constant, 6), counts, counts / (2 * pi), gains)
    profile = load_drive(name)
    found, start = [], {}
    for face in (own_face(profile, profile.eds_path), face_of(name)):
        loops = face.loops(motor)
        factory = loops.factory()
        start = start or factory
        for key, value in factory.items():  # half a unit may round either way
            assert value == pytest.approx(
                start.get(key, value), rel=1e-6, abs=isinstance(value, int)
            )
        held = {key: entry.default for key, entry in face.entries.items()}
        held |= face.values(motor) | factory | start
        acting = loops.settings(lambda i, s, held=held: held[i, s])
        found.append({p.name: v for p, v in acting.items()} | {"unit": face.units(motor)[0]})
        for what in ("latches", "hidden", "fault_after_lost_heartbeat"):
            assert getattr(face, what) == getattr(face_of(name), what)
    own, by_hand = found
    open_in_profile = {"INERTIA_FF": 0.0} if name == "epos4" else {}
    assert own | open_in_profile == pytest.approx(by_hand, rel=1e-9)


@pytest.mark.parametrize(
    "name",
    ["elmo-gold.dcf", "elmo-simpliq.dcf", "epos4.eds", "prbt.dcf", "reference.eds", "schunk.dcf"],
)
def test_a_first_profile_and_its_eds_already_make_a_drive(name, tmp_path):
    """All of it answers by SDO, with its own types; what is unknown does nothing."""
    made = new_profile(shipped(name), tmp_path / "first.yaml")
    machine_of(("reference", "reference"), tmp_path, table={"drive": made.path.name})
    in_machine(face={"profile": made.path.name})(tmp_path)
    machine = load_machine(tmp_path / "machine.yaml")
    with simulated(machine) as running, connect(machine, to_move=False) as group:
        drive, node = group.drives[0], running.nodes[0]
        assert running.axes.get(0, Parameter.VELOCITY_P) == 1.2
        told = read_eds(shipped(name))
        objects = [ObjectAddress(v.index, v.subindex) for v in variables(told)]
        infos = [info_at(told, address) for address in objects]
        read = [i for i in infos if i and node.face.entries[astuple(i.address)].access != "wo"]
        for info in read:
            drive.read(info)
        assert len(read) > 100


# --- what the drive does ---------------------------------------------------------------------------


def test_it_shows_itself_as_the_files_say(machine):
    with simulated(machine) as running, connect(machine, to_move=False) as group:
        drive, node = group.drives[0], running.nodes[0]
        scaling = drive.read_scaling()
        assert scaling.velocity == pytest.approx(0.1 * 2 * pi / 60)  # 0x60A9: 0.1 rpm
        assert scaling.position == pytest.approx(2 * pi / 2**20)
        assert drive.rated_torque == pytest.approx(4.0)  # 0x2100:01, 10 mA, and 0x2100:02
        assert node.dictionary.read(0x2100, 1) == 4000
        assert node.dictionary.shows((0x6076, 0)) is None
        assert node.face.entries[0x6502, 0].default == 0x381  # profile position, the cyclic modes
        assert node.face.entries[0x1018, 2].default == 0x00402001  # of the file's [DeviceInfo]
        assert running.axes.get(0, Parameter.VELOCITY_P) == pytest.approx(1.2, rel=1e-9)
        assert running.axes.get(0, Parameter.VELOCITY_I) == pytest.approx(8.0, rel=1e-5)
        assert running.axes.get(0, Parameter.POSITION_P) == pytest.approx(15.0, rel=1e-7)


def test_values_act_after_their_latch_and_survive_only_if_they_are_stored(machine):
    with simulated(machine) as running:
        node = running.nodes[0]
        write, get = node.dictionary.write, running.axes.get
        write(*KP, 9000)
        assert get(0, Parameter.VELOCITY_P) == pytest.approx(1.2)  # it waits
        write(*POSITION_KP, 20 / 2**20)  # another one, which waits for nothing
        assert get(0, Parameter.POSITION_P) == pytest.approx(20.0)
        assert get(0, Parameter.VELOCITY_P) == pytest.approx(1.2)
        running.receive(0, bytes((0x82, node.node_id)))  # a reset of the communication is no latch
        assert get(0, Parameter.VELOCITY_P) == pytest.approx(1.2)
        write(*TAKE_OVER, 1)
        assert get(0, Parameter.VELOCITY_P) == pytest.approx(1.8)
        assert node.dictionary.read(*TAKE_OVER) == 0
        node.power_cycle()
        assert get(0, Parameter.VELOCITY_P) == pytest.approx(1.2)
        write(*KP, 9000)
        with pytest.raises(SDODomainAbort):
            write(*KEEP, SIGNATURE + 1)
        write(*KEEP, SIGNATURE)
        running.advance_to(running.time + 10**9)
        assert node.dictionary.read(*KEPT) == 1
        node.power_cycle()
        assert get(0, Parameter.VELOCITY_P) == pytest.approx(1.8)


def test_states_and_ranges_are_kept(machine):
    with simulated(machine) as running, connect(machine) as group:
        node = running.nodes[0]
        write = node.dictionary.write
        for wrong in (-1e-5, float("inf")):
            with pytest.raises(SDODomainAbort):
                write(*POSITION_KP, wrong)
        with group.motion(0.002):
            assert node.motion.powered
            write(*KP, 6100)  # `write: always`
            for key, value in ((POSITION_KP, 20 / 2**20), (KEEP, SIGNATURE)):
                with pytest.raises(SDODomainAbort):
                    write(*key, value)
        write(*POSITION_KP, 20 / 2**20)


def test_a_password_stands_before_gains(tmp_path):
    machine = machine_of(("schunk", "reference"), tmp_path)
    with simulated(machine) as running:
        dictionary = running.nodes[0].dictionary
        with pytest.raises(SDODomainAbort):
            dictionary.write(0x2030, 0, 2.5)
        dictionary.write(0x2008, 0, b"guess")
        with pytest.raises(SDODomainAbort):
            dictionary.write(0x2030, 0, 2.5)
        dictionary.write(0x2008, 0, PASSWORD)
        dictionary.write(0x2030, 0, 2.5)
        assert dictionary.read(0x2030, 0) == 2.5


# --- what is wrong with the files ------------------------------------------------------------------


def in_profile(**facts):
    def change(folder):
        path = folder / "own.yaml"
        data = yaml.safe_load(path.read_text())
        for key, value in facts.items():
            *parts, last = key.split("__")
            inner = data
            for part in parts:
                inner = inner[part]
            inner[last] = value
        path.write_text(yaml.safe_dump(data, sort_keys=False))

    return change


def in_machine(**facts):
    def change(folder):
        path = folder / "machine.yaml"
        data = yaml.safe_load(path.read_text())
        data["simulation"]["axes"][0] |= facts
        path.write_text(yaml.safe_dump(data, sort_keys=False))

    return change


def in_eds(old, new):
    def change(folder):
        path = folder / "own.eds"
        text = path.read_text()
        assert old in text
        path.write_text(text.replace(old, new))

    return change


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (
            lambda folder: (folder / "own.eds").unlink(),
            "simulation: axis table, `face`: there is no EDS file {folder}/own.eds. Give its path from "
            "the machine profile's folder as `eds`.",
        ),
        (
            in_machine(face={"profile": "mine.yaml", "eds": "own.eds"}),
            "axis table, face.profile, 'mine.yaml': no such drive profile; packaged are: ",
        ),
        (
            in_machine(face={"profile": "cia402"}),
            "simulation: axis table, `face`: drive profile cia402 has no EDS file of its own. Give the "
            "drive's as `eds`, beside `profile: cia402`.",
        ),
        (
            in_machine(face={"eds": "own.eds"}),
            "axis table, face.profile is missing. Add it.",
        ),
        (
            in_machine(face={"profile": "own.yaml", "edz": "own.eds"}),
            "axis table, face.edz is not a known key. Check its spelling or take it out.",
        ),
        (
            in_profile(parameters__position_p__object="0x2999:01"),
            "axis table, `face`: drive profile own names object 0x2999:01 (parameters.position_p), "
            "which own.eds does not have. Correct the profile, or give the EDS of this drive's "
            "firmware.",
        ),
        (
            in_profile(store__status="0x2302"),
            "names object 0x2302:00 (store.status), which own.eds does not have. Correct the profile",
        ),
        (
            in_profile(torque__per_mille_of="0x6076"),
            "names object 0x6076:00 (torque.per_mille_of), which own.eds does not have.",
        ),
        (
            in_profile(parameters__velocity_p__type="INTEGER16"),
            "drive profile own says that object 0x2200:01 (parameters.velocity_p) is INTEGER16, and "
            "own.eds that it is UNSIGNED16. Correct the profile.",
        ),
        (
            in_eds("DataType=0x0008", "DataType=0x0016"),
            "object 0x2201:00 (parameters.position_p of drive profile own) is no number in own.eds.",
        ),
        (
            in_profile(parameters__velocity_p__scale=2e-6),
            "parameters.velocity_p: 1.2 N m s/rad is 6e+06 in object 0x2200:01 (UNSIGNED16), which "
            "holds 0 to 65535. Correct `scale` or `object` in drive profile own, or the simulated "
            "value.",
        ),
        (
            in_profile(quantities__gear={"object": "0x2301", "type": "UNSIGNED8", "scale": 1.0,
                                         "unit": "1"},
                       parameters__inertia_ff__times={"gear": 1}),
            "quantities.gear of drive profile own: own.eds gives object 0x2301:00 no value. Write what "
            "your drive holds there as its DefaultValue.",
        ),
        (
            in_machine(rated_torque=4.0025, peak_torque=12),
            "the rated current 40.025 A is 4002.5 in object 0x2100:01 of drive profile own, which holds "
            "whole numbers. Give a rated_torque that is one there, such as 4.002.",
        ),
        (
            in_eds("DefaultValue=4290004736", "DefaultValue=7"),
            "own.eds gives 0x60A9 the value 0x00000007, which is no velocity unit that is known here.",
        ),
        (
            lambda folder: (folder / "own.eds").write_text("[1000]\n"),
            "own.eds: is no EDS: it has none of",
        ),
        (
            in_machine(face={"profile": "reference", "eds": "machine.yaml"}),
            "simulation: axis table, `face`: {folder}/machine.yaml: is no EDS: it has none of the",
        ),
    ],
)  # fmt: skip
def test_what_is_wrong_is_said_in_one_sentence_with_its_place(machine, tmp_path, change, said):
    change(tmp_path)
    with pytest.raises(ProfileError) as refused:
        simulated_machine(load_machine(tmp_path / "machine.yaml"))
    print(refused.value)
    assert said.format(folder=tmp_path) in str(refused.value)
    assert "\n" not in str(refused.value)
    assert str(tmp_path) in str(refused.value)


def test_a_small_rounding_of_the_rated_torque_is_none(machine, tmp_path):
    in_machine(rated_torque=4.00001, peak_torque=12)(tmp_path)
    assert simulated_machine(load_machine(tmp_path / "machine.yaml")).drives[0].face.name == "own"


# --- files around it -------------------------------------------------------------------------------


def test_a_session_s_copy_of_the_profile_finds_the_files(machine):
    face = resolved(machine)["simulation"]["axes"][0]["face"]
    folder = machine.path.parent.resolve()
    assert face == {"profile": str(folder / "own.yaml"), "eds": str(folder / "own.eds")}


def test_editors_know_the_keys():
    defined = json_schema("machine")["$defs"]
    assert set(defined["FaceProfile"]["properties"]) == {"profile", "eds"}
    forms = defined["SimulatedAxisProfile"]["properties"]["face"]["anyOf"]
    assert {"$ref": "#/$defs/FaceProfile"} in forms
    assert {"type": "string"} in forms


def test_an_eds_with_a_mark_before_it_and_negative_numbers_as_bits_is_read(tmp_path):
    path = tmp_path / "x.eds"
    path.write_bytes(
        b"\xef\xbb\xbf[607A]\nParameterName=x\nObjectType=0x7\nDataType=0x0004\nAccessType=rw\n"
        b"DefaultValue=0xFFFFFFFE\nLowLimit=0x80000000\nHighLimit=0x7FFFFFFF\n"
        b"[6060]\nParameterName=y\nDataType=0x0002\nAccessType=rw\nDefaultValue=0x1FF\n"
    )
    file = EdsFile(path)
    entry = file.objects[0x607A].entries[0]
    assert (entry.default, entry.low, entry.high) == (-2, -(2**31), 2**31 - 1)
    assert file.objects[0x6060].entries[0].default == 127  # as much as it holds
