"""Ctrl-C in the middle of work whose errors become other words: it stays a stop, wherever it comes."""

import signal
from pathlib import Path

import can
import pytest

from drives.bus import adapters, close_bus, opening
from drives.bus.trouble import bus_state
from drives.canopen_drive import CanopenDrive, connect
from drives.canopen_drive.line import Line
from drives.canopen_drive.recovery import recover
from drives.cia402 import PowerState
from drives.errors import BusError, NotSupportedError, UserStopError
from drives.objects import ObjectAddress, ObjectInfo
from drives.parameters.access import unlock
from drives.profile import BusProfile, eds, load_drive, load_machine
from drives.replay import read_trace, reading
from drives.sim.faces import face_of
from drives.sim.faces.others import PASSWORD
from drives.sim.lockstep_bus import LockstepBus
from drives.sim.machine import SimulatedDrive, SimulatedMachine, simulated_machine
from drives.sim.plant import ChainParameters
from fieldtool.cli import stop_key
from fieldtool.records.session_folder import SessionFolder
from fieldtool.workflow import reporting

NODE = 5
TO_NODE, TO_ALL_DRIVES = 0x600 + NODE, 0x000
PRE_OPERATIONAL, NMT_PRE_OPERATIONAL, NMT_RESET_COMMUNICATION = 127, 0x80, 0x82
WORD = PASSWORD.decode()


def press(*_: object, **__: object) -> None:
    """Press Ctrl-C."""
    signal.raise_signal(signal.SIGINT)


@pytest.fixture(autouse=True)
def _key(monkeypatch: pytest.MonkeyPatch):
    """The command line's own handler; no motion has asked for a stop for a long time."""
    monkeypatch.setattr(stop_key, "ASKED_WITHIN", -1.0)
    with stop_key.stop_key():
        yield


class PressingBus(LockstepBus):
    """A bus on which Ctrl-C is pressed at a frame of the host's, before it goes out."""

    at = staticmethod(lambda _message: False)
    refusing = staticmethod(lambda _message: False)

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        if self.at(msg):
            self.at = lambda _message: False
            press()
        if self.refusing(msg):
            raise can.CanOperationError("no buffer")
        super().send(msg, timeout)


@pytest.fixture
def connected():
    """Return a drive of a face as the host sees it, and its bus."""
    buses = []

    def one(face: str, **axis_changes: object):
        chain = ChainParameters((0.02,), (), (), 0.02)
        simulated = SimulatedDrive(
            "x", NODE, chain, 4.0, 12.0, encoder_counts_per_rev=8192, face=face_of(face)
        )
        bus = PressingBus(machine=SimulatedMachine((simulated,)))
        buses.append(bus)
        axis = load_machine("turntable-arm").axes[0]
        axis = axis.model_copy(update={"name": "x", "node_id": NODE, **axis_changes})
        return CanopenDrive(Line(bus), axis, load_drive(face)), bus

    yield one
    for bus in buses:
        bus.shutdown()


def about(index: int, subindex: int = 0):
    """Return whether a frame asks the drive for an object, or writes it."""
    place = index.to_bytes(2, "little") + bytes([subindex])
    return lambda m: m.arbitration_id == TO_NODE and bytes(m.data[1:4]) == place


# --- a drive that is asked ---------------------------------------------------------------------------


def test_a_password_is_not_called_wrong(connected):
    drive, bus = connected("prbt", password=WORD)
    where = drive.profile.unlock.object
    bus.at = about(where.index, where.subindex)
    with pytest.raises(UserStopError):
        unlock(drive)


def test_a_bus_that_is_gone_says_nothing_of_the_password_either(connected):
    drive, bus = connected("prbt", password=WORD)
    where = drive.profile.unlock.object
    bus.refusing = about(where.index, where.subindex)
    with pytest.raises(BusError, match="does not take frames") as gone:
        unlock(drive)
    assert WORD not in str(gone.value)


def test_a_password_that_no_drive_takes_is_still_told(connected):
    drive, _ = connected("prbt", password="\u2028")
    with pytest.raises(NotSupportedError, match="does not take the password"):
        unlock(drive)


@pytest.mark.parametrize(
    ("index", "ask"),
    [
        (0x1000, CanopenDrive.answers),
        (0x1000, lambda drive: drive.wakes(1.0)),
        (0x1003, CanopenDrive.last_error),
    ],
    ids=["answers", "wakes", "last error"],
)
def test_a_drive_that_is_asked_is_not_called_silent(connected, index, ask):
    drive, bus = connected("reference")
    bus.at = lambda message: about(index, message.data[3])(message)
    with pytest.raises(UserStopError):
        ask(drive)


def test_a_drive_that_is_called_in_vain_is_not_called_again(connected):
    drive, bus = connected("reference")
    bus.at = lambda message: message.arbitration_id == TO_ALL_DRIVES
    bus.refusing = about(0x1000)
    with pytest.raises(UserStopError):
        drive.wakes(10.0)
    assert bus.clock.now() < 1.0


