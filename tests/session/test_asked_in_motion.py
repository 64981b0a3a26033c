"""Drives that leave their mode or state while axes move, unseen by their PDOs: they are asked."""

from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
import pytest

from drives import objects
from drives.bus import MAX_CYCLIC_LOAD, CyclicLoad, frame_bits, shortest_cycle
from drives.canopen_drive.asked import Asked
from drives.errors import SafetyStopError
from drives.sim.drive_faults import ModeChanges, OperationLost
from drives.sim.faults import Fault, SdoRefused, SdoSilent
from drives.sim.frame_faults import (
    FrameFault,
    SdoAnswerLate,
    SdoAnswerWrong,
    StatuswordFrozen,
    Stranger,
)
from tests.session.conftest import two_axes

TABLE, ARM = 11, 12
CYCLE = 0.002
EVERY = 25
"""Cycles from one request to the next."""
WITHIN = (2 * 2 + 2) * EVERY + 3
"""Cycles: two objects of two drives in turn, the wrong one again, and the stop."""
MODE, STATE = b"\x61\x60\x00", b"\x41\x60\x00"
REQUESTS = {
    node: [bytes([0x40, *place, 0, 0, 0, 0]) for place in (MODE, STATE)] for node in (11, 12)
}
OFF = 0x0240
PATIENCE = 275
"""Cycles, a request more than 0.5 s: until an answer is given up."""


def mode(value: int) -> bytes:
    return b"\x4f" + MODE + bytes([value, 0, 0, 0])


def state(value: int) -> bytes:
    return b"\x4b" + STATE + value.to_bytes(2, "little") + bytes(2)


@dataclass(frozen=True)
class Answers(FrameFault):
    """Answers of a node about an object are followed, preceded or replaced by what is listed."""

    place: bytes = MODE
    frames: Callable[[bytes, int], list[bytes]] = field(default=lambda data, _: [data])
    """Gets an answer and its number; returns what comes in its place."""
    seen: list[bytes] = field(default_factory=list, hash=False, compare=False)

    def concerns(self, cob_id, data, node_id):
        return cob_id == 0x580 + node_id and data[1:4] == self.place

    def instead(self, machine, cob_id, data):
        self.seen.append(data)
        return tuple((0, cob_id, one) for one in self.frames(data, len(self.seen)))


@dataclass(frozen=True)
class FrozenAndLost(Fault):
    """The drive leaves operation enabled, and its PDOs go on showing that it is enabled."""

    def set(self, machine, *, present):
        for one in (StatuswordFrozen(self.node_id), OperationLost(self.node_id)):
            one.set(machine, present=present)


def with_a_weight(torque: float) -> dict:
    """Return a machine whose arm has a weight, which its limits would never show."""
    profile = two_axes()
    profile["simulation"]["axes"][1]["effects"] = [
        {"effect": "gravity", "torque": torque, "angle": 1.5}
    ]
    for axis in profile["axes"]:
        axis["may_float"] = False
    return profile


def moved(bench, *faults: tuple[Fault, int], rows=1200, free=()):
    """Move the table slowly with faults to come, so many cycles after the first target."""
    with bench.connected() as group:
        with group.motion(CYCLE, free=free) as motion:
            begun = bench.machine.sync_count
            for fault, after in faults:
                bench.inject(fault, begun + after)
            targets = motion.position + np.outer(np.arange(rows), [2e-4, 0.0])
            motion.stream(lambda before: targets if before is None else None)
            for fault, _ in faults:  # the end of a motion asks again: not what is tried here
                bench.machine.lift(fault)
        for drive in group.drives:
            assert drive.read_int(objects.MODE_DISPLAY) == 1, "its own, as before"
            assert drive.node.sdo.contradicted == ""


def stopped(bench, fault, after, **more) -> SafetyStopError:
    """Return the error that a fault stopped all axes with, in time."""
    with pytest.raises(SafetyStopError) as caught:
        moved(bench, (fault, after), **more)
    error = caught.value
    assert error.axis == "arm"
    assert not error.power_off, "a quick stop holds what a drive without power lets fall"
    assert after <= error.capture.rows <= after + WITHIN
    assert bench.powered() == {}
    assert bench.changed() == {}
    return error


@pytest.mark.parametrize("after", [101, 127, 151, 177])  # wherever it comes in the turn
def test_a_weight_falls_only_until_the_mode_is_asked_for(make_bench, after):
    torque, inertia = 0.05, 0.03  # the arm's own less what the coupling takes at most
    bench = make_bench(with_a_weight(torque))
    error = stopped(bench, ModeChanges(ARM, 10), after)
    assert "object 0x6061:00 shows 10 (cyclic torque)" in str(error)
    assert "left mode cyclic position (8)" in str(error)
    assert str(error) not in getattr(error, "__notes__", ()), "it is said once"
    fallen = abs(error.capture.position[-1, 1] - error.capture.position[after, 1])
    assert 0.001 < fallen < 0.5 * torque / inertia * (WITHIN * CYCLE) ** 2


def test_a_drive_that_goes_into_profile_position_is_stopped(bench):
    assert "shows 1 (profile position)" in str(stopped(bench, ModeChanges(ARM), 200))


def test_a_floating_axis_has_a_mode_of_its_own(bench):
    moved(bench, free=("arm",))
    error = stopped(bench, ModeChanges(ARM, 8), 200, free=("arm",))
    assert "left mode cyclic torque (10)" in str(error)


