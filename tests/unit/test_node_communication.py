"""NMT, heartbeat, emergencies, memory and LSS of the simulated drive."""

import struct

import pytest

DISABLED, READY, ENABLED, STOPPING, FAULT = 0x40, 0x21, 0x27, 0x07, 0x08
PRE_OPERATIONAL, OPERATIONAL, STOPPED = 0x7F, 0x05, 0x04
HOST = 100


def nmt_state(rig):
    return int(rig.machine.node(1).nmt.state)


class TestNetworkManagement:
    def test_states(self, rig):
        assert nmt_state(rig) == PRE_OPERATIONAL
        for command, state in ((1, OPERATIONAL), (2, STOPPED), (0x80, PRE_OPERATIONAL)):
            rig.nmt(command)
            assert nmt_state(rig) == state

    def test_broadcast_and_others(self, rig):
        rig.nmt(1, node=0)
        assert nmt_state(rig) == OPERATIONAL
        rig.nmt(2, node=2)
        assert nmt_state(rig) == OPERATIONAL

    def test_reset_sends_boot_up(self, rig):
        for command in (0x81, 0x82):
            rig.take()
            rig.nmt(command)
            assert rig.take(0x701) == [b"\0"]
            assert nmt_state(rig) == PRE_OPERATIONAL

    def test_stopped_node_answers_no_sdo(self, rig):
        rig.nmt(2)
        rig.take()
        rig.send(0x601, bytes((0x40, 0, 0x10, 0, 0, 0, 0, 0)))
        assert rig.take() == []
        rig.nmt(0x80)
        assert rig.read("I", 0x1000)

    def test_reset_of_communication_keeps_the_application(self, rig):
        rig.write("I", 0x2010, 1, 7_777)
        rig.write("H", 0x1017, 0, 100)
        rig.nmt(0x82)
        assert rig.read("I", 0x2010, 1) == 7_777
        assert rig.read("H", 0x1017) == 0

    def test_reset_of_the_node_forgets_both(self, rig):
        rig.write("I", 0x2010, 1, 7_777)
        rig.write("H", 0x1017, 0, 100)
        rig.nmt(0x81)
        assert rig.read("I", 0x2010, 1) == 30_000
        assert rig.read("H", 0x1017) == 0

    @pytest.mark.parametrize(("option", "state"), [(0, ENABLED), (1, FAULT), (2, DISABLED)])
    def test_stop_while_enabled(self, rig, option, state):
        rig.write("h", 0x6007, 0, option)
        rig.write("h", 0x605E, 0, 0)
        rig.nmt(1)
        rig.enable()
        rig.nmt(2)
        rig.run(0.01)
        rig.nmt(0x80)
        assert rig.state() == state


