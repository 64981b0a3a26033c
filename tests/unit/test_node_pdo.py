"""Process data of the simulated drive: mapping procedure, transmission types, SYNC."""

import struct
from itertools import pairwise

import pytest

NOT_MAPPABLE, LENGTH, WRONG_STATE, UNSUPPORTED = 0x06040041, 0x06040042, 0x08000022, 0x06010000
INVALID = 0x06090030
OUT = (0x60400010, 0x607A0020, 0x60710010)
IN = (0x60410010, 0x60640020, 0x60770010)
LAYOUT = "<Hih"


@pytest.fixture
def mapped(rig):
    """The host's standard mapping: one PDO each way, at SYNC."""
    rig.map_pdo(0x1400, 0x1600, 0x201, OUT)
    rig.map_pdo(0x1800, 0x1A00, 0x181, IN)
    rig.nmt(0x01)
    rig.take()
    return rig


class TestMappingProcedure:
    def test_writing_while_valid_is_refused(self, rig, aborted):
        with aborted(WRONG_STATE):
            rig.write("B", 0x1600, 0, 0)
        with aborted(WRONG_STATE):
            rig.write("I", 0x1600, 1, OUT[0])

    def test_writing_entries_while_their_number_is_not_zero_is_refused(self, rig, aborted):
        rig.write("I", 0x1400, 1, 0x80000201)
        with aborted(UNSUPPORTED):
            rig.write("I", 0x1600, 1, OUT[0])

    @pytest.mark.parametrize(
        "word",
        [
            0x60410010,  # can be read only
            0x20100120,  # a gain is not mappable
            0x50000010,  # does not exist
            0x60400008,  # length does not fit
            0x60400110,  # no such sub-index
            0x00010001,  # a bit is no whole byte
        ],
    )
    def test_objects_that_an_rpdo_can_not_carry(self, rig, aborted, word):
        rig.write("I", 0x1400, 1, 0x80000201)
        rig.write("B", 0x1600, 0, 0)
        with aborted(NOT_MAPPABLE):
            rig.write("I", 0x1600, 1, word)

    def test_a_tpdo_carries_no_gaps(self, rig, aborted):
        rig.write("I", 0x1800, 1, 0xC0000181)
        rig.write("B", 0x1A00, 0, 0)
        with aborted(NOT_MAPPABLE):
            rig.write("I", 0x1A00, 1, 0x00050008)

    def test_more_than_eight_bytes_are_refused(self, rig, aborted):
        rig.write("I", 0x1800, 1, 0xC0000181)
        rig.write("B", 0x1A00, 0, 0)
        for k, word in enumerate((0x60640020, 0x606C0020, 0x60410010), start=1):
            rig.write("I", 0x1A00, k, word)
        with aborted(LENGTH):
            rig.write("B", 0x1A00, 0, 3)
        rig.write("B", 0x1A00, 0, 2)

    def test_a_number_of_entries_that_are_not_there_is_refused(self, rig, aborted):
        rig.write("I", 0x1800, 1, 0xC0000181)
        rig.write("B", 0x1A00, 0, 0)
        rig.write("I", 0x1A00, 1, 0)
        with aborted(NOT_MAPPABLE):
            rig.write("B", 0x1A00, 0, 1)

    @pytest.mark.parametrize("kind", [241, 250, 251, 252, 253])
    def test_reserved_transmission_types(self, rig, aborted, kind):
        with aborted(INVALID):
            rig.write("B", 0x1800, 2, kind)

    @pytest.mark.parametrize(
        ("value", "code"),
        [(0x20000181, INVALID), (0x182, WRONG_STATE), (0x101, INVALID), (0x601, INVALID)],
    )
    def test_identifiers(self, rig, aborted, value, code):
        with aborted(code):
            rig.write("I", 0x1800, 1, value)

    def test_inhibit_time_only_while_not_valid(self, rig, aborted):
        with aborted(WRONG_STATE):
            rig.write("H", 0x1800, 3, 100)
        rig.write("I", 0x1800, 1, 0xC0000181)
        rig.write("H", 0x1800, 3, 100)

    def test_remapping_while_operational(self, mapped):
        mapped.map_pdo(0x1800, 0x1A00, 0x1A1, (0x606C0020,))
        mapped.take()
        mapped.cycle()
        assert mapped.take(0x1A1) == [bytes(4)]
        assert mapped.take(0x181) == []