def test_what_does_not_answer_is_still_told_apart(connected):
    drive, bus = connected("reference")
    bus.refusing = lambda _message: True
    assert not drive.answers()
    assert drive.last_error() == "not readable"
    assert not drive.wakes(0.5)


def test_a_fault_is_not_reset_after_the_stop(connected):
    drive, bus = connected("epos4")
    drive.write(ObjectInfo(ObjectAddress(0x1016, 1), "UNSIGNED32", "consumer"), 127 << 16 | 50)
    bus.send(can.Message(arbitration_id=0x77F, data=[PRE_OPERATIONAL], is_extended_id=False))
    bus.clock.wait_until(bus.clock.now() + 0.5)
    assert drive.power_state() is PowerState.FAULT
    sent = []

    def asked_after_the_reset(message: can.Message) -> bool:
        sent.append((message.arbitration_id, bytes(message.data)))
        reset = any(data[0] == NMT_RESET_COMMUNICATION for cob, data in sent if cob == 0)
        return reset and about(0x1000)(message)

    bus.at = asked_after_the_reset
    with pytest.raises(UserStopError):
        recover(drive)
    assert sent[-1][1][1:3] == b"\x00\x10", "nothing was sent after it"
    assert drive.power_state() is PowerState.FAULT


def test_a_motion_s_last_commands_go_out_and_the_stop_counts():
    machine = load_machine("turntable-arm")
    bus = PressingBus(machine=simulated_machine(machine))
    pressed = []

    def leaving(message: can.Message) -> bool:
        found = message.arbitration_id == TO_ALL_DRIVES and message.data[0] == NMT_PRE_OPERATIONAL
        pressed.extend([True] if found else [])
        return found

    with connect(machine, bus) as group:
        with pytest.raises(UserStopError), group.motion(0.002):
            bus.at = leaving
        assert pressed
        assert group.warnings == []
        for node in bus.machine.nodes:
            assert node.nmt.state == PRE_OPERATIONAL
            assert not node.motion.powered
            assert node.dictionary.read(0x1016, 1) == 0
    bus.shutdown()


# --- buses and files ---------------------------------------------------------------------------------


class Opening:
    """An adapter at whose opening Ctrl-C is pressed."""

    __init__ = press


def test_a_bus_that_is_opened_is_not_called_broken(monkeypatch):
    monkeypatch.setitem(adapters.BACKENDS, "pressing", (__name__, "Opening"))
    with pytest.raises(UserStopError):
        opening.open_bus(BusProfile(interface="pressing"))


def test_a_bus_that_is_closed_is_not_closed_in_silence():
    class Closing:
        shutdown = press

    with pytest.raises(UserStopError):
        close_bus(Closing())


def test_an_adapter_s_package_is_not_called_missing(monkeypatch, tmp_path):
    (tmp_path / "pressing_adapter.py").write_text(
        "import signal\nsignal.raise_signal(signal.SIGINT)\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setitem(adapters.BACKENDS, "pressing", ("pressing_adapter", "Bus"))
    with pytest.raises(UserStopError):
        adapters.bus_class("pressing")


def test_an_adapter_s_options_are_not_called_unknown(monkeypatch):
    monkeypatch.setattr(adapters, "get_type_hints", press)
    with pytest.raises(UserStopError):
        adapters.known_options("virtual")


def test_an_adapter_that_is_asked_for_its_state_is_not_called_well():
    class Asked:
        state = property(press)

    with pytest.raises(UserStopError):
        bus_state(Asked())


def test_an_eds_is_not_called_damaged(monkeypatch, tmp_path):
    path = tmp_path / "drive.eds"
    path.write_bytes(Path(load_drive("reference").eds_path).read_bytes())
    with monkeypatch.context() as during:
        during.setattr(eds, "import_od", press)
        with pytest.raises(UserStopError):
            eds.read_eds(path)
    assert len(eds.read_eds(path)), "and it is no matter for the next time"


def test_a_trace_is_not_called_whole(monkeypatch, tmp_path):
    path = tmp_path / "trace.log"
    with can.CanutilsLogWriter(path) as log:
        for k in range(3):
            log.on_message_received(can.Message(timestamp=float(k), arbitration_id=k))

    def pressing(file):
        for k, message in enumerate(can.CanutilsLogReader(file)):
            if k == 2:
                press()
            yield message

    monkeypatch.setitem(reading._READERS, ".log", pressing)
    frames = read_trace(path)
    assert [next(frames).arbitration_id for _ in range(2)] == [0, 1]
    with pytest.raises(UserStopError):
        next(frames)


@pytest.mark.parametrize("reader", ["load_machine", "load", "prior_model", "_events"])
def test_a_session_s_file_is_not_called_unreadable(monkeypatch, tmp_path, reader):
    folder = SessionFolder.create(tmp_path / "session")
    folder.note("session", command="run")
    folder.recording.write_bytes(b"")
    folder.machine.write_text(
        Path(load_machine("turntable-arm").path).read_text(encoding="utf-8"), encoding="utf-8"
    )
    monkeypatch.setattr(reporting, reader, press)
    with pytest.raises(UserStopError):
        reporting.material_of(folder)
