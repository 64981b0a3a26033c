"""Object dictionary and SDO server of the simulated drive against CiA 301 and its EDS file."""

import struct
from io import StringIO

import pytest
from canopen.objectdictionary import ODArray, ODRecord, ODVariable, datatypes
from canopen.objectdictionary.eds import import_eds

from drives.sim.eds import eds_text, packaged_eds
from drives.sim.entries import ENTRIES

TOO_LONG, TOO_SHORT = 0x06070012, 0x06070013
NO_OBJECT, NO_SUBINDEX = 0x06020000, 0x06090011
READ_ONLY, INVALID, TOO_HIGH, TOO_LOW = 0x06010002, 0x06090030, 0x06090031, 0x06090032


def variables(od):
    for described in od.values():
        if described.index < 0x1000:
            continue  # data types that may fill gaps in RPDOs
        if isinstance(described, ODVariable):
            yield (described.index, 0), described
        else:
            for sub in described.values():
                yield (described.index, sub.subindex), sub


@pytest.fixture(scope="module", params=[1, 5, 127])
def node_id(request):
    return request.param


class TestEdsFile:
    """A foreign reader (python canopen) takes the packaged file apart."""

    def test_file_is_what_the_tables_say(self):
        assert packaged_eds().decode() == eds_text()

    def test_every_entry_agrees_with_the_node(self, rig_of, node_id):
        od = import_eds(StringIO(packaged_eds().decode()), node_id)
        in_file = dict(variables(od))
        rig = rig_of(1)
        assert set(in_file) == set(ENTRIES)
        node = rig.machine.node(1)
        node.dictionary.set_node_id(node_id)
        for key, var in in_file.items():
            variable = node.dictionary.lookup(*key)
            where = f"0x{key[0]:04X}:{key[1]:02X}"
            assert var.data_type == variable.datatype, where
            assert var.access_type == variable.access, where
            assert var.pdo_mappable == ENTRIES[key].mappable, where
            if var.data_type in datatypes.INTEGER_TYPES:
                entry = ENTRIES[key]
                assert (var.min, var.max) == (entry.low, entry.high), where
                assert var.default == entry.default_for(node_id), where
            elif var.data_type in datatypes.FLOAT_TYPES:
                assert var.default == pytest.approx(ENTRIES[key].default), where

    def test_defaults_are_what_a_plain_drive_answers(self, rig_of):
        own = {(0x1018, 4), (0x6076, 0), (0x2010, 1), (0x2010, 2), (0x2010, 3), (0x2010, 6)}
        live = {(0x6041, 0), (0x1021, 0), (0x6061, 0)}
        rig = rig_of(1)
        od = import_eds(StringIO(packaged_eds().decode()), 1)
        for key, var in variables(od):
            if key in own | live:
                continue
            raw = rig.read_raw(*key)
            expected = var.default
            if var.data_type == datatypes.VISIBLE_STRING:
                assert raw.decode() == expected
            else:
                assert var.decode_raw(raw) == pytest.approx(expected), f"{key[0]:04X}:{key[1]}"

    def test_kinds_of_objects(self):
        od = import_eds(StringIO(packaged_eds().decode()), 1)
        assert isinstance(od[0x1600], ODRecord)
        assert isinstance(od[0x1016], ODArray)
        assert isinstance(od[0x6040], ODVariable)
        assert od.device_information.nr_of_RXPDO == 4

    def test_mandatory_cia402_objects_are_there(self):
        od = import_eds(StringIO(packaged_eds().decode()), 1)
        wanted = """6007 603F 6040 6041 605A 605B 605C 605D 605E 6060 6061 6064 6065 6066 606C 6071
            6072 6074 6076 6077 607A 607D 607F 6080 6081 6083 6084 6085 608F 6091 60B0 60B1 60B2
            60C2 60F4 60FF 6502 1000 1001 1003 1005 1006 1008 1009 100A 1010 1011 1014 1016 1017
            1018 1021 1029 2010 2020 2021 2030"""
        assert all(int(index, 16) in od for index in wanted.split())


