"""Modes, halt, stops and supervision of the simulated drive."""

import struct
from math import pi

import pytest

COUNTS = 2**20
DISABLED, READY, ON, ENABLED, STOPPING, REACTING, FAULT = 0x40, 0x21, 0x23, 0x27, 0x07, 0x0F, 0x08
REACHED, LIMIT, BIT12, ERROR = 1 << 10, 1 << 11, 1 << 12, 1 << 13


def stream(rig, targets, layout="i", index=0x607A):
    """Cyclic targets over SDO, one a cycle."""
    for target in targets:
        rig.write(layout, index, 0, target)
        rig.cycle()


class TestModes:
    def test_supported_modes(self, rig):
        assert rig.read("I", 0x6502) == (1 << 0) | (1 << 7) | (1 << 8) | (1 << 9)

    def test_cyclic_position_follows(self, rig):
        rig.nmt(1)
        rig.enable()
        stream(rig, [50 * k for k in range(1, 400)])
        assert rig.read("i", 0x6064) == pytest.approx(50 * 399, abs=2_000)
        assert rig.statusword() & BIT12
        velocity = rig.read("i", 0x606C)
        assert velocity == pytest.approx(50_000, rel=0.1)

    def test_position_offset_is_added(self, rig):
        rig.enable()
        rig.write("i", 0x60B0, 0, 1_000)
        rig.run(0.5)
        assert rig.read("i", 0x6064) == pytest.approx(1_000, abs=5)

    def test_following_error_is_reference_minus_position(self, rig):
        rig.nmt(1)
        rig.enable()
        rig.write("H", 0x2010, 4, 0)  # no feed-forward: error = velocity / position P
        stream(rig, [20 * k for k in range(1, 500)])
        assert rig.read("i", 0x60F4) == pytest.approx(20_000 / 30.0, rel=0.1)

    def test_cyclic_velocity(self, rig):
        rig.nmt(1)
        rig.enable(mode=9)
        stream(rig, [100_000] * 600, index=0x60FF)
        assert rig.read("i", 0x606C) == pytest.approx(100_000, rel=0.05)
        rig.write("i", 0x60B1, 0, 50_000)
        rig.cycle(600)
        assert rig.read("i", 0x606C) == pytest.approx(150_000, rel=0.05)

    def test_cyclic_torque(self, rig):
        rig.nmt(1)
        rig.enable(mode=10)
        stream(rig, [10] * 20, "h", 0x6071)
        assert rig.read("h", 0x6077) == pytest.approx(10, abs=1)
        assert rig.read("h", 0x6074) == pytest.approx(10, abs=1)
        rig.write("h", 0x60B2, 0, 5)
        rig.cycle(20)
        assert rig.read("h", 0x6077) == pytest.approx(15, abs=1)

    def test_torque_scale_is_the_rated_torque(self, rig):
        """10 per mille of 10 N m accelerate 0.01 kg m2 with 10 rad/s2."""
        assert rig.read("I", 0x6076) == 10_000
        rig.nmt(1)
        rig.enable(mode=10)
        rig.write("h", 0x6071, 0, 10)
        rig.run(0.1)
        expected = 0.5 * 10.0 * 0.1**2 / (2 * pi) * COUNTS
        assert rig.read("i", 0x6064) == pytest.approx(expected, rel=0.06)

    def test_mode_display_follows_at_once(self, rig):
        for mode in (1, 8, 9, 10, 0):
            rig.write("b", 0x6060, 0, mode)
            assert rig.read("b", 0x6061) == mode

    def test_changing_the_mode_while_enabled_does_not_jump(self, rig):
        rig.nmt(1)
        rig.enable()
        stream(rig, [30 * k for k in range(1, 200)])
        before = rig.read("i", 0x6064)
        rig.write("b", 0x6060, 0, 1)
        rig.run(1.0)
        assert rig.read("i", 0x6064) == pytest.approx(before, abs=1_500)

    def test_max_torque_limits_and_is_shown(self, rig):
        rig.write("H", 0x6072, 0, 50)
        rig.enable(mode=10)
        rig.write("h", 0x6071, 0, 300)
        rig.run(0.01)
        assert rig.read("h", 0x6077) == pytest.approx(50, abs=1)
        assert rig.statusword() & LIMIT

    def test_position_limits_clamp_and_are_shown(self, rig):
        rig.write("i", 0x607D, 2, 2_000)
        rig.enable()
        rig.write("i", 0x607A, 0, 5_000)
        assert rig.statusword() & LIMIT
        rig.run(1.0)
        assert rig.read("i", 0x6064) == pytest.approx(2_000, abs=5)

    def test_interpolation_makes_a_line(self, rig):
        """Half way through a 10 ms cycle the reference stands half way."""
        rig.write("B", 0x60C2, 1, 10)
        rig.nmt(1)
        rig.enable()
        rig.write("i", 0x607A, 0, 1_000)
        rig.send(0x80, b"")
        rig.run(0.005)
        reference = rig.machine.axes.reference_position(0) * COUNTS / (2 * pi)
        assert reference == pytest.approx(500, abs=1)


