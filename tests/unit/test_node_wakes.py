"""How a node is waited for that does not answer, or not rightly."""

import can
import pytest

from drives.canopen_drive.drive import CanopenDrive
from drives.canopen_drive.line import Line
from drives.errors import SdoError
from drives.objects import DEVICE_TYPE
from drives.profile import load_drive, load_machine
from tests.unit.scripted_bus import ScriptedBus, frame

PATIENCE, ANSWER_TIME, LEAST_PAUSE = 10.0, 0.5, 0.1
RIGHT = bytes.fromhex("4300100092010200")
OTHER = bytes.fromhex("4300100092010300")
MOST_FRAMES = 1000


class BoundedBus(ScriptedBus):
    """A bus on which a loop without end fails in place of hanging."""

    tried = 0

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        self.tried += 1
        assert self.tried <= MOST_FRAMES, f"{self.tried} frames until {self.now():g} s"
        super().send(msg, timeout)


def drive_on(bus: ScriptedBus) -> CanopenDrive:
    machine = load_machine("turntable-arm")
    axis = machine.axes[0]
    return CanopenDrive(Line(bus), axis, load_drive(axis.drive))


def always(*answers: bytes):
    """Return a far end that gives these answers to each SDO request of node 11."""

    def answer(message: can.Message) -> list[can.Message]:
        return [frame(0x58B, data) for data in answers if message.arbitration_id == 0x60B]

    return answer


@pytest.mark.parametrize(
    "answers",
    [(), (b"",), (RIGHT[:4],), (bytes.fromhex("4301100092010200"),) * 1000],
    ids=["none", "empty", "short", "too many about another object"],
)
def test_a_node_without_a_right_answer_is_called_slowly_and_given_up(answers):
    bus = BoundedBus(always(*answers))
    assert not drive_on(bus).wakes(PATIENCE)
    assert PATIENCE <= bus.now() <= PATIENCE + 2 * ANSWER_TIME
    calls = [m for m in bus.sent if m.arbitration_id == 0]
    assert 10 <= len(calls) <= PATIENCE / LEAST_PAUSE + 1


def test_a_bus_that_takes_no_frames_is_given_up():
    bus = BoundedBus(refuses=can.CanOperationError("no buffer"))
    assert not drive_on(bus).wakes(PATIENCE)
    assert PATIENCE <= bus.now() <= PATIENCE + 2 * ANSWER_TIME


def test_two_drives_that_contradict_each_other_are_not_waited_for():
    bus = BoundedBus(always(RIGHT, OTHER))
    drive = drive_on(bus)
    assert drive.answers()  # the second answer is still to be heard
    drive.wait(ANSWER_TIME)
    began, sent = bus.now(), len(bus.sent)
    assert not drive.wakes(PATIENCE)
    assert bus.now() == began
    assert len(bus.sent) == sent
    with pytest.raises(SdoError, match=r"two answers came about 0x1000:00 that differ"):
        drive.read(DEVICE_TYPE)


def test_a_node_that_boots_meanwhile_is_found():
    bus = BoundedBus()
    bus._answer = lambda message: always(RIGHT)(message) if bus.now() > 3.0 else []
    assert drive_on(bus).wakes(PATIENCE)
    assert 3.0 < bus.now() < 3.0 + 2 * ANSWER_TIME