class TestHeartbeat:
    def test_producer_keeps_time(self, rig):
        rig.take()
        rig.write("H", 0x1017, 0, 30)
        rig.run(0.1)
        beats = [(t, d) for t, cob, d in rig.frames if cob == 0x701]
        assert [t for t, _ in beats] == [0, 30_000_000, 60_000_000, 90_000_000]
        assert {d for _, d in beats} == {bytes((PRE_OPERATIONAL,))}
        rig.write("H", 0x1017, 0, 0)
        rig.take()
        rig.run(0.1)
        assert rig.take(0x701) == []

    def beat(self, rig, seconds, every=0.02):
        for _ in range(round(seconds / every)):
            rig.send(0x700 + HOST, bytes((OPERATIONAL,)))
            rig.run(every)

    def watch(self, rig, option, behaviour=1, milliseconds=50):
        rig.write("h", 0x6007, 0, option)
        rig.write("B", 0x1029, 1, behaviour)
        rig.write("I", 0x1016, 1, HOST << 16 | milliseconds)
        rig.nmt(1)
        rig.enable()
        rig.take()

    def test_watching_begins_with_the_first_heartbeat(self, rig):
        self.watch(rig, option=2)
        rig.run(1.0)
        assert rig.state() == ENABLED

    def test_no_reaction_while_it_beats(self, rig):
        self.watch(rig, option=2)
        self.beat(rig, 0.5)
        assert rig.state() == ENABLED
        assert rig.emergencies() == []

    @pytest.mark.parametrize(
        ("option", "state"), [(0, ENABLED), (1, FAULT), (2, DISABLED), (3, DISABLED)]
    )
    def test_reaction(self, rig, option, state):
        self.watch(rig, option)
        self.beat(rig, 0.1)
        rig.take()
        rig.run(1.0)
        lost = [(t, d) for t, cob, d in rig.frames if cob == 0x81]
        assert rig.emergencies()[0] == 0x8130
        assert lost[0][0] == 80_000_000 + 50_000_000, "last heartbeat plus time-out, exactly"
        assert lost[0][1][2] & 0x10, "communication error in the error register"
        assert rig.state() == state

    def test_quick_stop_is_a_ramp(self, rig):
        self.watch(rig, option=3)
        rig.write("h", 0x605A, 0, 6)
        self.beat(rig, 0.1)
        rig.run(0.06)
        assert rig.state() == STOPPING

    @pytest.mark.parametrize(
        ("behaviour", "state"), [(0, PRE_OPERATIONAL), (1, OPERATIONAL), (2, STOPPED)]
    )
    def test_error_behaviour(self, rig, behaviour, state):
        self.watch(rig, option=2, behaviour=behaviour)
        self.beat(rig, 0.1)
        rig.run(0.1)
        assert nmt_state(rig) == state

    def test_back_again(self, rig):
        self.watch(rig, option=2)
        self.beat(rig, 0.1)
        rig.run(0.1)
        assert rig.emergencies() == [0x8130]
        self.beat(rig, 0.1)
        assert rig.emergencies() == [0x0000]
        rig.run(0.1)
        assert rig.emergencies() == [0x8130]

    def test_entries(self, rig, aborted):
        rig.write("I", 0x1016, 1, HOST << 16 | 50)
        with aborted(0x06040043):
            rig.write("I", 0x1016, 2, HOST << 16 | 70)
        with aborted(0x06090030):
            rig.write("I", 0x1016, 2, 200 << 16 | 70)
        rig.write("I", 0x1016, 2, 0)


class TestEmergency:
    def raise_(self, rig, code, bits=0x20):
        rig.machine.node(1).motion.fault(code, bits, b"\x34\x12")

    def test_frame(self, rig):
        rig.take()
        self.raise_(rig, 0x8611)
        assert rig.take(0x81) == [struct.pack("<HB5s", 0x8611, 0x21, b"\x34\x12")]

    def test_history_newest_first_and_cleared_by_zero(self, rig):
        for code in (0x2310, 0x3210, 0x8611):
            self.raise_(rig, code)
        assert rig.read("B", 0x1003, 0) == 3
        assert rig.read("I", 0x1003, 1) == 0x1234_8611
        assert rig.read("I", 0x1003, 3) == 0x1234_2310
        assert rig.read("H", 0x603F) == 0x8611
        rig.write("B", 0x1003, 0, 0)
        assert rig.read("B", 0x1003, 0) == 0
        assert rig.read("I", 0x1003, 1) == 0

    def test_register_clears_with_the_fault(self, rig):
        self.raise_(rig, 0x8611)
        assert rig.read("B", 0x1001) == 0x21
        rig.control(0x80)
        assert rig.read("B", 0x1001) == 0
        assert rig.read("H", 0x603F) == 0

    def test_can_be_switched_off(self, rig):
        rig.write("I", 0x1014, 0, 0x80000081)
        self.raise_(rig, 0x8611)
        assert rig.take(0x81) == []

    def test_same_error_is_sent_once(self, rig):
        self.raise_(rig, 0x8611)
        self.raise_(rig, 0x8611)
        assert rig.emergencies() == [0x8611]