class TestProfilePosition:
    @pytest.fixture
    def ready(self, rig):
        rig.enable(mode=1)
        rig.write("I", 0x6081, 0, COUNTS)
        return rig

    def set_point(self, rig, target, bits=0x10):
        rig.write("i", 0x607A, 0, target)
        rig.control(0x0F | bits)
        acknowledged = bool(rig.statusword() & BIT12)
        rig.control(0x0F)
        return acknowledged

    def test_moves_and_says_so(self, ready):
        assert self.set_point(ready, 100_000)
        ready.run(0.02)
        assert not ready.statusword() & REACHED
        ready.run(1.5)
        assert ready.statusword() & REACHED
        assert ready.read("i", 0x6064) == pytest.approx(100_000, abs=20)

    def test_nothing_moves_without_the_edge(self, ready):
        ready.write("i", 0x607A, 0, 100_000)
        ready.run(0.5)
        assert ready.read("i", 0x6064) == pytest.approx(0, abs=5)

    def test_handshake(self, ready):
        ready.write("i", 0x607A, 0, 1_000)
        assert not ready.statusword() & BIT12
        ready.control(0x1F)
        assert ready.statusword() & BIT12
        ready.control(0x0F)
        assert not ready.statusword() & BIT12

    def test_second_set_point_waits_for_the_first(self, ready):
        self.set_point(ready, 50_000)
        assert self.set_point(ready, 0)
        assert ready.statusword() & BIT12, "no room for a third"
        passed = 0
        for _ in range(200):
            ready.run(0.01)
            passed = max(passed, ready.read("i", 0x6064))
        assert passed == pytest.approx(50_000, rel=0.05)
        assert ready.read("i", 0x6064) == pytest.approx(0, abs=20)
        assert not ready.statusword() & BIT12

    def test_a_third_is_not_taken(self, ready):
        self.set_point(ready, 50_000)
        self.set_point(ready, 10_000)
        self.set_point(ready, 90_000)
        ready.run(3.0)
        assert ready.read("i", 0x6064) == pytest.approx(10_000, abs=20)

    def test_change_immediately(self, ready):
        self.set_point(ready, 2_000_000)
        ready.run(0.1)
        self.set_point(ready, 10_000, bits=0x30)
        ready.run(3.0)
        assert ready.read("i", 0x6064) == pytest.approx(10_000, abs=20)

    def test_relative(self, ready):
        self.set_point(ready, 10_000)
        ready.run(1.0)
        self.set_point(ready, 5_000, bits=0x50)
        ready.run(1.0)
        assert ready.read("i", 0x6064) == pytest.approx(15_000, abs=20)

    def test_halt_and_go_on(self, ready):
        self.set_point(ready, 500_000)
        ready.run(0.1)
        ready.control(0x10F)
        ready.run(0.5)
        stopped = ready.read("i", 0x6064)
        assert 0 < stopped < 400_000
        assert ready.statusword() & REACHED, "halted and at rest"
        ready.run(0.2)
        assert ready.read("i", 0x6064) == pytest.approx(stopped, abs=20)
        ready.control(0x0F)
        ready.run(2.0)
        assert ready.read("i", 0x6064) == pytest.approx(500_000, abs=20)


