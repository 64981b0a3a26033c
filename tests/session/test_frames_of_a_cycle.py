"""What is fresh and what is late; what is armed while axes move, and put back afterwards."""

import struct
from dataclasses import dataclass

import numpy as np
import pytest

from drives.errors import SafetyStopError
from drives.sim.faults import EmergencyOnly, Fault
from drives.sim.lockstep_bus import LockstepBus

TABLE, ARM = 11, 12
COUNTS = 2**20 / (2 * np.pi)


def once(targets):
    return lambda before: targets if before is None else None


def slow_ramp(rows=200):
    return np.stack([1e-3 * np.arange(rows), np.zeros(rows)], axis=1)


@dataclass(frozen=True)
class Look(Fault):
    """Look at objects at this moment."""

    seen: tuple = ()

    def set(self, machine, *, present):
        read = machine.node(self.node_id).dictionary.read
        self.seen[0].update(
            {key: read(*key) for key in ((0x605A, 0), (0x6007, 0), (0x1029, 1), (0x1016, 1))}
        )


class LatePdo:
    """Holds one TPDO of the arm, the last to answer, back until its cycle is over."""

    def __init__(self, monkeypatch, late_count):
        self.held, self.count, self.late_count = None, 0, late_count
        self.waited_in_vain = False
        self.recv = LockstepBus.recv
        monkeypatch.setattr(LockstepBus, "recv", lambda bus, timeout=None: self(bus, timeout))

    def __call__(self, bus, timeout):
        if self.held is not None and self.waited_in_vain:
            message, self.held = self.held, None
            return message
        message = self.recv(bus, timeout)
        if message is not None and message.arbitration_id == 0x180 + ARM:
            self.count += 1
            if self.count == self.late_count:
                self.held = message
                message = self.recv(bus, timeout)
        self.waited_in_vain = message is None
        return message


def test_a_late_pdo_is_never_taken_for_the_next_cycles(bench, monkeypatch):
    """One late frame must not shift every later sample by a cycle."""
    LatePdo(monkeypatch, late_count=150)
    bench.listen()
    with bench.connected() as group, group.motion(0.002) as motion:
        first = bench.machine.sync_count + 1
        capture = motion.stream(once(slow_ramp()[:, ::-1]))
    monkeypatch.undo()
    (late, *disturbed) = capture.missing
    assert all(row == late + 1 for row in disturbed)
    sent = {
        f.sync: struct.unpack("<Hih", f.data)[1] for f in bench.heard() if f.cob_id == 0x180 + ARM
    }
    counts = np.rint(capture.position[:, 1] * COUNTS).astype(int)
    fresh = [row for row in range(capture.rows) if row not in capture.missing]
    assert len(fresh) >= capture.rows - 2
    assert [counts[row] for row in fresh] == [sent[first + row] for row in fresh]
    assert counts[late] == counts[late - 1], "the row repeats the one before, and is marked"


def test_a_quick_stop_that_would_let_the_axis_coast_becomes_a_ramp(make_bench):
    bench = make_bench(objects={TABLE: {(0x605A, 0): 0}})
    seen: dict = {}
    bench.inject(Look(TABLE, (seen,)), 150)
    bench.inject(EmergencyOnly(ARM), 160)
    bench.listen()
    with (
        bench.connected() as group,
        pytest.raises(SafetyStopError),
        group.motion(0.002) as motion,
    ):
        motion.stream(once(slow_ramp(1000)))
    assert seen[0x605A, 0] == 2
    words = [
        struct.unpack_from("<H", f.data)[0] & 0x6F
        for f in bench.heard()
        if f.cob_id == 0x180 + TABLE
    ]
    assert 0x07 in words, "quick stop active: it was ramped down"
    assert bench.changed() == {}
    assert bench.machine.node(TABLE).dictionary.read(0x605A, 0) == 0


def test_the_fail_safe_is_armed_while_axes_move_and_gone_afterwards(bench):
    seen: dict = {}
    bench.inject(Look(ARM, (seen,)), 150)
    with bench.connected() as group, group.motion(0.002) as motion:
        motion.stream(once(slow_ramp()))
    assert seen == {(0x605A, 0): 2, (0x6007, 0): 3, (0x1029, 1): 1, (0x1016, 1): 127 << 16 | 200}
    assert bench.changed() == {}
    assert bench.powered() == {}


def test_heartbeats_come_often_enough_and_end_with_the_motion(bench):
    bench.listen()
    with bench.connected() as group:
        with group.motion(0.002) as motion:
            motion.stream(once(slow_ramp(500)))
        group.line.wait(1.0)
    frames = bench.heard()
    beats = [f.sync for f in frames if f.cob_id == 0x700 + 127]
    assert max(np.diff(beats)) * 0.002 <= 0.06
    assert not [f for f in frames if f.cob_id in (0x80 + TABLE, 0x80 + ARM)], "nobody missed one"


def test_feed_forward_is_put_back_after_an_error(bench):
    node = bench.machine.node(ARM).dictionary

    def fail():
        with bench.connected() as group, group.without_feed_forward():
            assert node.read(0x2010, 4) == 0
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fail()
    assert node.read(0x2010, 4) == 1000
    assert bench.changed() == {}