class TestMemory:
    SAVE = int.from_bytes(b"save", "little")
    LOAD = int.from_bytes(b"load", "little")

    def store(self, rig, index=0x1010, signature=None):
        """Ask for storing; return the answers after half of the time, and after all of it."""
        value = signature if signature is not None else self.SAVE
        rig.take()
        rig.send(0x601, struct.pack("<BHBI", 0x23, index, 1, value))
        rig.run(0.1)
        early = rig.take(0x581)
        rig.run(0.11)
        return early, rig.take(0x581)

    def test_answer_comes_when_it_is_done(self, rig):
        early, late = self.store(rig)
        assert early == []
        assert [answer[0] for answer in late] == [0x60]

    def test_what_was_stored_survives_and_what_was_not_is_gone(self, rig):
        rig.write("I", 0x2010, 1, 1_111)
        rig.write("H", 0x1017, 0, 0)
        self.store(rig)
        rig.write("I", 0x2010, 2, 2_222)
        rig.machine.node(1).power_cycle()
        assert rig.read("I", 0x2010, 1) == 1_111
        assert rig.read("I", 0x2010, 2) == 2_000
        assert rig.take(0x701) == [b"\0"]

    def test_the_loops_follow(self, rig):
        from drives.sim.firmware import Parameter

        rig.write("I", 0x2010, 1, 1_111)
        rig.machine.node(1).power_cycle()
        assert rig.machine.axes.get(0, Parameter.POSITION_P) == pytest.approx(30.0)

    def test_power_lost_while_storing(self, rig):
        rig.write("I", 0x2010, 1, 1_111)
        rig.send(0x601, struct.pack("<BHBI", 0x23, 0x1010, 1, self.SAVE))
        rig.run(0.1)
        rig.machine.node(1).power_cycle()
        rig.take()
        rig.run(0.5)
        assert rig.take(0x581) == []
        assert rig.read("I", 0x2010, 1) == 30_000

    def test_requests_wait_for_a_busy_memory(self, rig):
        rig.take()
        rig.send(0x601, struct.pack("<BHBI", 0x23, 0x1010, 1, self.SAVE))
        rig.send(0x601, bytes((0x40, 0, 0x10, 0, 0, 0, 0, 0)))
        assert rig.take(0x581) == []
        rig.run(0.25)
        assert [answer[0] for answer in rig.take(0x581)] == [0x60, 0x43]

    def test_restoring_acts_from_the_next_reset(self, rig):
        rig.write("I", 0x2010, 1, 1_111)
        self.store(rig)
        self.store(rig, 0x1011, self.LOAD)
        assert rig.read("I", 0x2010, 1) == 1_111
        rig.nmt(0x81)
        assert rig.read("I", 0x2010, 1) == 30_000

    def test_mapping_can_be_stored(self, rig):
        rig.map_pdo(0x1800, 0x1A00, 0x181, (0x60410010, 0x60640020))
        self.store(rig)
        rig.machine.node(1).power_cycle()
        assert rig.read("B", 0x1A00, 0) == 2
        assert rig.read("I", 0x1A00, 2) == 0x60640020
        assert rig.read("B", 0x1800, 2) == 1

    def test_a_power_cycle_switches_the_drive_off_and_forgets_commands(self, rig):
        rig.nmt(1)
        rig.enable()
        rig.write("i", 0x607A, 0, 1_000)
        self.store(rig)
        rig.machine.node(1).power_cycle()
        assert rig.state() == DISABLED
        assert nmt_state(rig) == PRE_OPERATIONAL
        assert rig.read("i", 0x607A) == 0
        assert rig.read("b", 0x6060) == 1


class TestLayerSettings:
    """durand's LSS slave on this node."""

    def lss(self, rig, *data):
        rig.take()
        rig.send(0x7E5, bytes(data).ljust(8, b"\0"))
        return rig.take(0x7E4)

    def test_node_id_is_asked_configured_and_stored(self, rig):
        self.lss(rig, 0x04, 1)
        assert self.lss(rig, 0x5E)[0][1] == 1
        assert self.lss(rig, 0x11, 9)[0][1] == 0
        assert self.lss(rig, 0x17)[0][1] == 0
        rig.take()
        rig.nmt(0x82)
        assert rig.take(0x709) == [b"\0"]
        assert rig.read("I", 0x1000, 0, node=9) == 0x00020192
        assert rig.read("I", 0x1014, 0, node=9) == 0x89
        rig.machine.node(1).power_cycle()
        assert rig.read("I", 0x1200, 1, node=9) == 0x609