class TestStops:
    @pytest.fixture
    def moving(self, rig):
        """At 400 000 counts/s, decelerating slowly or (quick stop) fast."""
        rig.write("I", 0x6084, 0, 1_000_000)
        rig.write("I", 0x6085, 0, 10_000_000)
        rig.nmt(1)
        rig.enable(mode=9)
        stream(rig, [400_000] * 500, index=0x60FF)
        assert rig.read("i", 0x606C) == pytest.approx(400_000, rel=0.05)
        return rig

    def time_to_stop(self, rig, limit=1.0):
        start = rig.machine.now
        while rig.machine.now - start < limit:
            rig.run(0.001)
            if abs(rig.read("i", 0x606C)) < 20_000:
                return rig.machine.now - start
        return limit

    @pytest.mark.parametrize(
        ("option", "seconds", "state"),
        [(1, 0.4, DISABLED), (2, 0.04, DISABLED), (5, 0.4, STOPPING), (6, 0.04, STOPPING)],
    )
    def test_quick_stop_options(self, moving, option, seconds, state):
        moving.write("h", 0x605A, 0, option)
        moving.control(0x02)
        assert moving.state() == STOPPING
        assert self.time_to_stop(moving) == pytest.approx(seconds, rel=0.3, abs=0.01)
        moving.run(0.5)
        assert moving.state() == state

    def test_quick_stop_option_0_switches_off(self, moving):
        moving.write("h", 0x605A, 0, 0)
        moving.control(0x02)
        assert moving.state() == DISABLED
        assert moving.machine.axes.torque(0) == 0.0

    def test_stopped_axis_is_held(self, moving):
        moving.write("h", 0x605A, 0, 6)
        moving.control(0x02)
        moving.run(1.0)
        position = moving.read("i", 0x6064)
        moving.run(1.0)
        assert moving.read("i", 0x6064) == pytest.approx(position, abs=20)
        assert moving.statusword() & REACHED

    @pytest.mark.parametrize(
        ("index", "word", "state"), [(0x605B, 0x06, READY), (0x605C, 0x07, ON)]
    )
    def test_leaving_on_a_ramp(self, moving, index, word, state):
        moving.write("h", index, 0, 1)
        moving.control(word)
        assert moving.state() == ENABLED, "the state follows at standstill"
        moving.run(0.2)
        assert moving.state() == ENABLED
        moving.run(0.8)
        assert moving.state() == state

    def test_disable_voltage_ends_a_ramp(self, moving):
        moving.write("h", 0x605B, 0, 1)
        moving.control(0x06)
        moving.control(0x00)
        assert moving.state() == DISABLED

    @pytest.mark.parametrize(("option", "seconds"), [(1, 0.4), (2, 0.04)])
    def test_halt(self, moving, option, seconds):
        moving.write("h", 0x605D, 0, option)
        moving.control(0x10F)
        assert self.time_to_stop(moving) == pytest.approx(seconds, rel=0.3, abs=0.01)
        assert moving.state() == ENABLED
        moving.control(0x0F)
        moving.cycle(500)
        assert moving.read("i", 0x606C) == pytest.approx(400_000, rel=0.05)

    @pytest.mark.parametrize(("option", "seconds"), [(1, 0.4), (2, 0.04)])
    def test_fault_reaction_on_a_ramp(self, moving, option, seconds):
        moving.write("h", 0x605E, 0, option)
        moving.machine.node(1).motion.fault(0x4310, 8)
        assert moving.state() == REACTING
        assert self.time_to_stop(moving) == pytest.approx(seconds, rel=0.3, abs=0.01)
        moving.run(0.5)
        assert moving.state() == FAULT
        assert moving.machine.axes.torque(0) == 0.0

    def test_fault_reaction_0_coasts(self, moving):
        moving.write("h", 0x605E, 0, 0)
        moving.machine.node(1).motion.fault(0x4310, 8)
        assert moving.state() == FAULT
        moving.run(0.1)
        assert moving.read("i", 0x606C) > 300_000

    def test_a_stop_ends_even_if_the_axis_does_not(self, moving):
        """With no gain left the axis can not be stopped; the drive gives up and switches off."""
        moving.write("h", 0x605E, 0, 2)
        moving.write("I", 0x2010, 2, 0)
        moving.write("I", 0x2010, 3, 0)
        moving.machine.node(1).motion.fault(0x4310, 8)
        moving.run(2.0)
        assert moving.state() == FAULT


class TestFollowingError:
    def test_beyond_the_window_for_longer_than_the_time_out_is_a_fault(self, rig):
        rig.write("I", 0x6065, 0, 10_000)
        rig.write("H", 0x6066, 0, 50)
        rig.nmt(1)
        rig.enable()
        rig.write("i", 0x607A, 0, 400_000)
        rig.take()
        rig.cycle(40)
        assert rig.state() == ENABLED
        rig.cycle(40)
        assert rig.state() in (REACTING, FAULT)
        assert rig.emergencies() == [0x8611]
        assert rig.read("B", 0x1001) == 0x21
        assert rig.read("H", 0x603F) == 0x8611
        rig.run(1.0)
        assert rig.state() == FAULT
        assert rig.statusword() & ERROR

    def test_supervision_can_be_switched_off(self, rig):
        rig.write("I", 0x6065, 0, 2**32 - 1)
        rig.nmt(1)
        rig.enable()
        rig.write("i", 0x607A, 0, 3 * COUNTS)
        rig.cycle(300)
        assert rig.state() == ENABLED


def test_linear_axis_counts_are_metres(rig_of):
    rig = rig_of(1, kind="linear", counts_per_metre=1e6)
    rig.enable()
    rig.write("i", 0x607A, 0, 10_000)
    rig.run(1.0)
    assert rig.machine.axes.position(0) == pytest.approx(0.01, abs=1e-5)


def test_values_beyond_their_types(rig):
    """Counts wrap, speed and torque saturate: a PDO can always be packed."""
    motion = rig.machine.node(1).motion
    motion.latch(2**31 + 5, 40_000, 1e9)
    assert motion.position_actual == -(2**31) + 5
    assert motion.torque_actual == 2**15 - 1
    assert motion.velocity_actual == 2**31 - 1
    assert struct.pack("<ihi", motion.position_actual, motion.torque_actual, motion.velocity_actual)