class TestSdo:
    def test_device_type_says_servo_drive(self, rig):
        assert rig.read("I", 0x1000) == 0x00020192

    def test_long_strings_come_in_segments(self, rig):
        assert rig.read_raw(0x1008) == b"simulated CiA 402 servo drive"

    def test_identity(self, rig):
        assert rig.read("I", 0x1018, 4) == 4711
        assert rig.read("B", 0x1018, 0) == 4

    def test_eds_can_be_read_from_the_drive(self, rig):
        assert rig.read_raw(0x1021) == packaged_eds()

    @pytest.mark.parametrize(
        ("index", "sub", "data", "code"),
        [
            (0x1000, 0, b"\1\0\0\0", READ_ONLY),
            (0x6041, 0, b"\1\0", READ_ONLY),
            (0x2000, 0, b"\1", NO_OBJECT),
            (0x6040, 1, b"\1\0", NO_SUBINDEX),
            (0x2010, 7, b"\1\0\0\0", NO_SUBINDEX),
            (0x1800, 4, b"\0", NO_SUBINDEX),
            (0x6040, 0, b"\1\0\0", TOO_LONG),
            (0x2010, 1, b"\1\0", TOO_SHORT),
            (0x2010, 4, struct.pack("<H", 1001), TOO_HIGH),
            (0x2020, 1, b"\3", TOO_HIGH),
            (0x2020, 2, struct.pack("<I", 99), TOO_LOW),
            (0x2020, 4, struct.pack("<f", 0.0), TOO_LOW),
            (0x2020, 3, struct.pack("<f", 10.5), TOO_HIGH),
            (0x2020, 3, struct.pack("<f", float("nan")), INVALID),
            (0x2020, 3, struct.pack("<f", float("inf")), TOO_HIGH),
            (0x605A, 0, struct.pack("<h", 3), INVALID),
            (0x6060, 0, struct.pack("<b", 6), INVALID),
            (0x6060, 0, struct.pack("<b", 3), INVALID),
            (0x60C2, 1, b"\0", TOO_LOW),
            (0x60C2, 2, struct.pack("<b", -7), TOO_LOW),
            (0x1010, 1, b"SAVE", 0x08000020),
            (0x1011, 1, b"save", 0x08000020),
            (0x1003, 0, b"\1", INVALID),
            (0x1005, 0, struct.pack("<I", 0x40000080), INVALID),
            (0x1014, 0, struct.pack("<I", 0x82), 0x08000022),
        ],
    )
    def test_refused_writes_name_the_reason(self, rig, aborted, index, sub, data, code):
        with aborted(code):
            rig.write_raw(index, sub, data)

    def test_a_refused_write_changes_nothing(self, rig, aborted):
        before = rig.read("H", 0x2010, 4)
        with aborted(TOO_HIGH):
            rig.write("H", 0x2010, 4, 60_000)
        assert rig.read("H", 0x2010, 4) == before

    @pytest.mark.parametrize(("index", "sub"), [(0x1000, 1), (0x6041, 255), (0x1018, 5)])
    def test_no_answer_is_given_for_subindices_that_do_not_exist(self, rig, aborted, index, sub):
        with aborted(NO_SUBINDEX):
            rig.read_raw(index, sub)

    def test_objects_that_do_not_exist(self, rig, aborted):
        with aborted(NO_OBJECT):
            rig.read_raw(0x5FFF)

    def test_node_answers_only_its_own_requests(self, rig):
        rig.take()
        rig.send(0x602, bytes((0x40, 0, 0x10, 0, 0, 0, 0, 0)))
        assert rig.take() == []

    def test_segmented_download(self, rig):
        rig.answer(struct.pack("<BHBI", 0x21, 0x2010, 1, 4))
        data = struct.pack("<I", 12_345)
        rig.answer(bytes((0x01 | 3 << 1,)) + data + bytes(3))
        assert rig.read("I", 0x2010, 1) == 12_345

    def test_toggle_bit_is_checked(self, rig, aborted):
        rig.answer(struct.pack("<BHB4x", 0x40, 0x1008, 0))
        with aborted(0x05030000):
            rig.answer(bytes((0x70,)) + bytes(7))

    def test_gain_reaches_the_loops(self, rig):
        from drives.sim.firmware import Parameter

        rig.write("I", 0x2010, 2, 1_234)
        assert rig.machine.axes.get(0, Parameter.VELOCITY_P) == pytest.approx(1.234)
        rig.write("B", 0x2020, 1, 1)
        rig.write("I", 0x2020, 2, 42_500)
        assert rig.machine.axes.get(0, Parameter.FILTER1_FREQUENCY) == pytest.approx(42.5)

    def test_filters_wait_until_the_power_stage_is_off(self, rig, aborted):
        rig.enable()
        with aborted(0x08000022):
            rig.write("B", 0x2020, 1, 1)
        rig.write("I", 0x2010, 1, 5_000)
        rig.control(0)
        rig.write("B", 0x2020, 1, 1)
        assert rig.read("B", 0x2020, 1) == 1