class TestAtSync:
    def test_inputs_are_those_of_the_sync_and_outputs_act_at_it(self, mapped):
        mapped.enable()
        position = mapped.read("i", 0x6064)
        mapped.send(0x201, struct.pack(LAYOUT, 0x0F, position + 500, 0))
        assert mapped.read("i", 0x607A) == position, "must wait for the SYNC"
        mapped.take()
        mapped.cycle()
        status, at_sync, _ = struct.unpack(LAYOUT, mapped.take(0x181)[0])
        assert status & 0x6F == 0x27
        assert at_sync == position, "sampled before the new target acts"
        assert mapped.read("i", 0x607A) == position + 500

    def test_controlword_in_a_pdo_drives_the_states(self, mapped):
        seen = []
        mapped.write("b", 0x6060, 0, 8)
        for word in (0x06, 0x07, 0x0F, 0x0F):
            mapped.send(0x201, struct.pack(LAYOUT, word, 0, 0))
            mapped.cycle()
            seen.append(struct.unpack(LAYOUT, mapped.take(0x181)[-1])[0] & 0x6F)
        assert seen == [0x40, 0x21, 0x23, 0x27]

    @pytest.mark.parametrize("every", [1, 2, 3, 240])
    def test_every_nth_sync(self, mapped, every):
        mapped.map_pdo(0x1800, 0x1A00, 0x181, IN, kind=every)
        mapped.take()
        mapped.cycle(2 * every)
        times = [t for t, cob, _ in mapped.frames if cob == 0x181]
        assert len(times) == 2
        assert times[1] - times[0] == every * 1_000_000

    def test_acyclic_synchronous_only_after_a_change(self, mapped):
        mapped.map_pdo(0x1800, 0x1A00, 0x181, (0x60410010,), kind=0)
        mapped.take()
        mapped.cycle(3)
        assert len(mapped.take(0x181)) == 1
        mapped.control(0x06)
        mapped.cycle(3)
        assert len(mapped.take(0x181)) == 1

    def test_last_of_several_rpdos_wins(self, mapped):
        for target in (1, 2, 3):
            mapped.send(0x201, struct.pack(LAYOUT, 0, target, 0))
        mapped.cycle()
        assert mapped.read("i", 0x607A) == 3

    def test_gaps_are_passed_over(self, mapped):
        mapped.map_pdo(0x1400, 0x1600, 0x201, (0x00060010, 0x607A0020))
        mapped.send(0x201, struct.pack("<Hi", 0xFFFF, 77))
        mapped.cycle()
        assert mapped.read("i", 0x607A) == 77
        assert mapped.read("H", 0x6040) == 0

    def test_too_short_a_frame_is_told_and_dropped(self, mapped):
        mapped.send(0x201, bytes(7))
        assert mapped.emergencies() == [0x8210]
        assert mapped.read("B", 0x1001) & 0x10
        mapped.nmt(0x82)
        assert mapped.read("B", 0x1001) == 0

    def test_no_pdo_unless_operational(self, mapped):
        mapped.nmt(0x80)
        mapped.take()
        mapped.send(0x201, struct.pack(LAYOUT, 0x06, 0, 0))
        mapped.cycle(3)
        assert mapped.take() == []
        assert mapped.state() == 0x40

    def test_values_that_an_object_refuses_are_passed_over(self, mapped):
        mapped.map_pdo(0x1400, 0x1600, 0x201, (0x60400010, 0x60600008))
        mapped.send(0x201, struct.pack("<Hb", 0, 8))
        mapped.cycle()
        mapped.send(0x201, struct.pack("<Hb", 0, 6))
        mapped.cycle()
        assert mapped.read("b", 0x6061) == 8

    def test_own_identifier_of_sync(self, mapped):
        mapped.write("I", 0x1005, 0, 0x90)
        mapped.take()
        mapped.send(0x80, b"")
        assert mapped.take(0x181) == []
        mapped.send(0x90, b"")
        assert len(mapped.take(0x181)) == 1


class TestEventDriven:
    def test_status_is_sent_when_it_changes(self, rig):
        rig.nmt(0x01)
        rig.run(0.01)
        assert rig.take(0x181) == [struct.pack("<H", 0x0240)]
        rig.control(0x06)
        rig.run(0.01)
        assert rig.take(0x181) == [struct.pack("<H", 0x0231)]

    def test_event_timer(self, rig):
        rig.write("H", 0x1800, 5, 20)
        rig.nmt(0x01)
        rig.take()
        rig.run(0.1)
        times = [t for t, cob, _ in rig.frames if cob == 0x181]
        assert len(times) == 5
        assert {b - a for a, b in pairwise(times)} == {20_000_000}

    def test_inhibit_time(self, rig):
        rig.write("I", 0x1800, 1, 0xC0000181)
        rig.write("H", 0x1800, 3, 500)  # 50 ms
        rig.write("I", 0x1800, 1, 0x40000181)
        rig.nmt(0x01)
        rig.run(0.005)
        rig.take()
        for word in (0x06, 0x07, 0x06, 0x07):
            rig.control(word)
            rig.run(0.005)
        assert rig.take(0x181) == []
        rig.run(0.04)
        assert rig.take(0x181) == [struct.pack("<H", 0x0233)]

    def test_outputs_act_at_once(self, rig):
        rig.nmt(0x01)
        rig.send(0x201, struct.pack("<H", 0x06))
        assert rig.state() == 0x21