def test_a_lost_axis_whose_statusword_is_stuck_is_stopped_in_time(bench):
    error = stopped(bench, FrozenAndLost(ARM), 200)
    assert "show statusword 0x1237 (operation enabled)" in str(error)
    assert "object 0x6041:00) shows 0x0240 (switch on disabled)" in str(error)


SOUND = {
    "its answers come twice": Answers(ARM, frames=lambda data, _: [data, data]),
    "a wrong one after each": Answers(ARM, frames=lambda data, _: [data, mode(10)]),
    "a wrong one before each": Answers(ARM, frames=lambda data, _: [mode(10), data]),
    "a wrong one twice before each": Answers(ARM, frames=lambda d, _: [mode(10), mode(10), d]),
    "one is wrong": Answers(ARM, 1, frames=lambda *_: [mode(10)]),
    "every second one is wrong": Answers(ARM, frames=lambda d, n: [d if n % 2 else mode(10)]),
    "all are wrong, each otherwise": Answers(ARM, frames=lambda _, n: [mode(20 + n)]),
    "one state is wrong": Answers(ARM, 1, place=STATE, frames=lambda *_: [state(OFF)]),
    "a wrong state after each": Answers(ARM, place=STATE, frames=lambda d, _: [d, state(OFF)]),
    "its state without its other bits": Answers(
        ARM, place=STATE, frames=lambda d, n: [state(0x0027 | n % 2 << 10)]
    ),
    "another value size": SdoAnswerWrong(ARM, how="other value size"),
    "three bytes": SdoAnswerWrong(ARM, how="truncated"),
    "another object": SdoAnswerWrong(ARM, how="other sub-index"),
    "no answer": SdoSilent(ARM, 0x6061),
    "refused": SdoRefused(ARM, 0x6041),
    "late by a request": SdoAnswerLate(ARM, delay=0.06),
    "too late": SdoAnswerLate(ARM, delay=0.7),
    "a stranger who reads": Stranger(ARM, 0x600 + ARM, REQUESTS[ARM][0], period=0.007),
    "a stranger who is told otherwise": Stranger(ARM, 0x580 + ARM, mode(10), period=0.3, times=1),
}


@pytest.mark.parametrize("name", SOUND)
def test_a_sound_axis_goes_on(bench, name):
    moved(bench, (SOUND[name], 30))
    assert bench.powered() == {}


@pytest.mark.parametrize("silent", [SdoSilent(TABLE, 0x6061), SdoAnswerLate(TABLE, delay=0.7)])
def test_a_drive_that_gives_no_answer_does_not_keep_the_others_from_being_asked(bench, silent):
    with pytest.raises(SafetyStopError, match=r"arm: .*0x6061:00 shows 10") as caught:
        moved(bench, (silent, 10), (ModeChanges(ARM, 10), 300))
    assert caught.value.capture.rows <= 300 + WITHIN


def test_a_drive_that_does_not_tell_its_mode_is_asked_for_its_state_all_the_same(bench):
    with pytest.raises(SafetyStopError, match=r"arm: .* shows 0x0240") as caught:
        moved(bench, (SdoSilent(ARM, 0x6061), 10), (FrozenAndLost(ARM), 300), rows=2000)
    assert caught.value.capture.rows <= 300 + 2 * PATIENCE + WITHIN


def test_a_wrong_answer_that_is_confirmed_stops(bench):
    """Else those above could not fail."""
    with pytest.raises(SafetyStopError, match=r"arm: .*0x6061:00 shows 10"):
        moved(bench, (Answers(ARM, 2, frames=lambda *_: [mode(10)]), 30))


def test_somebody_else_s_write_still_stops_all_axes(bench):
    write = Stranger(ARM, 0x600 + ARM, bytes.fromhex("2F60600001000000"), times=1)
    with pytest.raises(SafetyStopError, match="a write to object 0x6060:00 of arm"):
        moved(bench, (write, 300))


def test_one_drive_is_asked_at_a_time_and_both_as_often(bench):
    bench.listen()
    moved(bench, rows=1000)
    frames = bench.heard()
    begun = [f.sync for f in frames if f.cob_id == 0x200 + ARM and f.data[:2] == b"\x0f\x00"]
    asked = [
        (f.sync, f.cob_id - 0x600, f.data)
        for f in frames
        if f.data in REQUESTS.get(f.cob_id - 0x600, ()) and begun[0] < f.sync < begun[-1]
    ]
    assert 1000 / EVERY - 2 <= len(asked) <= 1000 / EVERY
    assert all(b[0] - a[0] == EVERY for a, b in pairwise(asked))
    what = [(node, data) for _, node, data in asked]
    assert all(len(set(what[k : k + 4])) == 4 for k in range(len(what) - 4))


@pytest.mark.parametrize("bitrate", [10_000, 50_000, 125_000, 500_000, 1_000_000])
@pytest.mark.parametrize("axes", [1, 2, 6, 20])
def test_it_fits_into_what_cyclic_frames_leave_free(axes, bitrate):
    cycle = shortest_cycle(axes, bitrate)
    bits = 2 * frame_bits(8) / Asked([], cycle).every
    assert CyclicLoad(axes, cycle, bitrate).share <= MAX_CYCLIC_LOAD
    assert bits / (cycle * bitrate) < 1 - MAX_CYCLIC_LOAD
